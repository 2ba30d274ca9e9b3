"""The filter and the two factors of an intersection: its pose, and its point alone (paper A, eq. 21-32)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plan_scenes import TwoIntersections, edges_of, flown

from mineloc import se3
from mineloc.config import Config, GraphConfig, layered_config
from mineloc.data import F64, Fix, IntersectionDatabase, RelativePose
from mineloc.graph.measurements import PointFix, point_jacobian
from mineloc.localize.map_tracker import IntersectionTracker
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.recognition import Recognizer
from mineloc.localize.sequence import RoadwaySequence

GRAPH = GraphConfig()


def some_pose(seed: int) -> F64:
    return se3.exp(np.random.default_rng(seed).normal(size=6) * [1, 1, 1, 20, 20, 20])


@given(seed=st.integers(0, 1000))
def test_the_jacobian_of_a_point_is_the_numeric_one(seed: int) -> None:
    T, point = some_pose(seed), np.random.default_rng(seed + 1).normal(size=3) * 5
    numeric = np.array(
        [
            (se3.apply(T @ se3.exp(step), point[None]) - se3.apply(T @ se3.exp(-step), point[None]))[0] / 2e-6
            for step in 1e-6 * np.eye(6)
        ]
    ).T
    assert point_jacobian(T, point) == pytest.approx(numeric, abs=1e-6)


@given(seed=st.integers(0, 1000))
def test_a_point_that_is_sure_is_where_it_is_afterwards(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, point = some_pose(seed), rng.normal(size=3) * 6
    at = se3.apply(truth, point[None])[0]
    believed = truth @ se3.exp(rng.normal(size=6) * [0.002, 0.002, 0.01, 0.2, 0.2, 0.1])
    covariance = np.diag(np.square([0.002, 0.002, 0.01, 0.2, 0.2, 0.1]))
    known = PoseFilter(believed, covariance, GRAPH)
    known.correct_by_point(PointFix(0, at, point, 1e-8 * np.eye(3)))
    assert np.linalg.norm(se3.apply(known.T_map_lidar, point[None])[0] - at) < 0.02
    # three numbers cannot make six sure
    assert np.linalg.eigvalsh(known.covariance)[-1] > 1e-5
    assert np.linalg.eigvalsh(covariance - known.covariance)[0] > -1e-9


@given(seed=st.integers(0, 1000))
def test_a_fix_of_a_point_is_the_registration_projected_on_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, point = some_pose(seed), rng.normal(size=3) * 10
    root = rng.normal(size=(6, 6)) * 0.05
    fix = Fix(0, 7, T, root @ root.T + 1e-6 * np.eye(6), True, point_map=point)
    seen = PointFix.of(fix)
    assert se3.apply(T, seen.point_lidar[None])[0] == pytest.approx(point, abs=1e-9)
    samples = T @ se3.exp(rng.multivariate_normal(np.zeros(6), fix.covariance * 1e-4, 4000))
    spread = np.cov((samples[:, :3, :3] @ seen.point_lidar + samples[:, :3, 3]).T)
    assert np.trace(spread) == pytest.approx(1e-4 * np.trace(seen.covariance), rel=0.1)


def test_odometry_that_leaves_a_direction_open_widens_it_and_no_more() -> None:
    open_ahead = RelativePose(0, 1, np.eye(4), np.diag([1e6, 1e6, 1e6, 0.0, 1e4, 1e4]))
    known = PoseFilter(np.eye(4), 1e-6 * np.eye(6), GRAPH)
    known.carry(open_ahead)
    assert np.sqrt(known.covariance[3, 3]) == pytest.approx(GRAPH.relative_max_m, rel=1e-3)
    assert np.sqrt(known.covariance[4, 4]) < 0.02


@pytest.mark.parametrize("factor", ["pose", "position"])
def test_both_factors_hold_a_flight_whose_odometry_drifts(database: IntersectionDatabase, factor: str) -> None:
    config = layered_config([{"intersections": {"factor": factor}}], where="test")
    keyframes, truth = flown(TwoIntersections(), -14.0, 42.0)
    drift = se3.exp(np.array([0, 0, np.radians(0.05), 0.01, 0.01, 0]))
    start = truth[0] @ se3.exp(np.array([0, 0, 0.02, 0.3, 0.2, 0]))
    covariance = np.diag(np.square([0.01, 0.01, 0.04, 0.4, 0.4, 0.05]))
    sequence = RoadwaySequence(database, config.intersections)
    tracker = IntersectionTracker(
        Recognizer(config, database), sequence, config, PoseFilter(start, covariance, config.graph)
    )
    errors, alone = [], start
    for keyframe, edge, T in zip(keyframes, edges_of(keyframes), truth, strict=True):
        moved = None
        if edge is not None:
            moved = RelativePose(edge.i, edge.j, edge.T_i_j @ drift, edge.information * 0.3)
            alone = alone @ moved.T_i_j
        tracker.follow(keyframe, moved)
        errors.append(np.linalg.norm((se3.inverse(T) @ tracker.filter.T_map_lidar)[:3, 3]))
    assert sum(fix.trusted for fix in tracker.fixes) >= 4
    assert np.linalg.norm((se3.inverse(truth[-1]) @ alone)[:3, 3]) > 0.8
    assert errors[-1] < (0.35 if factor == "position" else 0.2)


def test_configuration_knows_two_factors() -> None:
    assert Config().intersections.factor == "pose"
