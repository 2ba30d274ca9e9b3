"""Which pose of the reference an estimated pose is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from mineloc.data import F64, I64, Trajectory

Method = Literal["auto", "nearest", "interpolate"]
Used = Literal["nearest", "interpolate", "index"]

_AUTO_SHARE = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Reference and estimated poses for the same moments, in the order of time.

    Attributes:
        stamps_ns: (n,) times of the estimate.
        reference, estimate: (n, 4, 4).
        method: how they were found; `index` for files without times.
        time_difference_s: (n,) estimate minus reference; zero when the reference was interpolated.
        estimate_count, reference_count: how many poses there were.
    """

    stamps_ns: I64
    reference: F64
    estimate: F64
    method: Used
    time_difference_s: F64
    estimate_count: int
    reference_count: int

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def reference_path_m(self) -> F64:
        """(n,) distance travelled along the paired reference poses."""
        steps = np.linalg.norm(np.diff(self.reference[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])[: len(self)]

    def to_dict(self) -> dict[str, Any]:
        """What was compared with what, without the poses."""
        worst = float(np.abs(self.time_difference_s).max(initial=0.0))
        mean = float(np.abs(self.time_difference_s).mean()) if len(self) else 0.0
        return {
            "method": self.method,
            "pairs": len(self),
            "estimate_poses": self.estimate_count,
            "reference_poses": self.reference_count,
            "time_difference_mean_s": mean,
            "time_difference_max_s": worst,
        }


def associate(
    reference: Trajectory,
    estimate: Trajectory,
    *,
    method: Method = "auto",
    max_time_difference_s: float = 0.01,
    max_reference_gap_s: float = 0.5,
) -> Pairs:
    """Pair the poses of an estimate with those of a reference.

    `nearest` is evo's rule: each pose of the trajectory with fewer poses takes the nearest in time of the other; here
    one to one. `interpolate` moves the reference to the times of the estimate
    (linear and slerp) wherever two of its poses are near enough. `auto` is `nearest`, but interpolates when that
    leaves out a fifth or more of what interpolation could compare: then the rates do not fit. Trajectories without
    times are paired by their count.

    Args:
        reference, estimate: both with times or both without.
        max_time_difference_s: largest difference of a nearest pair.
        max_reference_gap_s: largest distance of two reference poses between which is interpolated.

    Returns:
        The pairs, possibly none.

    Raises:
        ValueError: only one of them has times, or neither and their lengths differ.
    """
    if not (reference.timed and estimate.timed):
        return _by_index(reference, estimate)
    nearest = _nearest(reference, estimate, max_time_difference_s)
    if method == "nearest":
        return nearest
    interpolated = _interpolated(reference, estimate, round(max_reference_gap_s * 1e9))
    possible = min(len(interpolated), len(reference))
    if method == "interpolate" or (len(nearest) < _AUTO_SHARE * possible and len(nearest) < len(interpolated)):
        return interpolated
    return nearest


def nearest_indices(short_ns: I64, long_ns: I64, max_difference_s: float) -> tuple[I64, I64]:
    """For each of `short_ns` the nearest of `long_ns`, one to one, at most `max_difference_s` apart.

    Args:
        short_ns, long_ns: strictly increasing.

    Returns:
        Indices into both, rising.
    """
    if not len(short_ns) or not len(long_ns):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    after = np.searchsorted(long_ns, short_ns, side="right").clip(max=len(long_ns) - 1)
    before = np.maximum(after - 1, 0)
    short, long = _seconds(short_ns), _seconds(long_ns)
    best = np.where(np.abs(long[after] - short) < np.abs(short - long[before]), after, before)
    difference = np.abs(long[best] - short)
    near = np.flatnonzero(difference <= max_difference_s)
    # one to one: of several that want the same pose the nearest has it
    order = near[np.lexsort((near, difference[near], best[near]))]
    first = np.concatenate([[True], np.diff(best[order]) > 0]) if len(order) else np.zeros(0, np.bool_)
    kept = np.sort(order[first])
    return kept, best[kept]


def _seconds(stamps_ns: I64) -> F64:
    """float64 seconds, rounded once. evo compares these, so that of two equally near poses the rounding decides."""
    whole, part = np.divmod(stamps_ns, 1_000_000_000)
    return np.asarray(whole + part * 1e-9, dtype=np.float64)


def _nearest(reference: Trajectory, estimate: Trajectory, max_difference_s: float) -> Pairs:
    if len(estimate) > len(reference):
        r, e = nearest_indices(reference.stamps_ns, estimate.stamps_ns, max_difference_s)
    else:
        e, r = nearest_indices(estimate.stamps_ns, reference.stamps_ns, max_difference_s)
    difference = np.asarray((estimate.stamps_ns[e] - reference.stamps_ns[r]) * 1e-9, dtype=np.float64)
    return _pairs(reference, estimate, e, reference.poses[r], "nearest", difference)


def _interpolated(reference: Trajectory, estimate: Trajectory, max_gap_ns: int) -> Pairs:
    t, ref = estimate.stamps_ns, reference.stamps_ns
    if len(ref) < 2:
        return _pairs(reference, estimate, np.zeros(0, np.int64), np.zeros((0, 4, 4)), "interpolate", np.zeros(0))
    after = np.clip(np.searchsorted(ref, t, side="left"), 1, len(ref) - 1)
    near = (ref[after] - ref[after - 1] <= max_gap_ns) | (ref[after] == t) | (ref[after - 1] == t)
    e = np.flatnonzero((t >= ref[0]) & (t <= ref[-1]) & near)
    return _pairs(reference, estimate, e, reference.at(t[e]), "interpolate", np.zeros(len(e)))


def _by_index(reference: Trajectory, estimate: Trajectory) -> Pairs:
    if reference.timed or estimate.timed:
        without = "estimate" if reference.timed else "reference"
        raise ValueError(f"the {without} has no times")
    if len(reference) != len(estimate):
        raise ValueError(f"no times, and {len(estimate)} poses against {len(reference)}")
    everything = np.arange(len(estimate))
    return _pairs(reference, estimate, everything, reference.poses, "index", np.zeros(len(estimate)))


def _pairs(
    reference: Trajectory, estimate: Trajectory, e: I64, reference_poses: F64, method: Used, difference_s: F64
) -> Pairs:
    return Pairs(
        stamps_ns=estimate.stamps_ns[e],
        reference=reference_poses,
        estimate=estimate.poses[e],
        method=method,
        time_difference_s=difference_s,
        estimate_count=len(estimate),
        reference_count=len(reference),
    )
