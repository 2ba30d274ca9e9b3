"""Where a run could not be sure: consecutive sweeps with the same trouble, taken together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from mineloc.data import Bool

MAX_GAP_SWEEPS = 10
"""Two stretches with at most this many good sweeps between them (1 s at 10 Hz) are told as one."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive rows of the sweeps table.

    Attributes:
        first, last: row numbers, both within.
        start_ns, end_ns: their stamps.
        sweeps: how many of the rows have the trouble.
        reason: the most frequent reason, empty when the table gives none.
    """

    first: int
    last: int
    start_ns: int
    end_ns: int
    sweeps: int
    reason: str = ""


def degenerate_stretches(sweeps: pl.DataFrame) -> list[Stretch]:
    """Where at least one direction of translation was weakly observed (METHOD 7.3)."""
    return _stretches(sweeps, sweeps["is_degenerate"].fill_null(False).to_numpy())


def untrusted_stretches(sweeps: pl.DataFrame) -> list[Stretch]:
    """Where the pose rests on the motion prior alone, with the most frequent reason."""
    return _stretches(sweeps, ~sweeps["trusted"].to_numpy())


def _stretches(sweeps: pl.DataFrame, troubled: Bool) -> list[Stretch]:
    rows = np.flatnonzero(troubled)
    if not rows.size:
        return []
    stamps = sweeps["stamp_ns"].to_numpy()
    out: list[Stretch] = []
    for group in np.split(rows, np.flatnonzero(np.diff(rows) > MAX_GAP_SWEEPS + 1) + 1):
        first, last = int(group[0]), int(group[-1])
        reasons = sweeps["reason"].gather(group).filter(sweeps["reason"].gather(group) != "")
        counted = reasons.value_counts(sort=True)
        # ties go to the alphabet: the table of reasons must not depend on a hash
        best = "" if counted.is_empty() else counted.sort(["count", "reason"], descending=[True, False])["reason"][0]
        out.append(Stretch(first, last, int(stamps[first]), int(stamps[last]), len(group), str(best)))
    return out
