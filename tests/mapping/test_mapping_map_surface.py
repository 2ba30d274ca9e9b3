"""Normals, joining across a wall, and what is not believed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from mineloc import se3
from mineloc.config import MapConfig
from mineloc.data import MapCloud
from mineloc.mapping.map_builder import MapBuilder
from mineloc.mapping.map_outliers import count_beside
from mineloc.mapping.seen_through import ViewRecorder, seen_through
from mineloc.mapping.surface_thinning import fit_normals
from mineloc.mapping.voxel_moments import REACH, VoxelTable, gather_points, no_voxels, unpack

SIGMA_M = 0.02
NONE_LEFT_OUT = MapConfig(lonely_support=0, view_reach_m=0.001)


def _wall(rng: np.random.Generator, normal: np.ndarray, at_m: float, count: int, half_m: float = 1.5) -> np.ndarray:
    """Points on a plane with noise along its normal."""
    a = np.cross(normal, [0.3, 0.5, 0.8])
    a /= np.linalg.norm(a)
    b = np.cross(normal, a)
    flat = rng.uniform(-half_m, half_m, (count, 2)) @ np.stack([a, b])
    return flat + normal * (at_m + rng.normal(0, SIGMA_M, (count, 1)))


def _map(clouds: list[np.ndarray], config: MapConfig = NONE_LEFT_OUT) -> MapCloud:
    builder = MapBuilder(config, origin_m=np.zeros(3))
    for cloud in clouds:
        builder.insert(cloud, np.eye(4))
    return builder.cloud()


def test_normals_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([_wall(rng, np.array([0, 0, 1.0]), -2, 4000), _wall(rng, np.array([0.6, 0.8, 0]), 3, 4000)])
    out = no_voxels(len(points))
    count = gather_points(points, np.eye(4)[:3].copy(), 50.0, 0.0, 5.0, out)
    table = VoxelTable(0, 1)
    table.insert(out.take(slice(0, count)), 0)
    voxels = table.voxels().take(np.argsort(table.voxels().keys))
    ours = fit_normals(voxels.keys, voxels.moments, 0.2)
    cells = unpack(voxels.keys)
    cell_of = np.floor(points * 5.0).astype(np.int64)
    for k in rng.integers(0, len(cells), 40):
        # the same neighbourhood point by point, a voxel weighing four at most
        beside = (np.abs(cell_of - cells[k]) <= 1).all(axis=1)
        number = np.unique(cell_of[beside], axis=0, return_inverse=True)[1].ravel()
        weight = (np.minimum(np.bincount(number), 4.0) / np.bincount(number))[number]
        covariance = np.cov(points[beside].T, aweights=weight, ddof=0)
        values, vectors = np.linalg.eigh(covariance)
        if beside.sum() > 10 and values[1] > 3 * values[0]:
            assert abs(vectors[:, 0] @ ours[k]) > 0.999


@pytest.mark.parametrize("normal", [[0, 0, 1.0], [1.0, 0, 0], [0.6, 0.64, 0.48], [-0.8, 0.6, 0]])
@pytest.mark.parametrize("at_m", [3.0, 3.05])
def test_noisy_wall_becomes_one_layer_on_the_wall(normal: list[float], at_m: float) -> None:
    """On a border of voxels the means of either half stand 1.6 cm off the wall; joined they must not."""
    rng = np.random.default_rng(3)
    n = np.array(normal)
    cloud = _map([_wall(rng, n, at_m, 8000) for _ in range(4)])
    off = cloud.points_map @ n - at_m
    assert np.sqrt((off**2).mean()) < 0.3 * SIGMA_M
    assert abs(off.mean()) < 0.05 * SIGMA_M
    # one layer: as many points as there are columns of 0.1 m across the dominant axis
    inside = np.abs(cloud.points_map - at_m * n).max(axis=1) < 1.0
    assert len(cloud) == pytest.approx(9.0 * np.abs(n).max() / 0.01, rel=0.12)
    # what the counts tell is what was put in
    assert cloud.counts.sum() == pytest.approx(32_000, rel=0.15)
    assert np.median(cloud.thickness_m[inside]) == pytest.approx(SIGMA_M, rel=0.2)
    # into the open: towards the sensor
    assert (cloud.normals @ n < -0.9).mean() > 0.98
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-5)
    assert (cloud.visits <= 4).all()
    assert cloud.near_m.min() == pytest.approx(at_m, abs=4 * SIGMA_M)


def test_both_sides_of_a_thin_pillar_stay() -> None:
    rng = np.random.default_rng(4)
    up = np.array([0, 0, 1.0])
    two = np.concatenate([_wall(rng, up, 2.0, 9000), _wall(rng, up, 2.5, 9000)])
    heights = _map([two, two]).points_map[:, 2]
    assert (np.minimum(np.abs(heights - 2.0), np.abs(heights - 2.5)) < 5 * SIGMA_M).all()
    assert (heights > 2.25).mean() == pytest.approx(0.5, abs=0.05)


def test_neighbours_are_counted_as_a_tree_counts_them() -> None:
    rng = np.random.default_rng(5)
    cells = np.unique(rng.integers(-8, 8, (900, 3)), axis=0)
    keys = ((cells[:, 0] + REACH) << 42) | ((cells[:, 1] + REACH) << 21) | (cells[:, 2] + REACH)
    order = np.argsort(keys)
    keys, cells = keys[order], cells[order]
    some = rng.random(len(keys)) < 0.6
    tree = KDTree(cells[some])
    theirs = tree.query_ball_point(cells, 1.01, p=np.inf, return_length=True) - some
    np.testing.assert_array_equal(count_beside(keys, keys[some]), theirs)


def _room(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    """Points on the walls of a round room of 5 m, seen from anywhere within."""
    angle, up = rng.uniform(-np.pi, np.pi, count), rng.uniform(-1, 1, count)
    return np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), up])


def test_what_beams_went_through_is_seen_through_and_walls_are_not() -> None:
    rng = np.random.default_rng(6)
    recorder = ViewRecorder(every_m=0.5)
    room = _room(rng)
    for x in (-1.0, -0.8, 0.0, 1.0):  # the second is too near to the first
        T = se3.exp([0, 0, 0.3 * x, x, 0.2, 0])
        recorder.add(se3.apply(se3.inverse(T), room), T[:3])
    views = recorder.views()
    assert len(views.row) == 3
    dust = np.array([[0.2, -1.0, 0.1], [1.5, 2.0, -0.1]], np.float32)
    behind = (1.2 * room[:50]).astype(np.float32)
    wall = room[:500].astype(np.float32)

    def through(points: np.ndarray, often: int, reach_m: float = 8.0) -> np.ndarray:
        return seen_through(points, np.full(len(points), often, np.int32), views, reach_m=reach_m)

    assert through(dust, 2).all()
    assert not through(dust, 4).any()  # there are but three views
    assert not through(dust, 1, reach_m=0.3).any()
    assert not through(wall, 1).any()
    assert not through(behind, 1).any()
    assert not seen_through(dust, np.ones(2, np.int32), ViewRecorder(1.0).views(), reach_m=8.0).any()


def test_dust_and_a_machine_that_drove_on_are_no_rock() -> None:
    """A box stands in the room for two visits of ten, and a share of the points is dust."""
    rng = np.random.default_rng(7)
    builder = MapBuilder(MapConfig(view_every_m=0.2), origin_m=np.zeros(3))
    for visit in range(10):
        T = se3.exp([0, 0, 0.1 * visit, -2.0 + 0.4 * visit, 0.5, 0])
        seen = se3.apply(se3.inverse(T), _room(rng, 20_000))
        seen[:200] *= rng.uniform(0.2, 0.9, (200, 1))
        if visit in (1, 2):
            box = np.column_stack([rng.uniform(0, 0.6, 800), np.full(800, -2.0), rng.uniform(-0.5, 0.5, 800)])
            seen = np.concatenate([seen, se3.apply(se3.inverse(T), box)])
        builder.insert(seen, T)
    radius = np.hypot(*builder.cloud().points_map[:, :2].T)
    walls, others = np.abs(radius - 5) < 0.1, radius < 4.5
    assert walls.sum() > 0.9 * (2 * np.pi * 5 * 2 / 0.01) * 0.8
    # of 2000 grains and 60 voxels of machine
    assert others.sum() < 40
