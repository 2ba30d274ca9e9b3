"""A map of surface patches: a voxel hash whose cells keep the Gaussian of all points that fell into them.

A patch averages many sweeps, so its plane is known far better than a single 2 cm range; that is what lets
centimetre roughness hold a pose along a roadway (METHOD 7.1, 7.3). One point costs one hash probe.
"""

from __future__ import annotations

import numpy as np

from mineloc.data import F64, I64
from mineloc.odometry.patches import (
    COUNT,
    FIT_COLUMNS,
    I32,
    MEAN,
    Insertion,
    PatchArrays,
    allocate,
    insert_and_fit,
    insert_and_fit_both,
    reinsert,
)


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
        self.arrays = allocate(1 << 14)
        self._touched = np.zeros(0, np.int32)

    def __len__(self) -> int:
        return self._used

    def insert(self, points: F64, *, now: float) -> None:
        """Add (n, 3) points; `now` is any number that never falls, for `forget`."""
        self.inserted(insert_and_fit(points, now, *self.insertion(len(points))))

    def insertion(self, n: int) -> tuple[PatchArrays, I32, Insertion]:
        """What a kernel needs to add n points, for which room is made."""
        self._make_room(n)
        if len(self._touched) < n:
            self._touched = np.zeros(2 * n, np.int32)
        how = Insertion(self._used, self.voxel_m, self._cap, self._min_weight, self._growth)
        return self.arrays, self._touched, how

    def inserted(self, used: int) -> None:
        """The kernel has left so many rows in use."""
        self._used = used

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
        old, new = self.arrays, allocate(capacity)
        m = len(keep)
        for name in ("sums", "fits", "centres", "seen", "fresh"):
            getattr(new, name)[:m] = getattr(old, name)[keep]
        index = np.floor(new.centres[:m] / self.voxel_m).astype(np.int64)
        reinsert(index, new.keys, new.rows)
        self.arrays, self._used = new, m


def insert_into_both(maps: tuple[VoxelMap, VoxelMap], points: F64, *, now: float) -> None:
    """`insert` into two maps at the same time."""
    used = np.zeros(2, np.int64)
    one, two = (patches.insertion(len(points)) for patches in maps)
    insert_and_fit_both(points, now, *one, *two, used)
    for patches, rows in zip(maps, used, strict=True):
        patches.inserted(int(rows))


def fits_at_plainly(patches: VoxelMap, places: F64) -> F64:
    """(n, 13) the fit of the voxel of each of (n, 3) places, its mean in odom; all zeros where there is none."""
    arrays, used = patches.arrays, len(patches)
    fits = arrays.fits[:used].astype(np.float64)
    fits[:, MEAN : MEAN + 3] += arrays.centres[:used]
    of_cell = {tuple(c): fit for c, fit in zip(np.floor(arrays.centres[:used] / patches.voxel_m), fits, strict=True)}
    cells = np.floor(places * (1.0 / patches.voxel_m))
    found = np.array([of_cell.get(tuple(cell), np.zeros(FIT_COLUMNS)) for cell in cells]).reshape(-1, FIT_COLUMNS)
    return np.where(found[:, COUNT:], found, 0.0)
