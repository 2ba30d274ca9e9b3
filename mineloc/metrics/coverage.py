"""How much of the reference an estimate speaks about. An error without it is not a result."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from mineloc.data import Trajectory


@dataclass(frozen=True, slots=True)
class Coverage:
    """Shares in [0, 1] of the reference's duration and path during which the estimate gives poses."""

    time: float
    path: float
    reference_duration_s: float
    reference_path_m: float

    def to_dict(self) -> dict[str, float]:
        """Plain values by name."""
        return asdict(self)


def coverage(reference: Trajectory, estimate: Trajectory, *, max_gap_s: float = 1.0) -> Coverage:
    """Share of the reference that lies between two estimated poses at most `max_gap_s` apart.

    Without times (KITTI) the pairs are by count, and nothing is missing.
    """
    t = (reference.stamps_ns - reference.stamps_ns[0]) * 1e-9 if len(reference) else np.zeros(0)
    duration = float(t[-1]) if reference.timed and len(t) else 0.0
    path = reference.path_m
    length = float(path[-1]) if len(path) else 0.0
    if not reference.timed or not estimate.timed:
        return Coverage(1.0, 1.0, duration, length)
    if len(reference) < 2 or len(estimate) < 2:
        return Coverage(0.0, 0.0, duration, length)
    e = (estimate.stamps_ns - reference.stamps_ns[0]) * 1e-9
    near = np.diff(e) <= max_gap_s
    begin, end = np.clip(e[:-1][near], 0.0, duration), np.clip(e[1:][near], 0.0, duration)
    time = float((end - begin).sum()) / duration
    travelled = float((np.interp(end, t, path) - np.interp(begin, t, path)).sum())
    # who stands still has no path to cover
    return Coverage(min(time, 1.0), min(travelled / length, 1.0) if length > 0 else min(time, 1.0), duration, length)
