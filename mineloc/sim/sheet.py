"""The free-space sheet: where a drone fits between floor and roof, as cells that may lie above one another.

A plan of a mine with several levels is not a picture: roadways cross over roadways. So the cells of the plan grid are
kept a gap (floor to roof) at a time and linked to the gaps beside them that they open into. Everything after works on
these links, never on rows and columns.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit
from mineloc.sim.scene import Crossings, Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
Bool = NDArray[np.bool_]

# 8 neighbours counter-clockwise from +x; opposite of k is k + 4
DX = np.array([1, 1, 0, -1, -1, -1, 0, 1])
DY = np.array([0, 1, 1, 1, 0, -1, -1, -1])
FILLINGS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """Gaps between floor and roof on a plan grid, n cells.

    Attributes:
        cell_m: size of the grid.
        origin_m: (2,) map position of the centre of cell (0, 0).
        column, row: (n,) place in the grid, several cells may share one.
        floor_m, roof_m: (n,) heights in the map frame.
        links: (n, 8) int32 neighbours in the order of `DX`, `DY`; -1: rock.
    """

    cell_m: float
    origin_m: F64
    column: I64
    row: I64
    floor_m: F64
    roof_m: F64
    links: I32

    def __len__(self) -> int:
        return len(self.column)

    def floor_points_m(self, cells: I64) -> F64:
        """(k, 3) points on the floor in the middle of cells."""
        return np.column_stack(
            [
                self.origin_m[0] + self.column[cells] * self.cell_m,
                self.origin_m[1] + self.row[cells] * self.cell_m,
                self.floor_m[cells],
            ]
        )

    def keep(self, mask: Bool) -> Sheet:
        """Only the masked cells, links to others cut."""
        new = np.full(len(self) + 1, -1, np.int32)
        new[:-1][mask] = np.arange(int(mask.sum()), dtype=np.int32)
        return Sheet(
            self.cell_m,
            self.origin_m,
            self.column[mask],
            self.row[mask],
            self.floor_m[mask],
            self.roof_m[mask],
            new[self.links[mask]],
        )


def free_sheet(
    scene: Scene, low_m: F64, high_m: F64, *, cell_m: float = 0.2, headroom_m: float = 1.5, opening_m: float = 1.2
) -> Sheet:
    """Cast a ray up through every cell of the plan and keep the gaps that are free.

    Which gaps are free and which are rock is read from the winding of the triangles: a free gap has a floor and a
    roof that face each other. Meshes wound the other way round (facing the rock) are recognised by their majority:
    there is always at least as much free gap as rock between levels. Meshes wound at random are taken to be closed.

    Args:
        scene: the mine.
        low_m, high_m: (3,) bounds of the mesh.
        cell_m: size of the grid.
        headroom_m: least height of a gap.
        opening_m: least height over which two neighbouring gaps must overlap to be linked.
    """
    # off the round numbers on which modelled meshes have their edges
    origin = low_m[:2] + cell_m * np.array([0.37, 0.61])
    columns, rows = (int(np.ceil((high_m[k] - origin[k]) / cell_m)) for k in range(2))
    found: list[_Gaps] = []
    band = max(1, 2_000_000 // max(columns, 1))
    for first in range(0, rows, band):
        row, column = np.divmod(np.arange(columns * min(band, rows - first)), columns)
        start = np.column_stack([origin[0] + column * cell_m, origin[1] + (row + first) * cell_m])
        crossings = scene.verticals(np.column_stack([start, np.full(len(start), low_m[2] - 1.0)]))
        found.append(_gaps(crossings, first * columns, headroom_m))
    gaps = _Gaps(*(np.concatenate([getattr(part, f.name) for part in found]) for f in fields(_Gaps)))
    free = gaps.free()
    row, column = np.divmod(gaps.cell[free], columns)
    floor, roof = gaps.bottom_m[free] + low_m[2] - 1.0, gaps.top_m[free] + low_m[2] - 1.0
    sheet = Sheet(cell_m, origin, column, row, floor, roof, link(column, row, floor, roof, opening_m))
    for _ in range(FILLINGS):
        sheet = _fill(sheet, opening_m)
    return sheet


@dataclass(frozen=True, slots=True, eq=False)
class _Gaps:
    """Tall gaps between neighbouring crossings of vertical rays: cell, heights, winding (±2: walls face), parity."""

    cell: I64
    bottom_m: F64
    top_m: F64
    facing: F64
    odd: Bool

    def free(self) -> Bool:
        """Which gaps are free space. Where half of the triangles are wound at random, every second gap of a ray is."""
        facing = np.abs(self.facing) == 2
        if facing.sum() < 0.6 * len(facing):
            return ~self.odd
        return self.facing == (2.0 if (self.facing > 0).sum() >= (self.facing < 0).sum() else -2.0)


def _gaps(crossings: Crossings, first_cell: int, headroom_m: float) -> _Gaps:
    ray, height, side = crossings.ray, crossings.height_m, np.sign(crossings.upward)
    tall = np.flatnonzero((ray[1:] == ray[:-1]) & (np.diff(height) >= headroom_m))
    odd = (tall - np.searchsorted(ray, ray[tall], "left")) % 2 == 1
    return _Gaps(ray[tall] + first_cell, height[tall], height[tall + 1], side[tall] - side[tall + 1], odd)


def _fill(sheet: Sheet, opening_m: float) -> Sheet:
    """Add cells that are surrounded on at least five of eight sides: pinholes would become loops of the skeleton."""
    cell, k = np.nonzero(sheet.links < 0)
    column, row, floor = sheet.column[cell] + DX[k], sheet.row[cell] + DY[k], sheet.floor_m[cell]
    order = np.lexsort((floor, column, row))
    cell, column, row, floor = cell[order], column[order], row[order], floor[order]
    new = (np.diff(column) != 0) | (np.diff(row) != 0) | (np.diff(floor) > opening_m)
    start = np.concatenate([[0], np.flatnonzero(new) + 1]) if len(cell) else np.zeros(0, np.int64)
    count = np.diff(np.append(start, len(cell)))
    start, count = start[count >= 5], count[count >= 5]
    middle = start + count // 2
    columns, rows = np.append(sheet.column, column[start]), np.append(sheet.row, row[start])
    floors = np.append(sheet.floor_m, floor[middle])
    roofs = np.append(sheet.roof_m, sheet.roof_m[cell[middle]])
    by_place = np.lexsort((floors, columns, rows))
    columns, rows, floors, roofs = (values[by_place] for values in (columns, rows, floors, roofs))
    links = link(columns, rows, floors, roofs, opening_m)
    return Sheet(sheet.cell_m, sheet.origin_m, columns, rows, floors, roofs, links)


def link(column: I64, row: I64, floor_m: F64, roof_m: F64, opening_m: float) -> I32:
    """(n, 8) neighbours: for each direction the gap that overlaps most, if both sides agree.

    Args:
        column, row: (n,) sorted by (row, column).
        floor_m, roof_m: (n,).
        opening_m: least overlap.
    """
    wide = int(column.max(initial=0) - column.min(initial=0)) + 3
    key = row * wide + column
    best = np.full((len(key), 8), -1, np.int32)
    for k in range(8):
        wanted = key + DY[k] * wide + DX[k]
        a, b = np.searchsorted(key, wanted, "left"), np.searchsorted(key, wanted, "right")
        best[:, k] = _best_overlap(a, b, floor_m, roof_m, opening_m)
    mutual = np.stack([_agree(best[:, k], best[:, (k + 4) % 8]) for k in range(8)], axis=1)
    return np.where(mutual, best, np.int32(-1)).astype(np.int32)


def _agree(there: I32, back: I32) -> Bool:
    return (there >= 0) & (back[there] == np.arange(len(there)))


@njit(cache=True)
def _best_overlap(first: I64, last: I64, floor: F64, roof: F64, least: float) -> I32:
    out = np.full(len(first), -1, np.int32)
    for i in range(len(first)):
        most = least
        for j in range(first[i], last[i]):
            overlap = min(roof[i], roof[j]) - max(floor[i], floor[j])
            if overlap >= most:
                most = overlap
                out[i] = j
    return out


def components(links: I32) -> I64:
    """(n,) number of the connected part of each cell."""
    return _components(links)


@njit(cache=True)
def _components(links: I32) -> I64:
    part = np.full(len(links), -1, np.int64)
    stack = np.empty(len(links), np.int64)
    count = 0
    for seed in range(len(links)):
        if part[seed] >= 0:
            continue
        part[seed] = count
        stack[0] = seed
        top = 1
        while top:
            top -= 1
            for j in links[stack[top]]:
                if j >= 0 and part[j] < 0:
                    part[j] = count
                    stack[top] = j
                    top += 1
        count += 1
    return part


def clearance_cells(links: I32, column: I64, row: I64) -> F64:
    """(n,) distance in cells to the nearest rock within the sheet (Euclidean, by propagation of the nearest rock)."""
    return _clearance(links, column, row, DX, DY)


@njit(cache=True)
def _clearance(links: I32, column: I64, row: I64, dx: I64, dy: I64) -> F64:
    n = len(links)
    rock_x, rock_y = np.zeros(n), np.zeros(n)
    squared = np.full(n, np.inf)
    for i in range(n):
        for k in range(8):
            if links[i, k] < 0 and dx[k] ** 2 + dy[k] ** 2 < squared[i]:
                squared[i] = dx[k] ** 2 + dy[k] ** 2
                rock_x[i], rock_y[i] = column[i] + dx[k], row[i] + dy[k]
    changed = True
    forward = True
    while changed:
        changed = False
        for step in range(n):
            i = step if forward else n - 1 - step
            for k in range(8):
                j = links[i, k]
                if j < 0 or squared[j] == np.inf:
                    continue
                d = (column[i] - rock_x[j]) ** 2 + (row[i] - rock_y[j]) ** 2
                if d < squared[i]:
                    squared[i] = d
                    rock_x[i], rock_y[i] = rock_x[j], rock_y[j]
                    changed = True
        forward = not forward
    return np.sqrt(squared)
