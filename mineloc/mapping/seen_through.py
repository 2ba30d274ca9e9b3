"""What later beams flew through is not rock: dust, machines, people, echoes.

Every so many metres the map keeps a view: the least range in each degree or two of what was seen from there. A point
of the map is seen through by a view if all that the view has in that direction lies well behind it. Points that are
seen through more often than seen go.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mineloc.compiled import njit, prange
from mineloc.data import F32, F64, I32, I64, U16, Bool

COLUMNS = 180
"""About two degrees of azimuth each."""
ROWS = 116
"""Equal steps of the slope up to ±1, one degree at the horizon: an OS0 sees ±45°."""
_ROWS_A_SLOPE = 57.3
_CM = 100.0


class Views(NamedTuple):
    """What was seen from some places, m of them.

    Attributes:
        to_view: (m, 3, 4) takes the map's points to the frame of a view.
        ranges_cm: least ranges of all views one after the other, rows of `COLUMNS`; 0: nothing seen.
        first: (m + 1,) where those of each begin.
        row: (m,) number of the first row that is kept.
    """

    to_view: F64
    ranges_cm: U16
    first: I64
    row: I32


class ViewRecorder:
    """Keeps the views of a map as it grows.

    Args:
        every_m: least distance between two views that follow one another.
    """

    def __init__(self, every_m: float) -> None:
        self._every_m = every_m
        self._transforms: list[F64] = []
        self._images: list[U16] = []
        self._rows: list[int] = []

    def add(self, points_lidar: F32 | F64, transform: F64) -> None:
        """Keep what is seen from a place, if it is not too near to the last one.

        Args:
            points_lidar: (n, 3).
            transform: (3, 4) that takes them to the map.
        """
        if self._transforms and np.linalg.norm(self._transforms[-1][:, 3] - transform[:, 3]) < self._every_m:
            return
        image = least_ranges(points_lidar)
        used = np.flatnonzero(image.any(axis=1))
        first, last = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 0)
        self._transforms.append(transform)
        self._images.append(image[first:last].copy())
        self._rows.append(first)

    def views(self) -> Views:
        """All that were kept."""
        forth = np.array(self._transforms).reshape(-1, 3, 4)
        back = np.swapaxes(forth[:, :, :3], 1, 2)
        to_view = np.concatenate([back, -back @ forth[:, :, 3:]], axis=2)
        sizes = [image.size for image in self._images]
        first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        flat = np.concatenate([np.zeros(0, np.uint16), *(image.ravel() for image in self._images)])
        return Views(to_view, flat, first, np.array(self._rows, np.int32))


@njit(cache=True, nogil=True)
def _cell(x: float, y: float, z: float) -> tuple[int, int]:
    """Row and column of a direction; rows may lie beyond the image."""
    flat = np.sqrt(x * x + y * y) + 1e-9
    slope = min(max(z / flat, -2.0), 2.0)
    # rises with the azimuth from 0 to 4, without an arctangent
    around = y / (abs(x) + abs(y) + 1e-9)
    turn = 1.0 + around if x >= 0 else 3.0 - around
    return int(np.floor(slope * _ROWS_A_SLOPE)) + ROWS // 2, int(turn * (COLUMNS / 4.0)) % COLUMNS


@njit(cache=True, nogil=True)
def least_ranges(points: F32 | F64) -> U16:
    """(`ROWS`, `COLUMNS`) least range of (n, 3) points in every direction, centimetres; 0: none."""
    out = np.zeros((ROWS, COLUMNS), np.uint16)
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        row, column = _cell(x, y, z)
        if row < 0 or row >= ROWS:
            continue
        r = np.uint16(min(np.sqrt(x * x + y * y + z * z) * _CM, 65535.0))
        if r > 0 and (out[row, column] == 0 or r < out[row, column]):
            out[row, column] = r
    return out


def seen_through(
    points_m: F32, often: I32, views: Views, *, reach_m: float, margin_m: float = 0.3, margin_share: float = 0.2
) -> Bool:
    """(n,) which of (n, 3) points are seen through by `often` (n,) views or more.

    Args:
        points_m: in the frame of the views.
        often: at least one.
        views: where from.
        reach_m: farther views are not asked.
        margin_m, margin_share: what a view has in a direction must lie so much behind the point, and so much of its
            own range: a beam one degree higher meets the floor that much farther away.
    """
    places = -np.einsum("mji,mj->mi", views.to_view[:, :, :3], views.to_view[:, :, 3])
    cell = np.floor(places[:, :2] / reach_m).astype(np.int64)
    low = cell.min(axis=0, initial=0) - 1
    wide, high = (cell.max(axis=0, initial=0) - low + 2).tolist()
    number = (cell[:, 1] - low[1]) * wide + cell[:, 0] - low[0]
    order = np.argsort(number, kind="stable")
    begin = np.searchsorted(number[order], np.arange(wide * high + 1))
    grid = (reach_m, int(low[0]), int(low[1]), wide, high)
    return _enough(points_m, often, views, places, order, begin, grid, (margin_m, 1.0 - margin_share))


@njit(cache=True, parallel=True)
def _enough(
    points: F32, often: I32, views: Views, places: F64, order: I64, begin: I64,
    grid: tuple[float, int, int, int, int], margin: tuple[float, float],
) -> Bool:  # fmt: skip
    reach, low_x, low_y, wide, high = grid
    out = np.zeros(len(points), np.bool_)
    for i in prange(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        cx, cy = int(np.floor(x / reach)) - low_x, int(np.floor(y / reach)) - low_y
        count = 0
        for row in range(max(cy - 1, 0), min(cy + 2, high)):
            left = row * wide + max(cx - 1, 0)
            for k in range(begin[left], begin[max(row * wide + min(cx + 2, wide), left)]):
                v = order[k]
                far = (x - places[v, 0]) ** 2 + (y - places[v, 1]) ** 2 + (z - places[v, 2]) ** 2
                if far < reach * reach and _through(x, y, z, np.sqrt(far), views, v, margin):
                    count += 1
                    if count >= often[i]:
                        break
            if count >= often[i]:
                break
        out[i] = count >= often[i]
    return out


@njit(cache=True)
def _through(x: float, y: float, z: float, r: float, views: Views, v: int, margin: tuple[float, float]) -> bool:
    T = views.to_view[v]
    a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    row, column = _cell(a, b, c)
    row -= views.row[v]
    beyond = (r + margin[0]) / margin[1] * _CM
    if not _lies_beyond(views, v, row, column, beyond, True):
        return False
    # an edge of rock may fill the next direction and not this one
    for up in range(-1, 2):
        for side in range(-1, 2):
            if up * side == 0 and not _lies_beyond(views, v, row + up, (column + side) % COLUMNS, beyond, False):
                return False
    return True


@njit(cache=True)
def _lies_beyond(views: Views, v: int, row: int, column: int, beyond_cm: float, unseen: bool) -> bool:
    """Whether all that a view has in a cell is farther away; `unseen` tells what an empty cell is not."""
    at = views.first[v] + row * COLUMNS + column
    if row < 0 or at >= views.first[v + 1] or views.ranges_cm[at] == 0:
        return not unseen
    return bool(views.ranges_cm[at] > beyond_cm)
