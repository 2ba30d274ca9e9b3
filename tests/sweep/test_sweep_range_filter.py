from __future__ import annotations

import numpy as np
import pytest

from mineloc.config import SweepConfig
from mineloc.data import Sweep
from mineloc.sweep.range_filter import within_range


def test_all_fields_are_filtered_together() -> None:
    ranges = np.array([0.1, 0.5, 3.0, 100.0, 100.1, np.nan, np.inf], np.float32)
    n = len(ranges)
    sweep = Sweep(
        stamp_ns=5,
        points_lidar=np.stack([ranges, np.zeros(n), np.zeros(n)], 1).astype(np.float32),
        offsets_ns=np.arange(n, dtype=np.int64),
        ring=np.arange(n, dtype=np.uint16),
        intensity=np.arange(n, dtype=np.float32),
    )
    kept = within_range(sweep, SweepConfig(min_range_m=0.5, max_range_m=100.0))
    assert kept.stamp_ns == 5
    assert kept.points_lidar[:, 0].tolist() == [0.5, 3.0, 100.0]
    for field in (kept.offsets_ns, kept.ring, kept.intensity):
        assert field is not None
        assert field.tolist() == [1, 2, 3]


def test_an_empty_sweep_stays_empty() -> None:
    assert len(within_range(Sweep(0, np.zeros((0, 3), np.float32)), SweepConfig())) == 0


def test_limits_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(ValueError, match="below"):
        within_range(Sweep(0, np.zeros((0, 3), np.float32)), SweepConfig(min_range_m=5, max_range_m=5))
