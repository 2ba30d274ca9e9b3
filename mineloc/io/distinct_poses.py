"""What to do when a file gives two poses for one time: real recordings do, motion capture above all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.data import F64, I64
from mineloc.errors import FormatError


@dataclass(frozen=True, slots=True, eq=False)
class DistinctPoses:
    """Poses with strictly rising times.

    Attributes:
        stamps_ns: (n,) int64, strictly increasing.
        values: (n, 7) position and xyzw quaternion as they were.
        duplicates: rows left out since they repeat the row before, time and pose.
        ties: rows with another pose for the time of the row before. They stay, 1 ns later: which of them is right
            nobody can tell, and the nearest in time to any other clock is found as if they stood side by side.
    """

    stamps_ns: I64
    values: F64
    duplicates: int
    ties: int


def tell_apart(where: str, stamps_ns: I64, values: F64) -> DistinctPoses:
    """Make non-decreasing stamps strictly increasing.

    Args:
        where: for the error.
        stamps_ns: (n,) non-decreasing.
        values: (n, 7).

    Raises:
        FormatError: so many poses share their times that the times have lost their digits.
    """
    if len(stamps_ns) < 2:
        return DistinctPoses(stamps_ns, values, 0, 0)
    tied = np.diff(stamps_ns, prepend=stamps_ns[0] - 1) == 0
    repeated = tied.copy()
    repeated[1:] &= (values[1:] == values[:-1]).all(axis=1)
    stamps, kept = stamps_ns[~repeated], values[~repeated]
    ties = int(tied[~repeated].sum())
    if ties > 0.75 * len(stamps):
        raise FormatError(
            where,
            f"{len(stamps)} poses have only {len(stamps) - ties} different times",
            expected="a time a pose",
            todo="write the times with more digits",
        )
    count = np.arange(len(stamps))
    # each at least 1 ns after the one before
    return DistinctPoses(np.maximum.accumulate(stamps - count) + count, kept, int(repeated.sum()), ties)
