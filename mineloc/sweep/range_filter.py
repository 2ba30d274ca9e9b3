"""Drops what is too near (the drone itself) or too far to be believed."""

from __future__ import annotations

import numpy as np

from mineloc.compiled import njit
from mineloc.config import SweepConfig
from mineloc.data import F32, I64, Sweep


def within_range(sweep: Sweep, config: SweepConfig) -> Sweep:
    """The points with `min_range_m <= range <= max_range_m`; a point that is not finite is dropped too.

    Args:
        sweep: as recorded.
        config: `min_range_m` and `max_range_m`.

    Raises:
        ValueError: `min_range_m` is not below `max_range_m`.
    """
    if not config.min_range_m < config.max_range_m:
        raise ValueError(f"min_range_m {config.min_range_m} must be below max_range_m {config.max_range_m}")
    kept, count = _between(sweep.points_lidar, config.min_range_m**2, config.max_range_m**2)
    return sweep if count == len(sweep) else sweep.keep(kept[:count])


@njit(cache=True, nogil=True)
def _between(points: F32, least_m2: float, most_m2: float) -> tuple[I64, int]:
    """Indices of the points whose squared range lies between, and how many they are."""
    kept = np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if least_m2 <= x * x + y * y + z * z <= most_m2:
            kept[count] = i
            count += 1
    return kept, count
