"""Where the points of a mine lie, seen from above."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mineloc.data import F64
from mineloc.stages.run_folder import RunFolder

_PIXELS = 1000  # longer side of the raster of points
_MIN_PIXEL_M, _MAX_PIXEL_M = 0.1, 0.4
_POINTS_A_CELL = 3
_CHUNK = 1 << 18


@dataclass(frozen=True, slots=True, eq=False)
class Density:
    """How many points lie over each cell of the plan.

    Attributes:
        counts: (rows, columns), row 0 at the smallest y.
        extent_m: x from, x to, y from, y to.
    """

    counts: F64
    extent_m: tuple[float, float, float, float]


def density(run: RunFolder, T_frame_map: F64, *, detail: float = 1.0) -> Density | None:
    """The keyframe points, placed by the smoothed poses and seen from above; None without points.

    Args:
        run: its points are placed in portions: a big map needs little memory.
        T_frame_map: (4, 4) from the run's map to the frame of the figure.
        detail: 1 for a page with one run, less for many.
    """
    table = run.points()
    if table.is_empty():
        return None
    poses = T_frame_map @ run.keyframe_poses
    rows_of = np.searchsorted(run.keyframes["index"].to_numpy(), table["keyframe"].to_numpy())
    points = table.select("x_m", "y_m", "z_m").to_numpy()
    chunks = [slice(at, at + _CHUNK) for at in range(0, len(points), _CHUNK)]
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for part in chunks:
        xy = _plan_xy(poses, rows_of[part], points[part])
        low, high = np.minimum(low, xy.min(axis=0)), np.maximum(high, xy.max(axis=0))
    size = high - low
    pixel_m = max(float(size.max()) / (_PIXELS * detail), _MIN_PIXEL_M)
    while True:
        columns, rows = (np.ceil(size / pixel_m).astype(int) + 1).tolist()
        counts = np.zeros(rows * columns)
        for part in chunks:
            cell = ((_plan_xy(poses, rows_of[part], points[part]) - low) / pixel_m).astype(np.int64)
            counts += np.bincount(cell[:, 1] * columns + cell[:, 0], minlength=rows * columns)
        # single points do not make a wall: where there are few, the cells are larger
        if len(points) >= _POINTS_A_CELL * np.count_nonzero(counts) or pixel_m * 1.4 > _MAX_PIXEL_M:
            break
        pixel_m *= 1.4
    extent = (low[0], low[0] + columns * pixel_m, low[1], low[1] + rows * pixel_m)
    return Density(counts.reshape(rows, columns), extent)


def _plan_xy(poses: F64, rows_of: Any, points: Any) -> F64:
    pose = poses[rows_of, :2]
    return np.einsum("nij,nj->ni", pose[:, :, :3], points.astype(np.float64)) + pose[:, :, 3]
