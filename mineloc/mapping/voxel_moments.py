"""What a voxel of the map remembers of all points that fell into it: moments, counts, and who saw it from where.

A point costs one probe of a hash table (open addressing, as in `sweep.voxel_grid`). Moments are kept in float32 about
the voxel's centre: offsets are at most half an edge, so ten thousand points still leave their mean to a micrometre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mineloc.compiled import njit
from mineloc.data import F32, F64, I32, I64

REACH = 1 << 20
"""Voxel coordinates must lie within ±REACH: three of them fit into one 64-bit key, z in its lowest bits."""
WEIGHT, FIRST, SECOND, NEAR_M2 = 0, 1, 4, 10
COUNT, VISITS, LAST, NEAREST = range(11, 15)
COLUMNS = 16
"""64 bytes a voxel: one line of the processor's cache."""
_START = 1 << 12
_WAITING = 256


class Voxels(NamedTuple):
    """Occupied voxels, n of them.

    Attributes:
        keys: (n,) packed coordinates, see `unpack`.
        moments: (n, 16) float32: `WEIGHT` Σw, `FIRST` Σw d (3), `SECOND` Σw d dᵀ (xx, xy, xz, yy, yz, zz) of offsets d
            from the voxel's centre; `NEAR_M2` squared distance from which it was seen best.
        tallies: (n, 16) int32, the same memory: `COUNT` points; `VISITS` that saw it; the `LAST` of them; the visit
            that came `NEAREST`.
    """

    keys: I64
    moments: F32
    tallies: I32

    def take(self, rows: I64 | slice) -> Voxels:
        """Only some rows."""
        moments = self.moments[rows]
        return Voxels(self.keys[rows], moments, moments.view(np.int32))


def no_voxels(room: int = 0) -> Voxels:
    """Arrays of zeros for so many voxels."""
    moments = np.zeros((room, COLUMNS), np.float32)
    return Voxels(np.zeros(room, np.int64), moments, moments.view(np.int32))


def unpack(keys: I64) -> I64:
    """(n, 3) voxel coordinates of packed keys."""
    part = (1 << 21) - 1
    return np.stack([(keys >> 42) - REACH, ((keys >> 21) & part) - REACH, (keys & part) - REACH], axis=1)


class VoxelTable:
    """The voxels of one shard: those whose hash ends in its number.

    Args:
        shard: number of this one.
        shards: how many there are, a power of two up to eight.
    """

    def __init__(self, shard: int, shards: int) -> None:
        self._shard, self._shards = shard, shards
        self._slots: I32 = np.full(2 * _START, -1, np.int32)
        self._room = no_voxels(_START)
        self._used = 0

    def __len__(self) -> int:
        return self._used

    def insert(self, gathered: Voxels, visit: int) -> None:
        """Add those of the gathered voxels that belong to this shard; `visit` must not fall."""
        begin = 0
        while True:
            begin, self._used = insert_gathered(
                gathered, visit, (self._shard, self._shards), self._slots, self._room, (begin, self._used)
            )
            if begin >= len(gathered.keys):
                return
            self._grow()

    def _grow(self) -> None:
        room = no_voxels(2 * len(self._room.keys))
        room.keys[: self._used], room.moments[: self._used] = self.voxels()[:2]
        self._room = room
        self._slots = np.full(2 * len(room.keys), -1, np.int32)
        fill_slots(self._slots, room.keys[: self._used])

    def voxels(self) -> Voxels:
        """All voxels in the order in which they were first hit; views, valid until the next `insert`."""
        return self._room.take(slice(0, self._used))


@njit(cache=True, nogil=True)
def _hash(key: int | np.int64) -> int | np.int64:
    # Fibonacci hashing: the product wraps around, its upper bits depend on all bits of the key
    return (key * np.int64(-7046029254386353131)) >> 24


@njit(cache=True, nogil=True)
def fill_slots(slots: I32, keys: I64) -> None:
    """Enter different keys as rows 0, 1, 2 … into an empty table."""
    mask = len(slots) - 1
    for row in range(len(keys)):
        slot = (_hash(keys[row]) >> 3) & mask
        while slots[slot] >= 0:
            slot = (slot + 1) & mask
        slots[slot] = row


@njit(cache=True, nogil=True)
def gather_points(
    points: F32 | F64, transform: F64, max_range_m: float, spread_pm2: float, per_m: float, out: Voxels
) -> int:
    """Take the points of one visit to the map and gather those that follow one another within a voxel.

    Neighbouring shots of a beam mostly hit the same voxel. What is gathered waits in a small cache, one place a hash,
    until another voxel needs the place: a voxel may come out several times.

    Args:
        points: (n, 3), seen from (0, 0, 0).
        transform: (3, 4) that takes them to the map, relative to its origin.
        max_range_m: points from farther away are left out.
        spread_pm2: a point weighs `1 / (1 + (spread · r²)²)`. The range noise of a surface grows with r and with the
            tangent of the angle at which the beam meets it, and along a roadway that tangent grows with r too.
        per_m: voxels a metre.
        out: written, with room for n.

    Returns:
        How many came out; -1: a point is not finite or out of reach.
    """
    edge, farthest = 1.0 / per_m, max_range_m * max_range_m
    waiting = np.full(_WAITING, -1, np.int64)
    sums = np.zeros((_WAITING, COLUMNS), np.float32)
    count = 0
    for i in range(len(points)):
        px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        x = transform[0, 0] * px + transform[0, 1] * py + transform[0, 2] * pz + transform[0, 3]
        y = transform[1, 0] * px + transform[1, 1] * py + transform[1, 2] * pz + transform[1, 3]
        z = transform[2, 0] * px + transform[2, 1] * py + transform[2, 2] * pz + transform[2, 3]
        ix, iy, iz = np.floor(x * per_m), np.floor(y * per_m), np.floor(z * per_m)
        if not (abs(ix) < REACH and abs(iy) < REACH and abs(iz) < REACH):
            return -1
        far = px * px + py * py + pz * pz
        if far > farthest:
            continue
        key = ((np.int64(ix) + REACH) << 42) | ((np.int64(iy) + REACH) << 21) | (np.int64(iz) + REACH)
        place = _hash(key) & (_WAITING - 1)
        m = sums[place]
        if waiting[place] != key:
            if waiting[place] >= 0:
                _release(waiting[place], m, out, count)
                count += 1
            waiting[place] = key
            m[:] = 0.0
            m[NEAR_M2] = np.inf
        spread = spread_pm2 * far
        weight = 1.0 / (1.0 + spread * spread)
        _add(m, weight, x - (ix + 0.5) * edge, y - (iy + 0.5) * edge, z - (iz + 0.5) * edge)
        m[NEAR_M2] = min(m[NEAR_M2], np.float32(far))
        m[COUNT] += np.float32(1.0)
    for place in range(_WAITING):
        if waiting[place] >= 0:
            _release(waiting[place], sums[place], out, count)
            count += 1
    return count


@njit(cache=True, nogil=True)
def _add(m: F32, weight: float, x: float, y: float, z: float) -> None:
    w, dx, dy, dz = np.float32(weight), np.float32(x), np.float32(y), np.float32(z)
    m[0] += w
    m[1] += w * dx
    m[2] += w * dy
    m[3] += w * dz
    m[4] += w * dx * dx
    m[5] += w * dx * dy
    m[6] += w * dx * dz
    m[7] += w * dy * dy
    m[8] += w * dy * dz
    m[9] += w * dz * dz


@njit(cache=True, nogil=True)
def _release(key: int | np.int64, sums: F32, out: Voxels, row: int) -> None:
    out.keys[row] = key
    for k in range(NEAR_M2 + 1):
        out.moments[row, k] = sums[k]
    out.tallies[row, COUNT] = np.int32(sums[COUNT])


@njit(cache=True, nogil=True)
def insert_gathered(
    gathered: Voxels, visit: int, which: tuple[int, int], slots: I32, voxels: Voxels, state: tuple[int, int]
) -> tuple[int, int]:
    """Add the voxels of one shard to its table until that is half full.

    Args:
        gathered: by `gather_points`.
        visit: a number that never falls.
        which: number of the shard, of shards.
        slots: table of the rows by hash; its length is a power of two.
        voxels: written.
        state: the voxel to begin with; rows in use.

    Returns:
        The first voxel that is not in yet (n: all are), rows in use.
    """
    shard, shards = which
    begin, used = state
    mask = len(slots) - 1
    for i in range(begin, len(gathered.keys)):
        key = gathered.keys[i]
        hashed = _hash(key)
        if (hashed & (shards - 1)) != shard:
            continue
        slot = (hashed >> 3) & mask
        row = slots[slot]
        while row >= 0 and voxels.keys[row] != key:
            slot = (slot + 1) & mask
            row = slots[slot]
        if row < 0:
            if used == len(voxels.keys):
                return i, used
            row = np.int32(used)
            slots[slot] = row
            used += 1
            voxels.keys[row] = key
            voxels.moments[row, NEAR_M2] = np.inf
            voxels.tallies[row, LAST] = -1
        m, new = voxels.moments[row], gathered.moments[i]
        for k in range(NEAR_M2):
            m[k] += new[k]
        t = voxels.tallies[row]
        t[COUNT] += gathered.tallies[i, COUNT]
        if t[LAST] != visit:
            t[VISITS] += 1
            t[LAST] = visit
        if new[NEAR_M2] < m[NEAR_M2]:
            m[NEAR_M2] = new[NEAR_M2]
            t[NEAREST] = visit
    return len(gathered.keys), used


def voxels_plainly(
    points: F64, sensors_m: F64, visit: I64, *, voxel_m: float, max_range_m: float, spread_pm2: float
) -> Voxels:
    """The voxels of (n, 3) points seen from (n, 3) places at visits in plain numpy, sorted by key: for comparison."""
    far = ((points - sensors_m) ** 2).sum(axis=1)
    near = far <= max_range_m**2
    points, visit, far = points[near], visit[near], far[near]
    cell = np.floor(points * (1.0 / voxel_m)).astype(np.int64)
    packed = ((cell[:, 0] + REACH) << 42) | ((cell[:, 1] + REACH) << 21) | (cell[:, 2] + REACH)
    keys, label = np.unique(packed, return_inverse=True)
    label = label.reshape(-1)
    weight = 1.0 / (1.0 + (spread_pm2 * far) ** 2)
    d = points - (cell + 0.5) * voxel_m
    columns = [np.ones(len(d)), *d.T] + [d[:, a] * d[:, b] for a in range(3) for b in range(a, 3)]
    moments = np.stack([np.bincount(label, weight * column, len(keys)) for column in columns], axis=1)
    out = no_voxels(len(keys))
    out.moments[:, :NEAR_M2], out.keys[:] = moments, keys
    for k in range(len(keys)):
        own = np.flatnonzero(label == k)
        nearest = own[np.argmin(far[own])]
        out.tallies[k, COUNT : NEAREST + 1] = len(own), len(np.unique(visit[own])), visit[own[-1]], visit[nearest]
        out.moments[k, NEAR_M2] = far[nearest]
    return out
