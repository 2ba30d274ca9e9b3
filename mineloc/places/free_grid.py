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
from mineloc.data import F32, F64, I32, U8, Bool, Sight

_BEAMS = 720
"""Bearings; in each the farthest return tells how far it is open."""
_SHORT_M = 0.15
"""A beam opens the cells up to so far before its end."""


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
    """One keyframe seen from above.

    Attributes:
        reach_m: (720,) farthest return of each bearing around the sensor, counter-clockwise from x; 0 without any.
        walls_m: (n, 2) float32 returns near the height of the sensor.
    """

    reach_m: F64
    walls_m: F32


def plan_view(cloud_level: F32, config: IntersectionsConfig) -> PlanView:
    """What a keyframe shows of the plan.

    Args:
        cloud_level: (n, 3) points around the sensor, levelled.
        config: `range_m`, `wall_band_m`.
    """
    return PlanView(*_view(np.ascontiguousarray(cloud_level), config.range_m, config.wall_band_m))


def free_grid(views: Sequence[PlanView], T_here_there: F64, config: IntersectionsConfig) -> FreeGrid:
    """Lay keyframes over each other.

    Args:
        views: of each keyframe.
        T_here_there: (k, 4, 4) from each one's level frame to the one in whose middle the grid lies.
        config: `cell_m`, `half_m`, `range_m`, `wall_votes`.
    """
    cells = 2 * round(config.half_m / config.cell_m) + 1
    origin = -0.5 * (cells - 1) * config.cell_m
    opened, closed, stamp = (np.zeros((cells, cells), np.int32) for _ in range(3))
    for index, (view, T) in enumerate(zip(views, T_here_there, strict=True)):
        _vote(
            view.walls_m, view.reach_m, np.ascontiguousarray(T), origin, config.cell_m, config.range_m,
            index + 1, stamp, opened, closed,
        )  # fmt: skip
    return FreeGrid(config.cell_m, np.array([origin, origin]), _sight(opened, closed, config.wall_votes))


@njit(cache=True, nogil=True)
def _view(points: F32, range_m: float, band_m: float) -> tuple[F64, F32]:
    farthest = np.zeros(_BEAMS)
    walls = np.empty((len(points), 2), np.float32)
    count = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        r = np.sqrt(x * x + y * y)
        if r < 1e-6:
            continue
        beam = int((np.arctan2(y, x) / (2 * np.pi) + 1.0) * _BEAMS) % _BEAMS
        farthest[beam] = max(farthest[beam], r)
        if r <= range_m and abs(z) <= band_m:
            walls[count, 0], walls[count, 1] = points[i, 0], points[i, 1]
            count += 1
    return farthest, walls[:count].copy()


@njit(cache=True, nogil=True)
def _vote(
    walls: F32, farthest: F64, T: F64, origin: float, cell_m: float, range_m: float,
    vote: int, stamp: I32, opened: I32, closed: I32,
) -> None:  # fmt: skip
    """One keyframe's votes: a cell counts once as wall, else once as open."""
    n = len(opened)
    sx, sy = T[0, 3], T[1, 3]
    for i in range(len(walls)):
        x, y = np.float64(walls[i, 0]), np.float64(walls[i, 1])
        px, py = T[0, 0] * x + T[0, 1] * y + sx, T[1, 0] * x + T[1, 1] * y + sy
        column, row = int(np.rint((px - origin) / cell_m)), int(np.rint((py - origin) / cell_m))
        if 0 <= row < n and 0 <= column < n and stamp[row, column] != vote:
            stamp[row, column] = vote
            closed[row, column] += 1
    for beam in range(_BEAMS):
        reach = min(farthest[beam] - _SHORT_M, range_m)
        if reach <= 0.0:
            continue
        angle = 2 * np.pi * (beam + 0.5) / _BEAMS
        dx, dy = np.cos(angle), np.sin(angle)
        ux, uy = T[0, 0] * dx + T[0, 1] * dy, T[1, 0] * dx + T[1, 1] * dy
        steps = int(reach / (0.7 * cell_m))
        for k in range(steps + 1):
            s = 0.7 * cell_m * k
            column, row = int(np.rint((sx + s * ux - origin) / cell_m)), int(np.rint((sy + s * uy - origin) / cell_m))
            # a cell of this keyframe's walls, or one already counted, carries its stamp
            if 0 <= row < n and 0 <= column < n and stamp[row, column] != vote:
                stamp[row, column] = vote
                opened[row, column] += 1


def _sight(opened: I32, closed: I32, wall_votes: float) -> U8:
    sight = np.full(opened.shape, Sight.UNKNOWN, np.uint8)
    walls = (closed > 0) & (closed >= wall_votes * (opened + closed))
    sight[(opened > 0) & ~walls] = Sight.OPEN
    sight[walls] = Sight.WALL
    return sight


def free_grid_plainly(clouds_level: Sequence[F32], T_here_there: F64, config: IntersectionsConfig) -> FreeGrid:
    """`plan_view` and `free_grid` in plain numpy, of (n, 3) levelled points each: what the kernels are held to."""
    cells = 2 * round(config.half_m / config.cell_m) + 1
    origin = -0.5 * (cells - 1) * config.cell_m
    opened, closed = np.zeros((cells, cells), np.int32), np.zeros((cells, cells), np.int32)
    for cloud, T in zip(clouds_level, T_here_there, strict=True):
        points = cloud.astype(np.float64)
        r = np.hypot(points[:, 0], points[:, 1])
        points, r = points[r >= 1e-6], r[r >= 1e-6]
        level = points[:, :2] @ T[:2, :2].T
        is_wall = (r <= config.range_m) & (np.abs(points[:, 2]) <= config.wall_band_m)
        wall = _mask(level[is_wall] + T[:2, 3], origin, cells, config.cell_m)
        farthest = np.zeros(_BEAMS)
        beams = ((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 1.0) * _BEAMS).astype(np.int64) % _BEAMS
        np.maximum.at(farthest, beams, r)
        crossed = np.zeros_like(wall)
        for beam in np.flatnonzero(farthest > _SHORT_M):
            angle = 2 * np.pi * (beam + 0.5) / _BEAMS
            direction = T[:2, :2] @ np.array([np.cos(angle), np.sin(angle)])
            reach = min(farthest[beam] - _SHORT_M, config.range_m)
            s = 0.7 * config.cell_m * np.arange(int(reach / (0.7 * config.cell_m)) + 1)
            crossed |= _mask(T[:2, 3] + s[:, None] * direction, origin, cells, config.cell_m)
        closed += wall
        opened += crossed & ~wall
    return FreeGrid(config.cell_m, np.array([origin, origin]), _sight(opened, closed, config.wall_votes))


def _mask(places: F64, origin: float, cells: int, cell_m: float) -> Bool:
    cell = np.rint((places - origin) / cell_m).astype(np.int64)
    cell = cell[((cell >= 0) & (cell < cells)).all(axis=1)]
    out = np.zeros((cells, cells), np.bool_)
    out[cell[:, 1], cell[:, 0]] = True
    return out
