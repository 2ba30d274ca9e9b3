"""The roadways of a map: centre-lines of its free space, and width and height along them from its points."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from mineloc.compiled import njit, prange
from mineloc.data import F64, I64, MapCloud, SurfaceKind
from mineloc.mapping.free_space import WIDE
from mineloc.mapping.surface_kinds import InGap
from mineloc.roadways.centre_lines import centre_lines
from mineloc.roadways.mapped import MappedRoadway, MappedRoadways
from mineloc.roadways.sheet import Sheet

WIDTH_HEIGHT_M = 1.2
BAND_M = 0.4
"""Wall points so far above and below that height speak for a width."""
ALONG_M = 0.5
"""And so far before and behind the place on the line."""
REACH_M = 10.0
"""A wall farther away than this is that of another place."""
FIRST_WALL = 5
"""So many points in front of everything else begin a wall; fewer are a bolt or a cable."""
WALL_M = 0.6
"""What lies so far behind its beginning is the same wall: its median counts."""
NEAR_M = 0.6
_MOST = 4096


def map_roadways(cloud: MapCloud, sheet: Sheet, gap: InGap) -> MappedRoadways:
    """Centre-lines, widths and heights.

    Args:
        cloud: the map.
        sheet: its free space, map frame.
        gap: where the points lie in it.
    """
    graph = centre_lines(sheet, rooms_overlap=True)
    if not graph.roadways:
        return MappedRoadways(np.zeros((0, 3)), (), WIDTH_HEIGHT_M)
    band = np.flatnonzero((gap.kind == SurfaceKind.WALL) & (np.abs(gap.above_floor_m - WIDTH_HEIGHT_M) < BAND_M))
    places = np.concatenate([road.line_m for road in graph.roadways])
    left_of = np.concatenate([lefts(road.line_m) for road in graph.roadways])
    walls = wall_distances(places, left_of, cloud.points_m[band] + cloud.origin_m)
    ends = np.cumsum([len(road.line_m) for road in graph.roadways])[:-1]
    profiles = (np.split(values, ends) for values in (walls[:, 0], walls[:, 1], heights_at(places, sheet)))
    roads = tuple(
        MappedRoadway(road.a, road.b, road.line_m, *profile)
        for road, *profile in zip(graph.roadways, *profiles, strict=True)
    )
    return MappedRoadways(graph.nodes_m, roads, WIDTH_HEIGHT_M)


def lefts(line_m: F64) -> F64:
    """(n, 2) horizontal unit vectors to the left of a line, smoothed over two points on either side."""
    step = line_m[np.minimum(np.arange(len(line_m)) + 2, len(line_m) - 1)]
    step = step - line_m[np.maximum(np.arange(len(line_m)) - 2, 0)]
    length = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
    return np.column_stack([-step[:, 1] / length, step[:, 0] / length])


def heights_at(places_m: F64, sheet: Sheet) -> F64:
    """(n,) floor to roof around (n, 3) places on the floor; NaN off the sheet."""
    cells = np.arange(len(sheet))
    near, which = KDTree(sheet.floor_points_m(cells)).query(places_m, k=9, distance_upper_bound=NEAR_M)
    tall = np.append(sheet.roof_m - sheet.floor_m, np.nan)[which]
    out = np.full(len(places_m), np.nan)
    known = np.isfinite(near).any(axis=1)
    out[known] = np.nanmedian(tall[known], axis=1)
    return out


def wall_distances(places_m: F64, left_of: F64, walls_m: F64) -> F64:
    """(n, 2) distances from places on a line to the walls left and right; NaN where none is in reach.

    Args:
        places_m: (n, 3) on the floor.
        left_of: (n, 2) see `lefts`.
        walls_m: (k, 3) wall points about `WIDTH_HEIGHT_M` above the floor.
    """
    corner = walls_m[:, :2].min(axis=0, initial=np.inf) if len(walls_m) else np.zeros(2)
    box = np.floor((walls_m[:, :2] - corner) / _BOX_M).astype(np.int64)
    number = box[:, 1] * WIDE + box[:, 0]
    order = np.argsort(number, kind="stable")
    return _distances(places_m, left_of, walls_m[order], number[order], corner)


_BOX_M = 2.0


@njit(cache=True, parallel=True)
def _distances(places: F64, left_of: F64, walls: F64, number: I64, corner: F64) -> F64:
    out = np.full((len(places), 2), np.nan)
    for i in prange(len(places)):
        x, y, z = places[i, 0], places[i, 1], places[i, 2] + WIDTH_HEIGHT_M
        lx, ly = left_of[i, 0], left_of[i, 1]
        sides = np.empty((2, _MOST)), np.zeros(2, np.int64)
        first = int(np.floor((x - REACH_M - corner[0]) / _BOX_M))
        last = int(np.floor((x + REACH_M - corner[0]) / _BOX_M))
        for row in range(
            int(np.floor((y - REACH_M - corner[1]) / _BOX_M)), int(np.floor((y + REACH_M - corner[1]) / _BOX_M)) + 1
        ):
            if row < 0:
                continue
            k = np.searchsorted(number, row * WIDE + max(first, 0))
            while k < len(number) and number[k] <= row * WIDE + last:
                dx, dy = walls[k, 0] - x, walls[k, 1] - y
                across = dx * lx + dy * ly
                side = 0 if across > 0 else 1
                near = abs(dx * ly - dy * lx) < ALONG_M and abs(walls[k, 2] - z) < 2 * BAND_M
                if near and abs(across) < REACH_M and sides[1][side] < _MOST:
                    sides[0][side, sides[1][side]] = abs(across)
                    sides[1][side] += 1
                k += 1
        for side in range(2):
            out[i, side] = _first_wall(np.sort(sides[0][side, : sides[1][side]]))
    return out


@njit(cache=True)
def _first_wall(rising: F64) -> float:
    """Median of the distances that belong to the nearest wall."""
    if len(rising) < FIRST_WALL:
        return np.nan
    end = np.searchsorted(rising, rising[FIRST_WALL - 1] + WALL_M)
    return np.median(rising[:end])
