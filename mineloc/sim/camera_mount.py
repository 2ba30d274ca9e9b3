"""The simulated drone's camera: a D435 that looks ahead, below the LiDAR. Depth and grey images share its frame."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mineloc.data import CameraModel
from mineloc.sim.imu import mounting

F64 = NDArray[np.float64]

CameraSize = Literal["848x480", "424x240"]
HFOV_DEG = 87.0
BASELINE_M = 0.05
"""Between the imagers of the depth camera; the right one is not there for grey images."""


def camera_mounting() -> F64:
    """(4, 4) `T_body_camera` of the optical frame: x right, y down, z ahead; some degrees off the LiDAR's axes."""
    optical = np.eye(4)
    optical[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    return mounting(0.7, -1.1, 0.9, (0.12, 0.018, 0.03)) @ optical


def camera_model(size: CameraSize) -> CameraModel:
    """The geometry of images of one size: f = 0.5 W / tan(HFOV / 2).

    source: METHOD 9.3.
    """
    width, height = map(int, size.split("x"))
    focal = 0.5 * width / np.tan(np.deg2rad(HFOV_DEG) / 2.0)
    return CameraModel(width, height, float(focal), float(focal), (width - 1) / 2.0, (height - 1) / 2.0)


def pixel_rays(camera: CameraModel) -> F64:
    """(height, width, 3) directions through all pixels in the optical frame, with z = 1."""
    x = (np.arange(camera.width_px) - camera.cx_px) / camera.fx_px
    y = (np.arange(camera.height_px) - camera.cy_px) / camera.fy_px
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
