"""Thinning a cloud to one point a voxel. The result depends on the order of the points and on nothing else."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit, prange
from mineloc.data import F32, F64, I64, U16

I32 = NDArray[np.int32]

REACH = 1 << 20
"""Voxel coordinates must lie within ±REACH: three of them fit into one 64-bit key."""
PARTS = 4
"""Fixed, so that a result does not depend on the number of threads."""
LANES = 64
_NO_RINGS = np.zeros(0, np.uint16)


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


class VoxelMeans(NamedTuple):
    """What is kept of the points of each voxel.

    Attributes:
        points: (k, 3) float64, their weighted mean.
        times_s: (k,) the weighted mean of their times.
        weights: (k,) the sum of their weights.
    """

    points: F64
    times_s: F64
    weights: F64


def voxel_means(
    points: F32 | F64, times_s: F64, weights: F64, voxel_m: float, *, ring: U16 | None = None
) -> VoxelMeans:
    """As `voxel_centroids`, with times and weights; means of means, weighted so, are the means of all.

    The points are taken in `PARTS` equal parts, side by side; a voxel has a mean for each part that has points in it.
    In a sweep the parts are sectors, and beginning and end, which a sweep sees at different times, are kept apart.

    Args:
        points: (n, 3), metres.
        times_s, weights: (n,); weights are positive.
        voxel_m: edge length.
        ring: (n,) of the points, for speed alone: the next point of a ring is often in the same voxel.

    Raises:
        ValueError: as `first_in_voxels`.
    """
    _check(voxel_m)
    size = (len(points) + PARTS - 1) // PARTS
    sums, counts = np.empty((PARTS, size, 5)), np.zeros(PARTS, np.int64)
    rings = _NO_RINGS if ring is None else ring
    _sum_in_parts(points, times_s, weights, rings, 1.0 / voxel_m, sums, counts)
    if counts.min() < 0:
        raise _out_of_reach(voxel_m)
    means = np.concatenate([part[:count] for part, count in zip(sums, counts, strict=True)])
    weight = means[:, 4].copy()
    means /= weight[:, None]
    return VoxelMeans(np.ascontiguousarray(means[:, :3]), means[:, 3].copy(), weight)


def _check(voxel_m: float) -> None:
    if not voxel_m > 0:
        raise ValueError(f"voxel_m must be positive, not {voxel_m}")


def _out_of_reach(voxel_m: float) -> ValueError:
    return ValueError(f"a point is not finite or more than {REACH} voxels of {voxel_m} m away")


def _assign(points: F32, voxel_m: float) -> tuple[I64, I64, int]:
    _check(voxel_m)
    first, voxel_of, count = number_voxels(points, 1.0 / voxel_m)
    if count < 0:
        raise _out_of_reach(voxel_m)
    return first, voxel_of, count


@njit(cache=True, nogil=True)
def _key(x: float, y: float, z: float) -> int | np.int64:
    """Three voxel coordinates within reach as one number that is not negative; -1 beyond."""
    if not (abs(x) < REACH and abs(y) < REACH and abs(z) < REACH):
        return -1
    return ((np.int64(x) + REACH) << 42) | ((np.int64(y) + REACH) << 21) | (np.int64(z) + REACH)


@njit(cache=True, nogil=True)
def _slot_of(slots: I32, keys: I64, key: int | np.int64) -> int | np.int64:
    """Where a key stands in a table, or where it would (open addressing, linear probing)."""
    mask = len(slots) - 1
    # Fibonacci hashing: the product wraps around, its upper bits depend on all bits of the key
    slot = ((key * np.int64(-7046029254386353131)) >> 24) & mask
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def number_voxels(points: F32, voxels_per_m: float) -> tuple[I64, I64, int]:
    """Number the occupied voxels 0, 1, 2 … in the order of their first point.

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
    keys = np.empty(n, np.int64)
    slots = np.full(size, -1, np.int32)
    count = 0
    for i in range(n):
        key = _key(
            np.floor(points[i, 0] * voxels_per_m),
            np.floor(points[i, 1] * voxels_per_m),
            np.floor(points[i, 2] * voxels_per_m),
        )
        if key < 0:
            return first, voxel_of, -1
        slot = _slot_of(slots, keys, key)
        if slots[slot] < 0:
            slots[slot] = count
            keys[count] = key
            first[count] = i
            count += 1
        voxel_of[i] = slots[slot]
    return first, voxel_of, count


@njit(cache=True, nogil=True)
def _sum_in_voxels(points: F32 | F64, times_s: F64, weights: F64, ring: U16, voxels_per_m: float, sums: F64) -> int:
    """Sums of w x, w y, w z, w t, w by voxel, in the order of their first point; how many, -1 out of reach."""
    n = len(points)
    size = 16
    while size < 2 * n:
        size *= 2
    slots, keys = np.full(size, -1, np.int32), np.empty(n, np.int64)
    key_before, row_before = np.full(LANES, -1, np.int64), np.zeros(LANES, np.int32)
    count = 0
    for i in range(n):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        key = _key(np.floor(x * voxels_per_m), np.floor(y * voxels_per_m), np.floor(z * voxels_per_m))
        if key < 0:
            return -1
        lane = ring[i] % LANES if len(ring) else 0
        if key_before[lane] == key:
            row = row_before[lane]
        else:
            slot = _slot_of(slots, keys, key)
            row = slots[slot]
            if row < 0:
                row = np.int32(count)
                slots[slot], keys[count] = row, key
                sums[count] = 0.0
                count += 1
            key_before[lane], row_before[lane] = key, row
        w = weights[i]
        sums[row, 0] += w * x
        sums[row, 1] += w * y
        sums[row, 2] += w * z
        sums[row, 3] += w * times_s[i]
        sums[row, 4] += w
    return count


@njit(cache=True, nogil=True, parallel=True)
def _sum_in_parts(
    points: F32 | F64, times_s: F64, weights: F64, ring: U16, voxels_per_m: float, sums: F64, counts: I64
) -> None:
    size = sums.shape[1]
    for part in prange(PARTS):
        a = min(part * size, len(points))
        b = min(a + size, len(points))
        rings = ring[a:b] if len(ring) else ring
        counts[part] = _sum_in_voxels(points[a:b], times_s[a:b], weights[a:b], rings, voxels_per_m, sums[part])


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
