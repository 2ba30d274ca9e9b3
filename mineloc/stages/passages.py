"""What a run recognised, intersection by intersection: the many fixes of one passage taken together."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from mineloc import se3
from mineloc.data import I64, Trajectory
from mineloc.metrics.recognition import LEFT_M, Passage, RecognitionScore
from mineloc.stages.recognitions import wording_of
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.run_tables import poses_of

_APART_M = 2.0 * LEFT_M
"""Fixes of one intersection with more metres flown between them belong to two passages."""


@dataclass(frozen=True, slots=True, eq=False)
class Encounter:
    """A passage by an intersection, or fixes of one that was not passed as far as is known.

    Attributes:
        row: of the intersection in the run's table.
        first_ns, last_ns: of the passage; where that is not known, of the fixes.
        at_ns: when the flight was nearest; where that is not known, of the best fix.
        nearest_m: how near the reference came; None without a passage in a reference.
        accepted: (n,) rows of the run's fixes that recognised it, by time.
        refused: (m,) rows of those that were refused meanwhile, whatever they took it for.
        best: the row whose numbers tell most: the accepted fix with the most inliers, else the refused one that came
            farthest; None where no keyframe looked.
    """

    row: int
    first_ns: int
    last_ns: int
    at_ns: int
    nearest_m: float | None
    accepted: I64
    refused: I64
    best: int | None

    @property
    def is_passage(self) -> bool:
        """Whether a reference says that it was passed."""
        return self.nearest_m is not None


def by_intersections(run: RunFolder) -> pl.DataFrame | None:
    """The intersections that the run looked for; None when something else held it: a map, loops, nothing."""
    known = run.intersections()
    if known is None or known.is_empty():
        return None
    strange = set(run.fixes["target"].to_list()) - {"", *known["name"].to_list()}
    return None if strange else known


def encounters(run: RunFolder, known: pl.DataFrame, score: RecognitionScore | None) -> list[Encounter]:
    """Every passage by time, and what was recognised elsewhere.

    Without a reference passages are not known: then it is what was recognised, and what was nearly.

    Args:
        run: whose fixes they are.
        known: as `by_intersections`.
        score: of the run against its reference.
    """
    fixes = _Fixes.of(run, known)
    found = [] if score is None else [fixes.passage(one) for one in score.passages]
    owner = {row: k for k, one in enumerate(found) for row in one.accepted.tolist()}
    for rows in fixes.groups():
        accepted = rows[fixes.trusted[rows]]
        owners = {owner[row] for row in accepted.tolist() if row in owner}
        if owners:
            # the same approach, from a little farther than a passage begins
            first = min(owners)
            rest = [row for row in accepted.tolist() if row not in owner]
            found[first] = fixes.with_accepted(found[first], rest)
        elif len(accepted):
            found.append(fixes.elsewhere(accepted, accepted))
        elif score is None:
            found.append(fixes.elsewhere(rows, accepted))
    return sorted(found, key=lambda one: (one.at_ns, one.row))


def most_frequent(reasons: Sequence[str]) -> tuple[str, int]:
    """The most frequent reason, without its numbers where they differ, and how often it came; ties by the alphabet."""
    counted = Counter(wording_of(reason) for reason in reasons)
    wording, count = min(counted.items(), key=lambda item: (-item[1], item[0]))
    whole = {reason for reason in reasons if wording_of(reason) == wording}
    return (whole.pop() if len(whole) == 1 else wording), count


def errors_of(run: RunFolder, reference: Trajectory) -> dict[int, tuple[float, float]]:
    """Metres and degrees that each accepted fix is off, by its row; those outside the reference are left out.

    Args:
        reference: `T_map_body`.
    """
    stamps = run.fixes["stamp_ns"].to_numpy()
    within = (stamps >= reference.stamps_ns[0]) & (stamps <= reference.stamps_ns[-1])
    rows = np.flatnonzero(within & run.fixes["trusted"].to_numpy())
    if not len(rows):
        return {}
    rows = rows[np.argsort(stamps[rows], kind="stable")]
    # all at once: each look-up walks through the whole reference
    away = se3.inverse(reference.at(stamps[rows]) @ run.T_body_lidar) @ poses_of(run.fixes[rows])
    metres = np.linalg.norm(away[:, :3, 3], axis=1)
    degrees = np.degrees([se3.angle_rad(T) for T in away])
    return dict(zip(rows.tolist(), zip(metres.tolist(), degrees.tolist(), strict=True), strict=True))


def scores_of(run: RunFolder, row: int) -> dict[str, float | None]:
    """The numbers of a fix by name; None where one is not finite."""
    numbers: dict[str, float | None] = json.loads(run.fixes["scores"][row])
    return numbers


@dataclass(frozen=True, slots=True, eq=False)
class _Fixes:
    """The table of fixes as columns, with rows in order of time; `targets` are rows of intersections, -1 for none."""

    order: I64
    stamps_ns: I64
    trusted: Any
    targets: I64
    along_m: Any
    scores: list[dict[str, float | None]]

    @staticmethod
    def of(run: RunFolder, known: pl.DataFrame) -> _Fixes:
        rows = {name: row for row, name in enumerate(known["name"].to_list())}
        stamps, way = run.fixes["stamp_ns"].to_numpy(), run.smoothed
        start = way.stamps_ns[0]
        return _Fixes(
            order=np.argsort(stamps, kind="stable"),
            stamps_ns=stamps,
            trusted=run.fixes["trusted"].to_numpy(),
            targets=np.array([rows.get(name, -1) for name in run.fixes["target"].to_list()], np.int64),
            along_m=np.interp(stamps - start, way.stamps_ns - start, way.path_m),
            scores=[scores_of(run, row) for row in range(len(run.fixes))],
        )

    def within(self, first_ns: int, last_ns: int) -> I64:
        """Rows of a span of time, by time."""
        stamps = self.stamps_ns[self.order]
        return self.order[(stamps >= first_ns) & (stamps <= last_ns)]

    def best(self, rows: I64) -> int | None:
        """That with the most inliers; without any, the one where most keyframes agree, then the most alike."""

        def merit(row: int) -> tuple[float, ...]:
            numbers = self.scores[row]
            return tuple(numbers.get(name) or 0.0 for name in ("inlier_ratio", "same", "matrix", "similarity"))

        return max(rows.tolist(), key=merit, default=None)

    def passage(self, one: Passage) -> Encounter:
        """What was decided during a passage."""
        within = self.within(one.first_ns, one.last_ns)
        accepted = within[self.trusted[within] & (self.targets[within] == one.target)]
        refused = within[~self.trusted[within]]
        best = self.best(accepted if len(accepted) else refused)
        return Encounter(one.target, one.first_ns, one.last_ns, one.nearest_ns, one.nearest_m, accepted, refused, best)

    def with_accepted(self, one: Encounter, rows: Sequence[int]) -> Encounter:
        """A passage with more fixes of its intersection."""
        accepted = self.order[np.isin(self.order, [*one.accepted.tolist(), *rows])]
        return replace(one, accepted=accepted, best=self.best(accepted))

    def groups(self) -> Iterator[I64]:
        """Rows that name one intersection with little way between them."""
        for target in np.unique(self.targets[self.targets >= 0]).tolist():
            rows = self.order[self.targets[self.order] == target]
            cuts = np.flatnonzero(np.diff(self.along_m[rows]) > _APART_M) + 1
            yield from np.split(rows, cuts)

    def elsewhere(self, told: I64, accepted: I64) -> Encounter:
        """What is not known to be a passage."""
        best = self.best(told)
        assert best is not None
        first, last = int(self.stamps_ns[told[0]]), int(self.stamps_ns[told[-1]])
        within = self.within(first, last)
        return Encounter(
            int(self.targets[best]), first, last, int(self.stamps_ns[best]), None, accepted,
            within[~self.trusted[within]], best,
        )  # fmt: skip
