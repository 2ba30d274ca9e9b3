"""The free-space sheet: where a drone fits between floor and roof, as cells that may lie above one another.

A plan of a mine with several levels is not a picture: roadways cross over roadways. So the cells of the plan grid are
kept a gap (floor to roof) at a time and linked to the gaps beside them that they open into. Everything after works on
these links, never on rows and columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
Bool = NDArray[np.bool_]

# 8 neighbours counter-clockwise from +x; opposite of k is k + 4
DX = np.array([1, 1, 0, -1, -1, -1, 0, 1])
DY = np.array([0, 1, 1, 1, 0, -1, -1, -1])


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


def fill_pinholes(sheet: Sheet, opening_m: float) -> Sheet:
    """Add cells that are surrounded on at least five of eight sides: pinholes would become loops of the skeleton.

    Args:
        sheet: cells sorted by (row, column).
        opening_m: least height over which two neighbouring gaps must overlap to be linked.
    """
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
