"""Which points of a map are floor, wall and roof: their height in the gap of the free-space sheet beside them, and
their normal. On rough rock the height says more than the normal (METHOD 5.1)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mineloc.compiled import njit, prange
from mineloc.data import F32, F64, I32, I64, U8, Bool, MapCloud, SurfaceKind
from mineloc.mapping.free_space import WIDE
from mineloc.roadways.sheet import Sheet, clearance_cells

FRINGE = 5
"""So many columns beyond its edge a sheet still says how high a point lies."""
STRAY_M = 1.0
"""A point so far above the roof or below the floor of a gap does not belong to it."""
SURE_M = 0.25
"""So near to floor or roof of its own column, the normal is not asked."""
FLOOR_M, ROOF_M = 0.5, 0.9
"""Up to here a surface that faces up or down is still floor or roof: roofs are arched."""
FACING = 0.5
ROUNDS = 3
"""Times that each cell's floor and roof become the median of those around: pits of one column say nothing."""
OPEN_CELLS = 3.0
"""What stands in the open, so far from every wall, is no wall."""


class InGap(NamedTuple):
    """Where points lie in the free space, n of them.

    Attributes:
        cell: (n,) the cell of the sheet that a point belongs to, -1: none.
        above_floor_m, below_roof_m: (n,) float32 heights in its gap, NaN without one.
        kind: (n,) uint8 `SurfaceKind`.
    """

    cell: I32
    above_floor_m: F32
    below_roof_m: F32
    kind: U8


def classify(cloud: MapCloud, sheet: Sheet) -> InGap:
    """Find the gap of every point and what kind of surface it is.

    Args:
        cloud: the map.
        sheet: its free space, map frame.
    """
    number, cell, ring = _fringe(sheet)
    local = sheet.origin_m - cloud.origin_m[:2]
    at = np.rint((cloud.points_m[:, :2] - local) / sheet.cell_m).astype(np.int64)
    own = at[:, 1] * WIDE + at[:, 0]
    floor, roof = calm(sheet.floor_m, sheet.links), calm(sheet.roof_m, sheet.links)
    open_ = clearance_cells(sheet.links, sheet.column, sheet.row) > OPEN_CELLS
    heights = floor - cloud.origin_m[2], roof - cloud.origin_m[2]
    nearest = _nearest_gap(own, cloud.points_m[:, 2].copy(), number, cell, ring, sheet.cell_m, *heights)
    out = InGap(
        nearest,
        np.full(len(cloud), np.nan, np.float32),
        np.full(len(cloud), np.nan, np.float32),
        np.zeros(len(cloud), np.uint8),
    )
    inside = nearest >= 0
    out.above_floor_m[inside] = cloud.points_m[inside, 2] - heights[0][nearest[inside]]
    out.below_roof_m[inside] = heights[1][nearest[inside]] - cloud.points_m[inside, 2]
    own_column = np.zeros(len(cloud), np.bool_)
    own_column[inside] = (sheet.row * WIDE + sheet.column)[nearest[inside]] == own[inside]
    in_the_open = np.zeros(len(cloud), np.bool_)
    in_the_open[inside] = own_column[inside] & open_[nearest[inside]]
    out.kind[:] = _kinds(out, cloud.normals[:, 2], own_column, in_the_open)
    return out


def _kinds(gap: InGap, up: F32, own_column: Bool, in_the_open: Bool) -> U8:
    above, below = gap.above_floor_m, gap.below_roof_m
    floor = (own_column & (above < SURE_M)) | ((above < FLOOR_M) & (up > FACING))
    roof = (own_column & (below < SURE_M)) | ((below < ROOF_M) & (up < -FACING))
    nowhere = gap.cell < 0
    floor |= nowhere & (up > FACING)
    roof |= nowhere & (up < -FACING)
    kind = np.where(in_the_open, SurfaceKind.OTHER, SurfaceKind.WALL).astype(np.uint8)
    kind[roof] = SurfaceKind.ROOF
    kind[floor & ~(roof & (below < above))] = SurfaceKind.FLOOR
    return kind


def _fringe(sheet: Sheet) -> tuple[I64, I32, I32]:
    """Columns in and around a sheet, sorted: number, a cell that may speak for it, squared distance to it in cells."""
    cell = np.arange(len(sheet), dtype=np.int32)
    number = sheet.row * WIDE + sheet.column
    ring = np.zeros(len(sheet), np.int32)
    edge = np.flatnonzero((sheet.links < 0).any(axis=1)).astype(np.int32)
    steps = [(dx, dy) for dx in range(-FRINGE, FRINGE + 1) for dy in range(-FRINGE, FRINGE + 1)]
    numbers, cells, rings = [number], [cell], [ring]
    for dx, dy in sorted(steps, key=lambda step: step[0] ** 2 + step[1] ** 2):
        if 0 < dx**2 + dy**2 <= FRINGE**2:
            numbers.append(number[edge] + dy * WIDE + dx)
            cells.append(edge)
            rings.append(np.full(len(edge), dx**2 + dy**2, np.int32))
    number, cell, ring = np.concatenate(numbers), np.concatenate(cells), np.concatenate(rings)
    order = np.argsort(number, kind="stable")
    return number[order], cell[order], ring[order]


def calm(values: F64, links: I32) -> F64:
    """(n,) values of cells, each made the median of its own and its neighbours', a few times."""
    for _ in range(ROUNDS):
        values = _medians(values, links)
    return values


@njit(cache=True)
def _medians(values: F64, links: I32) -> F64:
    out = np.empty_like(values)
    around = np.empty(9)
    for i in range(len(values)):
        around[0] = values[i]
        count = 1
        for k in range(8):
            if links[i, k] >= 0:
                around[count] = values[links[i, k]]
                count += 1
        out[i] = np.median(around[:count])
    return out


@njit(cache=True, parallel=True)
def _nearest_gap(own: I64, height: F32, number: I64, cell: I32, ring: I32, cell_m: float, floor: F64, roof: F64) -> I32:
    """(n,) for each point the cell whose gap is nearest, up or down and half as much sideways; -1: none is near."""
    out = np.full(len(own), -1, np.int32)
    for i in prange(len(own)):
        least = STRAY_M
        k = np.searchsorted(number, own[i])
        while k < len(number) and number[k] == own[i]:
            c = cell[k]
            outside = max(floor[c] - height[i], height[i] - roof[c], 0.0) + 0.5 * cell_m * np.sqrt(ring[k])
            if outside < least:
                least = outside
                out[i] = c
            k += 1
    return out
