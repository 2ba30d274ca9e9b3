"""Rays and distances in a triangle mesh (open3d's Embree scene), in map coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import ArrayLike, NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What rays met.

    Attributes:
        range_m: (n,) float32, infinite where nothing was met.
        normals: (n, 3) float32 unit normals of the triangles met, sign as wound.
    """

    range_m: F32
    normals: F32


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Where vertical rays go through the mesh, sorted by ray and height.

    Attributes:
        ray: (k,) number of the ray.
        height_m: (k,) above its origin.
        upward: (k,) upward component of the normal of the triangle, as wound.
    """

    ray: I64
    height_m: F64
    upward: F64


class Scene:
    """A triangle mesh ready for ray casting. Not shared between processes.

    Args:
        vertices_m: (n, 3) in the map frame.
        triangles: (m, 3).
        threads: of the ray caster, 0: all cores. The result does not depend on it.
    """

    def __init__(self, vertices_m: ArrayLike, triangles: ArrayLike, *, threads: int = 0) -> None:
        vertices = np.asarray(vertices_m, dtype=np.float64)
        # Embree counts in float32: 3 cm at 500 km of a mine grid, so the scene lives around its own origin
        self.origin_m: F64 = np.round((vertices.min(axis=0) + vertices.max(axis=0)) / 2)
        corners = vertices[np.asarray(triangles)]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._upward: F64 = normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
        self._scene.add_triangles(
            _tensor(np.ascontiguousarray(vertices - self.origin_m, dtype=np.float32)),
            _tensor(np.ascontiguousarray(triangles, dtype=np.uint32)),
        )

    def cast(self, rays: F32) -> Hits:
        """First hits of (n, 6) float32 rays `[origin - origin_m, unit direction]`."""
        found = self._scene.cast_rays(_tensor(rays))
        return Hits(found["t_hit"].numpy(), found["primitive_normals"].numpy())

    def ranges_m(self, origins_m: F64, directions: ArrayLike) -> F64:
        """(n,) ranges from (n, 3) origins along (n, 3) or (3,) unit directions, infinite where nothing is met."""
        local = origins_m - self.origin_m
        rays = np.concatenate([local, np.broadcast_to(np.asarray(directions, float), local.shape)], axis=1)
        return self.cast(np.ascontiguousarray(rays, dtype=np.float32)).range_m.astype(np.float64)

    def nearest_m(self, points_m: F64) -> F64:
        """(n, 3) nearest point of the mesh for each of (n, 3) points."""
        query = _tensor(np.ascontiguousarray(points_m - self.origin_m, dtype=np.float32))
        found = self._scene.compute_closest_points(query)["points"].numpy()
        return found.astype(np.float64) + self.origin_m

    def clearance_m(self, points_m: F64) -> F64:
        """(n,) distance of each point to the mesh."""
        return np.linalg.norm(points_m - self.nearest_m(points_m), axis=1)

    def verticals(self, origins_m: F64) -> Crossings:
        """All surfaces that rays straight up from (n, 3) origins cross, in rising order for each ray."""
        local = origins_m - self.origin_m
        rays = np.concatenate([local, np.broadcast_to([0.0, 0.0, 1.0], local.shape)], axis=1)
        found = self._scene.list_intersections(_tensor(np.ascontiguousarray(rays, dtype=np.float32)))
        ray = found["ray_ids"].numpy().astype(np.int64)
        height = found["t_hit"].numpy().astype(np.float64)
        order = np.lexsort((height, ray))
        return Crossings(ray[order], height[order], self._upward[found["primitive_ids"].numpy()[order]])


def _tensor(values: NDArray[Any]) -> Any:
    # open3d's own stubs do not know that numpy arrays are accepted
    return o3d.core.Tensor(values)  # pyright: ignore[reportCallIssue]
