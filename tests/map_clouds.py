"""A map of points alone, for tests."""

from __future__ import annotations

import numpy as np

from mineloc.data import F64, MapCloud, SurfaceKind


def cloud_of(points_m: F64, *, origin_m: F64 | None = None, surface: np.ndarray | None = None) -> MapCloud:
    """Points (n, 3) relative to an origin, walls unless told otherwise."""
    n = len(points_m)
    return MapCloud(
        origin_m=np.zeros(3) if origin_m is None else origin_m,
        points_m=points_m.astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (n, 1)),
        counts=np.full(n, 9, np.int32),
        visits=np.full(n, 2, np.int32),
        thickness_m=np.full(n, 0.01, np.float32),
        near_m=np.full(n, 2.0, np.float32),
        surface=(np.full(n, SurfaceKind.WALL) if surface is None else surface).astype(np.uint8),
        voxel_m=0.1,
    )
