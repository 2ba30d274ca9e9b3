"""LOAM's local map: one point a voxel, nearest neighbours, lines and planes through them (METHOD 4.1).

A-LOAM keeps cubes of 50 m in a grid of 21 × 21 × 11 around the sensor, thins them after every sweep and builds a
KD-tree of the nearest ones for every sweep. Here the voxels hang in hashed buckets of at least the search radius, so
that 27 buckets hold every neighbour that counts: the same neighbours, nothing built anew. As in A-LOAM a voxel's point
moves to the mean of itself and the newly arrived points.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mineloc import se3
from mineloc.compiled import njit
from mineloc.data import F32, F64, I64
from mineloc.odometry.loam_fit import FIRM, NO_FIT, fit_line, fit_plane
from mineloc.odometry.loam_solver import Matches
from mineloc.sweep.voxel_grid import mean_by_label, number_voxels

I32 = NDArray[np.int32]
U16 = NDArray[np.uint16]

NEIGHBOURS = 5
_BITS = 21
_REACH = 1 << (_BITS - 1)


class FeatureMap:
    """One kind of features around the sensor, thinned to a voxel grid.

    Args:
        leaf_m: edge of a voxel.
        search_m: the neighbours of a point must be nearer than this.
        reach_m: (3,) half size of the region around the sensor that is kept.
    """

    def __init__(self, *, leaf_m: float, search_m: float, reach_m: tuple[float, float, float]) -> None:
        self._leaf_m = leaf_m
        self._search_m = search_m
        self._reach_m = np.array(reach_m)
        self._edge = math.ceil(search_m / leaf_m)
        self._kept_around = np.zeros(3)
        self._allocate(256)

    def __len__(self) -> int:
        return int(self._counts[: self._used].sum())

    @property
    def points_map(self) -> F32:
        """(n, 3) all points of the map."""
        inside = np.arange(self._points.shape[1]) < self._counts[: self._used, None]
        return self._points[: self._used][inside]

    def add(self, points_map: F32, position_m: F64) -> None:
        """Put new points into their voxels, and forget what is out of reach of the sensor.

        Args:
            points_map: (n, 3) float32.
            position_m: (3,) of the sensor.
        """
        self._forget_far(position_m)
        _, voxel_of, count = number_voxels(points_map, 1.0 / self._leaf_m)
        if count < 0:
            raise ValueError("a point is not finite or out of reach of the map")
        self._reserve(count)
        means = mean_by_label(points_map, voxel_of, count)
        members = np.bincount(voxel_of, minlength=count).astype(np.float64)
        self._used = insert(
            means, members, self._leaf_m, self._edge, self._used,
            self._slots, self._keys, self._counts, self._cells, self._points,
        )  # fmt: skip

    def match_lines(self, points_lidar: F32, T_map_lidar: F64, *, ratio: float) -> Matches:
        """Lines through the five nearest map points of every point.

        Args:
            points_lidar: (n, 3) float32, deskewed.
            T_map_lidar: (4, 4) assumed pose.
            ratio: largest over second eigenvalue must exceed it.
        """
        return self._match(points_lidar, T_map_lidar, is_line=True, limit=ratio)

    def match_planes(self, points_lidar: F32, T_map_lidar: F64, *, tolerance_m: float) -> Matches:
        """Planes through the five nearest map points of every point.

        Args:
            points_lidar: (n, 3) float32, deskewed.
            T_map_lidar: (4, 4) assumed pose.
            tolerance_m: all five points must lie as close to their plane.
        """
        return self._match(points_lidar, T_map_lidar, is_line=False, limit=tolerance_m)

    def _match(self, points_lidar: F32, T_map_lidar: F64, *, is_line: bool, limit: float) -> Matches:
        fits, anchors, axes = fit_to_neighbours(
            se3.apply(T_map_lidar, points_lidar), self._search_m, self._leaf_m * self._edge, is_line, limit,
            self._slots, self._keys, self._counts, self._points,
        )  # fmt: skip
        good = fits != NO_FIT
        return Matches(
            points_lidar[good].astype(np.float64),
            anchors[good],
            axes[good],
            is_line=np.full(int(good.sum()), is_line),
            is_firm=fits[good] == FIRM,
        )

    def _allocate(self, buckets: int) -> None:
        self._used = 0
        self._slots: I32 = np.full(4 * buckets, -1, np.int32)
        self._keys: I64 = np.empty(buckets, np.int64)
        self._counts: I32 = np.zeros(buckets, np.int32)
        self._cells: U16 = np.empty((buckets, self._edge**3), np.uint16)
        self._points: F32 = np.empty((buckets, self._edge**3, 3), np.float32)

    def _reserve(self, extra: int) -> None:
        """Room for `extra` more buckets, with the table at most a quarter full."""
        if self._used + extra <= len(self._keys):
            return
        self._rebuild(np.arange(self._used), 2 * (self._used + extra))

    def _rebuild(self, kept: I64, buckets: int) -> None:
        old = (self._keys, self._counts, self._cells, self._points)
        self._allocate(1 << max(8, (buckets - 1).bit_length()))
        self._used = len(kept)
        for new, values in zip((self._keys, self._counts, self._cells, self._points), old, strict=True):
            new[: self._used] = values[kept]
        hash_buckets(self._keys[: self._used], self._slots)

    def _forget_far(self, position_m: F64) -> None:
        """Once the sensor has moved a tenth of the reach, drop the buckets outside it."""
        if (np.abs(position_m - self._kept_around) < 0.1 * self._reach_m).all():
            return
        self._kept_around = position_m.copy()
        off = np.abs(self._points[: self._used, 0] - position_m)
        kept = np.flatnonzero((off <= self._reach_m).all(axis=1))
        if len(kept) < self._used:
            self._rebuild(kept, len(kept))


@njit(cache=True, nogil=True, inline="always")
def _key(x: np.int64, y: np.int64, z: np.int64) -> np.int64:
    return ((x + _REACH) << (2 * _BITS)) | ((y + _REACH) << _BITS) | (z + _REACH)


@njit(cache=True, nogil=True, inline="always")
def _find(key: np.int64, slots: I32, keys: I64) -> np.int64:
    """The table slot that holds the key, or the empty one where it belongs."""
    mask = slots.shape[0] - 1
    # Fibonacci hashing: the product wraps around, its upper bits depend on all bits of the key
    slot = ((key * np.int64(-7046029254386353131)) >> 24) & mask
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def hash_buckets(keys: I64, slots: I32) -> None:
    """Enter the buckets 0 … n-1 into an empty table."""
    for i in range(keys.shape[0]):
        slots[_find(keys[i], slots, keys)] = i


@njit(cache=True, nogil=True)
def insert(
    means: F32,
    members: F64,
    leaf_m: float,
    edge: int,
    used: int,
    slots: I32,
    keys: I64,
    counts: I32,
    cells: U16,
    points: F32,
) -> int:
    """Put one mean a voxel into the buckets; an occupied voxel moves to the mean of all. Returns the buckets in use."""
    per_m = 1.0 / leaf_m
    for i in range(means.shape[0]):
        x = np.int64(np.floor(means[i, 0] * per_m))
        y = np.int64(np.floor(means[i, 1] * per_m))
        z = np.int64(np.floor(means[i, 2] * per_m))
        key = _key(x // edge, y // edge, z // edge)
        slot = _find(key, slots, keys)
        if slots[slot] < 0:
            slots[slot] = used
            keys[used] = key
            counts[used] = 0
            used += 1
        bucket = slots[slot]
        cell = ((x % edge) * edge + y % edge) * edge + z % edge
        place = 0
        while place < counts[bucket] and cells[bucket, place] != cell:
            place += 1
        if place == counts[bucket]:
            counts[bucket] += 1
            cells[bucket, place] = cell
            points[bucket, place] = means[i]
        else:
            for k in range(3):
                points[bucket, place, k] = (points[bucket, place, k] + members[i] * means[i, k]) / (1.0 + members[i])
    return used


@njit(cache=True, nogil=True)
def _neighbours(
    q: F64, search_m: float, bucket_m: float, slots: I32, keys: I64, counts: I32, points: F32, found: F64, found2: F64
) -> bool:
    """The five nearest points into `found` (5, 3); False when the fifth is not nearer than the search radius."""
    for k in range(NEIGHBOURS):
        found2[k] = search_m * search_m
    have = 0
    bx = np.int64(np.floor(q[0] / bucket_m))
    by = np.int64(np.floor(q[1] / bucket_m))
    bz = np.int64(np.floor(q[2] / bucket_m))
    for index in range(27):
        # the own bucket first: it fills the list and spares most of the others
        turn = (index + 13) % 27
        cx = bx + turn // 9 - 1
        cy = by + turn // 3 % 3 - 1
        cz = bz + turn % 3 - 1
        dx = max(cx * bucket_m - q[0], q[0] - (cx + 1) * bucket_m, 0.0)
        dy = max(cy * bucket_m - q[1], q[1] - (cy + 1) * bucket_m, 0.0)
        dz = max(cz * bucket_m - q[2], q[2] - (cz + 1) * bucket_m, 0.0)
        if dx * dx + dy * dy + dz * dz >= found2[NEIGHBOURS - 1]:
            continue
        bucket = slots[_find(_key(cx, cy, cz), slots, keys)]
        if bucket < 0:
            continue
        for i in range(counts[bucket]):
            x = points[bucket, i, 0] - q[0]
            y = points[bucket, i, 1] - q[1]
            z = points[bucket, i, 2] - q[2]
            d2 = x * x + y * y + z * z
            if d2 >= found2[NEIGHBOURS - 1]:
                continue
            have += 1
            k = NEIGHBOURS - 1
            while k > 0 and found2[k - 1] > d2:
                found2[k] = found2[k - 1]
                found[k] = found[k - 1]
                k -= 1
            found2[k] = d2
            found[k] = points[bucket, i]
    return have >= NEIGHBOURS


@njit(cache=True, nogil=True)
def fit_to_neighbours(
    query: F64,
    search_m: float,
    bucket_m: float,
    is_line: bool,
    limit: float,
    slots: I32,
    keys: I64,
    counts: I32,
    points: F32,
) -> tuple[NDArray[np.int8], F64, F64]:
    """Five neighbours of every query point (n, 3) and their line or plane.

    Returns:
        (n,) `NO_FIT`, `FITS` or `FIRM`; (n, 3) anchors; (n, 3) unit directions or normals.
    """
    n = query.shape[0]
    fits = np.full(n, NO_FIT, np.int8)
    anchors = np.zeros((n, 3))
    axes = np.zeros((n, 3))
    found = np.empty((NEIGHBOURS, 3))
    found2 = np.empty(NEIGHBOURS)
    for i in range(n):
        if not _neighbours(query[i], search_m, bucket_m, slots, keys, counts, points, found, found2):
            continue
        if is_line:
            fits[i] = fit_line(found, limit, anchors[i], axes[i])
        else:
            fits[i] = fit_plane(found, limit, anchors[i], axes[i])
    return fits, anchors, axes
