"""Map clouds of mines that are pictures: floor, walls and roof of open boxes on a grid, without a flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.data import MapCloud, SurfaceKind

STEP_M = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class RasterMine:
    """One level.

    Attributes:
        mask: (rows, columns) open cells of 0.1 m; row and column 0 are at 0 m.
        floor_m: (rows, columns) height of the floor.
        tall_m: of the roadways.
    """

    mask: np.ndarray
    floor_m: np.ndarray
    tall_m: float = 3.0

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(n, 3) points, (n, 3) normals into the open, (n,) kinds."""
        row, column = np.nonzero(self.mask)
        xy = np.column_stack([column, row]) * STEP_M + STEP_M / 2
        floor = np.column_stack([xy, self.floor_m[row, column]])
        up = np.tile([0, 0, 1.0], (len(xy), 1))
        parts = [(floor, up, SurfaceKind.FLOOR), (floor + self.tall_m * up, -up, SurfaceKind.ROOF)]
        padded = np.pad(self.mask, 1)
        heights = np.arange(STEP_M / 2, self.tall_m, STEP_M)
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            edge = np.flatnonzero(~padded[row + 1 + dy, column + 1 + dx])
            foot = floor[edge] + np.array([dx, dy, 0]) * STEP_M / 2
            wall = (foot[:, None] + heights[None, :, None] * np.array([0, 0, 1.0])).reshape(-1, 3)
            parts.append((wall, np.tile([-dx, -dy, 0.0], (len(wall), 1)), SurfaceKind.WALL))
        kinds = np.concatenate([np.full(len(points), kind) for points, _, kind in parts])
        return np.concatenate([p for p, _, _ in parts]), np.concatenate([n for _, n, _ in parts]), kinds


def plan(size_m: tuple[float, float], *boxes: tuple[float, float, float, float]) -> np.ndarray:
    """A picture with open boxes (x from, to, y from, to), metres."""
    mask = np.zeros((round(size_m[1] / STEP_M), round(size_m[0] / STEP_M)), np.bool_)
    for x0, x1, y0, y1 in boxes:
        mask[round(y0 / STEP_M) : round(y1 / STEP_M), round(x0 / STEP_M) : round(x1 / STEP_M)] = True
    return mask


def cloud_of(*levels: RasterMine, origin_m: tuple[float, float, float] = (0, 0, 0), seed: int = 0) -> MapCloud:
    """All levels as one map with 1 cm of noise; `surface` holds the truth."""
    points, normals, kinds = (np.concatenate(parts) for parts in zip(*(mine.points for mine in levels), strict=True))
    points = points + np.random.default_rng(seed).normal(0, 0.01, points.shape)
    n = len(points)
    return MapCloud(
        origin_m=np.array(origin_m, dtype=np.float64),
        points_m=points.astype(np.float32),
        normals=normals.astype(np.float32),
        counts=np.full(n, 10, np.int32),
        visits=np.full(n, 3, np.int32),
        thickness_m=np.full(n, 0.01, np.float32),
        near_m=np.full(n, 2.0, np.float32),
        surface=kinds.astype(np.uint8),
        voxel_m=STEP_M,
    )
