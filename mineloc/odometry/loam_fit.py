"""A line or a plane through a few neighbours (METHOD 4.1)."""

from __future__ import annotations

import numpy as np

from mineloc.compiled import njit
from mineloc.data import F64

NO_FIT, FITS, FIRM = 0, 1, 2

_FIRM_WIDTH = 0.1
_FIRM_FLATNESS = 0.03
"""Eigenvalue ratios of a plane that says something about the wall. Calibrated on VLP-16 sweeps with 0-3 cm of noise: in
a smooth tunnel these planes hold at most 0.0015 of the information along the axis that they hold across, all planes
0.03, lines fitted to noise 0.2; where the walls are rough all three agree."""


@njit(cache=True, nogil=True)
def fit_line(points: F64, ratio: float, centre: F64, axis: F64) -> int:
    """Line through the centroid along the largest spread; a line only if λ_max > ratio · λ_mid.

    Args:
        points: (k, 3).
        ratio: how much the largest eigenvalue must exceed the second.
        centre, axis: (3,) receive the centroid and the unit direction.

    Returns:
        `NO_FIT` or `FITS`; a line is never `FIRM`, for noise makes lines too.
    """
    covariance = _covariance(points, centre)
    _, mid, high = eigenvalues(covariance)
    if not high > ratio * mid:
        return NO_FIT
    eigenvector(covariance, high, axis)
    return FITS


@njit(cache=True, nogil=True)
def fit_plane(points: F64, tolerance_m: float, centre: F64, axis: F64) -> int:
    """Plane through the centroid across the smallest spread; a plane only if all points lie within the tolerance.

    A-LOAM solves A n = −1 in map coordinates instead, which depends on where the map's origin lies and has no answer
    for a plane through it; the rule of validity is A-LOAM's.

    Args:
        points: (k, 3).
        tolerance_m: largest distance of a point from the plane.
        centre, axis: (3,) receive the centroid and the unit normal.

    Returns:
        `NO_FIT`, `FITS`, or `FIRM` when the points also spread in two directions: neighbours on one arc of one ring
        lie on any plane through it.
    """
    covariance = _covariance(points, centre)
    low, mid, high = eigenvalues(covariance)
    eigenvector(covariance, low, axis)
    for i in range(points.shape[0]):
        off = 0.0
        for k in range(3):
            off += axis[k] * (points[i, k] - centre[k])
        if not abs(off) <= tolerance_m:
            return NO_FIT
    return FIRM if mid > _FIRM_WIDTH * high and low < _FIRM_FLATNESS * mid else FITS


@njit(cache=True, nogil=True)
def _covariance(points: F64, centre: F64) -> F64:
    n = points.shape[0]
    for k in range(3):
        centre[k] = 0.0
        for i in range(n):
            centre[k] += points[i, k]
        centre[k] /= n
    out = np.zeros((3, 3))
    for i in range(n):
        for a in range(3):
            for b in range(3):
                out[a, b] += (points[i, a] - centre[a]) * (points[i, b] - centre[b])
    return out / n


@njit(cache=True, nogil=True)
def eigenvalues(a: F64) -> tuple[float, float, float]:
    """Eigenvalues of a symmetric (3, 3) matrix, rising, in closed form (Smith, CACM 4(4), 1961)."""
    q = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
    x = a[0, 0] - q
    y = a[1, 1] - q
    z = a[2, 2] - q
    off2 = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
    p = np.sqrt((x * x + y * y + z * z + 2.0 * off2) / 6.0)
    if p == 0.0:
        return q, q, q
    det = (
        x * (y * z - a[1, 2] * a[1, 2])
        - a[0, 1] * (a[0, 1] * z - a[1, 2] * a[0, 2])
        + a[0, 2] * (a[0, 1] * a[1, 2] - y * a[0, 2])
    )
    phi = np.arccos(min(max(det / (2.0 * p * p * p), -1.0), 1.0)) / 3.0
    high = q + 2.0 * p * np.cos(phi)
    low = q + 2.0 * p * np.cos(phi + 2.0 * np.pi / 3.0)
    return low, 3.0 * q - high - low, high


@njit(cache=True, nogil=True)
def eigenvector(a: F64, value: float, out: F64) -> None:
    """Unit eigenvector of a symmetric (3, 3) matrix: the longest cross product of two rows of `a − value I`.

    A double eigenvalue has many: one across the longest row is given.
    """
    m = a.copy()
    for k in range(3):
        m[k, k] -= value
    best = 0.0
    largest = 0.0
    row = 0
    for i in range(3):
        size = m[i, 0] ** 2 + m[i, 1] ** 2 + m[i, 2] ** 2
        if size > largest:
            largest = size
            row = i
        j = (i + 1) % 3
        x = m[i, 1] * m[j, 2] - m[i, 2] * m[j, 1]
        y = m[i, 2] * m[j, 0] - m[i, 0] * m[j, 2]
        z = m[i, 0] * m[j, 1] - m[i, 1] * m[j, 0]
        length2 = x * x + y * y + z * z
        if length2 > best:
            best = length2
            out[0] = x
            out[1] = y
            out[2] = z
    if best <= 1e-24 * largest * largest:
        smallest = 0
        for k in range(1, 3):
            if abs(m[row, k]) < abs(m[row, smallest]):
                smallest = k
        i = (smallest + 1) % 3
        j = (smallest + 2) % 3
        out[smallest] = 0.0
        out[i] = -m[row, j]
        out[j] = m[row, i]
        if largest == 0.0:
            out[i] = 1.0
    length = np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    for k in range(3):
        out[k] /= length
