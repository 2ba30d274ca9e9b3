"""The voxels of a growing map against plain numpy, and what does not go in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc import se3
from mineloc.config import MapConfig
from mineloc.mapping.map_builder import SHARDS, MapBuilder
from mineloc.mapping.voxel_moments import (
    COUNT,
    LAST,
    NEAR_M2,
    NEAREST,
    VISITS,
    Voxels,
    VoxelTable,
    gather_points,
    no_voxels,
    unpack,
    voxels_plainly,
)

SPREAD, RANGE_M = 0.02, 15.0


def _gathered(points: np.ndarray, T_map_lidar: np.ndarray, voxel_m: float) -> Voxels:
    out = no_voxels(len(points))
    count = gather_points(points, np.ascontiguousarray(T_map_lidar[:3]), RANGE_M, SPREAD, 1.0 / voxel_m, out)
    assert count >= 0
    return out.take(slice(0, count))


def _sorted(tables: list[VoxelTable]) -> Voxels:
    moments = np.concatenate([table.voxels().moments for table in tables])
    keys = np.concatenate([table.voxels().keys for table in tables])
    return Voxels(keys, moments, moments.view(np.int32)).take(np.argsort(keys))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([1, 4]), st.floats(0.05, 0.5))
def test_voxels_are_those_of_plain_numpy(seed: int, shards: int, voxel_m: float) -> None:
    rng = np.random.default_rng(seed)
    clouds = [rng.normal(0, 6, (300, 3)) * [1, 1, 0.1] for _ in range(4)]
    poses = se3.exp(rng.normal(0, 1, (4, 6)))
    tables = [VoxelTable(k, shards) for k in range(shards)]
    for visit, (cloud, T) in enumerate(zip(clouds, poses, strict=True)):
        for table in tables:
            table.insert(_gathered(cloud, T, voxel_m), visit)
    ours = _sorted(tables)
    placed = np.concatenate([se3.apply(T, cloud) for T, cloud in zip(poses, clouds, strict=True)])
    visits = np.repeat(np.arange(4), 300)
    theirs = voxels_plainly(
        placed, poses[visits, :3, 3], visits, voxel_m=voxel_m, max_range_m=RANGE_M, spread_pm2=SPREAD
    )
    np.testing.assert_array_equal(ours.keys, theirs.keys)
    # float32 sums of at most 1200 offsets of half an edge
    np.testing.assert_allclose(ours.moments[:, :NEAR_M2], theirs.moments[:, :NEAR_M2], atol=2e-5, rtol=1e-4)
    np.testing.assert_allclose(ours.moments[:, NEAR_M2], theirs.moments[:, NEAR_M2], rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(ours.tallies[:, COUNT : NEAREST + 1], theirs.tallies[:, COUNT : NEAREST + 1])
    cells = np.floor(placed / voxel_m)
    assert {tuple(cell) for cell in unpack(ours.keys)} <= {tuple(cell) for cell in cells.astype(int)}


def test_table_grows_and_forgets_nothing() -> None:
    rng = np.random.default_rng(1)
    cells = np.unique(rng.integers(-60, 60, (60_000, 3)), axis=0)
    points = (rng.permutation(cells) + 0.5) * 0.1
    table = VoxelTable(0, 1)
    for visit, part in enumerate(np.array_split(points, 7)):
        table.insert(_gathered(part, np.eye(4), 0.1), visit)
        table.insert(_gathered(part, np.eye(4), 0.1), visit)
    voxels = table.voxels()
    assert len(table) == len(cells)
    assert (voxels.tallies[:, COUNT] == 2).all()
    assert (voxels.tallies[:, VISITS] == 1).all()
    np.testing.assert_array_equal(voxels.tallies[:, LAST], voxels.tallies[:, NEAREST])
    assert {tuple(cell) for cell in unpack(voxels.keys)} == {tuple(cell) for cell in cells}


def test_map_is_the_same_at_any_origin_and_however_clouds_are_cut() -> None:
    """A mine grid: seven digits before the point and still the same map to a tenth of a millimetre."""
    rng = np.random.default_rng(2)
    clouds = [(rng.normal(0, 1, (2000, 3)) * [8, 2, 0.01]).astype(np.float32) for _ in range(6)]
    poses = se3.exp(np.column_stack([np.zeros((6, 2)), rng.normal(0, 1, 6), rng.normal(0, 2, (6, 3)) * [1, 1, 0]]))
    maps = []
    for grid in (np.zeros(3), np.array([500_000.0, 7_100_000.0, -350.0])):
        builder = MapBuilder(MapConfig(voxel_m=0.2), origin_m=grid)
        for cloud, T in zip(clouds, poses, strict=True):
            placed = T.copy()
            placed[:3, 3] += grid
            builder.insert(cloud, placed)
        maps.append(builder.cloud())
    near, far = maps
    assert len(near) > 1000
    # a point on the border of two voxels may change sides by rounding
    assert abs(len(far) - len(near)) <= 2
    if len(far) == len(near):
        np.testing.assert_allclose(far.points_m, near.points_m, atol=1e-4)
    np.testing.assert_allclose(far.points_map - far.origin_m, far.points_m, atol=1e-8)


def test_points_that_are_no_numbers_or_out_of_reach_are_refused() -> None:
    builder = MapBuilder(MapConfig(), origin_m=np.zeros(3))
    builder.insert(np.zeros((0, 3), np.float32), np.eye(4))
    for bad in (np.nan, np.inf, 1e7):
        with pytest.raises(ValueError, match="not finite or more than a million voxels"):
            builder.insert(np.array([[1, 1, 1], [bad, 0, 0]], np.float32), np.eye(4))
    builder.insert(np.array([[1, 1, 1]], np.float32), np.eye(4))
    assert len(builder) == 1
    with pytest.raises(ValueError, match="origin_m"):
        MapBuilder(MapConfig(), origin_m=np.array([0.0, np.nan, 0.0]))
    assert SHARDS & (SHARDS - 1) == 0


def test_far_points_count_less_and_those_beyond_the_range_not_at_all() -> None:
    weights = [_gathered(np.array([[r, 0.0, 0.0]]), np.eye(4), 0.1).moments[:, 0] for r in (1.0, 14.0, 16.0)]
    # at r = spread ** -0.5 = 7.1 m the noise is √2 of that near by, so the weight is half
    half = _gathered(np.array([[SPREAD**-0.5, 0.0, 0.0]]), np.eye(4), 0.1).moments[0, 0]
    assert half == pytest.approx(0.5, abs=1e-6)
    assert weights[0][0] == pytest.approx(1.0, abs=1e-3)
    assert weights[1][0] == pytest.approx(1 / (1 + (SPREAD * 14**2) ** 2), rel=1e-6)
    assert len(weights[2]) == 0
