"""The cylinder wall contour, CWC: a wall contour for every height above the floor (METHOD 5.1 (7)).

Where the plane contour of two intersections is the same, the heights at which their walls bulge are not.
"""

from __future__ import annotations

import numpy as np

from mineloc.config import IntersectionsConfig
from mineloc.data import F32, F64

_LEAST_M = 0.3
_SHIFTS, _ROWS = 3, 1
"""Turns and heights around those of the plane contour that are tried, in bins and rows."""


def contour_matrix(points_level: F32 | F64, point_m: F64, floor_m: float, config: IntersectionsConfig) -> F32:
    """Median horizontal distance of what lies at each height and bearing around a point.

    Args:
        points_level: (n, 3) stacked keyframes, levelled.
        point_m: (2,) invariant point in their frame.
        floor_m: height of the floor there.
        config: `matrix_rows`, `matrix_row_m`, `matrix_below_m`, `contour_bins`, `contour_radius_m`.

    Returns:
        (rows, bins) distance over radius, in (0, 1]; 0 where nothing was seen.
    """
    rows, bins, radius = config.matrix_rows, config.contour_bins, config.contour_radius_m
    away = points_level[:, :2] - point_m
    distance = np.hypot(away[:, 0], away[:, 1])
    row = np.floor((points_level[:, 2] - floor_m + config.matrix_below_m) / config.matrix_row_m).astype(np.int64)
    bearing = np.arctan2(away[:, 1], away[:, 0]) % (2 * np.pi)
    column = np.rint(bearing * (bins / (2 * np.pi))).astype(np.int64) % bins
    inside = (distance <= radius) & (distance > _LEAST_M) & (row >= 0) & (row < rows)
    cell = row[inside] * bins + column[inside]
    order = np.lexsort((distance[inside], cell))
    cell, near = cell[order], distance[inside][order]
    begin = np.flatnonzero(np.diff(cell, prepend=-1))
    count = np.diff(np.append(begin, len(cell)))
    out = np.zeros(rows * bins, np.float32)
    out[cell[begin]] = near[begin + (count - 1) // 2] / radius
    return out.reshape(rows, bins)


def matrix_likeness(a: F32, b: F32, yaw_rad: float, config: IntersectionsConfig) -> float:
    """Similarity of two matrices near a turn, in [0, 1]; 0 when they have too little in common.

    Args:
        a, b: (rows, bins).
        yaw_rad: turn that takes b's bearings to a's, of `contour_likeness`.
        config: `contour_sigma_m`, `contour_radius_m`, `contour_known`.

    Raises:
        ValueError: the shapes differ.
    """
    if a.shape != b.shape:
        raise ValueError(f"matrices of shapes {a.shape} and {b.shape}")
    bins = a.shape[1]
    about = round(yaw_rad * bins / (2 * np.pi))
    scale = config.contour_radius_m / config.contour_sigma_m
    best = 0.0
    for lift in range(-_ROWS, _ROWS + 1):
        one, other = (a[max(lift, 0) :], b[: len(b) - max(lift, 0)]) if lift >= 0 else (a[:lift], b[-lift:])
        for shift in range(about - _SHIFTS, about + _SHIFTS + 1):
            turned = np.roll(other, shift, axis=1)
            both = (one > 0) & (turned > 0)
            if both.sum() < config.contour_known * min(int((one > 0).sum()), int((turned > 0).sum())) or not both.any():
                continue
            best = max(best, float(np.exp(-np.square((one - turned)[both] * scale)).mean()))
    return best
