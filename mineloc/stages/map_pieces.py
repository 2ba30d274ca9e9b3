"""What is seen between two keyframes, as one piece of the map that waits on the disk until the map is made.

A map is put together from the smoothed poses, which are known when the flight is over. Every sweep's points, deskewed
by the front end, wait until then at their keyframe: moved there by odometry, which over a metre is exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mineloc import se3
from mineloc.compiled import njit
from mineloc.data import F32, F64, OdometryStep
from mineloc.sweep.voxel_grid import voxel_centroids

_POINT_BYTES = 12
_MOST_POINTS = 400_000  # gathered before they are thinned: hovering gives no keyframes


@njit(cache=True, nogil=True)
def _placed(points: F32, T: F64, most_m2: float) -> F32:
    """The points (n, 3) with a squared range below, taken through T (4, 4)."""
    out = np.empty((len(points), 3), np.float32)
    count = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if x * x + y * y + z * z < most_m2:
            for row in range(3):
                out[count, row] = T[row, 0] * x + T[row, 1] * y + T[row, 2] * z + T[row, 3]
            count += 1
    return out[:count]


class _Piece(NamedTuple):
    keyframe: int
    first: int
    points: int


class MapPieces:
    """Clouds of one flight on the disk, one or more a keyframe, in the lidar frame of the keyframe.

    Args:
        path: file to write to.
        voxel_m: one mean point a voxel is kept.
        max_range_m: farther points are left out.
    """

    def __init__(self, path: Path, *, voxel_m: float, max_range_m: float) -> None:
        self._path, self._voxel_m, self._max_range_m = path, voxel_m, max_range_m
        self._file = path.open("wb")
        self._pieces: list[_Piece] = []
        self._written = 0
        self._keyframe = -1
        self._T_odom_key: F64 = np.eye(4)
        self._gathered: list[F32] = []
        self._count = 0

    def __len__(self) -> int:
        return len(self._pieces)

    @property
    def keyframe(self) -> int:
        """The keyframe that points are gathered at now, -1 before the first."""
        return self._keyframe

    def watch(self, step: OdometryStep) -> None:
        """Take the points of the next sweep; those that rest on the motion prior alone are left out."""
        if step.keyframe is not None:
            self._flush()
            self._keyframe, self._T_odom_key = step.keyframe.index, step.T_odom_lidar
        if step.points_lidar is not None and self._keyframe >= 0 and (step.trusted or step.keyframe is not None):
            self.add(step.points_lidar, step.T_odom_lidar)

    def add(self, points: F32, T_odom_points: F64) -> None:
        """Points (n, 3) in any frame, and its place in the odometry frame."""
        T_key_points = np.ascontiguousarray(se3.inverse(self._T_odom_key) @ T_odom_points)
        placed = _placed(np.ascontiguousarray(points), T_key_points, self._max_range_m**2)
        self._gathered.append(placed)
        self._count += len(placed)
        if self._count > _MOST_POINTS:
            self._flush()

    def close(self) -> None:
        """Write what is left; from now on the pieces can be read."""
        self._flush()
        self._file.close()

    def __iter__(self) -> Iterator[tuple[int, F32]]:
        """(keyframe, (n, 3) points) in the order of flight."""
        with self._path.open("rb") as file:
            for piece in self._pieces:
                file.seek(piece.first * _POINT_BYTES)
                data = np.frombuffer(file.read(piece.points * _POINT_BYTES), np.float32)
                yield piece.keyframe, data.reshape(-1, 3)

    def _flush(self) -> None:
        if self._count:
            points = voxel_centroids(np.concatenate(self._gathered), self._voxel_m)
            self._file.write(points.tobytes())
            self._pieces.append(_Piece(self._keyframe, self._written, len(points)))
            self._written += len(points)
        self._gathered, self._count = [], 0
