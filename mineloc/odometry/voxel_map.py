"""A map of surface patches: a voxel hash whose cells keep the Gaussian of all points that fell into them.

A patch averages many sweeps, so its plane is known far better than a single 2 cm range; that is what lets
centimetre roughness hold a pose along a roadway (METHOD 7.1, 7.3). One point costs one hash probe.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit
from mineloc.data import F64, I64

F32 = NDArray[np.float32]
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


@njit(cache=True, inline="always")
def _pack(ix: int, iy: int, iz: int) -> int:
    return ((ix + _OFFSET) << 42) | ((iy + _OFFSET) << 21) | (iz + _OFFSET)


@njit(cache=True, inline="always")
def _slot(key: int, mask: int) -> int:
    # Fibonacci hashing: the product wraps around, its upper bits depend on all bits of the key
    return ((key * -7046029254386353131) >> 24) & mask


@njit(cache=True, inline="always")
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


@njit(cache=True)
def _insert(
    points: F64, arrays: PatchArrays, used: int, voxel_m: float, now: float, cap: float, touched: I32
) -> tuple[int, int]:
    """Add points; returns (rows in use, rows touched). The caller made room for len(points) new voxels."""
    keys, rows, sums, fits, centres, seen, fresh, marked = arrays
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
            sums[used] = 0.0
            fits[used] = 0.0
            fresh[used] = 0.0
            marked[used] = False
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


@njit(cache=True)
def eigen_symmetric(c00: float, c01: float, c02: float, c11: float, c12: float, c22: float) -> tuple[F64, F64]:
    """Eigenvalues ascending and eigenvectors in columns of a symmetric 3x3 (cyclic Jacobi, exact to rounding)."""
    a = np.array([[c00, c01, c02], [c01, c11, c12], [c02, c12, c22]])
    v = np.eye(3)
    for _ in range(12):
        off = a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2
        if off <= 1e-22 * (a[0, 0] ** 2 + a[1, 1] ** 2 + a[2, 2] ** 2) + 1e-300:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    akp, akq = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * akp - s * akq, s * akp + c * akq
                for k in range(3):
                    apk, aqk = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * apk - s * aqk, s * apk + c * aqk
                for k in range(3):
                    vkp, vkq = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * vkp - s * vkq, s * vkp + c * vkq
    w = np.array([a[0, 0], a[1, 1], a[2, 2]])
    order = np.argsort(w)
    out = np.empty((3, 3))
    for k in range(3):
        out[:, k] = v[:, order[k]]
    return w[order], out


@njit(cache=True)
def _fit(arrays: PatchArrays, touched: I32, min_weight: float, growth: float) -> None:
    """Fit the touched patches that have grown by the share `growth` since their last fit."""
    sums, fits, fresh = arrays.sums, arrays.fits, arrays.fresh
    for i in range(len(touched)):
        row = touched[i]
        arrays.marked[row] = False
        n = sums[row, 0]
        if n < min_weight or fresh[row] < growth * fits[row, COUNT]:
            continue
        m0, m1, m2 = sums[row, 1] / n, sums[row, 2] / n, sums[row, 3] / n
        w, v = eigen_symmetric(
            sums[row, 4] / n - m0 * m0,
            sums[row, 5] / n - m0 * m1,
            sums[row, 6] / n - m0 * m2,
            sums[row, 7] / n - m1 * m1,
            sums[row, 8] / n - m1 * m2,
            sums[row, 9] / n - m2 * m2,
        )
        f = fits[row]
        f[0], f[1], f[2] = m0, m1, m2
        for k in range(3):
            f[NORMAL + k] = v[k, 0]
            f[MAJOR + k] = v[k, 2]
            f[LAMBDA + k] = max(w[k], 0.0)
        f[COUNT] = n
        fresh[row] = 0.0


class VoxelMap:
    """A growing, forgetting map of patches at one voxel size.

    Args:
        voxel_m: edge of a voxel.
        cap: most weight a patch keeps; older points fade.
        min_weight: least weight for a fit.
        growth: share of new weight that makes a patch fitted again.
    """

    def __init__(self, voxel_m: float, *, cap: float = 200.0, min_weight: float = 5.0, growth: float = 0.2) -> None:
        self.voxel_m = voxel_m
        self._cap, self._min_weight, self._growth = cap, min_weight, growth
        self._used = 0
        self.arrays = _allocate(1 << 14)
        self._touched = np.zeros(0, np.int32)

    def __len__(self) -> int:
        return self._used

    def insert(self, points: F64, *, now: float) -> None:
        """Add (n, 3) points; `now` is any number that never falls, for `forget`."""
        self._make_room(len(points))
        if len(self._touched) < len(points):
            self._touched = np.zeros(2 * len(points), np.int32)
        self._used, hits = _insert(points, self.arrays, self._used, self.voxel_m, now, self._cap, self._touched)
        _fit(self.arrays, self._touched[:hits], self._min_weight, self._growth)

    def forget(self, before: float) -> None:
        """Drop the patches last hit before `before`."""
        keep = np.flatnonzero(self.arrays.seen[: self._used] >= before)
        if len(keep) < self._used:
            self._rebuild(keep, len(self.arrays.rows))

    def _make_room(self, extra: int) -> None:
        # at most half full: probes stay short
        need = 2 * (self._used + extra)
        if need > len(self.arrays.keys):
            self._rebuild(np.arange(self._used), 1 << int(np.ceil(np.log2(2 * need))))

    def _rebuild(self, keep: I64, capacity: int) -> None:
        old, new = self.arrays, _allocate(capacity)
        m = len(keep)
        for name in ("sums", "fits", "centres", "seen", "fresh"):
            getattr(new, name)[:m] = getattr(old, name)[keep]
        index = np.floor(new.centres[:m] / self.voxel_m).astype(np.int64)
        _reinsert(index, new.keys, new.rows)
        self.arrays, self._used = new, m


@njit(cache=True)
def _reinsert(index: I64, keys: I64, rows: I32) -> None:
    mask = len(keys) - 1
    for n in range(len(index)):
        key = _pack(index[n, 0], index[n, 1], index[n, 2])
        s = _slot(key, mask)
        while keys[s] != _EMPTY:
            s = (s + 1) & mask
        keys[s] = key
        rows[s] = n


def _allocate(capacity: int) -> PatchArrays:
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
