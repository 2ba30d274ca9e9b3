"""What cameras see. Camera frames are optical: x right, y down, z ahead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.data.arrays import F32, U8
from mineloc.data.checks import freeze, need


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A pinhole camera without distortion.

    Attributes:
        width_px, height_px: size of its images.
        fx_px, fy_px: focal lengths.
        cx_px, cy_px: principal point; the centre of the first pixel is (0, 0).
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        need(self.width_px > 0 and self.height_px > 0, "an image has pixels")
        need(self.fx_px > 0 and self.fy_px > 0, "focal lengths are positive")


@dataclass(frozen=True, slots=True, eq=False)
class DepthImage:
    """One image of a depth camera.

    Attributes:
        stamp_ns: the time of exposure (global shutter).
        depth_m: (height, width) float32, distance along the optical axis, 0 where unknown.
        camera: its geometry.
    """

    stamp_ns: int
    depth_m: F32
    camera: CameraModel

    def __post_init__(self) -> None:
        need(self.depth_m.shape == (self.camera.height_px, self.camera.width_px), "depth_m must be (height, width)")
        need(self.depth_m.dtype == np.float32, "depth_m must be float32")
        freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class GreyImage:
    """One image of a camera, in grey.

    Attributes:
        stamp_ns: the time of exposure.
        pixels: (height, width) uint8.
        camera: its geometry.
    """

    stamp_ns: int
    pixels: U8
    camera: CameraModel

    def __post_init__(self) -> None:
        need(self.pixels.shape == (self.camera.height_px, self.camera.width_px), "pixels must be (height, width)")
        need(self.pixels.dtype == np.uint8, "pixels must be uint8")
        freeze(self)
