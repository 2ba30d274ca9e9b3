"""One dense depth image from a depth camera and a LiDAR, with a standard deviation for every pixel (METHOD 6.1).

Stands in for Chen et al. 2022 (paper A's reference 39), whose text is not at hand. A stereo camera errs in disparity,
so all is done in inverse depth, where its error n is stationary and a plane is an affine function of the pixel:

    camera, smoothed:  w_S(u) = w(u) + n(u)          n: drift (calibration) + patches + what smoothing left of the noise
    LiDAR:             w_L(u_i) = w(u_i) + noise
    so                 w_S(u_i) - w_L(u_i) = n(u_i) - noise

n is kriged from its values at the LiDAR's pixels and taken off. What is left, w_S - n̂, has the kriging variance of n:
nothing is counted twice. (METHOD's weighted mean of z_k and z_C takes the two for independent; but z_k = z_C + δ̂ holds
all of z_C's noise at the pixel, and the mean would claim up to √2 too little error.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from mineloc.config import FusionConfig
from mineloc.data import F32, F64, I64, CameraModel, DepthImage
from mineloc.data.checks import freeze, need
from mineloc.mapping.depth_holes import fill_from_lidar
from mineloc.mapping.depth_projection import Samples, project
from mineloc.mapping.depth_smoothing import smooth_inverse_depth
from mineloc.mapping.kriging import fit_drift, krige_near
from mineloc.mapping.variogram import BinnedLags, bin_lags, fit_exponential

_VARIOGRAM_SAMPLES = 400
_CLEAN_SHARE = 0.1  # smoothing of a pixel well inside a surface leaves less of the white variance
_FORGOTTEN = 0.05  # of the first prior that comes back to the drift with every image


@dataclass(frozen=True, slots=True, eq=False)
class FusedDepth:
    """Depth and its standard deviation, pixel by pixel.

    Attributes:
        stamp_ns: of the image.
        depth_m: (height, width) float32 along the optical axis, 0 where unknown.
        sigma_m: (height, width) float32, infinite where unknown.
        camera: geometry.
    """

    stamp_ns: int
    depth_m: F32
    sigma_m: F32
    camera: CameraModel

    def __post_init__(self) -> None:
        freeze(self)

    def points(self, *, max_sigma_m: float) -> tuple[F32, F32]:
        """(n, 3) points in the optical frame that are surer than that, and (n,) their standard deviations."""
        row, column = np.nonzero(self.sigma_m <= max_sigma_m)
        z = self.depth_m[row, column]
        x = (column - self.camera.cx_px) / self.camera.fx_px * z
        y = (row - self.camera.cy_px) / self.camera.fy_px * z
        return np.column_stack([x, y, z]).astype(np.float32), self.sigma_m[row, column]


class DepthFusion:
    """Fuses the images of one camera; drift and variogram are learned from image to image.

    Args:
        config: noise, neighbourhoods.
        camera: of all images.

    Attributes:
        camera: as given.
    """

    def __init__(self, config: FusionConfig, camera: CameraModel) -> None:
        self.camera = camera
        self._config = config
        # a pixel of disparity in inverse depth: w = d / (f B)
        self._pixel = 1.0 / (camera.fx_px * config.baseline_m)
        slope = config.drift_slope_px * 2.0 / np.array([camera.width_px, camera.height_px])
        self._first_prior = np.diag(np.square([config.drift_px, *slope]) * self._pixel**2)
        self._mean, self._prior = np.zeros(3), self._first_prior
        self._binned: BinnedLags | None = None
        self._sill = (config.patchy_px * self._pixel) ** 2
        self._range_px = config.patch_range_px
        self._lattice = _lattice(camera, config.stride_px)

    def fuse(self, depth: DepthImage, points_lidar: F32 | F64, *, T_camera_lidar: F64) -> FusedDepth:
        """Smooth the camera, krige its error from the LiDAR, take it off; holes from the LiDAR alone.

        Args:
            depth: an image of this camera.
            points_lidar: (n, 3) points of the sweep around it, deskewed; may be none.
            T_camera_lidar: (4, 4) takes them to the optical frame at exposure.

        Raises:
            ValueError: an image of another camera.
        """
        need(depth.camera == self.camera, "an image of another camera")
        smooth, left = self._smoothed(depth)
        lidar = project(points_lidar, T_camera_lidar, self.camera)
        seen, error, open_to_both = self._errors(smooth, left, lidar)
        self._learn(seen, error)
        error_of, variance_of = self._kriged(smooth, seen, error)
        inverse = np.where(smooth > 0, smooth - error_of, 0.0)
        # what the window inside a surface leaves of the noise is in n; beside edges and holes it leaves more
        within = 1.0 / (2 * self._config.window_px + 1) ** 2
        variance = variance_of + np.maximum(left - within, 0.0) * self._white**2
        self._fill(inverse, variance, open_to_both)
        return self._fused(depth.stamp_ns, inverse, variance)

    @property
    def _white(self) -> float:
        return self._config.white_px * self._pixel

    def _smoothed(self, depth: DepthImage) -> tuple[F32, F32]:
        c, known = self._config, depth.depth_m > 0
        inverse = np.where(known, 1.0 / np.where(known, depth.depth_m, 1.0), 0.0).astype(np.float32)
        return smooth_inverse_depth(
            inverse, sigma=self._white, half_px=c.window_px, edge_sigmas=c.edge_sigmas, edge_slope=c.edge_slope
        )

    def _errors(self, smooth: F32, left: F32, lidar: Samples) -> tuple[Samples, F64, Samples]:
        """n at the LiDAR's pixels well inside a surface that both sensors see; and all points but the contradicted.

        The LiDAR looks past edges that hide what is behind from the camera.
        """
        at = smooth[lidar.row, lidar.column]
        error = np.asarray(at - lidar.inverse_depth, dtype=np.float64)
        drift = self._mean[0] + lidar.places_px @ self._mean[1:]
        spread = self._sill + self._noise(lidar) + self._prior[0, 0]
        agrees = np.abs(error - drift) < self._config.edge_sigmas * np.sqrt(spread)
        clean = (at > 0) & (left[lidar.row, lidar.column] < _CLEAN_SHARE) & agrees
        return lidar.keep(clean), error[clean], lidar.keep(agrees | (at <= 0))

    def _noise(self, samples: Samples) -> F64:
        """(n,) variance of the LiDAR's inverse depth, and of the relief that only it sees."""
        c = self._config
        return (c.lidar_sigma_m**2 + c.relief_m**2) * samples.inverse_depth**4

    def _learn(self, seen: Samples, error: F64) -> None:
        """Drift and variogram, from this image and those before."""
        c = self._config
        if len(seen) < 2 * c.neighbours:
            return
        patches = self.camera.width_px * self.camera.height_px / (6.0 * self._range_px**2)
        total = self._sill + float(np.median(self._noise(seen)))
        self._mean, posterior = fit_drift(
            seen.places_px, error, total, mean=self._mean, prior=self._prior, count=max(patches, 3.0)
        )
        self._prior = posterior + _FORGOTTEN * self._first_prior
        some = slice(None, None, max(1, len(seen) // _VARIOGRAM_SAMPLES))
        rest = error - self._mean[0] - seen.places_px @ self._mean[1:]
        binned = bin_lags(seen.places_px[some], rest[some], lags=c.variogram_lags, reach=c.variogram_reach_px)
        self._binned = binned if self._binned is None else self._binned.blended(binned, c.variogram_share)
        fitted = fit_exponential(self._binned, nugget=float(np.median(self._noise(seen))))
        if fitted is not None:
            least = (0.2 * c.patchy_px * self._pixel) ** 2
            self._sill, self._range_px = max(fitted[0], least), fitted[1]

    def _kriged(self, smooth: F32, seen: Samples, error: F64) -> tuple[F64, F64]:
        """(height, width) n and its variance: kriged on a lattice, bilinear between."""
        rows, columns = self._lattice
        v, u = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
        at = np.column_stack([u - self.camera.cx_px, v - self.camera.cy_px]).astype(np.float64)
        near = self._neighbours(at, smooth[v, u], seen)
        found = krige_near(
            seen.places_px,
            error,
            self._noise(seen),
            at,
            near,
            sill=self._sill,
            range_=self._range_px,
            mean=self._mean,
            prior=self._prior,
        )
        shape = len(rows), len(columns)
        value, variance = (_upsampled(one.reshape(shape), rows, columns, smooth.shape) for one in found)
        return value, variance

    def _neighbours(self, at: F64, inverse: F32, seen: Samples) -> I64:
        """(m, k) nearest samples of each place that no edge divides from it; -1: none."""
        c = self._config
        count = min(c.neighbours, len(seen))
        if not count:
            return np.full((len(at), 1), -1, np.int64)
        gap, index = KDTree(seen.places_px).query(at, k=count)
        gap, index = gap.reshape(len(at), count), np.asarray(index, dtype=np.int64).reshape(len(at), count)
        centre = inverse[:, None].astype(np.float64)
        limit = c.edge_sigmas * self._pixel * (c.white_px + c.drift_px) + c.edge_slope * centre * gap
        beyond = (centre > 0) & (np.abs(seen.inverse_depth[index] - centre) > limit)
        index[beyond] = -1
        order = np.argsort(beyond, axis=1, kind="stable")
        return np.ascontiguousarray(np.take_along_axis(index, order, axis=1))

    def _fill(self, inverse: F64, variance: F64, lidar: Samples) -> None:
        """Where the camera saw nothing: the LiDAR's own inverse depth, where it lies all around on one surface."""
        row, column = np.nonzero(inverse <= 0)
        at = np.column_stack([column - self.camera.cx_px, row - self.camera.cy_px]).astype(np.float64)
        filled = fill_from_lidar(at, lidar, self._noise(lidar), self._config)
        inverse[row[filled.chosen], column[filled.chosen]] = filled.inverse_depth
        variance[row[filled.chosen], column[filled.chosen]] = filled.variance

    def _fused(self, stamp_ns: int, inverse: F64, variance: F64) -> FusedDepth:
        known = inverse > 1e-3
        depth = np.where(known, 1.0 / np.where(known, inverse, 1.0), 0.0)
        relief = self._config.relief_m
        sigma = np.where(known, np.sqrt(variance * depth**4 + relief**2), np.inf)
        return FusedDepth(stamp_ns, depth.astype(np.float32), sigma.astype(np.float32), self.camera)


def _lattice(camera: CameraModel, stride: int) -> tuple[I64, I64]:
    """Rows and columns every `stride` pixels, the last ones included."""
    rows = np.unique(np.append(np.arange(0, camera.height_px, stride), camera.height_px - 1))
    columns = np.unique(np.append(np.arange(0, camera.width_px, stride), camera.width_px - 1))
    return rows.astype(np.int64), columns.astype(np.int64)


def _upsampled(values: F64, rows: I64, columns: I64, shape: tuple[int, ...]) -> F64:
    """Bilinear, from the lattice to every pixel."""
    v, u = np.arange(shape[0]), np.arange(shape[1])
    j = np.clip(np.searchsorted(rows, v, side="right") - 1, 0, len(rows) - 2)
    i = np.clip(np.searchsorted(columns, u, side="right") - 1, 0, len(columns) - 2)
    b = ((v - rows[j]) / (rows[j + 1] - rows[j]))[:, None]
    a = ((u - columns[i]) / (columns[i + 1] - columns[i]))[None, :]
    lines = values[j] * (1 - b) + values[j + 1] * b
    return lines[:, i] * (1 - a) + lines[:, i + 1] * a
