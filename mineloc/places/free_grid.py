"""Free space around a drone, seen from above: what its beams crossed, and where they ended (METHOD 5.1 (3)).

Every return says that the way to it is open. Seen from above that holds for returns of floor and roof too; walls are
where beams end near the height of the sensor. Several keyframes are laid over each other, each with one vote a cell:
what one of them saw through a gap outvotes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mineloc.compiled import njit
from mineloc.config import IntersectionsConfig
from mineloc.data import F32, F64, I32, I64, U8, Bool, Sight

_BEAMS = 720
"""Bearings; in each the farthest return tells how far it is open."""
_SHORT_M = 0.15
"""A beam opens the cells up to so far before its end."""
_STEP = 0.7
"""Cells between two places on a beam."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeGrid:
    """A square of the plan.

    Attributes:
        cell_m: edge of a cell.
        origin_m: (2,) of the centre of cell (0, 0).
        sight: (rows, columns) uint8 `Sight`: row along y, column along x.
    """

    cell_m: float
    origin_m: F64
    sight: U8

    @property
    def is_open(self) -> Bool:
        """(rows, columns) where a drone may be."""
        return self.sight == Sight.OPEN

    def cells_of(self, places_m: F64) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of (n, 2) places; they may lie outside."""
        cell = np.rint((places_m - self.origin_m) / self.cell_m).astype(np.int64)
        return cell[:, 1], cell[:, 0]


@dataclass(frozen=True, slots=True, eq=False)
class PlanView:
    """The votes of one keyframe, on a lattice of cells whose cell (0, 0) has its centre at the origin of the plan.

    Attributes:
        open_cells, wall_cells: (n, 2) int32 row (along y) and column (along x); no cell is in both.
    """

    open_cells: I32
    wall_cells: I32


def plan_view(cloud: F32, at_m: F64, config: IntersectionsConfig) -> PlanView:
    """What a keyframe shows of the plan.

    Args:
        cloud: (n, 3) points around the sensor, levelled, in the axes of the plan.
        at_m: (2,) where the sensor is in the plan.
        config: `cell_m`, `range_m`, `wall_band_m`.
    """
    return PlanView(
        *_view(
            np.ascontiguousarray(cloud), float(at_m[0]), float(at_m[1]), config.cell_m, config.range_m,
            config.wall_band_m,
        )
    )  # fmt: skip


def free_grid(views: Sequence[PlanView], at_m: F64, config: IntersectionsConfig) -> FreeGrid:
    """Lay keyframes over each other: a square of the plan around a place, which is the origin of its frame.

    Args:
        views: of each keyframe.
        at_m: (2,) of the place in the plan.
        config: `cell_m`, `half_m`, `wall_votes`.
    """
    half = round(config.half_m / config.cell_m)
    middle = np.rint(at_m / config.cell_m).astype(np.int64)
    first = middle[::-1] - half
    opened, closed = np.zeros((2 * half + 1, 2 * half + 1), np.int32), np.zeros((2 * half + 1, 2 * half + 1), np.int32)
    for view in views:
        _add(view.open_cells, first, opened)
        _add(view.wall_cells, first, closed)
    origin = config.cell_m * (middle - half) - at_m
    return FreeGrid(config.cell_m, origin, _sight(opened, closed, config.wall_votes))


@njit(cache=True, nogil=True)
def _view(points: F32, x_m: float, y_m: float, cell_m: float, range_m: float, band_m: float) -> tuple[I32, I32]:
    """A cell counts once: as wall where a beam ends near the height of the sensor, else as open."""
    farthest = np.zeros(_BEAMS)
    half = int(range_m / cell_m) + 2
    n = 2 * half + 1
    row0, column0 = int(np.rint(y_m / cell_m)) - half, int(np.rint(x_m / cell_m)) - half
    stamp = np.zeros((n, n), np.uint8)
    walls = np.empty((len(points), 2), np.int32)
    wall_count = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        r = np.sqrt(x * x + y * y)
        if r < 1e-6:
            continue
        beam = int((np.arctan2(y, x) / (2 * np.pi) + 1.0) * _BEAMS) % _BEAMS
        farthest[beam] = max(farthest[beam], r)
        if r <= range_m and abs(z) <= band_m:
            row, column = int(np.rint((y_m + y) / cell_m)), int(np.rint((x_m + x) / cell_m))
            if stamp[row - row0, column - column0] == 0:
                stamp[row - row0, column - column0] = 1
                walls[wall_count, 0], walls[wall_count, 1] = row, column
                wall_count += 1
    opened = np.empty((n * n, 2), np.int32)
    open_count = 0
    for beam in range(_BEAMS):
        reach = min(farthest[beam] - _SHORT_M, range_m)
        if reach <= 0.0:
            continue
        angle = 2 * np.pi * (beam + 0.5) / _BEAMS
        dx, dy = np.cos(angle), np.sin(angle)
        for k in range(int(reach / (_STEP * cell_m)) + 1):
            s = _STEP * cell_m * k
            row, column = int(np.rint((y_m + s * dy) / cell_m)), int(np.rint((x_m + s * dx) / cell_m))
            if stamp[row - row0, column - column0] == 0:
                stamp[row - row0, column - column0] = 2
                opened[open_count, 0], opened[open_count, 1] = row, column
                open_count += 1
    return opened[:open_count].copy(), walls[:wall_count].copy()


@njit(cache=True, nogil=True)
def _add(cells: I32, first: I64, votes: I32) -> None:
    rows, columns = votes.shape
    for i in range(len(cells)):
        row, column = cells[i, 0] - first[0], cells[i, 1] - first[1]
        if 0 <= row < rows and 0 <= column < columns:
            votes[row, column] += 1


def _sight(opened: I32, closed: I32, wall_votes: float) -> U8:
    sight = np.full(opened.shape, Sight.UNKNOWN, np.uint8)
    walls = (closed > 0) & (closed >= wall_votes * (opened + closed))
    sight[(opened > 0) & ~walls] = Sight.OPEN
    sight[walls] = Sight.WALL
    return sight


def plan_view_plainly(cloud: F32, at_m: F64, config: IntersectionsConfig) -> PlanView:
    """`plan_view` in plain numpy: what the kernel is held to; cells in another order."""
    points = cloud.astype(np.float64)
    r = np.hypot(points[:, 0], points[:, 1])
    points, r = points[r >= 1e-6], r[r >= 1e-6]
    is_wall = (r <= config.range_m) & (np.abs(points[:, 2]) <= config.wall_band_m)
    walls = {*_cells(points[is_wall, :2] + at_m, config.cell_m)}
    farthest = np.zeros(_BEAMS)
    beams = ((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 1.0) * _BEAMS).astype(np.int64) % _BEAMS
    np.maximum.at(farthest, beams, r)
    crossed: set[tuple[int, int]] = set()
    for beam in np.flatnonzero(farthest > _SHORT_M):
        angle = 2 * np.pi * (beam + 0.5) / _BEAMS
        reach = min(farthest[beam] - _SHORT_M, config.range_m)
        s = _STEP * config.cell_m * np.arange(int(reach / (_STEP * config.cell_m)) + 1)
        crossed |= {*_cells(at_m + s[:, None] * np.array([np.cos(angle), np.sin(angle)]), config.cell_m)}
    open_cells = sorted(crossed - walls)
    return PlanView(np.array(open_cells, np.int32).reshape(-1, 2), np.array(sorted(walls), np.int32).reshape(-1, 2))


def _cells(places: F64, cell_m: float) -> list[tuple[int, int]]:
    return [(row, column) for column, row in np.rint(places / cell_m).astype(np.int64).tolist()]
