"""LOAM's sweep-to-sweep correspondences: lines and planes through points of different rings (METHOD 4.1).

A sharp point is matched to the line through its nearest less sharp point of the last sweep and the nearest one on
another ring close by; a flat point to the plane through its nearest less flat point, a second one of the same ring and
a third one of another ring.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mineloc import se3
from mineloc.compiled import njit
from mineloc.data import F32, F64, I64, Sweep
from mineloc.odometry.loam_features import ring_starts
from mineloc.odometry.loam_solver import Matches

_SHORTEST_NORMAL_M2 = 1e-6
"""Three points whose cross product is shorter lie on one line: no plane."""

_BLOCK = 32
"""Points in one box of the search."""


def match_lines(sharp: Sweep, reference: Sweep, T_reference_lidar: F64, *, distance_m: float, rings: float) -> Matches:
    """Point-to-line correspondences.

    Args:
        sharp: edge points, deskewed.
        reference: less sharp points of the last sweep, deskewed, sorted by ring.
        T_reference_lidar: (4, 4) assumed motion.
        distance_m: both points of the line must be nearer than this.
        rings: how far apart the rings of the line's points may be.
    """
    starts = ring_starts(reference)
    query = se3.apply(T_reference_lidar, sharp.points_lidar)
    found = nearest_on_two_rings(query, reference.points_lidar, starts, distance_m**2, int(rings))
    some = (found[:, 0] >= 0) & (found[:, 2] >= 0)
    a, b = (reference.points_lidar[found[some, k]].astype(np.float64) for k in (0, 2))
    return _matches(sharp.points_lidar[some], a, b - a, shortest=0.0, is_line=True)


def match_planes(flat: Sweep, reference: Sweep, T_reference_lidar: F64, *, distance_m: float, rings: float) -> Matches:
    """Point-to-plane correspondences.

    Args:
        flat: plane points, deskewed.
        reference: less flat points of the last sweep, deskewed, sorted by ring.
        T_reference_lidar: (4, 4) assumed motion.
        distance_m: all three points of the plane must be nearer than this.
        rings: how far apart the rings of the plane's points may be.
    """
    starts = ring_starts(reference)
    query = se3.apply(T_reference_lidar, flat.points_lidar)
    found = nearest_on_two_rings(query, reference.points_lidar, starts, distance_m**2, int(rings))
    some = (found >= 0).all(axis=1)
    a, b, c = (reference.points_lidar[found[some, k]].astype(np.float64) for k in range(3))
    return _matches(flat.points_lidar[some], a, np.cross(b - a, c - a), shortest=_SHORTEST_NORMAL_M2, is_line=False)


def _matches(points_lidar: F32, anchors: F64, axes: F64, *, shortest: float, is_line: bool) -> Matches:
    """Matches with axes made unit vectors, without those too short; never firm (too few points)."""
    length = np.linalg.norm(axes, axis=1)
    good = length > shortest
    count = int(good.sum())
    return Matches(
        points_lidar[good].astype(np.float64),
        anchors[good],
        axes[good] / length[good, None],
        is_line=np.full(count, is_line),
        is_firm=np.zeros(count, np.bool_),
    )


@njit(cache=True, nogil=True)
def nearest_on_two_rings(query: F64, points: F32, starts: I64, limit2: float, rings: int) -> I64:
    """For every query point: the nearest point, the next one on its ring, and the nearest on another ring close by.

    Args:
        query: (m, 3).
        points: (n, 3) sorted by ring.
        starts: (r + 1,) from `ring_starts`.
        limit2: squared distance that all three must stay below.
        rings: the third point's ring differs by 1 to `rings` from the first one's.

    Returns:
        (m, 3) indices, -1 where there is none; among equals the lowest.
    """
    out = np.full((query.shape[0], 3), -1, np.int64)
    boxes, box_starts, ring_boxes = _box_rings(points, starts)
    near = np.empty(boxes.shape[0])
    last = starts.shape[0] - 1
    for i in range(query.shape[0]):
        q = query[i]
        k, _ = _nearest(q, points, boxes, box_starts, 0, boxes.shape[0], -1, limit2, near)
        if k < 0:
            continue
        ring = np.searchsorted(starts, k, side="right") - 1
        out[i, 0] = k
        a = ring_boxes[ring]
        b = ring_boxes[ring + 1]
        out[i, 1], _ = _nearest(q, points, boxes, box_starts, a, b, k, limit2, near)
        low = ring_boxes[max(ring - rings, 0)]
        high = ring_boxes[min(ring + rings + 1, last)]
        below, below2 = _nearest(q, points, boxes, box_starts, low, a, k, limit2, near)
        above, above2 = _nearest(q, points, boxes, box_starts, b, high, k, limit2, near)
        out[i, 2] = below if below >= 0 and (above < 0 or below2 <= above2) else above
    return out


@njit(cache=True, nogil=True)
def _box_rings(points: F32, starts: I64) -> tuple[F64, I64, I64]:
    """Boxes around every `_BLOCK` consecutive points of a ring: neighbours in time are neighbours in space.

    Returns:
        (b, 6) lowest and highest corners, (b + 1,) their first points, (r + 1,) the rings' first boxes.
    """
    rings = starts.shape[0] - 1
    ring_boxes = np.zeros(rings + 1, np.int64)
    for ring in range(rings):
        ring_boxes[ring + 1] = ring_boxes[ring] + (starts[ring + 1] - starts[ring] + _BLOCK - 1) // _BLOCK
    total = ring_boxes[rings]
    boxes = np.empty((total, 6))
    box_starts = np.empty(total + 1, np.int64)
    box_starts[total] = points.shape[0]
    for ring in range(rings):
        for box in range(ring_boxes[ring], ring_boxes[ring + 1]):
            first = starts[ring] + (box - ring_boxes[ring]) * _BLOCK
            box_starts[box] = first
            for axis in range(3):
                low = points[first, axis]
                high = low
                for k in range(first + 1, min(first + _BLOCK, starts[ring + 1])):
                    low = min(low, points[k, axis])
                    high = max(high, points[k, axis])
                boxes[box, axis] = low
                boxes[box, 3 + axis] = high
    return boxes, box_starts, ring_boxes


@njit(cache=True, nogil=True)
def _nearest(
    q: F64, points: F32, boxes: F64, box_starts: I64, first: int, last: int, skip: int, limit2: float, near: F64
) -> tuple[int, float]:
    """Nearest point, other than `skip`, in the boxes first … last - 1 and its squared distance; -1 beyond the limit."""
    best = -1
    best2 = limit2
    if first >= last:
        return best, best2
    closest = first
    for box in range(first, last):
        near[box] = 0.0
        for axis in range(3):
            off = max(boxes[box, axis] - q[axis], q[axis] - boxes[box, 3 + axis], 0.0)
            near[box] += off * off
        if near[box] < near[closest]:
            closest = box
    # the closest box first: it makes the bound that spares most of the others
    best, best2 = _scan_box(q, points, box_starts[closest], box_starts[closest + 1], skip, best, best2)
    for box in range(first, last):
        if box != closest and near[box] <= best2:
            best, best2 = _scan_box(q, points, box_starts[box], box_starts[box + 1], skip, best, best2)
    return best, best2


@njit(cache=True, nogil=True)
def _scan_box(q: F64, points: F32, first: int, last: int, skip: int, best: int, best2: float) -> tuple[int, float]:
    for k in range(first, last):
        x = points[k, 0] - q[0]
        y = points[k, 1] - q[1]
        z = points[k, 2] - q[2]
        d2 = x * x + y * y + z * z
        if k != skip and (d2 < best2 or (d2 == best2 and k < best)):
            best = k
            best2 = d2
    return best, best2


def nearest_on_two_rings_plainly(query: F64, points: F32, ring: NDArray[np.uint16], limit2: float, rings: int) -> I64:
    """`nearest_on_two_rings` in plain numpy, from the matrix of all distances."""
    out = np.full((len(query), 3), -1, np.int64)
    if not len(points):
        return out
    distance2 = np.sum((points.astype(np.float64)[None] - query[:, None]) ** 2, axis=2)
    distance2[distance2 >= limit2] = np.inf
    for i, row in enumerate(distance2):
        nearest = int(np.argmin(row))
        if not np.isfinite(row[nearest]):
            continue
        out[i, 0] = nearest
        apart = np.abs(ring.astype(int) - int(ring[nearest]))
        for column, allowed in ((1, apart == 0), (2, (apart >= 1) & (apart <= rings))):
            candidates = np.where(allowed, row, np.inf)
            candidates[nearest] = np.inf
            k = int(np.argmin(candidates))
            out[i, column] = k if np.isfinite(candidates[k]) else -1
    return out
