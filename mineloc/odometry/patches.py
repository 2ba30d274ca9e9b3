"""Patches: what a voxel remembers of the points that fell into it, and the plane through them.

The kernels are compiled; `patches_plainly` says the same in numpy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit, prange
from mineloc.data import F32, F64, I64

I32 = NDArray[np.int32]

_EMPTY = np.int64(-1)
_OFFSET = 1 << 20  # 21 bits an axis: ±100 km at 0.1 m

# Columns of a fitted patch
MEAN, NORMAL, MAJOR, LAMBDA, COUNT = 0, 3, 6, 9, 12
FIT_COLUMNS = 13


class PatchArrays(NamedTuple):
    """The arrays that the kernels see (numba passes named tuples by field).

    Attributes:
        keys: (c,) packed voxel indices, -1 where empty; c is a power of two.
        rows: (c,) row of each key in the arrays below.
        sums: (m, 10) count, Σp (3), Σppᵀ upper triangle (6), about the voxel's centre.
        fits: (m, 13) f32: mean about the centre (3), normal (3), major axis (3), eigenvalues ascending (3), count (0:
            not fitted yet).
        centres: (m, 3) voxel centres.
        seen: (m,) distance flown when the voxel was last hit.
        fresh: (m,) weight that came since the last fit.
        marked: (m,) whether the row is already in the list of touched rows.
    """

    keys: I64
    rows: I32
    sums: F64
    fits: F32
    centres: F64
    seen: F64
    fresh: F64
    marked: NDArray[np.bool_]


@njit(cache=True, nogil=True)
def _pack(ix: int, iy: int, iz: int) -> int:
    return ((ix + _OFFSET) << 42) | ((iy + _OFFSET) << 21) | (iz + _OFFSET)


@njit(cache=True, nogil=True)
def _slot(key: int, mask: int) -> int:
    # Fibonacci hashing: the product wraps around, its upper bits depend on all bits of the key
    return ((key * -7046029254386353131) >> 24) & mask


@njit(cache=True, nogil=True)
def find(keys: I64, rows: I32, ix: int, iy: int, iz: int) -> int:
    """Row of a voxel, -1 if it is not in the map."""
    key = _pack(ix, iy, iz)
    mask = len(keys) - 1
    s = _slot(key, mask)
    while True:
        k = keys[s]
        if k == key:
            return rows[s]
        if k == _EMPTY:
            return -1
        s = (s + 1) & mask


@njit(cache=True, nogil=True)
def insert_points(
    points: F64, arrays: PatchArrays, used: int, voxel_m: float, now: float, cap: float, touched: I32
) -> tuple[int, int]:
    """Add points; returns (rows in use, rows touched). The caller made room for len(points) new voxels.

    Args:
        points: (n, 3).
        arrays: written.
        used: rows in use.
        voxel_m: edge of a voxel.
        now: what `seen` becomes.
        cap: most weight a patch keeps.
        touched: (≥ n,) receives the rows that were hit, for `fit_patches`.
    """
    keys, rows, sums, centres = arrays.keys, arrays.rows, arrays.sums, arrays.centres
    seen, fresh, marked = arrays.seen, arrays.fresh, arrays.marked
    mask = len(keys) - 1
    inv = 1.0 / voxel_m
    hits = 0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        ix, iy, iz = int(np.floor(x * inv)), int(np.floor(y * inv)), int(np.floor(z * inv))
        key = _pack(ix, iy, iz)
        s = _slot(key, mask)
        while keys[s] != key and keys[s] != _EMPTY:
            s = (s + 1) & mask
        if keys[s] == _EMPTY:
            keys[s] = key
            rows[s] = used
            centres[used, 0] = (ix + 0.5) * voxel_m
            centres[used, 1] = (iy + 0.5) * voxel_m
            centres[used, 2] = (iz + 0.5) * voxel_m
            used += 1
        row = rows[s]
        seen[row] = now
        if not marked[row]:
            marked[row] = True
            touched[hits] = row
            hits += 1
        a = sums[row]
        w = 1.0
        fresh[row] += w
        if a[0] + w > cap:
            # old points fade: the patch follows the present, and its count stays honest
            shrink = max(0.0, (cap - w) / a[0])
            for k in range(10):
                a[k] *= shrink
        dx, dy, dz = x - centres[row, 0], y - centres[row, 1], z - centres[row, 2]
        a[0] += w
        a[1] += w * dx
        a[2] += w * dy
        a[3] += w * dz
        a[4] += w * dx * dx
        a[5] += w * dx * dy
        a[6] += w * dx * dz
        a[7] += w * dy * dy
        a[8] += w * dy * dz
        a[9] += w * dz * dz
    return used, hits


@njit(cache=True, nogil=True)
def eigen_symmetric(a: F64, v: F64) -> None:
    """Eigenvalues ascending and unit eigenvectors of a symmetric 3x3 (cyclic Jacobi, exact to rounding).

    Args:
        a: (3, 3); its diagonal becomes the eigenvalues.
        v: (3, 3); its columns become the eigenvectors.
    """
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):
        off = a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2
        if off <= 1e-22 * (a[0, 0] ** 2 + a[1, 1] ** 2 + a[2, 2] ** 2) + 1e-300:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                _rotate_away(a, v, p, q)
    for p in range(2):
        for q in range(2 - p):
            if a[q, q] > a[q + 1, q + 1]:
                a[q, q], a[q + 1, q + 1] = a[q + 1, q + 1], a[q, q]
                for k in range(3):
                    v[k, q], v[k, q + 1] = v[k, q + 1], v[k, q]


@njit(cache=True, nogil=True)
def _rotate_away(a: F64, v: F64, p: int, q: int) -> None:
    """One Jacobi rotation: makes a[p, q] zero."""
    if a[p, q] == 0.0:
        return
    theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
    t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
    c = 1.0 / np.sqrt(t * t + 1.0)
    s = t * c
    for k in range(3):
        a[k, p], a[k, q] = c * a[k, p] - s * a[k, q], s * a[k, p] + c * a[k, q]
    for k in range(3):
        a[p, k], a[q, k] = c * a[p, k] - s * a[q, k], s * a[p, k] + c * a[q, k]
    for k in range(3):
        v[k, p], v[k, q] = c * v[k, p] - s * v[k, q], s * v[k, p] + c * v[k, q]


@njit(cache=True, nogil=True)
def fit_patches(arrays: PatchArrays, touched: I32, min_weight: float, growth: float) -> None:
    """Fit the touched patches that have grown by the share `growth` since their last fit."""
    sums, fits, fresh = arrays.sums, arrays.fits, arrays.fresh
    a, v, m = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for i in range(len(touched)):
        row = touched[i]
        arrays.marked[row] = False
        n = sums[row, 0]
        if n < min_weight or fresh[row] < growth * fits[row, COUNT]:
            continue
        for j in range(3):
            m[j] = sums[row, 1 + j] / n
        column = 4
        for j in range(3):
            for k in range(j, 3):
                a[j, k] = a[k, j] = sums[row, column] / n - m[j] * m[k]
                column += 1
        eigen_symmetric(a, v)
        for k in range(3):
            fits[row, MEAN + k] = m[k]
            fits[row, NORMAL + k] = v[k, 0]
            fits[row, MAJOR + k] = v[k, 2]
            fits[row, LAMBDA + k] = max(a[k, k], 0.0)
        fits[row, COUNT] = n
        fresh[row] = 0.0


class Insertion(NamedTuple):
    """How a map takes points; see `insert_points` and `fit_patches`."""

    used: int
    voxel_m: float
    cap: float
    min_weight: float
    growth: float


@njit(cache=True, nogil=True)
def insert_and_fit(points: F64, now: float, arrays: PatchArrays, touched: I32, how: Insertion) -> int:
    """Add points and fit what they changed; returns the rows in use."""
    used, hits = insert_points(points, arrays, how.used, how.voxel_m, now, how.cap, touched)
    fit_patches(arrays, touched[:hits], how.min_weight, how.growth)
    return used


@njit(cache=True, nogil=True, parallel=True)
def insert_and_fit_both(
    points: F64, now: float,
    one: PatchArrays, touched_one: I32, how_one: Insertion,
    two: PatchArrays, touched_two: I32, how_two: Insertion, used: I64,
) -> None:  # fmt: skip
    """`insert_and_fit` for two maps, side by side; their rows in use go into `used`."""
    for which in prange(2):
        if which == 0:
            used[0] = insert_and_fit(points, now, one, touched_one, how_one)
        else:
            used[1] = insert_and_fit(points, now, two, touched_two, how_two)


@njit(cache=True, nogil=True)
def reinsert(index: I64, keys: I64, rows: I32) -> None:
    """Fill an empty table with (m, 3) different voxel indices: row 0, 1, 2 …"""
    mask = len(keys) - 1
    for n in range(len(index)):
        key = _pack(index[n, 0], index[n, 1], index[n, 2])
        s = _slot(key, mask)
        while keys[s] != _EMPTY:
            s = (s + 1) & mask
        keys[s] = key
        rows[s] = n


def allocate(capacity: int) -> PatchArrays:
    """Empty arrays for a table of `capacity` slots (a power of two), of which at most half may be used."""
    rows = capacity // 2 + 1
    return PatchArrays(
        keys=np.full(capacity, _EMPTY),
        rows=np.zeros(capacity, np.int32),
        sums=np.zeros((rows, 10)),
        fits=np.zeros((rows, FIT_COLUMNS), np.float32),
        centres=np.zeros((rows, 3)),
        seen=np.zeros(rows),
        fresh=np.zeros(rows),
        marked=np.zeros(rows, np.bool_),
    )


class PlainPatches(NamedTuple):
    """What a map holds, said in numpy.

    Attributes:
        cells: (m, 3) voxel indices in lexical order.
        counts: (m,) points.
        means: (m, 3).
        eigenvalues: (m, 3) of the covariance, ascending; eigenvectors: (m, 3, 3) in columns.
    """

    cells: I64
    counts: I64
    means: F64
    eigenvalues: F64
    eigenvectors: F64


def patches_plainly(points: F64, voxel_m: float) -> PlainPatches:
    """The patches of (n, 3) points in plain numpy: what the kernels are held to."""
    cell = np.floor(points * (1.0 / voxel_m)).astype(np.int64)
    cells, label, counts = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    label = label.reshape(-1)
    means = np.stack([np.bincount(label, column, len(cells)) for column in points.T], axis=1) / counts[:, None]
    off = points - means[label]
    covariances = np.zeros((len(cells), 3, 3))
    np.add.at(covariances, label, off[:, :, None] * off[:, None, :])
    eigenvalues, eigenvectors = np.linalg.eigh(covariances / counts[:, None, None])
    return PlainPatches(cells, counts, means, eigenvalues, eigenvectors)
