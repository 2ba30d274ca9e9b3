"""Drops what is too near (the drone itself) or too far to be believed."""

from __future__ import annotations

import numpy as np

from mineloc.config import SweepConfig
from mineloc.data import Sweep


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
    x, y, z = sweep.points_lidar.astype(np.float64).T
    range2 = x * x + y * y + z * z
    return sweep.keep((range2 >= config.min_range_m**2) & (range2 <= config.max_range_m**2))
