"""Registration of a sweep to the patches of the map: planar and non-planar residuals in one 6x6 system.

Errors are those of the motion filter: rotation in the body on the right, position in odom,
`p_odom = R Exp(δθ) p_body + t + δt`. The kernels are compiled; `linearise_plainly` says the same in numpy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit, prange
from mineloc.config import OdometryConfig
from mineloc.data import F64
from mineloc.odometry.voxel_map import COUNT, LAMBDA, MAJOR, MEAN, NORMAL, PatchArrays, VoxelMap, find

CHUNKS = 8
"""Partial sums, fixed so that the result does not depend on the number of threads."""
MIN_LAMBDA_M2 = 1e-6
_COST, _PLANAR, _OTHER, _REJECTED, _SQUARES = 0, 1, 2, 3, 4
_TALLIES = 5


class Weighting(NamedTuple):
    """Noise and robustness of the residuals; see `OdometryConfig` for the meaning of the numbers."""

    range_sigma_m: float
    angle_sigma_rad: float
    surface_sigma_m: float
    max_flatness: float
    min_width_m: float
    point_weight: float
    kernel: float
    gate: float

    @staticmethod
    def of(config: OdometryConfig) -> Weighting:
        """The weighting that a configuration asks for."""
        return Weighting(
            config.range_sigma_m,
            config.angle_sigma_rad,
            config.surface_sigma_m,
            config.max_flatness,
            config.min_patch_width_m,
            config.point_weight,
            config.kernel_sigmas,
            config.gate_sigmas,
        )


class Linearised(NamedTuple):
    """The normal equations `H δ = -b` of one round.

    Attributes:
        H: (6, 6). b: (6,). Both weighted by inverse variances, robust weights included.
        planar, other, rejected: residuals to planes, to points, and beyond the gate.
        residual_m: root mean square distance from the planes.
    """

    H: F64
    b: F64
    planar: int
    other: int
    rejected: int
    residual_m: float


def linearise(
    points_body: F64, weights: F64, T_odom_body: F64, maps: tuple[VoxelMap, VoxelMap], w: Weighting
) -> Linearised:
    """Residuals of (n, 3) points, each the mean of `weights` ranges, against the finer map, else the coarser.

    A patch that is flat and wide gives a point-to-plane residual. Its variance is the range noise seen along the
    normal, the patch's roughness, and the uncertainty of its plane at that place (a regression's: it grows with the
    distance from the patch's mean). Any other patch gives a point-to-point residual with the patch's own spread: the
    blend that GenZ-ICP showed to be decisive in roadways (METHOD 4.6, 7.1).
    """
    fine, coarse = maps
    R, t = np.ascontiguousarray(T_odom_body[:3, :3]), T_odom_body[:3, 3].copy()
    H, b, tally = _linearise(points_body, weights, R, t, fine.arrays, fine.voxel_m, coarse.arrays, coarse.voxel_m, w)
    planar = int(tally[_PLANAR])
    rms = float(np.sqrt(tally[_SQUARES] / planar)) if planar else float("nan")
    return Linearised(H, b, planar, int(tally[_OTHER]), int(tally[_REJECTED]), rms)


@njit(cache=True, nogil=True, inline="always")
def _patch_at(arrays: PatchArrays, voxel_m: float, x: float, y: float, z: float) -> int:
    """Row of the fitted patch at a place, -1 if there is none."""
    row = find(
        arrays.keys, arrays.rows, int(np.floor(x / voxel_m)), int(np.floor(y / voxel_m)), int(np.floor(z / voxel_m))
    )
    if row >= 0 and arrays.fits[row, COUNT] > 0:
        return row
    return -1


@njit(cache=True, nogil=True, inline="always")
def _is_plane(fit: NDArray[np.float32], min_width_m: float, max_flatness: float) -> bool:
    """Flat and wide in both directions.

    Width is the point: the returns of one ring lie in a line, and range noise spreads them *along the beam*, so that
    the plane fitted to them is the ring's own scanning cone. Such patches tilt a pose by degrees at every junction.
    """
    total = fit[LAMBDA] + fit[LAMBDA + 1] + fit[LAMBDA + 2]
    return fit[LAMBDA + 1] > min_width_m * min_width_m and fit[LAMBDA] < max_flatness * total


@njit(cache=True, nogil=True, inline="always")
def _plane_variance(
    fit: NDArray[np.float32], e: F64, r: float, cos2: float, d2: float, ranges: float, w: Weighting
) -> float:
    along = fit[MAJOR] * e[0] + fit[MAJOR + 1] * e[1] + fit[MAJOR + 2] * e[2]
    across2 = max(e[0] * e[0] + e[1] * e[1] + e[2] * e[2] - r * r - along * along, 0.0)
    noise = w.range_sigma_m**2 * cos2 + d2 * w.angle_sigma_rad**2 * (1.0 - cos2)
    leverage = 1.0 + along * along / max(fit[LAMBDA + 2], MIN_LAMBDA_M2) + across2 / max(fit[LAMBDA + 1], MIN_LAMBDA_M2)
    plane = (fit[LAMBDA] + MIN_LAMBDA_M2) / fit[COUNT] * leverage
    return noise / ranges + fit[LAMBDA] + plane + w.surface_sigma_m**2


@njit(cache=True, nogil=True, inline="always")
def _add_row(H: F64, b: F64, J: F64, p: F64, R: F64, n: F64, residual: float, weight: float) -> None:
    """One residual along the direction n: J = [p × Rᵀn, n]; the upper triangle of H."""
    qx = R[0, 0] * n[0] + R[1, 0] * n[1] + R[2, 0] * n[2]
    qy = R[0, 1] * n[0] + R[1, 1] * n[1] + R[2, 1] * n[2]
    qz = R[0, 2] * n[0] + R[1, 2] * n[1] + R[2, 2] * n[2]
    J[0], J[1], J[2] = p[1] * qz - p[2] * qy, p[2] * qx - p[0] * qz, p[0] * qy - p[1] * qx
    J[3], J[4], J[5] = n[0], n[1], n[2]
    for j in range(6):
        wj = weight * J[j]
        b[j] += wj * residual
        for k in range(j, 6):
            H[j, k] += wj * J[k]


@njit(cache=True, nogil=True, inline="always")
def _robust(u: float, kernel: float) -> float:
    """Geman-McClure weight of a squared normalised residual."""
    k2 = kernel * kernel
    return (k2 / (k2 + u)) ** 2


@njit(cache=True, nogil=True)
def _accumulate(
    points: F64, ranges: F64, start: int, stop: int, R: F64, t: F64,
    fine: PatchArrays, fine_m: float, coarse: PatchArrays, coarse_m: float, w: Weighting,
    H: F64, b: F64, tally: F64,
) -> None:  # fmt: skip
    J, n, e, p, q = np.empty(6), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(start, stop):
        for a in range(3):
            p[a] = points[i, a]
        for a in range(3):
            q[a] = R[a, 0] * p[0] + R[a, 1] * p[1] + R[a, 2] * p[2]
        x, y, z = q[0] + t[0], q[1] + t[1], q[2] + t[2]
        patches = fine
        row = _patch_at(fine, fine_m, x, y, z)
        flat = row >= 0 and _is_plane(fine.fits[row], w.min_width_m, w.max_flatness)
        if not flat:
            wider = _patch_at(coarse, coarse_m, x, y, z)
            if wider >= 0 and _is_plane(coarse.fits[wider], 2.0 * w.min_width_m, w.max_flatness):
                patches, row, flat = coarse, wider, True
        if row < 0:
            continue
        fit = patches.fits[row]
        e[0] = x - patches.centres[row, 0] - fit[MEAN]
        e[1] = y - patches.centres[row, 1] - fit[MEAN + 1]
        e[2] = z - patches.centres[row, 2] - fit[MEAN + 2]
        if flat:
            n[0], n[1], n[2] = fit[NORMAL], fit[NORMAL + 1], fit[NORMAL + 2]
            r = n[0] * e[0] + n[1] * e[1] + n[2] * e[2]
            d2 = max(p[0] * p[0] + p[1] * p[1] + p[2] * p[2], MIN_LAMBDA_M2)
            cosine = n[0] * q[0] + n[1] * q[1] + n[2] * q[2]
            variance = _plane_variance(fit, e, r, cosine * cosine / d2, d2, ranges[i], w)
            u = r * r / variance
            if u > w.gate * w.gate:
                tally[_REJECTED] += 1
                continue
            _add_row(H, b, J, p, R, n, r, _robust(u, w.kernel) / variance)
            tally[_PLANAR] += 1
            tally[_SQUARES] += r * r
        elif w.point_weight > 0:
            variance = (fit[LAMBDA] + fit[LAMBDA + 1] + fit[LAMBDA + 2]) / 3.0 + w.range_sigma_m**2
            u = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) / variance
            if u > w.gate * w.gate:
                tally[_REJECTED] += 1
                continue
            weight = w.point_weight * _robust(u, w.kernel) / variance
            for a in range(3):
                n[0], n[1], n[2] = 0.0, 0.0, 0.0
                n[a] = 1.0
                _add_row(H, b, J, p, R, n, e[a], weight)
            tally[_OTHER] += 1


@njit(cache=True, parallel=True)
def _linearise(
    points: F64, ranges: F64, R: F64, t: F64,
    fine: PatchArrays, fine_m: float, coarse: PatchArrays, coarse_m: float, w: Weighting,
) -> tuple[F64, F64, F64]:  # fmt: skip
    Hs, bs, tallies = np.zeros((CHUNKS, 6, 6)), np.zeros((CHUNKS, 6)), np.zeros((CHUNKS, _TALLIES))
    n = len(points)
    size = (n + CHUNKS - 1) // CHUNKS
    for c in prange(CHUNKS):
        _accumulate(
            points, ranges, c * size, min(n, (c + 1) * size), R, t, fine, fine_m, coarse, coarse_m, w,
            Hs[c], bs[c], tallies[c],
        )  # fmt: skip
    H, b, tally = np.zeros((6, 6)), np.zeros(6), np.zeros(_TALLIES)
    for c in range(CHUNKS):
        H += Hs[c]
        b += bs[c]
        tally += tallies[c]
    for j in range(6):
        for k in range(j):
            H[j, k] = H[k, j]
    return H, b, tally
