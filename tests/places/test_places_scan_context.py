from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.config import ScanContextConfig
from mineloc.data import F32, F64
from mineloc.places.scan_context import (
    UNLIKE,
    context_distance,
    context_distance_plainly,
    ring_key,
    scan_context,
    scan_context_plainly,
    sector_key,
    yaw_of_shift,
)

Cell = Literal["max_height", "free_range"]
CELLS: tuple[Cell, ...] = ("max_height", "free_range")
CONFIG = ScanContextConfig()


def cloud(seed: int, n: int) -> F32:
    rng = np.random.default_rng(seed)
    return (rng.normal(0, 1, (n, 3)) * rng.choice([1.0, 10.0, 30.0]) * [1, 1, 0.2]).astype(np.float32)


def context(seed: int, *, filled: float = 1.0) -> F32:
    """Made-up columns, some of them empty."""
    rng = np.random.default_rng(seed)
    out = rng.uniform(0.1, 5.0, (CONFIG.rings, CONFIG.sectors)) * (rng.uniform(size=CONFIG.sectors) < filled)
    return out.astype(np.float32)


def room_seen_from(x_m: float, y_m: float, yaw_rad: float) -> F64:
    """A room of 16 m by 9 m, 4 m high, with a bay in one wall and a pillar: its walls in the frame of a lidar there.

    The lidar stands at (x, y), 1.5 m above the floor, its x axis turned by `yaw_rad` counter-clockwise from the room's.
    """
    ways = np.linspace(0, 2 * np.pi, 3600, endpoint=False)
    flat = np.stack([np.cos(ways), np.sin(ways)], axis=1)
    boxes = [((-8.0, -4.5), (8.0, 4.5)), ((3.0, 4.0), (6.0, 9.0))]
    reach = np.zeros(len(ways))
    for low, high in boxes:  # the far side of each box that the ray reaches through free space
        for _ in range(2):
            at = np.array([x_m, y_m]) + (reach[:, None] + 1e-6) * flat
            inside = np.all((at > low) & (at < high), axis=1)
            with np.errstate(divide="ignore"):
                leave = ((np.where(flat > 0, high, low) - np.array([x_m, y_m])) / flat).min(axis=1)
            reach = np.where(inside, np.maximum(reach, leave), reach)
    to = np.array([-5.0, 2.0]) - [x_m, y_m]
    along, side = flat @ to, flat @ np.array([-to[1], to[0]])
    reach = np.where((along > 0) & (np.abs(side) < 0.6), np.minimum(reach, along), reach)
    heights = np.linspace(-1.5, 2.5, 15)
    walls = (flat * reach[:, None])[:, None, :].repeat(len(heights), axis=1)
    points = np.concatenate([walls, np.broadcast_to(heights[:, None], (*walls.shape[:2], 1))], axis=2).reshape(-1, 3)
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])  # rows times R: p_lidar = Rᵀ p_room


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(0, 500),
    rings=st.integers(1, 30),
    sectors=st.integers(3, 90),
    cell=st.sampled_from(CELLS),
)
def test_the_context_kernels_agree_with_plain_numpy(seed: int, n: int, rings: int, sectors: int, cell: Cell) -> None:
    config = ScanContextConfig(rings=rings, sectors=sectors, lidar_height_m=1.0, cell=cell)
    found, plain = scan_context(cloud(seed, n), config), scan_context_plainly(cloud(seed, n), config)
    assert found.shape == (rings, sectors)
    assert found.dtype == np.float32
    assert np.array_equal(found, plain)


@settings(deadline=None, max_examples=40)
@given(one=st.integers(0, 10_000), other=st.integers(0, 10_000), filled=st.floats(0, 1), ratio=st.floats(0, 1))
def test_the_distance_kernel_agrees_with_plain_numpy(one: int, other: int, filled: float, ratio: float) -> None:
    config = ScanContextConfig(search_ratio=ratio)
    a, b = context(one, filled=filled), context(other, filled=filled)
    distance, shift = context_distance(a, b, config)
    expected, expected_shift = context_distance_plainly(a, b, config)
    assert distance == pytest.approx(expected, abs=1e-9)
    assert shift == expected_shift
    assert 0 <= distance <= UNLIKE


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000), n=st.integers(0, 500), cell=st.sampled_from(CELLS))
def test_the_order_of_the_points_does_not_matter(seed: int, n: int, cell: Cell) -> None:
    points, config = cloud(seed, n), ScanContextConfig(cell=cell)
    order = np.random.default_rng(seed).permutation(n)
    assert np.array_equal(scan_context(points, config), scan_context(points[order], config))


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000), k=st.integers(-60, 60))
def test_a_turn_by_k_sectors_is_shift_k_without_distance(seed: int, k: int) -> None:
    a = context(seed)
    distance, shift = context_distance(a, np.roll(a, k, axis=1), CONFIG)
    assert distance == pytest.approx(0, abs=1e-9)
    assert shift == k % CONFIG.sectors
    assert np.allclose(ring_key(a), ring_key(np.roll(a, k, axis=1)), rtol=1e-6)
    assert np.allclose(np.roll(sector_key(a), k), sector_key(np.roll(a, k, axis=1)), rtol=1e-6)


def test_cells_are_where_the_definition_puts_them() -> None:
    points = np.array([[1, 0.01, 0], [0.01, 3, 1], [-5, -0.01, -0.5], [39.9, -0.01, 0.3], [0.5, 0.02, 4], [40.1, 0, 9]])
    found = scan_context(points, CONFIG)
    filled = {(int(r), int(s)): round(float(found[r, s]), 4) for r, s in np.argwhere(found)}
    # 2 m rings, 6° sectors from +x counter-clockwise, z + 2; the higher of two points stays, what is beyond is dropped
    assert filled == {(0, 0): 6.0, (1, 14): 3.0, (2, 30): 1.5, (19, 59): 2.3}


def test_free_range_is_the_share_of_a_cell_before_the_farthest_point() -> None:
    config = ScanContextConfig(cell="free_range", rings=4, sectors=4, radius_m=8.0)
    # 2 m rings, quadrants: 3 m and less in the first, 5 m in the second, beyond the radius in the third
    points = np.array([[3 * math.cos(0.5), 3 * math.sin(0.5), -1], [1, 1, 5], [0, 5, 9], [-50, -1, 0], [np.nan, -1, 0]])
    expected = [[1, 1, 1, 0], [0.5, 1, 1, 0], [0, 0.5, 1, 0], [0, 0, 1, 0]]
    assert scan_context(points, config) == pytest.approx(np.array(expected))


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("yaw_deg", [10.0, 90.0, 175.0, -60.0, -117.0])
def test_the_yaw_takes_the_query_to_the_match(yaw_deg: float, cell: Cell) -> None:
    yaw, config = math.radians(yaw_deg), ScanContextConfig(cell=cell)
    query, match = room_seen_from(1.0, -0.5, yaw), room_seen_from(1.2, -0.4, 0.0)
    distance, shift = context_distance(scan_context(query, config), scan_context(match, config), config)
    assert distance < config.max_distance
    found = yaw_of_shift(shift, config.sectors)
    # half a sector, and what 0.2 m turn at the nearest wall (4 m)
    assert abs(math.remainder(found - yaw, 2 * math.pi)) < math.radians(3.0 + 3.0)
    c, s = math.cos(found), math.sin(found)
    turned = query @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    again = context_distance(scan_context(turned, config), scan_context(match, config), config)
    assert again[0] < config.max_distance
    assert again[1] in (0, 1, config.sectors - 1)  # nothing is left to turn


def test_yaw_is_within_half_a_turn() -> None:
    assert [yaw_of_shift(k, 4) for k in range(4)] == pytest.approx([0, np.pi / 2, np.pi, -np.pi / 2])


def test_an_empty_or_unfinite_sweep_is_an_empty_context() -> None:
    bad = np.array([[np.nan, 0, 0], [1, np.inf, 0], [1, 1, np.nan], [2, 1, -np.inf], [50, 0, 0]], np.float32)
    for points in (np.zeros((0, 3), np.float32), bad):
        empty = scan_context(points, CONFIG)
        assert not empty.any()
        assert context_distance(empty, empty, CONFIG)[0] == UNLIKE
        assert context_distance(empty, context(1), CONFIG)[0] == UNLIKE


def test_few_columns_in_common_are_nothing_in_common() -> None:
    a = context(3)
    a[:, 17:] = 0  # 17 of 60 columns are left, 18 are asked for
    assert context_distance(a, a, CONFIG)[0] == UNLIKE
    assert context_distance(a, a, ScanContextConfig(min_shared_columns=0.28))[0] < 1e-9


def test_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="shapes"):
        context_distance(context(1), context(1)[:, :30].copy(), CONFIG)
