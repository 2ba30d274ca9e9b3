"""LinK3D's parts (METHOD part 2, 4.3, D14-D16): edge points, keypoints, descriptors, matching, motion."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import room, rough_tunnel, vlp16_sweep, with_pillar
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc import se3
from mineloc.config import Link3dConfig
from mineloc.data import F64, Sweep
from mineloc.odometry.link3d_descriptors import angle_between, describe, describe_all, describe_plainly, sector_of
from mineloc.odometry.link3d_edges import NOISE, edge_points, lower_gate, smoothness_of, smoothness_plainly
from mineloc.odometry.link3d_keypoints import aggregate, azimuth_rad, cluster_in_sectors, merge_clusters
from mineloc.odometry.link3d_matching import (
    KeypointSweep,
    equal_dimensions,
    equal_dimensions_plainly,
    match_edges,
    match_keypoints,
)
from mineloc.odometry.link3d_motion import motion_of
from mineloc.odometry.link3d_outliers import isolated, isolated_plainly, without_isolated
from mineloc.odometry.loam_features import ring_starts

AT_REST = np.zeros(6)


def by_ring(sweep: Sweep) -> Sweep:
    assert sweep.ring is not None
    return sweep.keep(np.argsort(sweep.ring, kind="stable"))


def pillars() -> Sweep:
    scene = room(9.0, 6.0, 1.5)
    for x, y, half in ((3.0, 2.0, 0.4), (-4.0, 3.0, 0.25), (2.0, -3.5, 0.3), (-3.0, -2.0, 0.2), (6.0, -1.0, 0.35)):
        scene = with_pillar(scene, x, y, half)
    return by_ring(vlp16_sweep(scene, np.eye(4), AT_REST, sigma_m=0.01, rng=np.random.default_rng(1)))


def seen(sweep: Sweep, config: Link3dConfig | None = None) -> KeypointSweep:
    config = config or Link3dConfig()
    return KeypointSweep.of(edge_points(sweep, config), config)


def turned(sweep: Sweep, yaw_rad: float) -> Sweep:
    """The same revolution of a sensor turned about z."""
    points = se3.apply(se3.exp(np.array([0, 0, yaw_rad, 0, 0, 0])), sweep.points_lidar).astype(np.float32)
    return Sweep(sweep.stamp_ns, points, sweep.offsets_ns, sweep.ring, None, sweep.period_ns)


def test_smoothness_is_that_of_the_paper_and_the_mean_is_a_tenth_of_the_sum() -> None:
    sweep = pillars().keep(np.arange(0, 4000))
    starts = ring_starts(sweep)
    for mean in (False, True):
        found = smoothness_of(sweep.points_lidar, starts, mean)
        assert found == pytest.approx(smoothness_plainly(sweep.points_lidar, starts, mean), rel=1e-6, nan_ok=True)
    both = [smoothness_of(sweep.points_lidar, starts, mean) for mean in (False, True)]
    assert both[1] == pytest.approx(both[0] / 10, rel=1e-12, nan_ok=True)  # METHOD D14


def test_pure_noise_has_the_mean_that_the_gate_counts_with() -> None:
    rng = np.random.default_rng(0)
    azimuth = np.linspace(0, 2 * np.pi, 3600, endpoint=False)
    range_m = 20.0 + rng.normal(0, 0.03, 3600)
    points = np.column_stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0 * azimuth]).astype(np.float32)
    smooth = smoothness_of(points, np.array([0, 3600]), False)
    assert np.nanmean(smooth) == pytest.approx(NOISE * 0.03**2, rel=0.1)
    # three times that: next to nothing of it passes for an edge
    assert np.nanmean(smooth > lower_gate(smooth, Link3dConfig(range_sigma_m=0.03))) < 0.06


def test_the_published_gate_starves_in_a_roadway_and_the_adaptive_one_does_not() -> None:
    """METHOD 4.3: 0 to 2 keypoints with the published gate, 9 and more with a lower one."""
    sweep = by_ring(vlp16_sweep(rough_tunnel(0.03), np.eye(4), AT_REST, sigma_m=0.02, rng=np.random.default_rng(2)))
    published = Link3dConfig(gate="fixed", min_points=12, cluster_min_points=10)
    assert len(seen(sweep, published).keypoints) <= 2
    assert len(seen(sweep).keypoints) >= 9


def test_azimuth_keeps_its_quadrant() -> None:
    """METHOD D15: B(2)'s arctangent of a quotient takes opposite directions for one."""
    points = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, -1e-20, 0]], np.float32)
    assert azimuth_rad(points) == pytest.approx(np.array([0.25, 0.75, 1.25, 1.75, 0.0]) * np.pi)
    assert azimuth_rad(points).max() < 2 * np.pi  # not 2π for a rounding below 0


def test_a_point_that_misses_the_last_cluster_opens_its_own() -> None:
    """In the authors' code a point that fails x or y but not the range is lost (METHOD 4.3)."""
    a = np.repeat([[5.0, 0.0, 0.0]], 6, axis=0)
    b = np.repeat([[4.98, 0.35, 0.0]], 6, axis=0)  # the same range, more than 0.3 m aside
    points = np.concatenate([a, b]).astype(np.float32)
    found = cluster_in_sectors(points, np.zeros(12, np.int64), np.arange(12), 6, 0.4, 0.3)
    assert found.tolist() == [0] * 6 + [1] * 6


def test_no_cluster_merges_with_itself_and_few_points_are_no_keypoint() -> None:
    """In the authors' code every cluster counts its own points twice: the least of 12 is in effect 10 (METHOD 4.3)."""
    points = np.repeat([[5.0, 0.0, 0.0], [5.0, 0.5, 0.0], [9.0, 3.0, 0.0]], [6, 5, 7], axis=0).astype(np.float32)
    merged = merge_clusters(points, np.repeat([0, 1, 2], [6, 5, 7]), 4, 0.6, 0.8)
    assert merged[0] == merged[6] != merged[11]
    sweep = Sweep(0, points, None, np.tile(np.arange(6, dtype=np.uint16), 3), None)
    edges = edge_points(sweep.keep(np.argsort(sweep.ring, kind="stable")), Link3dConfig())
    assert len(edges.sweep) == 0  # the ends of rings say nothing
    sizes = np.bincount(merged)
    assert sorted(sizes.tolist()) == [7, 11]


def test_keypoints_stand_on_the_pillars() -> None:
    keypoints = seen(pillars()).keypoints
    assert len(keypoints) >= 8
    corners = [(3.0, 2.0, 0.4), (-4.0, 3.0, 0.25), (2.0, -3.5, 0.3), (-3.0, -2.0, 0.2), (6.0, -1.0, 0.35)]
    near = [
        min(np.abs(np.hypot(*(keypoints.points_lidar[:, :2] - [x, y]).T) - 0).min() for x, y, _ in [corner])
        for corner in corners
    ]
    assert max(near) < 0.8
    assert (np.diff(keypoints.sharpest) != 0).all()


@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(-10, 10), st.floats(-10, 10))
def test_the_angle_is_the_arctangent_and_never_nan(x1: float, y1: float, x2: float, y2: float) -> None:
    found = angle_between(x1, y1, x2, y2)
    assert 0 <= found < 2 * np.pi
    if np.hypot(x1, y1) > 1e-3 and np.hypot(x2, y2) > 1e-3:
        expected = (np.arctan2(y2, x2) - np.arctan2(y1, x1)) % (2 * np.pi)
        assert min(abs(found - expected), 2 * np.pi - abs(found - expected)) < 1e-6


def test_on_the_line_the_dot_product_decides() -> None:
    """METHOD D16."""
    assert angle_between(1, 2, 2, 4) == 0.0
    assert angle_between(1, 2, -2, -4) == pytest.approx(np.pi)
    assert sector_of(2 * np.pi - 1e-9, 180) == 0


keypoint_sets = st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20)), min_size=5, max_size=12, unique=True)


@settings(deadline=None)
@given(keypoint_sets)
def test_the_descriptor_kernel_is_the_plain_version(places: list[tuple[float, float]]) -> None:
    xy = np.round(np.array(places), 2)
    # on a sector's border rounding decides: the two ways of computing the angle may differ there
    found, expected = describe_all(xy, 180, 3, 0.1), describe_plainly(xy, 180, 3, 0.1)
    assert (np.abs(found - expected) < 1e-5).mean() > 0.97


def test_descriptors_do_not_turn_with_the_sensor() -> None:
    xy = np.random.default_rng(3).uniform(-15, 15, (14, 2))
    turn = se3.exp(np.array([0, 0, 1.1, 0, 0, 0]))[:2, :2]
    before, after = (describe_all(p, 180, 3, 0.1) for p in (xy, np.ascontiguousarray(xy @ turn.T)))
    assert (np.abs(before - after) < 1e-5).mean() > 0.99


def test_equally_near_keypoints_are_two() -> None:
    """The authors' code finds the nearest ones by rounded distance, and twins twice (METHOD 4.3)."""
    xy = np.array([[0, 0], [2, 0], [0, 2], [-2, 0], [5, 5.0]])
    row = describe_all(xy, 180, 3, 0.1)[0]
    assert row[0] == pytest.approx(2.0)
    # towards (2, 0), then (0, 2), then (-2, 0): all four directions are seen
    assert {int(np.round(d, 0)) for d in row[row > 0]} == {2, 7}
    assert (row > 0).sum() >= 6


def test_few_keypoints_have_no_descriptor() -> None:
    assert not describe(np.zeros((4, 3)), Link3dConfig()).any()


def test_scores_count_equal_dimensions_and_matches_are_one_to_one() -> None:
    rng = np.random.default_rng(4)
    a = np.round(rng.uniform(1, 30, (9, 180)) * (rng.random((9, 180)) < 0.1), 1).astype(np.float32)
    b = np.concatenate([a[[4, 2, 7]] + np.where(a[[4, 2, 7]] > 0, 0.2, 0).astype(np.float32), a[[2]]])
    assert (equal_dimensions(a, b, 0.201) == equal_dimensions_plainly(a, b, 0.201)).all()
    pairs = match_keypoints(a, b, tolerance_m=0.2, min_score=3)
    assert {tuple(pair) for pair in pairs.tolist()} >= {(4, 0), (7, 2)}
    assert len(set(pairs[:, 0].tolist())) == len(set(pairs[:, 1].tolist())) == len(pairs)
    assert match_keypoints(a[:0], b, tolerance_m=0.2, min_score=3).shape == (0, 2)
    assert len(match_keypoints(a, b, tolerance_m=0.2, min_score=99)) == 0


@pytest.mark.parametrize("yaw_deg", [10, 90, -137])
def test_a_sweep_matches_itself_turned(yaw_deg: float) -> None:
    config, sweep = Link3dConfig(), pillars()
    a, b = seen(turned(sweep, np.radians(yaw_deg))), seen(sweep)
    pairs = match_keypoints(a.descriptors, b.descriptors, tolerance_m=config.tolerance_m, min_score=config.min_score)
    edges = match_edges(a, b, pairs)
    found = motion_of(
        a.edges.sweep.points_lidar[edges[:, 0]].astype(np.float64),
        b.edges.sweep.points_lidar[edges[:, 1]].astype(np.float64),
        inlier_m=config.inlier_m,
        trials=config.trials,
        min_inliers=config.min_matches,
        rng=np.random.default_rng(0),
    )
    assert found is not None
    moved = se3.log(found.T_target_source)
    assert np.degrees(moved[2]) == pytest.approx(-yaw_deg, abs=0.5)
    assert np.linalg.norm(moved[3:]) < 0.05


def test_ransac_finds_the_motion_among_wrong_pairs_or_says_no() -> None:
    rng = np.random.default_rng(5)
    T = se3.exp(np.array([0.02, -0.01, 0.4, 1.0, -0.5, 0.1]))
    source = rng.uniform(-8, 8, (40, 3))
    target = se3.apply(T, source) + rng.normal(0, 0.01, (40, 3))
    target[::3] += rng.uniform(-4, 4, (14, 3))
    law: dict[str, float | int] = {"inlier_m": 0.3, "trials": 64, "min_inliers": 5}
    found = motion_of(source, target, rng=np.random.default_rng(0), **law)
    assert found is not None
    assert np.abs(se3.log(se3.inverse(T) @ found.T_target_source)).max() < 0.02
    assert not found.inliers[::3].any()
    assert motion_of(source[:4], target[:4], rng=np.random.default_rng(0), **law) is None
    on_a_line: F64 = np.outer(np.arange(10.0), [1.0, 2.0, 3.0])
    assert motion_of(on_a_line, on_a_line, rng=np.random.default_rng(0), **law) is None


def test_grains_of_dust_go_and_walls_stay() -> None:
    sweep = pillars()
    points = sweep.points_lidar.copy()
    dust = np.random.default_rng(6).choice(len(points), 40, replace=False)
    points[dust] *= 0.5
    dusty = Sweep(sweep.stamp_ns, points, None, sweep.ring, None)
    alone = isolated(points, ring_starts(dusty), 0.5, 0.05)
    assert (alone == isolated_plainly(points, ring_starts(dusty), 0.5, 0.05)).all()
    assert alone[dust].mean() > 0.9
    assert alone.mean() < 0.005
    assert len(without_isolated(dusty, gap_m=0.5, gap_ratio=0.05)) == len(points) - alone.sum()


def test_a_sweep_without_edges_has_no_keypoints() -> None:
    empty = Sweep(0, np.zeros((0, 3), np.float32), None, np.zeros(0, np.uint16), None)
    found = seen(empty)
    assert len(found.keypoints) == 0
    assert len(aggregate(found.edges, Link3dConfig())) == 0
    assert match_edges(found, found, np.zeros((0, 2), np.int64)).shape == (0, 2)
