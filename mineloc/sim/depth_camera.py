"""A stereo depth camera (RealSense D435): depth from a disparity that is noisy, biased and missing in places.

source: METHOD 9.3. Disparity d = f B / z, so an error of s pixels is one of z² s / (f B) in depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from mineloc.data import CameraModel
from mineloc.sim.camera_mount import BASELINE_M, pixel_rays
from mineloc.sim.machine import in_front
from mineloc.sim.scene import Hits, Scene

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

NEAREST_M = 0.2
STEP_PX = 1.0 / 32.0
"""Of the disparity."""
STEP_M = 0.001
"""Of the depth (z16)."""
_FADE = 12.0  # depth is lost like 1 / (1 + (range / z)^_FADE): a tenth at 6.7 m of 8 m, nine tenths at 9.6 m
_GRAZING = 0.1  # cosine of the incidence at which half of the pixels are lost
_BLOB_PX = 3.0  # matching windows reach so far: errors and holes come in patches
_MODES = 4  # of the bias each way, from constant on


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """How depth is measured wrongly or not at all. Pixels are those of the depth image.

    Attributes:
        subpixel_px: white noise of the disparity, standard deviation.
        correlated_px: noise of the disparity in patches, standard deviation, new in every image.
        bias_px: smooth error of the disparity that stays for a flight (calibration), root mean square over the image.
        range_m: depth at which half of the pixels are lost.
        holes: share of pixels lost by chance.
    """

    subpixel_px: float
    correlated_px: float
    bias_px: float
    range_m: float
    holes: float


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """What is truly before a camera.

    Attributes:
        depth_m: (height, width) float64 along the optical axis, infinite where nothing is met.
        cosine: (height, width) of the incidence angle.
    """

    depth_m: F64
    cosine: F64


class DepthCamera:
    """Looks at a scene with a global shutter; its bias is drawn once.

    Args:
        scene: the mine.
        camera: geometry.
        errors: of the measurement.
        rng: the bias.
    """

    def __init__(self, scene: Scene, camera: CameraModel, errors: DepthErrors, rng: np.random.Generator) -> None:
        self._scene = scene
        self.camera = camera
        self._errors = errors
        self._focal_base = camera.fx_px * BASELINE_M
        rays = pixel_rays(camera)
        self._length: F64 = np.linalg.norm(rays, axis=-1)
        self._directions: F64 = (rays / self._length[..., None]).reshape(-1, 3)
        self.bias_px: F64 = errors.bias_px * smooth_field(camera, rng)

    def look(self, T_map_camera: F64, T_map_box: F64 | None = None) -> DepthView:
        """The truth from (4, 4); a machine's box may stand in the way."""
        rays = np.empty((len(self._directions), 6), np.float32)
        rays[:, :3] = T_map_camera[:3, 3] - self._scene.origin_m
        # not a matrix product: its threads wait for each other longer than this takes
        rays[:, 3:] = np.einsum("ni,ji->nj", self._directions, T_map_camera[:3, :3])
        hits: Hits = self._scene.cast(rays)
        if T_map_box is not None:
            T_scene_box = T_map_box.copy()
            T_scene_box[:3, 3] -= self._scene.origin_m
            hits = in_front(hits, rays, T_scene_box)
        cosine = np.abs(np.einsum("ni,ni->n", rays[:, 3:], hits.normals))
        shape = self._length.shape
        return DepthView(hits.range_m.reshape(shape) / self._length, cosine.reshape(shape).astype(np.float64))

    def measure(self, view: DepthView, rng: np.random.Generator) -> F32:
        """(height, width) depths in metres as the camera reports them, 0 where it knows none.

        Args:
            view: the truth.
            rng: noise and chance.
        """
        errors, shape = self._errors, view.depth_m.shape
        true_px = self._focal_base / view.depth_m
        noise = errors.subpixel_px * rng.standard_normal(shape, np.float32)
        disparity = true_px + self.bias_px + noise + errors.correlated_px * _patches(rng, shape)
        disparity = np.rint(disparity / STEP_PX) * STEP_PX
        depth = self._focal_base / np.maximum(disparity, STEP_PX)
        lost = ndtr(_patches(rng, shape)) < self._loss(view)
        lost |= rng.random(shape, np.float32) < errors.holes
        lost |= hidden_from_right(true_px) | ~np.isfinite(view.depth_m) | (disparity < STEP_PX)
        depth = np.rint(depth / STEP_M) * STEP_M
        return np.where(lost | (depth < NEAREST_M), 0.0, depth).astype(np.float32)

    def _loss(self, view: DepthView) -> F64:
        """(height, width) chance of a pixel to be lost for its distance or for its slant."""
        far = 1.0 / (1.0 + (self._errors.range_m / view.depth_m) ** _FADE)
        slant = 1.0 / (1.0 + (view.cosine / _GRAZING) ** 4)
        return 1.0 - (1.0 - far) * (1.0 - slant)


def hidden_from_right(disparity_px: F64) -> Bool:
    """(height, width) which pixels of the left imager the right one does not see.

    Pixel u is at u − d in the right image. It is hidden where a nearer thing further right in the left image comes to
    lie on or left of it there, and where u − d is outside of the right image.
    """
    there = np.arange(disparity_px.shape[1]) - disparity_px
    others = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
    hidden = there < 0.0
    # neighbours on one slanted surface come close but do not cross
    hidden[:, :-1] |= others[:, 1:] < there[:, :-1]
    return hidden


def smooth_field(camera: CameraModel, rng: np.random.Generator) -> F64:
    """(height, width) field of root mean square 1: a few cosine modes each way, weaker the finer they are."""
    order = np.arange(_MODES)
    u = np.cos(np.pi * order[:, None] * (np.arange(camera.width_px) + 0.5) / camera.width_px)
    v = np.cos(np.pi * order[:, None] * (np.arange(camera.height_px) + 0.5) / camera.height_px)
    weights = rng.standard_normal((_MODES, _MODES)) / (1.0 + order[:, None] + order)
    field = v.T @ weights @ u
    return field / np.sqrt(np.mean(field**2))


def _patches(rng: np.random.Generator, shape: tuple[int, ...]) -> F32:
    """Noise of standard deviation 1 in patches of some pixels."""
    white = rng.standard_normal(shape, np.float32)
    # a Gaussian of width b leaves 1/(2 b √π) of the deviation of white noise, in two dimensions
    smooth = gaussian_filter(white, _BLOB_PX, mode="wrap", truncate=3.0)
    return (smooth * (2.0 * _BLOB_PX * np.sqrt(np.pi))).astype(np.float32)
