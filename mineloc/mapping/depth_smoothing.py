"""The inverse depth of an image, smoothed by affine functions that end at edges.

A plane's inverse depth is an affine function of the pixel: smoothing in it bends no wall, however steep.
"""

from __future__ import annotations

import numpy as np

from mineloc.compiled import njit, prange
from mineloc.data import F32, F64

FEWEST = 6
_GUIDE_NOISE = 0.45


def smooth_inverse_depth(
    inverse: F32, *, sigma: float, half_px: int, edge_sigmas: float, edge_slope: float
) -> tuple[F32, F32]:
    """Fit an affine function around every pixel, to the neighbours that no edge divides from it.

    Args:
        inverse: (h, w) inverse depth, 0 where unknown.
        sigma: white noise of a pixel.
        half_px: half of the square window.
        edge_sigmas, edge_slope: a neighbour is beyond an edge when it is farther off than so many sigma and so much of
            the value a pixel of distance.

    Returns:
        (h, w) smoothed inverse depth, 0 where unknown, and (h, w) the share of the white variance that is left.
    """
    # first a little, so that edges are sought in less noise; nine values leave a third of it
    guide, _ = _smooth(inverse, inverse, sigma, 1, edge_sigmas, edge_slope)
    return _smooth(inverse, guide, sigma * _GUIDE_NOISE, half_px, edge_sigmas, edge_slope)


@njit(cache=True, parallel=True)
def _smooth(inverse: F32, guide: F32, sigma: float, half: int, sigmas: float, slope: float) -> tuple[F32, F32]:
    rows, columns = inverse.shape
    out, left = np.zeros((rows, columns), np.float32), np.ones((rows, columns), np.float32)
    for v in prange(rows):
        for u in range(columns):
            if inverse[v, u] > 0:
                value, share = _fit(inverse, guide, v, u, sigma, half, sigmas, slope)
                out[v, u], left[v, u] = value, share
    return out, left


@njit(cache=True, nogil=True)
def _fit(
    inverse: F32, guide: F32, v: int, u: int, sigma: float, half: int, sigmas: float, slope: float
) -> tuple[float, float]:
    rows, columns = inverse.shape
    centre = guide[v, u]
    n = x = y = xx = xy = yy = s = sx = sy = 0.0
    for j in range(max(0, v - half), min(rows, v + half + 1)):
        for i in range(max(0, u - half), min(columns, u + half + 1)):
            w = inverse[j, i]
            a, b = float(i - u), float(j - v)
            if w > 0 and abs(guide[j, i] - centre) <= sigmas * sigma + slope * centre * max(abs(a), abs(b)):
                n += 1.0
                x += a
                y += b
                xx += a * a
                xy += a * b
                yy += b * b
                s += w
                sx += a * w
                sy += b * w
    # intercept of the least squares plane, by the cofactors of the normal matrix
    c0, c1, c2 = xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y
    det = n * c0 + x * c1 + y * c2
    if n < FEWEST or det < 1e-6:
        return inverse[v, u], 1.0
    return (c0 * s + c1 * sx + c2 * sy) / det, c0 / det


def smooth_plainly(
    inverse: F32, *, sigma: float, half_px: int, edge_sigmas: float, edge_slope: float
) -> tuple[F64, F64]:
    """As `smooth_inverse_depth`, in plain numpy, pixel by pixel."""
    law = {"edge_sigmas": edge_sigmas, "edge_slope": edge_slope}
    guide, _ = _fit_plainly(inverse, inverse, sigma=sigma, half_px=1, **law)
    return _fit_plainly(inverse, guide, sigma=sigma * _GUIDE_NOISE, half_px=half_px, **law)


def _fit_plainly(
    inverse: F32, guide: F32 | F64, *, sigma: float, half_px: int, edge_sigmas: float, edge_slope: float
) -> tuple[F64, F64]:
    out, left = np.zeros(inverse.shape), np.ones(inverse.shape)
    for v, u in np.argwhere(inverse > 0):
        rows = slice(max(0, v - half_px), v + half_px + 1)
        columns = slice(max(0, u - half_px), u + half_px + 1)
        patch = inverse[rows, columns].astype(np.float64)
        b, a = np.mgrid[rows.start : rows.start + patch.shape[0], columns.start : columns.start + patch.shape[1]]
        a, b = a - u, b - v
        gate = edge_sigmas * sigma + edge_slope * float(guide[v, u]) * np.maximum(abs(a), abs(b))
        near = (patch > 0) & (abs(guide[rows, columns] - float(guide[v, u])) <= gate)
        A = np.column_stack([np.ones(int(near.sum())), a[near], b[near]])
        normal = A.T @ A
        if near.sum() < FEWEST or np.linalg.det(normal) < 1e-6:
            out[v, u] = inverse[v, u]
            continue
        out[v, u] = np.linalg.solve(normal, A.T @ patch[near])[0]
        left[v, u] = np.linalg.inv(normal)[0, 0]
    return out, left
