"""Submaps: the points of neighbouring keyframes as one cloud, each placed by its own pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import open3d as o3d

from mineloc import se3
from mineloc.data import F32, F64
from mineloc.data.checks import freeze, need
from mineloc.sweep.voxel_grid import voxel_centroids

_NEIGHBOURS = 20


@dataclass(frozen=True, eq=False)
class Submap:
    """A piece of the map around one keyframe, its root, in the lidar frame of the root.

    Attributes:
        points_root: (n, 3) float64, one mean point a voxel, within `reach_m` of the root.
        reach_m: radius.
        normal_radius_m: neighbourhood that a normal is fitted to.
    """

    points_root: F64
    reach_m: float
    normal_radius_m: float

    def __post_init__(self) -> None:
        need(self.points_root.ndim == 2 and self.points_root.shape[1] == 3, "points_root must be (n, 3)")
        freeze(self)

    def __len__(self) -> int:
        return len(self.points_root)

    @cached_property
    def normals_root(self) -> F64:
        """(n, 3) unit normals towards the root (FPFH depends on their sign); fitted when they are asked for."""
        return normals_of(self.points_root, radius_m=self.normal_radius_m)

    def thinned(self, every: int) -> Submap:
        """Every so-many-th point: enough to come near."""
        return Submap(self.points_root[::every], self.reach_m, self.normal_radius_m)


def submap_of(
    clouds_lidar: Sequence[F32], T_root_lidar: F64, *, voxel_m: float, reach_m: float, normal_radius_m: float
) -> Submap:
    """Put the clouds of neighbouring keyframes into one.

    Each cloud is placed by its own keyframe's pose. (SC-A-LOAM places all of them by the root's: METHOD 4.2, trap b.)

    Args:
        clouds_lidar: k clouds (n_i, 3), each in the lidar frame of its keyframe.
        T_root_lidar: (k, 4, 4) places of the keyframes seen from the root.
        voxel_m: one mean point a voxel is left.
        reach_m: farther points are left out: their errors grow with the distance.
        normal_radius_m: neighbourhood that a normal is fitted to.

    Raises:
        ValueError: not one pose a cloud.
    """
    if len(clouds_lidar) != len(T_root_lidar):
        raise ValueError(f"{len(clouds_lidar)} clouds, {len(T_root_lidar)} poses")
    placed = [se3.apply(T, cloud) for T, cloud in zip(T_root_lidar, clouds_lidar, strict=True)]
    points = np.concatenate([np.zeros((0, 3)), *placed])
    near = points[np.einsum("ni,ni->n", points, points) < reach_m**2]
    thin = voxel_centroids(near.astype(np.float32), voxel_m).astype(np.float64)
    return Submap(thin, reach_m, normal_radius_m)


def open3d_cloud(submap: Submap, *, normals: bool = True) -> Any:
    """A submap as open3d's PointCloud."""
    cloud = o3d.geometry.PointCloud(_vectors(submap.points_root))
    if normals:
        cloud.normals = _vectors(submap.normals_root)
    return cloud


def _vectors(values: F64) -> Any:
    # open3d refuses read-only arrays, though it copies them
    return o3d.utility.Vector3dVector(values if values.flags.writeable else values.copy())


def normals_of(points: F64, *, radius_m: float) -> F64:
    """(n, 3) unit normals of (n, 3) points from their neighbours within a radius (open3d), towards the origin."""
    if not len(points):
        return np.zeros((0, 3))
    cloud = o3d.geometry.PointCloud(_vectors(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=radius_m, max_nn=_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    return np.asarray(cloud.normals).copy()
