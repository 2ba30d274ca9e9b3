"""Tracking in a prior map of wall points: held where the map fits, on odometry alone where it does not."""

from __future__ import annotations

import numpy as np
import pytest
from map_clouds import cloud_of
from rough_mine import Drifted, WallPoints, fly_along, ring, roadway_along

from mineloc import se3
from mineloc.config import Config, GraphConfig, OdometryConfig, PriorMapConfig
from mineloc.data import F64, Fix
from mineloc.localize.map_tracker import MapTracker
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.prior_map import PriorMap

ORIGIN = np.array([512_000.0, 4_398_000.0, 2_300.0])
WIDE = np.diag([np.radians(0.5) ** 2] * 2 + [np.radians(3.0) ** 2] + [0.5**2] * 3)


def prior_map(points_m: F64) -> PriorMap:
    return PriorMap(cloud_of(points_m, origin_m=ORIGIN), PriorMapConfig(), OdometryConfig())


def dense(mine: WallPoints) -> F64:
    """A map has a point every 8 cm or so: the mine's own, and those half way between."""
    rings = mine.points_m.reshape(-1, 40, 3)
    along = np.concatenate([rings, 0.5 * (rings + np.roll(rings, -1, axis=0))])
    return np.concatenate([along, 0.5 * (along + np.roll(along, -1, axis=1))]).reshape(-1, 3)


@pytest.fixture(scope="module")
def mine() -> WallPoints:
    return roadway_along(ring(13.0), rough_m=0.12, rng=np.random.default_rng(1))


@pytest.fixture(scope="module")
def flown(mine: WallPoints) -> Drifted:
    """Once around, with odometry that turns 0.05° a metre too much."""
    rng = np.random.default_rng(2)
    return fly_along(ring(13.0)[::4], mine, sigma_rad=0.001, sigma_m=0.01, rng=rng, bias_rad=0.0009)


def track(flown: Drifted, prior: PriorMap, *, off: F64 | None = None) -> tuple[list[Fix], F64, MapTracker]:
    """Fixes and (n,) errors of the tracked positions in metres; the start is wrong by `off`."""
    shifted = flown.truth.copy()
    shifted[:, :3, 3] += ORIGIN
    start = shifted[0] @ se3.exp(np.zeros(6) if off is None else off)
    tracker = MapTracker(prior, Config(), PoseFilter(start, WIDE, GraphConfig()))
    errors = []
    for keyframe, edge, T in zip(flown.keyframes, flown.edges, shifted, strict=True):
        tracker.follow(keyframe, edge)
        errors.append(np.linalg.norm((se3.inverse(T) @ tracker.filter.T_map_lidar)[:3, 3]))
    return tracker.fixes, np.array(errors), tracker


def drift_of(flown: Drifted) -> float:
    return float(
        np.linalg.norm(flown.keyframes[-1].T_odom_lidar[:3, 3] - flown.truth[-1, :3, 3] + flown.truth[0, :3, 3])
    )


def test_the_map_holds_what_odometry_loses(mine: WallPoints, flown: Drifted) -> None:
    off = np.array([0.0, 0.0, np.radians(2.0), 0.3, -0.3, 0.1])
    fixes, errors, _ = track(flown, prior_map(dense(mine)), off=off)
    assert np.mean([fix.trusted for fix in fixes]) > 0.95
    assert errors[5:].max() < 0.06
    assert np.median(errors[5:]) < 0.02


def test_a_fix_is_as_sure_as_it_says(mine: WallPoints, flown: Drifted) -> None:
    fixes, _, _ = track(flown, prior_map(dense(mine)))
    squares = []
    for fix, T in zip(fixes, flown.truth, strict=True):
        if not fix.trusted:
            continue
        true = T.copy()
        true[:3, 3] += ORIGIN
        error = se3.log(se3.rigid(se3.inverse(true) @ fix.T_map_lidar))
        squares.append(error @ np.linalg.solve(fix.covariance, error) / 6.0)
        assert 0.05 <= np.sqrt(np.linalg.eigvalsh(fix.covariance[3:, 3:])).min() < 0.08
    assert max(squares) < 1.0


@pytest.mark.parametrize("wrong", ["shifted by 50 m", "another mine"])
def test_a_wrong_map_gives_no_fix_and_odometry_goes_on(mine: WallPoints, flown: Drifted, wrong: str) -> None:
    if wrong == "another mine":
        line = np.column_stack([np.linspace(-40, 40, 320), np.linspace(3, 9, 320), np.zeros(320)])
        points = dense(roadway_along(line, rough_m=0.12, rng=np.random.default_rng(9)))
    else:
        points = dense(mine) + np.array([50.0, 0.0, 0.0])
    fixes, errors, tracker = track(flown, prior_map(points))
    assert not any(fix.trusted for fix in fixes[8:])
    assert all(fix.reason for fix in fixes if not fix.trusted)
    # nothing but odometry: the pose is its chain, the covariance grows
    assert np.trace(tracker.filter.covariance[3:, 3:]) > np.trace(WIDE[3:, 3:])
    assert np.isfinite(errors).all()


def test_a_hole_in_the_map_is_flown_over_by_odometry_and_left_again(mine: WallPoints, flown: Drifted) -> None:
    points = dense(mine)
    angle = np.arctan2(points[:, 1], points[:, 0])
    fixes, errors, _ = track(flown, prior_map(points[(angle < 1.2) | (angle > 2.2)]))
    at = np.arctan2(flown.truth[:, 1, 3], flown.truth[:, 0, 3])
    inside = (at > 1.6) & (at < 1.8)
    assert inside.sum() >= 2
    assert not any(fix.trusted for fix, within in zip(fixes, inside, strict=True) if within)
    after = at < -0.5
    assert errors[after].max() < 0.06


def test_a_smooth_tube_holds_nothing_along_its_axis() -> None:
    line = np.column_stack([np.arange(0, 60, 0.25), np.zeros(240), np.zeros(240)])
    tube = roadway_along(line, rough_m=0.0, rng=np.random.default_rng(3))
    T = np.eye(4)
    T[:3, 3] = [30.0, 0.0, 0.0]
    seen = tube.seen_from(T, np.random.default_rng(4))
    T[:3, 3] += ORIGIN
    found = prior_map(dense(tube)).register(seen, T, WIDE)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.information)))[3:]
    assert sigma[0] > 5 * sigma[1]
    assert not found.reason


def test_a_keyframe_without_points_is_refused(mine: WallPoints) -> None:
    found = prior_map(dense(mine)).register(np.zeros((0, 3), np.float32), np.eye(4), WIDE)
    assert "0 matches" in found.reason
