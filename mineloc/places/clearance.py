"""How far the walls are: free space that hangs together, its clearance, and the widest places (METHOD 5.1 (4))."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from scipy.ndimage import binary_opening, distance_transform_edt, label, maximum_filter

from mineloc.compiled import njit
from mineloc.data import F64, I64, Bool

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.bool_)
_FAR = 1 << 30


class Clearance(NamedTuple):
    """Free space around a cell.

    Attributes:
        free: (rows, columns) opened by a cross of cells, and connected with the free cell nearest to the given one.
        cells: (rows, columns) distance to the nearest cell that is not free, in cells.
        peaks: (k, 2) row and column of its local maxima, row by row.
    """

    free: Bool
    cells: F64
    peaks: I64


def clearance_of(is_open: Bool, here: tuple[float, float], *, window: int, least: float, within: float) -> Clearance:
    """Clearance of the free space around a place.

    Args:
        is_open: (rows, columns).
        here: row and column of the place; it may lie between cells.
        window: cells on a side of the square in which a peak is the largest, odd.
        least: clearance that a peak exceeds, in cells.
        within: peaks are nearer than so many cells to `here`.
    """
    return Clearance(*_clearance(np.ascontiguousarray(is_open), here[0], here[1], window // 2, least, within))


def clearance_plainly(
    is_open: Bool, here: tuple[float, float], *, window: int, least: float, within: float
) -> Clearance:
    """`clearance_of` in scipy: what the kernel is held to."""
    free = np.asarray(binary_opening(is_open, _CROSS), dtype=np.bool_)
    numbered, count = cast("tuple[np.ndarray, int]", label(free))
    if not count:
        return Clearance(free, np.zeros(free.shape), np.zeros((0, 2), np.int64))
    rows, columns = np.nonzero(free)
    nearest = int(np.hypot(rows - here[0], columns - here[1]).argmin())
    free = np.asarray(numbered == numbered[rows[nearest], columns[nearest]])
    cells = np.asarray(distance_transform_edt(free), dtype=np.float64)
    rows, columns = np.nonzero((cells == maximum_filter(cells, window)) & (cells > least))
    near = np.hypot(rows - here[0], columns - here[1]) < within
    return Clearance(free, cells, np.column_stack([rows[near], columns[near]]).astype(np.int64))


@njit(cache=True, nogil=True)
def _clearance(
    is_open: Bool, row: float, column: float, half: int, least: float, within: float
) -> tuple[Bool, F64, I64]:
    rows, columns = is_open.shape
    free = np.zeros((rows, columns), np.bool_)
    _open_by_cross(is_open, free)
    start_r, start_c, nearest = -1, -1, np.inf
    for r in range(rows):
        for c in range(columns):
            away = (r - row) ** 2 + (c - column) ** 2
            if free[r, c] and away < nearest:
                start_r, start_c, nearest = r, c, away
    if start_r < 0:
        return free, np.zeros((rows, columns)), np.zeros((0, 2), np.int64)
    connected = np.zeros((rows, columns), np.bool_)
    flood(free, start_r, start_c, connected)
    squared = _squared_distance(connected)
    peaks = np.empty((rows * columns, 2), np.int64)
    count = 0
    for r in range(rows):
        for c in range(columns):
            here = squared[r, c]
            if here <= least * least or (r - row) ** 2 + (c - column) ** 2 >= within * within:
                continue
            is_peak = True
            for i in range(max(r - half, 0), min(r + half + 1, rows)):
                for j in range(max(c - half, 0), min(c + half + 1, columns)):
                    if squared[i, j] > here:
                        is_peak = False
                        break
                if not is_peak:
                    break
            if is_peak:
                peaks[count, 0], peaks[count, 1] = r, c
                count += 1
    return connected, np.sqrt(squared.astype(np.float64)), peaks[:count].copy()


@njit(cache=True, nogil=True)
def _open_by_cross(is_open: Bool, out: Bool) -> None:
    """Erosion by a cross, then dilation by it; what lies beyond the edge is closed."""
    rows, columns = is_open.shape
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            if is_open[r, c] and is_open[r - 1, c] and is_open[r + 1, c] and is_open[r, c - 1] and is_open[r, c + 1]:
                out[r, c] = out[r - 1, c] = out[r + 1, c] = out[r, c - 1] = out[r, c + 1] = True


@njit(cache=True, nogil=True)
def flood(free: Bool, row: int, column: int, out: Bool) -> None:
    """Mark what hangs together with a free cell by its four sides; `out` (same shape) must be False there."""
    rows, columns = free.shape
    stack = np.empty(rows * columns, np.int64)
    stack[0] = row * columns + column
    out[row, column] = True
    left = 1
    while left:
        left -= 1
        r, c = stack[left] // columns, stack[left] % columns
        for way in range(4):
            i = r + (1 if way == 0 else (-1 if way == 1 else 0))
            j = c + (1 if way == 2 else (-1 if way == 3 else 0))
            if 0 <= i < rows and 0 <= j < columns and free[i, j] and not out[i, j]:
                out[i, j] = True
                stack[left] = i * columns + j
                left += 1


@njit(cache=True, nogil=True)
def _squared_distance(free: Bool) -> I64:
    """(rows, columns) squared distance to the nearest cell that is not free (Felzenszwalb and Huttenlocher 2012)."""
    down = _down_columns(free)
    out = np.empty_like(down)
    for r in range(len(down)):
        _along_row(down[r], out[r])
    return out


@njit(cache=True, nogil=True)
def _down_columns(free: Bool) -> I64:
    """(rows, columns) distance to the nearest closed cell of the column."""
    rows, columns = free.shape
    down = np.empty((rows, columns), np.int64)
    for c in range(columns):
        last = -_FAR
        for r in range(rows):
            if not free[r, c]:
                last = r
            down[r, c] = min(r - last, _FAR)
        last = _FAR
        for r in range(rows - 1, -1, -1):
            if not free[r, c]:
                last = r
            down[r, c] = min(down[r, c], last - r)
    return down


@njit(cache=True, nogil=True)
def _along_row(down: I64, out: I64) -> None:
    """The lower envelope of the parabolas over one row."""
    columns = len(down)
    at = np.empty(columns, np.int64)
    until = np.empty(columns + 1)
    k = -1
    for q in range(columns):
        if down[q] >= _FAR // 2:
            continue
        f = down[q] ** 2 + q * q
        crossing = -np.inf
        while k >= 0:
            v = at[k]
            crossing = (f - (down[v] ** 2 + v * v)) / (2.0 * (q - v))
            if crossing > until[k]:
                break
            k -= 1
            crossing = -np.inf
        k += 1
        at[k], until[k], until[k + 1] = q, crossing, np.inf
    if k < 0:
        out[:] = _FAR
        return
    k = 0
    for q in range(columns):
        while until[k + 1] < q:
            k += 1
        out[q] = (q - at[k]) ** 2 + down[at[k]] ** 2
