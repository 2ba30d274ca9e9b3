"""A run beside its reference, as report and viewer show it: the scores, the drift, and one alignment to draw under."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.config import EvaluateConfig
from mineloc.data import F64
from mineloc.metrics.absolute import AbsoluteError
from mineloc.metrics.alignment import Alignment
from mineloc.stages.evaluate import ALIGNMENTS
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.scores import Scores, pair, score


@dataclass(frozen=True, slots=True)
class Drift:
    """What was lost over the whole flight when the first pose is laid on the reference's first.

    Attributes:
        end_error_m: distance of the last poses.
        percent: of the metres flown by the reference, None when it stood still.
        one_in: metres flown a metre of end error (the trade's 1:N), None when either is zero.
    """

    end_error_m: float
    percent: float | None
    one_in: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """One estimate beside the reference.

    Attributes:
        scores: every metric.
        shown: the error under the alignment in which the run is drawn.
        drift: over the whole flight.
    """

    scores: Scores
    shown: AbsoluteError
    drift: Drift


def compare(run: RunFolder, config: EvaluateConfig) -> dict[str, Comparison]:
    """Both `online` and `smoothed` beside the run's reference; empty without one, or without times in common."""
    if run.reference is None:
        return {}
    out: dict[str, Comparison] = {}
    for name, estimate in (("online", run.online), ("smoothed", run.smoothed)):
        pairs = pair(run.reference, estimate, config)
        if not len(pairs):
            return {}
        scores = score(name, run.reference, estimate, pairs, ALIGNMENTS, config)
        by_kind = {one.absolute.alignment: one.absolute for one in scores.aligned}
        shown = by_kind.get(_shown_alignment(run, config), by_kind["origin"])
        out[name] = Comparison(scores, shown, _drift(by_kind["origin"]))
    return out


def frame_of(comparison: Comparison | None) -> F64:
    """(4, 4) from the run's map to the frame in which it is drawn; the map itself without a reference."""
    return np.eye(4) if comparison is None else comparison.shown.T_reference_estimate


def _shown_alignment(run: RunFolder, config: EvaluateConfig) -> Alignment:
    """In a map that stands in the mine grid nothing is aligned: estimate and reference are told in its frame.

    Else the first pose is laid on the reference's: the error begins at zero and grows as the drift does. So it is for
    a flight that did not find itself in the map, and in a map without a grid, whose frame is that of another flight.
    """
    if config.shown_alignment != "auto":
        return config.shown_alignment
    known = run.manifest.get("map")
    return "none" if known and known["is_grid"] and known.get("found", True) else "origin"


def _drift(origin: AbsoluteError) -> Drift:
    end, path = float(origin.error_m[-1]), float(origin.path_m[-1])
    return Drift(
        end_error_m=end,
        percent=100.0 * end / path if path > 0 else None,
        one_in=path / end if path > 0 and end > 0 else None,
    )
