"""LiDAR points in a depth image: where they fall, and which of them the camera cannot see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.data import F32, F64, I64, CameraModel
from mineloc.data.checks import freeze

NEAREST_M = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """LiDAR points that fall into an image, the nearest one a pixel.

    Attributes:
        places_px: (n, 2) column and row from the principal point.
        column, row: (n,) of the pixel.
        inverse_depth: (n,) 1 / m along the optical axis.
    """

    places_px: F64
    column: I64
    row: I64
    inverse_depth: F64

    def __post_init__(self) -> None:
        freeze(self)

    def __len__(self) -> int:
        return len(self.inverse_depth)

    def keep(self, mask: np.ndarray) -> Samples:
        """Only the masked (or indexed) ones."""
        return Samples(self.places_px[mask], self.column[mask], self.row[mask], self.inverse_depth[mask])


def project(points_lidar: F32 | F64, T_camera_lidar: F64, camera: CameraModel) -> Samples:
    """The points that fall into the image.

    Args:
        points_lidar: (n, 3).
        T_camera_lidar: (4, 4) to the optical frame at exposure.
        camera: geometry.
    """
    points = se3.apply(T_camera_lidar, points_lidar)
    points = points[points[:, 2] > NEAREST_M]
    x, y = camera.fx_px * points[:, 0] / points[:, 2], camera.fy_px * points[:, 1] / points[:, 2]
    column = np.rint(x + camera.cx_px).astype(np.int64)
    row = np.rint(y + camera.cy_px).astype(np.int64)
    inside = (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    # the nearest point of a pixel hides the others; sorted so, np.unique takes it first
    order = np.flatnonzero(inside)[np.argsort(points[inside, 2], kind="stable")]
    _, first = np.unique(row[order] * camera.width_px + column[order], return_index=True)
    chosen = order[first]
    return Samples(np.column_stack([x, y])[chosen], column[chosen], row[chosen], 1.0 / points[chosen, 2])
