"""Errors over pieces of the flight: REP-k of Zhang and Scaramuzza, and KITTI's segments.

Both compare motions, so no alignment has any influence; both are given as a share of the distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mineloc.data import F64, I64
from mineloc.metrics.association import Pairs
from mineloc.metrics.relative import motion_error, nearest_on_path, turn_deg
from mineloc.metrics.statistics import Statistics

_REP_TOLERANCE = 0.2


@dataclass(frozen=True, slots=True)
class PercentError:
    """REP over one share of the flight (Zhang and Scaramuzza 2018).

    Attributes:
        percent_of_path: which share.
        distance_m: the nominal distance D, cut to 2 decimals.
        literal: translation error in percent of D over all sub-trajectories, as their toolbox finds them: None below 2.
        strict: the same, but over 100 % there is one sub-trajectory, from the first pair to the last. The toolbox's
            tolerance of 0.2 D lets every start in the first fifth of the flight count as a whole flight.
        literal_deg_per_m, strict_deg_per_m: rotation error over D.
    """

    percent_of_path: float
    distance_m: float
    literal: Statistics | None
    strict: Statistics | None
    literal_deg_per_m: Statistics | None
    strict_deg_per_m: Statistics | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name; the errors are percent of the distance and degrees a metre."""
        both = {"literal": self.literal, "strict": self.strict}
        turns = {"literal_deg_per_m": self.literal_deg_per_m, "strict_deg_per_m": self.strict_deg_per_m}
        return {
            "percent_of_path": self.percent_of_path,
            "distance_m": self.distance_m,
            **{name: value.to_dict() if value else None for name, value in (both | turns).items()},
        }


def percent_errors(pairs: Pairs, *, path_length_m: float, percents: Sequence[float]) -> tuple[PercentError, ...]:
    """REP-1, REP-2 … over the given shares of the path (paper A: 20, 40, 60, 80, 100 %).

    Args:
        path_length_m: length L of the whole reference, paired or not.
        percents: shares of L, percent.
    """
    path = pairs.reference_path_m
    return tuple(_percent_error(pairs, path, path_length_m, percent) for percent in percents)


def _percent_error(pairs: Pairs, path: F64, path_length_m: float, percent: float) -> PercentError:
    distance = math.trunc(percent / 100.0 * path_length_m * 100.0) / 100.0
    if not distance > 0 or len(pairs) < 2:
        return PercentError(percent, distance, None, None, None, None)
    start = np.arange(len(pairs))
    end, miss = nearest_on_path(path, start, distance, start)
    # explicit pairs: the toolbox drops starts without an end from its list and then takes the position for the start
    near = miss < _REP_TOLERANCE * distance
    literal = _shares(pairs, start[near], end[near], distance) if int(near.sum()) >= 2 else (None, None)
    strict = literal
    if percent == 100:
        ends = np.array([0, len(pairs) - 1])
        whole = abs(path[-1] - distance) < _REP_TOLERANCE * distance
        strict = _shares(pairs, ends[:1], ends[1:], distance) if whole else (None, None)
    return PercentError(percent, distance, literal[0], strict[0], literal[1], strict[1])


def _shares(pairs: Pairs, i: I64, j: I64, distance_m: float) -> tuple[Statistics, Statistics]:
    error = motion_error(pairs.reference, pairs.estimate, i, j)
    translation = np.linalg.norm(error[:, :3, 3], axis=1) / distance_m * 100.0
    rotation = turn_deg(error) / distance_m
    return Statistics.of(translation), Statistics.of(rotation)


@dataclass(frozen=True, slots=True)
class SegmentError:
    """KITTI's error over segments of one or several lengths.

    Attributes:
        lengths_m: the lengths that were asked for.
        percent, deg_per_m: average over all segments; None when the flight is shorter than all of them.
        count: how many segments.
        by_length: (length, percent, deg_per_m, count) of the lengths that occur.
    """

    lengths_m: tuple[float, ...]
    percent: float | None
    deg_per_m: float | None
    count: int
    by_length: tuple[tuple[float, float, float, int], ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name."""
        names = ("length_m", "percent", "deg_per_m", "count")
        return {
            "lengths_m": list(self.lengths_m),
            "percent": self.percent,
            "deg_per_m": self.deg_per_m,
            "count": self.count,
            "by_length": [dict(zip(names, row, strict=True)) for row in self.by_length],
        }


def segment_errors(
    pairs: Pairs, *, lengths_m: Sequence[float] = (100, 200, 300, 400, 500, 600, 700, 800), step: int = 10
) -> SegmentError:
    """KITTI odometry error: starts every `step` pairs, ends at the first pair further than the length.

    `lengths_m=(100,)` is "translation error over 100 m sub-trajectories".

    Raises:
        ValueError: `step` or a length is not positive.
    """
    if step < 1 or not all(length > 0 for length in lengths_m):
        raise ValueError(f"step {step}, lengths {lengths_m}")
    path = pairs.reference_path_m
    start = np.arange(0, len(pairs), step)
    rows: list[tuple[float, float, float, int]] = []
    for length in lengths_m:
        end = np.searchsorted(path, path[start] + length, side="right")
        i, j = start[end < len(path)], end[end < len(path)]
        if not len(i):
            continue
        error = motion_error(pairs.reference, pairs.estimate, i, j)
        translation = np.linalg.norm(error[:, :3, 3], axis=1) / length * 100.0
        rotation = turn_deg(error) / length
        rows.append((float(length), float(translation.mean()), float(rotation.mean()), len(i)))
    count = sum(row[3] for row in rows)
    percent = sum(row[1] * row[3] for row in rows) / count if count else None
    deg_per_m = sum(row[2] * row[3] for row in rows) / count if count else None
    return SegmentError(tuple(float(x) for x in lengths_m), percent, deg_per_m, count, tuple(rows))
