"""LOAM's feature points: edges and planes of every ring, by curvature (METHOD 4.1, as in A-LOAM).

Zhang and Singh, *LOAM: Lidar Odometry and Mapping in Real-time*, RSS 2014; counts and thresholds are A-LOAM's. Its one
omission is undone: LOAM's rejection of occluded points and of surfaces parallel to the beam is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit
from mineloc.config import LoamConfig
from mineloc.data import F32, F64, I64, Sweep
from mineloc.sweep import deskew_constant_twist
from mineloc.sweep.voxel_grid import mean_by_label, number_voxels

I8 = NDArray[np.int8]

SHARP, LESS_SHARP, PLAIN, FLAT, UNUSED = 2, 1, 0, -1, -2
"""Labels of points: picked as edge, further edges, neither, picked as plane, too near to the end of a ring."""

REGION = 5
"""Neighbours on each side that curvature and suppression look at."""


@dataclass(frozen=True, slots=True)
class LoamFeatures:
    """The four feature sets of a sweep, each with times and rings, sorted by ring.

    Attributes:
        sharp: the best edges of every sector.
        less_sharp: more edges, `sharp` among them.
        flat: the best plane points of every sector.
        less_flat: everything that is no edge, thinned to one centroid a voxel and ring.
    """

    sharp: Sweep
    less_sharp: Sweep
    flat: Sweep
    less_flat: Sweep

    def deskewed(self, twist_lidar: F64, *, target_ns: int) -> LoamFeatures:
        """All sets at one time, under a constant twist (see `deskew_constant_twist`)."""
        return LoamFeatures(
            deskew_constant_twist(self.sharp, twist_lidar, target_ns=target_ns),
            deskew_constant_twist(self.less_sharp, twist_lidar, target_ns=target_ns),
            deskew_constant_twist(self.flat, twist_lidar, target_ns=target_ns),
            deskew_constant_twist(self.less_flat, twist_lidar, target_ns=target_ns),
        )


def extract_features(sweep: Sweep, config: LoamConfig) -> LoamFeatures:
    """Find the edge and plane points of a sweep.

    Args:
        sweep: points with rings, in the order of firing; not deskewed (curvature is local).
        config: counts and thresholds.

    Raises:
        ValueError: the sweep has no rings.
    """
    if sweep.ring is None:
        raise ValueError("LOAM's features need rings")
    by_ring = sweep.keep(np.argsort(sweep.ring, kind="stable"))
    labels = label_points(
        by_ring.points_lidar,
        ring_starts(by_ring),
        config.curvature_threshold_m2,
        config.sectors,
        config.sharp_per_sector,
        config.less_sharp_per_sector,
        config.flat_per_sector,
        config.neighbour_gap_m2,
        config.reject_unreliable,
    )
    return LoamFeatures(
        sharp=by_ring.keep(labels == SHARP),
        less_sharp=by_ring.keep(labels >= LESS_SHARP),
        flat=by_ring.keep(labels == FLAT),
        less_flat=_thin_by_ring(by_ring.keep((labels == PLAIN) | (labels == FLAT)), config.less_flat_voxel_m),
    )


def ring_starts(sweep: Sweep) -> I64:
    """First index of every ring 0 … r-1 in a sweep sorted by ring, and the number of points: (r + 1,)."""
    assert sweep.ring is not None
    rings = int(sweep.ring[-1]) + 1 if len(sweep) else 0
    return np.searchsorted(sweep.ring, np.arange(rings + 1)).astype(np.int64)


def _thin_by_ring(sweep: Sweep, voxel_m: float) -> Sweep:
    """One centroid a voxel and ring; times are averaged like coordinates."""
    assert sweep.ring is not None
    starts = ring_starts(sweep)
    points: list[F32] = []
    offsets: list[I64] = []
    rings: list[NDArray[np.uint16]] = []
    for ring, (a, b) in enumerate(pairwise(starts)):
        _, voxel_of, count = number_voxels(sweep.points_lidar[a:b], 1.0 / voxel_m)
        points.append(mean_by_label(sweep.points_lidar[a:b], voxel_of, count))
        rings.append(np.full(count, ring, np.uint16))
        if sweep.offsets_ns is not None:
            total = np.bincount(voxel_of, weights=sweep.offsets_ns[a:b], minlength=count)
            offsets.append((total / np.bincount(voxel_of, minlength=count)).astype(np.int64))
    if not points:
        return sweep
    return replace(
        sweep,
        points_lidar=np.concatenate(points),
        offsets_ns=np.concatenate(offsets) if offsets else None,
        ring=np.concatenate(rings),
        intensity=None,
    )


@njit(cache=True, nogil=True)
def label_points(
    points: F32,
    starts: I64,
    threshold: float,
    sectors: int,
    sharp: int,
    less_sharp: int,
    flat: int,
    gap_m2: float,
    reject: bool,
) -> I8:
    """Label every point `SHARP`, `LESS_SHARP`, `PLAIN`, `FLAT` or `UNUSED`.

    Args:
        points: (n, 3) sorted by ring, in the order of firing within a ring.
        starts: (r + 1,) from `ring_starts`.
        threshold: curvature that parts edges from planes, m².
        sectors: parts of a ring that are picked from evenly.
        sharp, less_sharp, flat: picks a sector (`less_sharp` counts the sharp ones too).
        gap_m2: suppression of neighbours ends at a squared gap larger than this.
        reject: leave out occluded points and surfaces parallel to the beam.

    Returns:
        (n,) int8.
    """
    n = points.shape[0]
    labels = np.full(n, UNUSED, np.int8)
    picked = np.zeros(n, np.bool_)
    curvature = np.zeros(n)
    for ring in range(starts.shape[0] - 1):
        a = starts[ring] + REGION
        b = starts[ring + 1] - REGION - 1
        if b - a < sectors:
            continue
        for i in range(a, b):
            curvature[i] = _curvature(points, i)
            labels[i] = PLAIN
        if reject:
            for i in range(a, b):
                _reject_unreliable(points, i, picked)
        for sector in range(sectors):
            first = a + (b - a) * sector // sectors
            last = a + (b - a) * (sector + 1) // sectors
            order = first + np.argsort(curvature[first:last], kind="mergesort")
            _pick_edges(points, curvature, order, threshold, sharp, less_sharp, gap_m2, picked, labels)
            _pick_planes(points, curvature, order, threshold, flat, gap_m2, picked, labels)
    return labels


@njit(cache=True, nogil=True)
def _curvature(points: F32, i: int) -> float:
    """‖Σ p_k − 10 p_i‖² over five neighbours on each side: not divided by range or count (A-LOAM)."""
    total = 0.0
    for axis in range(3):
        d = -2.0 * REGION * points[i, axis]
        for k in range(1, REGION + 1):
            d += np.float64(points[i - k, axis]) + np.float64(points[i + k, axis])
        total += d * d
    return total


@njit(cache=True, nogil=True)
def _gap2(points: F32, i: int, j: int) -> float:
    x = np.float64(points[i, 0]) - np.float64(points[j, 0])
    y = np.float64(points[i, 1]) - np.float64(points[j, 1])
    z = np.float64(points[i, 2]) - np.float64(points[j, 2])
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def _range(points: F32, i: int) -> float:
    x = np.float64(points[i, 0])
    y = np.float64(points[i, 1])
    z = np.float64(points[i, 2])
    return np.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def _reject_unreliable(points: F32, i: int, picked: NDArray[np.bool_]) -> None:
    """Mark what LOAM distrusts around point i: the far side of a depth jump, a surface parallel to the beam."""
    next2 = _gap2(points, i, i + 1)
    here = _range(points, i)
    if next2 > 0.1:
        there = _range(points, i + 1)
        near = min(here, there)
        # both points at the nearer range: their distance over it is the angle between the beams
        angle2 = 0.0
        for axis in range(3):
            d = points[i + 1, axis] * (near / there) - points[i, axis] * (near / here)
            angle2 += d * d
        if angle2 < (0.1 * near) ** 2:
            if here > there:
                picked[i - REGION : i + 1] = True
            else:
                picked[i + 1 : i + REGION + 2] = True
    if next2 > 0.0002 * here * here and _gap2(points, i, i - 1) > 0.0002 * here * here:
        picked[i] = True


@njit(cache=True, nogil=True)
def unreliable_points(points: F32, starts: I64) -> NDArray[np.bool_]:
    """What LOAM distrusts as edges: occluded points, surfaces parallel to the beam; (n,), False at the ends of rings.

    Args:
        points: (n, 3) sorted by ring, in the order of firing within a ring.
        starts: (r + 1,) from `ring_starts`.
    """
    out = np.zeros(points.shape[0], np.bool_)
    for ring in range(starts.shape[0] - 1):
        for i in range(starts[ring] + REGION, starts[ring + 1] - REGION - 1):
            _reject_unreliable(points, i, out)
    return out


@njit(cache=True, nogil=True)
def _suppress_neighbours(points: F32, i: int, gap_m2: float, picked: NDArray[np.bool_]) -> None:
    for step in (1, -1):
        for k in range(1, REGION + 1):
            if _gap2(points, i + step * k, i + step * (k - 1)) > gap_m2:
                break
            picked[i + step * k] = True


@njit(cache=True, nogil=True)
def _pick_edges(
    points: F32,
    curvature: F64,
    order: I64,
    threshold: float,
    sharp: int,
    less_sharp: int,
    gap_m2: float,
    picked: NDArray[np.bool_],
    labels: I8,
) -> None:
    count = 0
    for k in range(order.shape[0] - 1, -1, -1):
        i = order[k]
        if curvature[i] <= threshold or count == less_sharp:
            break
        if picked[i]:
            continue
        count += 1
        labels[i] = SHARP if count <= sharp else LESS_SHARP
        picked[i] = True
        _suppress_neighbours(points, i, gap_m2, picked)


@njit(cache=True, nogil=True)
def _pick_planes(
    points: F32,
    curvature: F64,
    order: I64,
    threshold: float,
    flat: int,
    gap_m2: float,
    picked: NDArray[np.bool_],
    labels: I8,
) -> None:
    count = 0
    for k in range(order.shape[0]):
        i = order[k]
        if curvature[i] >= threshold or count == flat:
            break
        if picked[i]:
            continue
        count += 1
        labels[i] = FLAT
        picked[i] = True
        _suppress_neighbours(points, i, gap_m2, picked)


def curvature_plainly(points: F32) -> F64:
    """Curvature of the inner points of one ring in plain numpy: (n - 10,) for (n, 3)."""
    p = points.astype(np.float64)
    window = np.lib.stride_tricks.sliding_window_view(p, 2 * REGION + 1, axis=0).sum(axis=-1)
    return np.sum((window - (2 * REGION + 1) * p[REGION:-REGION]) ** 2, axis=1)
