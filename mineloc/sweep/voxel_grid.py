"""Thinning a cloud to one point a voxel. The result depends on the order of the points and on nothing else."""

from __future__ import annotations

import numpy as np

from mineloc.compiled import njit
from mineloc.data import F32, F64, I64

REACH = 1 << 20
"""Voxel coordinates must lie within ±REACH: three of them fit into one 64-bit key."""


def first_in_voxels(points: F32, voxel_m: float) -> I64:
    """Indices of the first point in every occupied voxel, rising.

    Args:
        points: (n, 3), metres.
        voxel_m: edge length.

    Returns:
        (k,) int64: `points[indices]`, or `sweep.keep(indices)` for all fields of a sweep.

    Raises:
        ValueError: `voxel_m` is not positive; a point is not finite or farther than a million voxels away.
    """
    first, _, count = _assign(points, voxel_m)
    return first[:count]


def voxel_centroids(points: F32, voxel_m: float) -> F32:
    """Mean of the points in every occupied voxel, in the order in which the voxels were first entered.

    Args:
        points: (n, 3), metres.
        voxel_m: edge length.

    Returns:
        (k, 3) float32; sums are taken in float64.

    Raises:
        ValueError: as `first_in_voxels`.
    """
    _, voxel_of, count = _assign(points, voxel_m)
    return mean_by_label(points, voxel_of, count)


def _assign(points: F32, voxel_m: float) -> tuple[I64, I64, int]:
    if not voxel_m > 0:
        raise ValueError(f"voxel_m must be positive, not {voxel_m}")
    first, voxel_of, count = number_voxels(points, 1.0 / voxel_m)
    if count < 0:
        raise ValueError(f"a point is not finite or more than {REACH} voxels of {voxel_m} m away")
    return first, voxel_of, count


@njit(cache=True, nogil=True)
def number_voxels(points: F32, voxels_per_m: float) -> tuple[I64, I64, int]:
    """Number the occupied voxels 0, 1, 2 … in the order of their first point (open addressing, linear probing).

    Args:
        points: (n, 3).
        voxels_per_m: inverse edge length.

    Returns:
        (n,) index of the first point by voxel number (valid up to the count), (n,) voxel number by point, and the
        count; the count is -1 when a point is out of reach or not finite.
    """
    n = points.shape[0]
    first = np.empty(n, np.int64)
    voxel_of = np.empty(n, np.int64)
    size = 16
    while size < 2 * n:
        size *= 2
    keys = np.empty(size, np.int64)
    slots = np.full(size, -1, np.int32)
    count = 0
    for i in range(n):
        x = np.floor(points[i, 0] * voxels_per_m)
        y = np.floor(points[i, 1] * voxels_per_m)
        z = np.floor(points[i, 2] * voxels_per_m)
        if not (abs(x) < REACH and abs(y) < REACH and abs(z) < REACH):
            return first, voxel_of, -1
        key = ((np.int64(x) + REACH) << 42) | ((np.int64(y) + REACH) << 21) | (np.int64(z) + REACH)
        # Fibonacci hashing: the product wraps around, its upper bits depend on all bits of the key
        slot = ((key * np.int64(-7046029254386353131)) >> 24) & (size - 1)
        while slots[slot] >= 0 and keys[slot] != key:
            slot = (slot + 1) & (size - 1)
        if slots[slot] < 0:
            slots[slot] = count
            keys[slot] = key
            first[count] = i
            count += 1
        voxel_of[i] = slots[slot]
    return first, voxel_of, count


@njit(cache=True, nogil=True)
def mean_by_label(points: F32, labels: I64, count: int) -> F32:
    """Mean of the points (n, 3) with the same label 0 … count - 1: (count, 3) float32, summed in float64."""
    sums = np.zeros((count, 3))
    members = np.zeros(count)
    for i in range(points.shape[0]):
        k = labels[i]
        members[k] += 1.0
        for axis in range(3):
            sums[k, axis] += points[i, axis]
    out = np.empty((count, 3), np.float32)
    for k in range(count):
        for axis in range(3):
            out[k, axis] = sums[k, axis] / members[k]
    return out


def voxel_members_plainly(points: F32, voxel_m: float) -> tuple[I64, F64]:
    """First indices and centroids (float64) in plain numpy: what the kernels are held to."""
    cells = np.floor(points.astype(np.float64) * (1.0 / voxel_m)).astype(np.int64)
    _, first, voxel_of, members = np.unique(cells, axis=0, return_index=True, return_inverse=True, return_counts=True)
    order = np.argsort(first)
    flat = voxel_of.reshape(-1)
    sums = np.stack([np.bincount(flat, weights=column, minlength=len(first)) for column in points.T.astype(float)], 1)
    return first[order].astype(np.int64), (sums / members[:, None])[order]
