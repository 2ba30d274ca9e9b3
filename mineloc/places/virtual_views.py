"""How well an intersection is recognised as itself: looked at as a drone comes and goes (METHOD 5.4, leave one out)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mineloc.config import IntersectionsConfig
from mineloc.data import F64, Sight, WallContour
from mineloc.places.branches import find_junctions
from mineloc.places.free_grid import FreeGrid
from mineloc.places.wall_contour import branches_fit, contour_likeness, wall_contour

_BEAMS = 720
FROM_M, TO_M = 7.0, (3.0, 0.0)
"""A drone has come along a branch from so far away to so far away."""


def visible(grid: FreeGrid, places_m: F64, *, reach_m: float) -> FreeGrid:
    """The grid as far as it is seen from some places: what no beam meets is unknown.

    Args:
        grid: all of the free space around.
        places_m: (k, 2) in its frame; those in rock see nothing.
        reach_m: of a beam.
    """
    angles = 2 * np.pi * np.arange(_BEAMS) / _BEAMS
    steps = np.arange(0.0, reach_m, 0.7 * grid.cell_m)
    beams = steps[None, :, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None, :]
    sight = np.full_like(grid.sight, Sight.UNKNOWN)
    rows_count, columns_count = grid.sight.shape
    for place in places_m:
        rows, columns = grid.cells_of((place + beams).reshape(-1, 2))
        inside = (rows >= 0) & (columns >= 0) & (rows < rows_count) & (columns < columns_count)
        met = np.full(len(rows), Sight.UNKNOWN, np.uint8)
        met[inside] = grid.sight[rows[inside], columns[inside]]
        is_open = (met == Sight.OPEN).reshape(_BEAMS, -1)
        # up to the first cell that is not open, that one included
        lit = np.ones_like(is_open)
        lit[:, 1:] = np.logical_and.accumulate(is_open, axis=1)[:, :-1]
        shown = lit.reshape(-1) & inside & is_open[:, :1].repeat(len(steps), axis=1).reshape(-1)
        sight[rows[shown], columns[shown]] = met[shown]
    return FreeGrid(grid.cell_m, grid.origin_m, sight)


def self_recognition(
    grid: FreeGrid, point_m: F64, own: int, contours: Sequence[WallContour], config: IntersectionsConfig
) -> float:
    """Share of views along its branches in which a junction is found at the point and is most alike to itself.

    Args:
        grid: free space around the intersection.
        point_m: (2,) its invariant point in the grid's frame.
        own: index in `contours`.
        contours: of all intersections of the map.
        config: of detection and descriptors.
    """
    right, views = 0, 0
    for bearing in contours[own].branches_rad:
        ahead = np.array([np.cos(bearing), np.sin(bearing)])
        for end_m in TO_M:
            way = point_m + np.arange(FROM_M, end_m - 0.5, -1.0)[:, None] * ahead
            views += 1
            right += _is_recognised(visible(grid, way, reach_m=config.range_m), way[-1], point_m, own, contours, config)
    return right / views if views else 0.0


def _is_recognised(
    view: FreeGrid, here_m: F64, point_m: F64, own: int, contours: Sequence[WallContour], config: IntersectionsConfig
) -> bool:
    near = [
        junction
        for junction in find_junctions(view, config, at_m=here_m)
        if np.linalg.norm(junction.point_m - point_m) < config.apart_m
    ]
    if not near:
        return False
    junction = min(near, key=lambda one: float(np.linalg.norm(one.point_m - point_m)))
    seen = wall_contour(view, junction.point_m, junction.branches_rad, config)
    within = np.radians(config.branch_match_deg)
    alike = np.zeros(len(contours))
    for k, known in enumerate(contours):
        found = contour_likeness(known, seen, config)
        if branches_fit(known.branches_rad, seen.branches_rad, found.yaw_rad, within_rad=within):
            alike[k] = found.similarity
    return bool(alike[own] > 0 and alike.argmax() == own)
