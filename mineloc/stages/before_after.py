"""Two estimates of one flight side by side: the error before and after, as paper B's tables 1 and 2 (METHOD 2.5)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mineloc.config import EvaluateConfig
from mineloc.errors import EvaluationError
from mineloc.metrics.alignment import Alignment
from mineloc.metrics.statistics import Statistics
from mineloc.stages.evaluate import Evaluation, evaluate
from mineloc.stages.scores import Scores

SCHEMA = "mineloc.before_after/1"


@dataclass(frozen=True, slots=True)
class Change:
    """What became of the APE of one trajectory under one alignment.

    Attributes:
        trajectory, baseline_trajectory: `estimate`, `smoothed` or `online`; which one was compared with which.
        alignment: of both.
        before_m, after_m: statistics of the translation error.
        before_coverage, after_coverage: share of the reference's path that they speak of.
    """

    trajectory: str
    baseline_trajectory: str
    alignment: Alignment
    before_m: Statistics
    after_m: Statistics
    before_coverage: float
    after_coverage: float

    @property
    def rmse_percent(self) -> float | None:
        """Change of the rmse, negative when it became better; None when there was no error before."""
        if self.before_m.rmse == 0:
            return None
        return 100.0 * (self.after_m.rmse / self.before_m.rmse - 1.0)

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name."""
        return {
            "trajectory": self.trajectory,
            "baseline_trajectory": self.baseline_trajectory,
            "alignment": self.alignment,
            "before": {"translation_m": self.before_m.to_dict(), "path_coverage": self.before_coverage},
            "after": {"translation_m": self.after_m.to_dict(), "path_coverage": self.after_coverage},
            "rmse_change_percent": self.rmse_percent,
        }


@dataclass(frozen=True, slots=True, eq=False)
class BeforeAfter:
    """The evaluations of a baseline and of an estimate against the same reference.

    Attributes:
        before: of the baseline.
        after: of the estimate.
        changes: one entry a trajectory of the estimate and alignment that both have.
    """

    before: Evaluation
    after: Evaluation
    changes: tuple[Change, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "schema": SCHEMA,
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "changes": [one.to_dict() for one in self.changes],
        }


def evaluate_before_after(
    estimate: str | Path,
    baseline: str | Path,
    reference: str | Path | None = None,
    *,
    align: Alignment | None = None,
    config: EvaluateConfig | None = None,
) -> BeforeAfter:
    """Score an estimate and the baseline that it is to beat.

    `smoothed` is compared with `smoothed` and `online` with `online`. Where the baseline has no trajectory of that
    name, its first one is taken, which is the smoothed one of a run.

    Args:
        estimate, baseline: as `evaluate` takes them.
        reference: as `evaluate` takes it; None takes the one that the estimate brings along, for both.
        align: one alignment, None: none, origin and se3.
        config: association, distances, gaps.

    Raises:
        EvaluationError: as `evaluate`; no alignment that both poses determine.
        FormatError: a file cannot be read.
    """
    after = evaluate(estimate, reference, align=align, config=config)
    before = evaluate(baseline, reference if reference is not None else after.reference, align=align, config=config)
    by_name = {scores.name: scores for scores in before.scores}
    changes = tuple(
        change for scores in after.scores for change in _changes(by_name.get(scores.name, before.scores[0]), scores)
    )
    if not changes:
        raise EvaluationError(baseline, "no alignment in common with the estimate", todo="choose --align none")
    return BeforeAfter(before, after, changes)


def _changes(before: Scores, after: Scores) -> Iterator[Change]:
    known = {one.absolute.alignment: one.absolute for one in before.aligned}
    for one in after.aligned:
        absolute = one.absolute
        if absolute.alignment in known:
            yield Change(
                trajectory=after.name,
                baseline_trajectory=before.name,
                alignment=absolute.alignment,
                before_m=known[absolute.alignment].translation_m,
                after_m=absolute.translation_m,
                before_coverage=before.coverage.path,
                after_coverage=after.coverage.path,
            )
