"""What to do when a file gives two poses for one time: real recordings do, motion capture above all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.data import F64, I64
from mineloc.errors import FormatError


@dataclass(frozen=True, slots=True, eq=False)
class DistinctPoses:
    """Poses with strictly rising times: the first of each time.

    Attributes:
        stamps_ns: (n,) int64, strictly increasing.
        values: (n, 7) position and xyzw quaternion as they were.
        duplicates: rows left out that repeat the pose before them.
        conflicts: rows left out that give another pose for a time that has one.
    """

    stamps_ns: I64
    values: F64
    duplicates: int
    conflicts: int


def first_of_each_time(where: str, stamps_ns: I64, values: F64) -> DistinctPoses:
    """Make non-decreasing stamps strictly increasing by leaving out rows.

    Args:
        where: for the error.
        stamps_ns: (n,) non-decreasing.
        values: (n, 7).

    Raises:
        FormatError: so many poses share their times that the times have lost their digits.
    """
    again = np.diff(stamps_ns, prepend=stamps_ns[:1] - 1) == 0
    same = again.copy()
    same[1:] &= (values[1:] == values[:-1]).all(axis=1)
    conflicts = int((again & ~same).sum())
    if conflicts > 0.75 * len(stamps_ns):
        raise FormatError(
            where,
            f"{len(stamps_ns)} poses have only {int((~again).sum())} different times",
            expected="a time a pose",
            todo="write the times with more digits",
        )
    return DistinctPoses(stamps_ns[~again], values[~again], int(same.sum()), conflicts)
