"""The map as it grows: placed clouds go in one after the other, one surface cloud comes out."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from mineloc.config import MapConfig
from mineloc.data import F32, F64, MapCloud
from mineloc.mapping.map_outliers import believed
from mineloc.mapping.seen_through import ViewRecorder
from mineloc.mapping.surface_thinning import thin_surface
from mineloc.mapping.voxel_moments import COLUMNS, Voxels, VoxelTable, gather_points, no_voxels

SHARDS = 4
"""Fixed, so that a map does not depend on the number of threads."""


class MapBuilder:
    """Gathers placed clouds voxel by voxel; memory grows with the surface seen, not with the flight.

    Args:
        config: voxel size and weights.
        origin_m: (3,) local origin in the map frame, near the mine: a mine grid does not fit into float32.
    """

    def __init__(self, config: MapConfig, *, origin_m: F64) -> None:
        self.config = config
        self.origin_m: F64 = np.array(origin_m, dtype=np.float64)
        if self.origin_m.shape != (3,) or not np.isfinite(self.origin_m).all():
            raise ValueError(f"origin_m must be three finite numbers, not {origin_m}")
        self._tables = [VoxelTable(k, SHARDS) for k in range(SHARDS)]
        self._sensors: list[F64] = []
        self._views = ViewRecorder(config.view_every_m)
        self._threads = ThreadPoolExecutor(min(SHARDS, os.cpu_count() or 1))

    def __len__(self) -> int:
        return sum(len(table) for table in self._tables)

    def insert(self, points_lidar: F32 | F64, T_map_lidar: F64) -> None:
        """Add one cloud, a visit: a keyframe or a sweep without motion in it.

        Args:
            points_lidar: (n, 3), metres, seen from (0, 0, 0) of their frame.
            T_map_lidar: (4, 4).

        Raises:
            ValueError: a point is not finite or more than a million voxels from the origin.
        """
        transform = np.ascontiguousarray(T_map_lidar[:3], dtype=np.float64).copy()
        transform[:, 3] -= self.origin_m
        points: F32 | F64 = np.ascontiguousarray(points_lidar)  # pyright: ignore[reportAssignmentType]
        parts = list(self._gathered(points, transform))
        visit = len(self._sensors)
        self._sensors.append(transform[:, 3])
        self._views.add(points_lidar, transform)

        def insert(table: VoxelTable) -> None:
            for part in parts:
                table.insert(part, visit)

        list(self._threads.map(insert, self._tables))

    def _gathered(self, points: F32 | F64, transform: F64) -> Iterator[Voxels]:
        """The points in parts, side by side."""
        config = self.config
        ends = [len(points) * k // SHARDS for k in range(SHARDS + 1)]

        def gather(part: int) -> Voxels:
            own = points[ends[part] : ends[part + 1]]
            moments = np.empty((len(own), COLUMNS), np.float32)
            out = Voxels(np.empty(len(own), np.int64), moments, moments.view(np.int32))
            weights = config.max_range_m, config.range_spread_pm2
            count = gather_points(own, transform, *weights, 1.0 / config.voxel_m, out)
            if count < 0:
                raise ValueError(f"a point is not finite or more than a million voxels from {self.origin_m}")
            return out.take(slice(0, count))

        return self._threads.map(gather, range(SHARDS))

    def cloud(self, *, frame: str = "map") -> MapCloud:
        """The surface so far, one point thick, without what moved; all of kind `OTHER`.

        Args:
            frame: name of the frame, for files.
        """
        voxels, edge_m = self._voxels(), self.config.voxel_m
        sensors = np.array(self._sensors).reshape(-1, 3)
        surface = thin_surface(voxels, sensors, edge_m)
        keys = voxels.keys[surface.rows]
        del voxels
        surface = surface.take(believed(surface, keys, self._views.views(), self.config))
        kinds = np.zeros(len(surface.rows), np.uint8)
        return MapCloud(self.origin_m, *surface[1:], kinds, edge_m, frame)

    def _voxels(self) -> Voxels:
        """All voxels sorted by key: the same whatever the number of threads."""
        parts = [table.voxels() for table in self._tables]
        out = no_voxels(sum(len(part.keys) for part in parts))
        order = np.argsort(np.concatenate([part.keys for part in parts]))
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        begin = 0
        for part in parts:
            to = place[begin : begin + len(part.keys)]
            out.keys[to], out.moments[to] = part.keys, part.moments
            begin += len(part.keys)
        return out
