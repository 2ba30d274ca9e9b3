"""The recognitions of a run against its reference: by kind of intersection, with what was passed and not recognised."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from mineloc.data import Trajectory
from mineloc.metrics.recognition import RecognitionScore, recognition_score
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.run_tables import poses_of

_STEP = re.compile(r"\((step \d+|not found yet)\)$")
_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """How well a run recognised the intersections of its database.

    Attributes:
        names, kinds: of the intersections, by the rows that `score` names.
        score: of all, bays too.
        refused: how often recognition stopped at each step, by the step's name.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    score: RecognitionScore
    refused: dict[str, int]

    @property
    def recall(self) -> float | None:
        """Share of the passages of intersections proper that were recognised; a bay is where roadways do not meet."""
        proper = [one.recognised for one in self.score.passages if self.kinds[one.target] != "bay"]
        return sum(proper) / len(proper) if proper else None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        told = self.score.to_dict()
        told["recall_with_bays"] = told["recall"]
        told["recall"] = self.recall
        for row in told["passages"]:
            row["name"], row["kind"] = self.names[row["target"]], self.kinds[row["target"]]
        return {**told, "refused": self.refused}


def recognition_of(run: RunFolder, reference: Trajectory) -> Recognition | None:
    """Score a run that localized by its database and found itself in the map; None for any other.

    A run that the map itself holds recognises intersections only where it is lost.

    Args:
        reference: `T_map_body`.
    """
    known = run.intersections()
    if known is None or run.manifest.get("map") is None or not run.manifest["map"].get("found", True):
        return None
    if (run.fixes["target"] == "map").any():
        return None
    row = {name: k for k, name in enumerate(known["name"].to_list())}
    accepted = run.fixes.filter(pl.col("trusted") & pl.col("target").is_in(list(row))).sort("stamp_ns")
    score = recognition_score(
        np.column_stack([known[name].to_numpy() for name in ("x_m", "y_m", "z_m")]).reshape(-1, 3),
        reference.compose(right=run.T_body_lidar, child="lidar"),
        stamps_ns=accepted["stamp_ns"].to_numpy(),
        poses=poses_of(accepted),
        targets=[row[name] for name in accepted["target"].to_list()],
    )
    return Recognition(
        names=tuple(known["name"].to_list()),
        kinds=tuple(known["kind"].to_list()),
        score=score,
        refused=refusals_by_step(run.fixes),
    )


def refusals_by_step(fixes: pl.DataFrame) -> dict[str, int]:
    """How many keyframes stopped at each step, by its name."""
    reasons = fixes.filter(~pl.col("trusted"))["reason"].to_list()
    return dict(sorted(Counter(step_of(reason) for reason in reasons).items()))


def step_of(reason: str) -> str:
    """The step that a reason names at its end, `afterwards` for what others outvoted, else `other`."""
    named = _STEP.search(reason)
    if named is not None:
        return named[1]
    return "afterwards" if reason.startswith("outvoted") else "other"


def wording_of(reason: str) -> str:
    """A reason without its numbers, but for that of its step: the same for all that stopped for the same cause."""
    named = _STEP.search(reason)
    end = len(reason) if named is None else named.start()
    return _NUMBER.sub("…", reason[:end]) + reason[end:]
