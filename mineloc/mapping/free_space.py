"""The free-space sheet of a map: gaps between floor and roof points, found a column at a time (METHOD 5.4).

A gap counts if what lies below it faces up and what lies above it faces down: points know which side they were seen
from, so rock between two levels is never taken for a roadway, whatever lies over what.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mineloc.compiled import njit
from mineloc.data import F32, F64, I32, I64, Bool, MapCloud
from mineloc.roadways.sheet import DX, DY, Sheet, components, fill_pinholes, link

SKIN_M = 0.3
"""So thick is what counts as one surface of rough rock within a column."""
LEAST_FACING = 0.25
"""Mean vertical part of the normals that makes a floor or a roof."""
STEP_M = 0.5
"""A floor goes on in the next column if it is no higher or lower than this."""
STRAY_VISITS, STRAY_BESIDE = 2, 2
GROWTHS = 8
"""A floor of which the roof was not seen, or the other way round, is believed so many columns on."""
FILLINGS = 4
SEED_M = 0.6
WIDE = 1 << 31
"""Columns are numbered row · WIDE + column."""


class Columns(NamedTuple):
    """The points of a map by column of the plan, c columns with points in them.

    Attributes:
        number: (c,) rising.
        begin: (c + 1,) where the points of each begin.
        height_m: (n,) rising within a column.
        facing: (n,) vertical part of the normal.
    """

    number: I64
    begin: I64
    height_m: F32
    facing: F32


def free_sheet_of_map(
    cloud: MapCloud, flown_m: F64, *, cell_m: float = 0.2, headroom_m: float = 1.5, opening_m: float = 1.2
) -> Sheet:
    """Where a drone fits: what was flown, and all that it opens into and that was seen.

    Args:
        cloud: the map, levelled.
        flown_m: (k, 3) positions of the drone, map frame. Only parts of the sheet stay that hang together with one;
            with none of them in the sheet, the largest part.
        cell_m: size of the grid.
        headroom_m: least height of a gap.
        opening_m: least height over which two neighbouring gaps must overlap to be linked.
    """
    corner = cloud.points_m[:, :2].min(axis=0, initial=np.inf) if len(cloud) else np.zeros(2)
    # a margin, so that rows and columns beside the first are not negative
    origin = (np.floor(corner / cell_m) - 10.0 + 0.5) * cell_m
    columns = columns_of(cloud, origin, cell_m)
    which, floor, roof = find_gaps(columns, headroom_m)
    number = columns.number[which]
    whole = ~holds_two(number, floor, roof, opening_m)
    number, floor, roof = number[whole], floor[whole], roof[whole]
    sheet = _sheet(cell_m, origin, number % WIDE, number // WIDE, floor, roof, opening_m)
    for _ in range(GROWTHS):
        before = len(sheet)
        sheet = _grown(sheet, columns, opening_m)
        if len(sheet) == before:
            break
    for _ in range(FILLINGS if len(sheet) else 0):
        sheet = fill_pinholes(sheet, opening_m)
    return _in_map(sheet.keep(_reached(sheet, flown_m - cloud.origin_m)), cloud.origin_m)


def columns_of(cloud: MapCloud, origin_m: F64, cell_m: float) -> Columns:
    """Sort the points into the columns of a plan.

    Args:
        cloud: the map.
        origin_m: (2,) centre of cell (0, 0), relative to the map's origin.
        cell_m: size of a cell.
    """
    cell = np.rint((cloud.points_m[:, :2] - origin_m) / cell_m).astype(np.int64)
    # one number a point, column before height, sorts ten times as fast as two
    low = cell.min(axis=0, initial=0)
    wide = int((cell[:, 0] - low[0]).max(initial=0)) + 1
    height_mm = np.rint((cloud.points_m[:, 2] - cloud.points_m[:, 2].min(initial=0)) * 1e3).astype(np.int64)
    order = np.argsort((((cell[:, 1] - low[1]) * wide + cell[:, 0] - low[0]) << 24) + height_mm, kind="stable")
    number = (cell[:, 1] * WIDE + cell[:, 0])[order]
    order = order[~stray(number, cloud.points_m[order, 2], cloud.visits[order])]
    number = cell[order, 1] * WIDE + cell[order, 0]
    begin = np.flatnonzero(np.diff(number, prepend=-1))
    return Columns(
        number[begin], np.append(begin, len(number)), cloud.points_m[order, 2], cloud.normals[order, 2].copy()
    )


@njit(cache=True)
def stray(number: I64, height: F32, visits: I32) -> Bool:
    """(n,) points that close no gap: seen once or twice, nearly alone in their column and not its ends.

    A grain of dust or what is left of a machine hangs between floor and roof; a wall fills its column.

    Args:
        number: (n,) of the column, rising.
        height: (n,) rising within a column.
        visits: (n,).
    """
    n = len(number)
    out = np.zeros(n, np.bool_)
    for i in range(1, n - 1):
        if visits[i] > STRAY_VISITS or number[i - 1] != number[i] or number[i + 1] != number[i]:
            continue
        beside = 0
        for step in (-1, 1):
            j = i + step
            while 0 <= j < n and number[j] == number[i] and abs(height[j] - height[i]) <= SKIN_M:
                beside += 1
                j += step
        out[i] = beside < STRAY_BESIDE
    return out


def _sheet(cell_m: float, origin_m: F64, column: I64, row: I64, floor_m: F64, roof_m: F64, opening_m: float) -> Sheet:
    links = link(column, row, floor_m, roof_m, opening_m)
    return Sheet(cell_m, origin_m, column, row, floor_m, roof_m, links)


def _in_map(sheet: Sheet, origin_m: F64) -> Sheet:
    heights = sheet.floor_m + origin_m[2], sheet.roof_m + origin_m[2]
    return Sheet(sheet.cell_m, sheet.origin_m + origin_m[:2], sheet.column, sheet.row, *heights, sheet.links)


@njit(cache=True)
def find_gaps(columns: Columns, headroom_m: float) -> tuple[I64, F64, F64]:
    """Gaps without points, tall enough, over something that faces up and under something that faces down.

    Returns:
        (k,) index of the column, (k,) floor, (k,) roof: means of what faces the gap within `SKIN_M`.
    """
    height, facing = columns.height_m, columns.facing
    which = np.empty(len(height), np.int64)
    floor, roof = np.empty(len(height)), np.empty(len(height))
    count = 0
    for c in range(len(columns.number)):
        for i in range(columns.begin[c], columns.begin[c + 1] - 1):
            if height[i + 1] - height[i] < headroom_m:
                continue
            low = _skin(height, facing, i, columns.begin[c] - 1, -1)
            high = _skin(height, facing, i + 1, columns.begin[c + 1], 1)
            if low[1] >= LEAST_FACING and high[1] <= -LEAST_FACING:
                which[count], floor[count], roof[count] = c, low[0], high[0]
                count += 1
    return which[:count], floor[:count], roof[:count]


@njit(cache=True)
def holds_two(number: I64, floor_m: F64, roof_m: F64, opening_m: float) -> Bool:
    """(n,) gaps that open into two gaps over one another beside them: there the rock between them was not seen.

    One such column would join the levels.

    Args:
        number: (n,) of the columns, rising.
        floor_m, roof_m: (n,).
        opening_m: least overlap.
    """
    out = np.zeros(len(number), np.bool_)
    for i in range(len(number)):
        for k in range(8):
            beside = number[i] + DY[k] * WIDE + DX[k]
            j = np.searchsorted(number, beside)
            shared = 0
            while j < len(number) and number[j] == beside:
                shared += min(roof_m[i], roof_m[j]) - max(floor_m[i], floor_m[j]) >= opening_m
                j += 1
            out[i] |= shared >= 2
    return out


@njit(cache=True)
def _skin(height: F32, facing: F32, first: int, end: int, step: int) -> tuple[float, float]:
    """Mean height and facing of the points from one on, up or down, within `SKIN_M`."""
    sum_height = sum_facing = 0.0
    count = 0
    i = first
    while i != end and abs(height[i] - height[first]) <= SKIN_M:
        sum_height += height[i]
        sum_facing += facing[i]
        count += 1
        i += step
    return sum_height / count, sum_facing / count


def _grown(sheet: Sheet, columns: Columns, opening_m: float) -> Sheet:
    """Add cells beside the sheet in whose columns floor or roof go on and nothing is in the way."""
    cell, k = np.nonzero(sheet.links < 0)
    column, row = sheet.column[cell] + DX[k], sheet.row[cell] + DY[k]
    number = row * WIDE + column
    at = np.searchsorted(columns.number, number)
    there = (at < len(columns.number)) & (columns.number[np.minimum(at, len(columns.number) - 1)] == number)
    cell, at, number = cell[there], at[there], number[there]
    floor, roof = goes_on(columns, at, sheet.floor_m[cell], sheet.roof_m[cell], opening_m)
    own = sheet.row * WIDE + sheet.column
    open_ = ~np.isnan(floor)
    number, floor, roof = number[open_], floor[open_], roof[open_]
    fresh = ~_overlaps(own, sheet, number, floor, roof)
    number, floor, roof = number[fresh], floor[fresh], roof[fresh]
    # of several that say the same, the first
    order = np.lexsort((floor, number))
    number, floor, roof = number[order], floor[order], roof[order]
    first = (np.diff(number, prepend=-1) != 0) | (np.diff(floor, prepend=-np.inf) > opening_m)
    number, floor, roof = (
        np.concatenate([old, new[first]]) for old, new in ((own, number), (sheet.floor_m, floor), (sheet.roof_m, roof))
    )
    order = np.lexsort((floor, number))
    number, floor, roof = number[order], floor[order], roof[order]
    return _sheet(sheet.cell_m, sheet.origin_m, number % WIDE, number // WIDE, floor, roof, opening_m)


def _overlaps(own: I64, sheet: Sheet, number: I64, floor_m: F64, roof_m: F64) -> Bool:
    """Which new cells would lie within a cell that the sheet has already."""
    out = np.zeros(len(number), np.bool_)
    first = np.searchsorted(own, number)
    for step in range(8):
        at = np.minimum(first + step, len(own) - 1)
        same = (first + step < len(own)) & (own[at] == number)
        if not same.any():
            break
        out |= same & (np.minimum(sheet.roof_m[at], roof_m) > np.maximum(sheet.floor_m[at], floor_m))
    return out


@njit(cache=True)
def goes_on(columns: Columns, at: I64, floor_m: F64, roof_m: F64, opening_m: float) -> tuple[F64, F64]:
    """Floor and roof of gaps in the columns beside them; NaN where they end.

    Args:
        columns: the points.
        at: (k,) index of the column beside.
        floor_m, roof_m: (k,) of the gap.
        opening_m: least height of what is left.
    """
    floor, roof = np.full(len(at), np.nan), np.full(len(at), np.nan)
    for k in range(len(at)):
        below = above = 0.0
        below_count = above_count = 0
        blocked = False
        for i in range(columns.begin[at[k]], columns.begin[at[k] + 1]):
            z = columns.height_m[i]
            if abs(z - floor_m[k]) <= STEP_M and columns.facing[i] >= LEAST_FACING:
                below += z
                below_count += 1
            elif abs(z - roof_m[k]) <= STEP_M and columns.facing[i] <= -LEAST_FACING:
                above += z
                above_count += 1
            elif floor_m[k] < z < roof_m[k]:
                blocked = True
        if blocked or below_count + above_count == 0:
            continue
        low = below / below_count if below_count else floor_m[k]
        high = above / above_count if above_count else roof_m[k]
        if high - low >= opening_m:
            floor[k], roof[k] = low, high
    return floor, roof


def _reached(sheet: Sheet, flown_m: F64) -> Bool:
    """(n,) which cells hang together with a place that was flown; the largest part if there is none."""
    if not len(sheet):
        return np.zeros(0, np.bool_)
    part = components(sheet.links)
    seeds: set[int] = set()
    own = sheet.row * WIDE + sheet.column
    at = np.rint((flown_m[:, :2] - sheet.origin_m) / sheet.cell_m).astype(np.int64)
    reach = round(SEED_M / sheet.cell_m)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            number = (at[:, 1] + dy) * WIDE + at[:, 0] + dx
            first = np.searchsorted(own, number)
            for step in range(8):
                k = np.minimum(first + step, len(own) - 1)
                inside = (own[k] == number) & (sheet.floor_m[k] < flown_m[:, 2]) & (flown_m[:, 2] < sheet.roof_m[k])
                seeds.update(np.unique(part[k[inside]]).tolist())
    if not seeds:
        return part == np.bincount(part).argmax()
    return np.isin(part, sorted(seeds))
