"""What the localization decided and why, as lines of a log and as states over time."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import groupby, zip_longest
from typing import Any

import polars as pl

from mineloc.data import Trajectory
from mineloc.stages.passages import most_frequent
from mineloc.stages.recognitions import step_of, wording_of
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.stretches import Stretch, degenerate_stretches, untrusted_stretches

Line = tuple[int, str, str]

_WAITING = ("step 2", "step 8")
"""Nothing to see, or not seen often enough: nothing is wrong."""
_WORDS = {
    "matched_similarity": "contours alike {:.2f}",
    "matrix": "matrices alike {:.2f}",
    "same": "{:.0f} keyframes agree",
    "inlier_ratio": "inliers {:.2f}",
    "residual_m": "residual {:.3f} m",
    "sigmas": "{:.1f} sigmas from the prediction",
}

HELD, DEGENERATE, UNTRUSTED = "held on all sides", "degenerate", "motion prior alone"


def run_decisions(run: RunFolder, smoothed: Trajectory) -> list[Line]:
    """(time, level, text) of begin and end, untrusted and degenerate stretches and recognitions, by time."""
    lines = [_untrusted(stretch) for stretch in untrusted_stretches(run.sweeps)]
    lines += [_degenerate(stretch, smoothed) for stretch in degenerate_stretches(run.sweeps)]
    lines += _recognitions(run.fixes)
    return [_begin(run, smoothed), *sorted(lines), _end(smoothed)]


def run_states(sweeps: pl.DataFrame) -> dict[int, str]:
    """{time: state} of the registration; untrusted wins where it is degenerate too."""
    state = pl.when(~pl.col("trusted")).then(pl.lit(UNTRUSTED))
    state = state.when(pl.col("is_degenerate")).then(pl.lit(DEGENERATE)).otherwise(pl.lit(HELD))
    table = sweeps.select("stamp_ns", state=state)
    changed = table.filter(pl.col("state").ne_missing(pl.col("state").shift()))
    return dict(changed.iter_rows())


def _begin(run: RunFolder, smoothed: Trajectory) -> Line:
    return int(smoothed.stamps_ns[0]), "INFO", f"first pose; {len(run.sweeps)} sweeps, {len(run.keyframes)} keyframes"


def _end(smoothed: Trajectory) -> Line:
    seconds = int(smoothed.stamps_ns[-1] - smoothed.stamps_ns[0]) * 1e-9
    return int(smoothed.stamps_ns[-1]), "INFO", f"last pose, {smoothed.path_m[-1]:.1f} m and {seconds:.1f} s on"


def _seconds(stretch: Stretch) -> float:
    return (stretch.end_ns - stretch.start_ns) * 1e-9


def _untrusted(stretch: Stretch) -> Line:
    sweeps = "1 sweep" if stretch.sweeps == 1 else f"{stretch.sweeps} sweeps"
    text = f"pose by motion prior alone for {sweeps} ({_seconds(stretch):.1f} s): {stretch.reason}"
    return stretch.start_ns, "WARN", text


def _degenerate(stretch: Stretch, smoothed: Trajectory) -> Line:
    origin = int(smoothed.stamps_ns[0])
    inside = (smoothed.stamps_ns >= stretch.start_ns) & (smoothed.stamps_ns <= stretch.end_ns)
    path = smoothed.path_m[inside]
    length = float(path[-1] - path[0]) if len(path) else 0.0
    text = (
        f"degenerate for {length:.0f} m ({_seconds(stretch):.1f} s), from {(stretch.start_ns - origin) * 1e-9:.1f} s on"
    )
    return stretch.start_ns, "INFO", text


def _recognitions(fixes: pl.DataFrame) -> list[Line]:
    """A line for every accepted fix, and one for keyframes in a row that were refused for the same cause."""

    def cause(row: dict[str, Any]) -> object:
        return row["keyframe"] if row["trusted"] else (wording_of(row["reason"]), row["target"])

    rows = fixes.sort("stamp_ns", maintain_order=True).to_dicts()
    # that one keyframe more was waited for is told by the line of the next one
    told = [row for row, after in zip_longest(rows, rows[1:]) if not _waits_for(row, after)]
    groups = groupby(told, key=cause)
    return [_accepted(rows[0]) if rows[0]["trusted"] else _refused(rows) for rows in (list(g) for _, g in groups)]


def _waits_for(row: dict[str, Any], after: dict[str, Any] | None) -> bool:
    return after is not None and step_of(row["reason"]) == "step 8" and row["target"] == after["target"]


def _accepted(row: dict[str, Any]) -> Line:
    told = _told(json.loads(row["scores"]))
    return row["stamp_ns"], "INFO", f"keyframe {row['keyframe']}: recognised {row['target'] or 'the map'}{told}"


def _refused(rows: Sequence[dict[str, Any]]) -> Line:
    first, last, names_step = rows[0], rows[-1], step_of(rows[0]["reason"]) != "other"
    if len(rows) == 1:
        who, reason = f"keyframe {first['keyframe']}", first["reason"]
    else:
        who = f"keyframes {first['keyframe']} to {last['keyframe']}"
        reason = most_frequent([row["reason"] for row in rows])[0]
    # the reason of a step brings its number along
    told = "" if names_step or len(rows) > 1 else _told(json.loads(first["scores"]))
    waits = step_of(first["reason"]) in _WAITING
    verdict = "not yet, " if waits and first["target"] else "" if waits else "refused, "
    target = f"{first['target']} " if first["target"] and names_step else ""
    return first["stamp_ns"], "INFO" if waits else "WARN", f"{who}: {target}{verdict}{reason}{told}"


def _told(scores: dict[str, float | None]) -> str:
    """The numbers in brackets; of an intersection those that say why, in words."""
    if "matched_similarity" in scores:
        parts = [text.format(scores[key]) for key, text in _WORDS.items() if scores.get(key) is not None]
    else:
        parts = [f"{name} {value:.3g}" for name, value in scores.items() if value is not None]
    return f" ({', '.join(parts)})" if parts else ""
