"""Why a recognition was accepted: its nine steps with the number of each beside what was needed, as a page of text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mineloc.view.about import escaped

NOTHING = "–"


@dataclass(frozen=True, slots=True)
class Away:
    """How far two poses are from each other."""

    metres: float
    degrees: float

    def __str__(self) -> str:
        return f"{self.metres:.3f} m, {self.degrees:.2f}°"


@dataclass(frozen=True, slots=True, eq=False)
class Accepted:
    """An accepted fix, as far as it says why.

    Attributes:
        name, kind: of the intersection, from outside.
        id: in its database.
        keyframe: that it was recognised from.
        seconds: since the first pose.
        times: accepted fixes of the whole passage.
        scores: of the fix.
        reach_m: way over ground to the invariant point.
        contour_threshold: of the database.
        configuration: of the run, by section.
        predicted: away from where odometry put it; None while the flight was not found yet.
        error: against the reference; None without one.
    """

    name: str
    kind: str
    id: int
    keyframe: int
    seconds: float
    times: int
    scores: Mapping[str, float | None]
    reach_m: float
    contour_threshold: float
    configuration: Mapping[str, Any]
    predicted: Away | None
    error: Away | None

    @property
    def is_tracked(self) -> bool:
        """Whether the flight was followed in the map already: then fewer keyframes and less likeness suffice."""
        return "sigmas" in self.scores

    def limit(self, key: str, *, section: str = "intersections") -> float | None:
        """A threshold of the run; None where its configuration does not tell."""
        value = self.configuration.get(section, {}).get(key)
        return None if value is None else float(value)


def line_of(one: Accepted) -> str:
    """One line for a list of recognitions."""
    s = one.scores
    return (
        f"{one.name} ({one.kind}): accepted {one.times}×, contours alike {_written(_likeness(one), 2)}, "
        f"inliers {_written(s.get('inlier_ratio'), 2)}, residual {_written(s.get('residual_m'), 3)} m"
    )


def page_of(one: Accepted) -> str:
    """Markdown; names from outside are escaped."""
    rows = [f"| {step} | {what} | {number} | {needed} |" for step, what, number, needed in _rows(one)]
    return "\n".join(
        [
            f"# {escaped(one.name)}",
            "",
            f"{one.kind}, id {one.id}. Keyframe {one.keyframe}, {one.seconds:.1f} s after the first pose: of "
            f"{one.times} accepted on this passage the one with the most inliers.",
            "",
            "| step | | number | needed |",
            "| ---: | --- | ---: | ---: |",
            *rows,
            "",
            "Clouds: grey stored, without its roof; yellow the keyframes, placed by the accepted pose. Contours: green "
            "stored; yellow seen, from the few points that a run keeps.",
        ]
    )


def _likeness(one: Accepted) -> float | None:
    matched = one.scores.get("matched_similarity")
    return one.scores.get("similarity") if matched is None else matched


def _rows(one: Accepted) -> list[tuple[str, str, str, str]]:
    s = one.scores
    candidates = s.get("candidates")
    alone = candidates is not None and candidates <= 1
    margin = None
    best, second = s.get("matrix"), s.get("matrix_second")
    if best is not None and second:
        margin = best - second
    threshold, tracked_threshold = one.contour_threshold, one.limit("threshold_known")
    if one.is_tracked and tracked_threshold is not None:
        threshold = min(threshold, tracked_threshold)
    needed = one.limit("same_needed_known" if one.is_tracked else "same_needed")
    least_margin = one.limit("matrix_margin")
    sigmas = one.limit("max_moved_sigmas", section="prior_map")
    return [
        ("1", "keyframes laid over each other", f"up to {_written(one.limit('window_keyframes'), 0)}", ""),
        ("2", f"{_written(s.get('branches'), 0)} branches meet within reach", f"{one.reach_m:.1f} m",
         _most(one.limit("recognise_m"), 1, " m")),
        ("3", "directions with a wall (PWCV)", _written(s.get("walls"), 0), ""),
        ("4", "contours alike", _written(_likeness(one), 2), _least(threshold, 2)),
        ("", "candidates that may be here", _written(candidates, 0), _least(1, 0)),
        ("5", "one candidate alone", "yes" if alone else "no", ""),
        ("6", "matrices alike (CWC)", "not asked" if best is None else _written(best, 2), ""),
        *([] if margin is None else [("", "better than the second by", f"{margin:.2f}", _least(least_margin, 2))]),
        ("7, 8", "keyframes in a row that agree", _written(s.get("same"), 0), _least(needed, 0)),
        ("9", "inliers of the registration", _written(s.get("inlier_ratio"), 2),
         _least(one.limit("verify_inlier_ratio"), 2)),
        ("", "residual", _written(s.get("residual_m"), 3, " m"), _most(one.limit("verify_residual_m"), 3, " m")),
        ("", "moved by registration", _written(s.get("moved_m"), 2, " m"), ""),
        ("", "from the prediction", _written(s.get("sigmas"), 1, " sigmas"), _most(sigmas, 1, " sigmas")),
        ("", "that is", "not found yet" if one.predicted is None else str(one.predicted), ""),
        ("", "from the reference", "there is none" if one.error is None else str(one.error), ""),
    ]  # fmt: skip


def _written(value: float | None, decimals: int, unit: str = "") -> str:
    return NOTHING if value is None else f"{value:.{decimals}f}{unit}"


def _least(value: float | None, decimals: int) -> str:
    return NOTHING if value is None else f"≥ {value:.{decimals}f}"


def _most(value: float | None, decimals: int, unit: str) -> str:
    return NOTHING if value is None else f"≤ {value:.{decimals}f}{unit}"
