"""Whether the drone moved at all, from sparse looks at the sweeps and the reference."""

from __future__ import annotations

import numpy as np

from mineloc.data import F32, F64

_LOOK_EVERY_NS = 1_000_000_000
_AZIMUTHS = 72
_LEVELS = 4
_ENOUGH_POINTS = 5
_MOVED_M = 0.05
_MOVED_POSES_M = 0.3


class MotionWatch:
    """Compares the surroundings once a second with the first look, and the reference's positions with each other."""

    def __init__(self) -> None:
        self._first: F64 | None = None
        self._next_look_ns = 0
        self._looks = 0
        self._shape_changed = False
        self._low = np.full(3, np.inf)
        self._high = np.full(3, -np.inf)

    def take_sweep(self, stamp_ns: int, points_lidar: F32) -> None:
        """Look at (n, 3) points of a sweep, once a second until something changed."""
        if self._shape_changed or stamp_ns < self._next_look_ns:
            return
        self._next_look_ns = stamp_ns + _LOOK_EVERY_NS
        shape = _shape(points_lidar)
        self._looks += 1
        if self._first is None:
            self._first = shape
            return
        change = np.abs(shape - self._first)
        both = np.isfinite(change)
        if both.any():
            self._shape_changed = bool(np.quantile(change[both], 0.75) > _MOVED_M)

    def take_positions(self, positions_m: F64) -> None:
        """Look at (n, 3) reference positions."""
        if len(positions_m):
            self._low = np.minimum(self._low, positions_m.min(axis=0))
            self._high = np.maximum(self._high, positions_m.max(axis=0))

    @property
    def stood_still(self) -> bool | None:
        """By the reference if there is one, else by the sweeps; None if neither can tell."""
        if np.isfinite(self._low).all():
            return bool(np.linalg.norm(self._high - self._low) < _MOVED_POSES_M)
        return not self._shape_changed if self._looks > 1 else None


def _shape(points: F32) -> F64:
    """(bins,) mean range by azimuth and elevation, NaN where there are few points."""
    x, y, z = np.asarray(points, dtype=np.float64).T
    flat = np.hypot(x, y)
    azimuth = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * _AZIMUTHS).astype(np.int64) % _AZIMUTHS
    level = np.clip(np.floor((np.arctan2(z, flat) / np.pi + 0.5) * _LEVELS * 4) - 6, 0, _LEVELS - 1).astype(np.int64)
    at = azimuth * _LEVELS + level
    counts = np.bincount(at, minlength=_AZIMUTHS * _LEVELS)
    sums = np.bincount(at, np.hypot(flat, z), minlength=_AZIMUTHS * _LEVELS)
    return np.where(counts >= _ENOUGH_POINTS, sums / np.maximum(counts, 1), np.nan)
