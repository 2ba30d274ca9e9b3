"""Registration of a sweep to the patches of the map: planar and non-planar residuals in one 6x6 system.

Errors are those of the motion filter: rotation in the body on the right, position in odom, and the twist, by which the
points of a sweep lie otherwise than the prediction deskewed them: `p_odom = R Exp(δθ + τ δω) p_body + t + δt + τ δv`
with τ ≤ 0 the time of the point against the sweep's end. Without the twist a wrong velocity shifts the sweep, the shift
is taken for motion, and a drone that hovers without an IMU swings itself up. The kernels are compiled;
`linearise_plainly` says the same in numpy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mineloc import se3
from mineloc.compiled import njit, prange
from mineloc.config import OdometryConfig
from mineloc.data import F32, F64, Bool
from mineloc.odometry.information import degeneracy_of
from mineloc.odometry.patches import COUNT, LAMBDA, MAJOR, MEAN, NORMAL, PatchArrays, find
from mineloc.odometry.voxel_map import VoxelMap, fits_at_plainly

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
    min_cosine: float

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
            config.min_incidence_cosine,
        )


class Thinned(NamedTuple):
    """What of a sweep is registered: mean points of its voxels.

    Attributes:
        points_body: (n, 3) deskewed to the sweep's end.
        times_s: (n,) their mean times against the sweep's end, at most zero.
        ranges: (n,) of how many ranges each is the mean.
    """

    points_body: F64
    times_s: F64
    ranges: F64


class Equations(NamedTuple):
    """Normal equations `H δ = -b`, weighted by inverse variances, robust weights included.

    Attributes:
        H: (12, 12) of [rotation (body), position (odom), rate (body), velocity (odom)].
        b: (12,).
    """

    H: F64
    b: F64


class Linearised(NamedTuple):
    """One round.

    Attributes:
        planes, points: what the residuals to planes and to points say.
        planar, other, rejected: residuals to planes, to points, and beyond the gate.
        residual_m: root mean square distance from the planes.
    """

    planes: Equations
    points: Equations
    planar: int
    other: int
    rejected: int
    residual_m: float

    @property
    def H(self) -> F64:
        """(12, 12) of both."""
        return self.planes.H + self.points.H

    @property
    def b(self) -> F64:
        """(12,) of both."""
        return self.planes.b + self.points.b

    def left_open(self, weak_ratio: float) -> F64:
        """(k, 3) directions in odom along which the planes hold next to nothing; see `degeneracy_of`.

        Empty where there is no plane at all: then the points are all there is.
        """
        weak = degeneracy_of(self.planes.H[:6, :6], self.planar, weak_ratio=weak_ratio).weak_directions
        return weak if len(weak) < 3 else weak[:0]

    def held(self, left_open: F64) -> Equations:
        """Both, but points are silent along `left_open`, (k, 3) unit vectors.

        The points of a map travel with the sensor: along a smooth roadway they pretend to hold what nothing holds, and
        the way flown is lost without a word (METHOD 7.1).
        """
        if not len(left_open):
            return Equations(self.H, self.b)
        keep = np.eye(12)
        keep[3:6, 3:6] -= left_open.T @ left_open
        keep[9:, 9:] = keep[3:6, 3:6]
        return Equations(self.planes.H + keep @ self.points.H @ keep, self.planes.b + keep @ self.points.b)


def linearise(
    sweep: Thinned, T_odom_body: F64, twist: F64, maps: tuple[VoxelMap, VoxelMap], w: Weighting
) -> Linearised:
    """Residuals of the points against the finer map, else the coarser.

    A patch that is flat and wide gives a point-to-plane residual. Its variance is the range noise seen along the
    normal, the patch's roughness, and the uncertainty of its plane at that place (a regression's: it grows with the
    distance from the patch's mean). Any other patch gives a point-to-point residual with the patch's own spread: the
    blend that GenZ-ICP showed to be decisive in roadways (METHOD 4.6, 7.1).

    Args:
        sweep: its points.
        T_odom_body: (4, 4) at the sweep's end.
        twist: (6,) [rate (body), velocity (odom)] that came on top since the points were deskewed.
        maps: finer, coarser.
        w: noise and robustness.
    """
    fine, coarse = maps
    # upper triangles of Σ w J Jᵀ, Σ w τ J Jᵀ, Σ w τ² J Jᵀ: a point's motion counts τ times its place
    # planes and points apart
    Hs, bs, tallies = np.zeros((CHUNKS, 2, 3, 6, 6)), np.zeros((CHUNKS, 2, 2, 6)), np.zeros((CHUNKS, _TALLIES))
    T, twist = np.ascontiguousarray(T_odom_body), np.ascontiguousarray(twist)
    _linearise(sweep, T, twist, fine.arrays, fine.voxel_m, coarse.arrays, coarse.voxel_m, w, Hs, bs, tallies)
    planes, points = (
        Equations(_whole(upper), b.reshape(12)) for upper, b in zip(Hs.sum(axis=0), bs.sum(axis=0), strict=True)
    )
    tally = tallies.sum(axis=0)
    planar = int(tally[_PLANAR])
    rms = float(np.sqrt(tally[_SQUARES] / planar)) if planar else float("nan")
    return Linearised(planes, points, planar, int(tally[_OTHER]), int(tally[_REJECTED]), rms)


def _whole(upper: F64) -> F64:
    """(12, 12) from the three (6, 6) sums, of which the upper triangles are there."""
    place, mixed, motion = upper + np.swapaxes(np.triu(upper, 1), 1, 2)
    out = np.empty((12, 12))
    out[:6, :6], out[:6, 6:], out[6:, :6], out[6:, 6:] = place, mixed, mixed, motion
    return out


@njit(cache=True, nogil=True)
def _patch_at(arrays: PatchArrays, inverse_m: float, x: float, y: float, z: float) -> int:
    """Row of the fitted patch at a place, -1 if there is none."""
    ix, iy, iz = int(np.floor(x * inverse_m)), int(np.floor(y * inverse_m)), int(np.floor(z * inverse_m))
    row = find(arrays.keys, arrays.rows, ix, iy, iz)
    if row >= 0 and arrays.fits[row, COUNT] > 0:
        return row
    return -1


@njit(cache=True, nogil=True)
def _is_plane(fit: F32, min_width_m: float, max_flatness: float) -> bool:
    """Flat and wide in both directions.

    Width is the point: the returns of one ring lie in a line, and range noise spreads them *along the beam*, so that
    the plane fitted to them is the ring's own scanning cone. Such patches tilt a pose by degrees at every junction.
    Where walls are rough the cone is wide too; hence `min_cosine`: a wall does not hold the beam that measures it.
    """
    return fit[LAMBDA + 1] > min_width_m * min_width_m and fit[LAMBDA] < max_flatness * _spread(fit)


@njit(cache=True, nogil=True)
def _spread(fit: F32) -> float:
    """Sum of the eigenvalues (m²), not in single precision."""
    return np.float64(fit[LAMBDA]) + fit[LAMBDA + 1] + fit[LAMBDA + 2]


@njit(cache=True, nogil=True)
def _plane_variance(fit: F32, e: F64, r: float, cos2: float, d2: float, ranges: float, w: Weighting) -> float:
    along = fit[MAJOR] * e[0] + fit[MAJOR + 1] * e[1] + fit[MAJOR + 2] * e[2]
    across2 = max(e[0] * e[0] + e[1] * e[1] + e[2] * e[2] - r * r - along * along, 0.0)
    noise = w.range_sigma_m**2 * cos2 + d2 * w.angle_sigma_rad**2 * (1.0 - cos2)
    leverage = 1.0 + along * along / max(fit[LAMBDA + 2], MIN_LAMBDA_M2) + across2 / max(fit[LAMBDA + 1], MIN_LAMBDA_M2)
    plane = (fit[LAMBDA] + MIN_LAMBDA_M2) / fit[COUNT] * leverage
    return noise / ranges + fit[LAMBDA] + plane + w.surface_sigma_m**2


@njit(cache=True, nogil=True)
def _add_row(H: F64, b: F64, J: F64, p: F64, tau: float, T: F64, n: F64, residual: float, weight: float) -> None:
    """One residual along the direction n: J = [p × Rᵀn, n], and τ J for the twist; upper triangles of H."""
    qx = T[0, 0] * n[0] + T[1, 0] * n[1] + T[2, 0] * n[2]
    qy = T[0, 1] * n[0] + T[1, 1] * n[1] + T[2, 1] * n[2]
    qz = T[0, 2] * n[0] + T[1, 2] * n[1] + T[2, 2] * n[2]
    J[0], J[1], J[2] = p[1] * qz - p[2] * qy, p[2] * qx - p[0] * qz, p[0] * qy - p[1] * qx
    J[3], J[4], J[5] = n[0], n[1], n[2]
    for j in range(6):
        wj = weight * J[j]
        b[0, j] += wj * residual
        b[1, j] += tau * wj * residual
        for k in range(j, 6):
            h = wj * J[k]
            H[0, j, k] += h
            H[1, j, k] += tau * h
            H[2, j, k] += tau * tau * h


@njit(cache=True, nogil=True)
def _robust(u: float, kernel: float) -> float:
    """Geman-McClure weight of a squared normalised residual."""
    k2 = kernel * kernel
    return (k2 / (k2 + u)) ** 2


@njit(cache=True, nogil=True)
def _place(point: F64, tau: float, T: F64, twist: F64, p: F64, q: F64, place: F64) -> None:
    """Where a point lies: p in the body, q turned to odom's axes, its place in odom; the twist to first order."""
    wx, wy, wz = tau * twist[0], tau * twist[1], tau * twist[2]
    p[0] = point[0] + wy * point[2] - wz * point[1]
    p[1] = point[1] + wz * point[0] - wx * point[2]
    p[2] = point[2] + wx * point[1] - wy * point[0]
    for a in range(3):
        q[a] = T[a, 0] * p[0] + T[a, 1] * p[1] + T[a, 2] * p[2]
        place[a] = q[a] + T[a, 3] + tau * twist[3 + a]


@njit(cache=True, nogil=True)
def _accumulate(
    sweep: Thinned, start: int, stop: int, T: F64, twist: F64,
    fine: PatchArrays, fine_m: float, coarse: PatchArrays, coarse_m: float, w: Weighting,
    H: F64, b: F64, tally: F64,
) -> None:  # fmt: skip
    J, n, e, p, q, at = np.empty(6), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(start, stop):
        tau = sweep.times_s[i]
        _place(sweep.points_body[i], tau, T, twist, p, q, at)
        patches = fine
        row = _patch_at(fine, 1.0 / fine_m, at[0], at[1], at[2])
        flat = row >= 0 and _is_plane(fine.fits[row], w.min_width_m, w.max_flatness)
        if not flat:
            wider = _patch_at(coarse, 1.0 / coarse_m, at[0], at[1], at[2])
            if wider >= 0 and _is_plane(coarse.fits[wider], 2.0 * w.min_width_m, w.max_flatness):
                patches, row, flat = coarse, wider, True
        if row < 0:
            continue
        fit = patches.fits[row]
        for a in range(3):
            e[a] = at[a] - patches.centres[row, a] - fit[MEAN + a]
        if flat:
            n[0], n[1], n[2] = fit[NORMAL], fit[NORMAL + 1], fit[NORMAL + 2]
            r = n[0] * e[0] + n[1] * e[1] + n[2] * e[2]
            d2 = max(p[0] * p[0] + p[1] * p[1] + p[2] * p[2], MIN_LAMBDA_M2)
            cosine = n[0] * q[0] + n[1] * q[1] + n[2] * q[2]
            if cosine * cosine < w.min_cosine * w.min_cosine * d2:
                continue  # the plane holds the beam
            variance = _plane_variance(fit, e, r, cosine * cosine / d2, d2, sweep.ranges[i], w)
            u = r * r / variance
            if u > w.gate * w.gate:
                tally[_REJECTED] += 1
                continue
            _add_row(H[0], b[0], J, p, tau, T, n, r, _robust(u, w.kernel) / variance)
            tally[_PLANAR] += 1
            tally[_SQUARES] += r * r
        elif w.point_weight > 0:
            variance = _spread(fit) / 3.0 + w.range_sigma_m**2
            u = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) / variance
            if u > w.gate * w.gate:
                tally[_REJECTED] += 1
                continue
            weight = w.point_weight * _robust(u, w.kernel) / variance
            for a in range(3):
                n[0], n[1], n[2] = 0.0, 0.0, 0.0
                n[a] = 1.0
                _add_row(H[1], b[1], J, p, tau, T, n, e[a], weight)
            tally[_OTHER] += 1


@njit(cache=True, nogil=True, parallel=True)
def _linearise(
    sweep: Thinned, T: F64, twist: F64,
    fine: PatchArrays, fine_m: float, coarse: PatchArrays, coarse_m: float, w: Weighting,
    Hs: F64, bs: F64, tallies: F64,
) -> None:  # fmt: skip
    n = len(sweep.points_body)
    size = (n + CHUNKS - 1) // CHUNKS
    for c in prange(CHUNKS):
        _accumulate(
            sweep, c * size, min(n, (c + 1) * size), T, twist, fine, fine_m, coarse, coarse_m, w,
            Hs[c], bs[c], tallies[c],
        )  # fmt: skip


def linearise_plainly(
    sweep: Thinned, T_odom_body: F64, twist: F64, maps: tuple[VoxelMap, VoxelMap], w: Weighting
) -> Linearised:
    """`linearise` in plain numpy: what the kernel is held to."""
    R, t = T_odom_body[:3, :3], T_odom_body[:3, 3]
    tau = sweep.times_s[:, None]
    points = sweep.points_body + np.cross(tau * twist[:3], sweep.points_body)
    places = points @ R.T + t + tau * twist[3:]
    fit, flat = _chosen_plainly(places, maps, w)
    e = places - fit[:, MEAN : MEAN + 3]
    # of the place against a right rotation and a translation in odom, [-R [p]x, 1], and against their rates
    J = np.concatenate([-R @ se3.hat(points), np.tile(np.eye(3), (len(e), 1, 1))], axis=2)
    J = np.concatenate([J, tau[:, :, None] * J], axis=2)
    r = np.einsum("ni,ni->n", fit[:, NORMAL : NORMAL + 3], e)
    turned = points @ R.T
    cosines = np.abs(np.einsum("ni,ni->n", fit[:, NORMAL : NORMAL + 3], turned)) / np.linalg.norm(turned, axis=1)
    variance, square = np.empty(len(e)), np.where(flat, r * r, np.einsum("ni,ni->n", e, e))
    variance[flat] = _plane_variances_plainly(fit[flat], e[flat], turned[flat], sweep.ranges[flat], w)
    variance[~flat] = fit[~flat, LAMBDA : LAMBDA + 3].mean(axis=1) + w.range_sigma_m**2
    u = square / variance
    seen = (fit[:, COUNT] > 0) & np.where(flat, cosines >= w.min_cosine, w.point_weight > 0)
    inside = seen & ~(u > w.gate**2)
    weight = inside * np.where(flat, 1.0, w.point_weight) / (1.0 + u / w.kernel**2) ** 2 / variance
    # a plane counts along its normal, a point in every direction
    n = fit[:, NORMAL : NORMAL + 3]
    onto = np.where(flat[:, None, None], n[:, :, None] * n[:, None, :], np.eye(3))
    planes, points = (
        Equations(
            np.einsum("n,naj,nab,nbk->jk", some, J, onto, J, optimize=True),
            np.einsum("n,naj,nab,nb->j", some, J, onto, e, optimize=True),
        )
        for some in (weight * flat, weight * ~flat)
    )
    planar = inside & flat
    rms = float(np.sqrt(square[planar].mean())) if planar.any() else float("nan")
    return Linearised(planes, points, int(planar.sum()), int((inside & ~flat).sum()), int((seen & ~inside).sum()), rms)


def _chosen_plainly(places: F64, maps: tuple[VoxelMap, VoxelMap], w: Weighting) -> tuple[F64, Bool]:
    """(n, 13) the patch for each place, its mean in odom, count 0 where there is none; (n,) whether it is a plane."""
    fine, coarse = (fits_at_plainly(patches, places) for patches in maps)

    def planes(fit: F64, width_m: float) -> Bool:
        low, mid = fit[:, LAMBDA], fit[:, LAMBDA + 1]
        return (
            (fit[:, COUNT] > 0) & (mid > width_m**2) & (low < w.max_flatness * fit[:, LAMBDA : LAMBDA + 3].sum(axis=1))
        )

    is_fine = planes(fine, w.min_width_m)
    is_coarse = ~is_fine & planes(coarse, 2.0 * w.min_width_m)
    return np.where(is_coarse[:, None], coarse, fine), is_fine | is_coarse


def _plane_variances_plainly(fit: F64, e: F64, turned: F64, ranges: F64, w: Weighting) -> F64:
    """(n,) variance of point-to-plane residuals; `turned` are the points as seen from the sensor, in odom's axes."""
    n, major = fit[:, NORMAL : NORMAL + 3], fit[:, MAJOR : MAJOR + 3]
    d2 = np.maximum(np.einsum("ni,ni->n", turned, turned), MIN_LAMBDA_M2)
    cos2 = np.einsum("ni,ni->n", n, turned) ** 2 / d2
    r, along = np.einsum("ni,ni->n", n, e), np.einsum("ni,ni->n", major, e)
    across2 = np.maximum(np.einsum("ni,ni->n", e, e) - r**2 - along**2, 0.0)
    low, mid, high = fit[:, LAMBDA : LAMBDA + 3].T
    range_noise = (w.range_sigma_m**2 * cos2 + d2 * w.angle_sigma_rad**2 * (1.0 - cos2)) / ranges
    leverage = 1.0 + along**2 / np.maximum(high, MIN_LAMBDA_M2) + across2 / np.maximum(mid, MIN_LAMBDA_M2)
    return range_noise + low + (low + MIN_LAMBDA_M2) / fit[:, COUNT] * leverage + w.surface_sigma_m**2
