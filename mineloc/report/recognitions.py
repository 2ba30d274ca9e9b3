"""What a report says of the recognitions of a run: in all, by the step where they stopped, passage by passage."""

from __future__ import annotations

from typing import Any

import polars as pl

from mineloc.metrics.recognition import WRONG_DEG, WRONG_M
from mineloc.report.along import Way
from mineloc.stages.passages import Encounter, by_intersections, encounters, errors_of, most_frequent, scores_of
from mineloc.stages.recognitions import Recognition, recognition_of, step_of, wording_of
from mineloc.stages.run_folder import RunFolder

_LAST = 5
_ASKS = {
    "step 2": "Is an intersection within reach?",
    "step 4": "Does it look like one that may be here?",
    "step 6": "Does one of several stand out?",
    "step 8": "Do keyframes in a row see the same one?",
    "step 9": "Does it register where odometry and roadways allow?",
    "not found yet": "Do enough intersections say where the flight is?",
    "afterwards": "Do the other recognitions and odometry agree?",
}
"""Of the nine steps those that can stop a recognition."""


def map_facts(run: RunFolder, way: Way) -> dict[str, Any] | None:
    """The map that the run was given, and why it did not find itself in it; None without one."""
    known = run.manifest.get("map")
    if not known:
        return None
    found = bool(known.get("found", True))
    return {
        "manifest_sha256": known["manifest_sha256"],
        "grid_origin_m": list(known["grid_origin_m"]),
        "is_grid": bool(known["is_grid"]),
        "found": found,
        "start_off_m": known.get("start_off_m"),
        "last_refusals": [] if found else _last_refusals(run, way),
    }


def recognition_facts(run: RunFolder, way: Way) -> dict[str, Any] | None:
    """Accepted, refused and where it stopped; passages too when intersections held the run. None without any fix."""
    if run.fixes.is_empty():
        return None
    accepted = run.fixes.filter(pl.col("trusted"))["stamp_ns"].to_list()
    known = by_intersections(run)
    scored = None if known is None or run.reference is None else recognition_of(run, run.reference)
    return {
        "accepted": len(accepted),
        "refused": len(run.fixes) - len(accepted),
        "first_m": float(way.metres(min(accepted))) if accepted else None,
        "stopped": _stopped(run),
        "score": None if scored is None else _score(scored),
        "intersections": None if known is None else len(known),
        "places": None if known is None else _places(run, known, scored, way),
    }


def _stopped(run: RunFolder) -> list[dict[str, Any]]:
    """By step, in their order; what names no step by its wording, the most frequent first."""
    by_cause: dict[tuple[str, str], list[str]] = {}
    for reason in run.fixes.filter(~pl.col("trusted"))["reason"].to_list():
        step = step_of(reason)
        by_cause.setdefault((step, "" if step in _ASKS else wording_of(reason)), []).append(reason)
    total = sum(len(reasons) for reasons in by_cause.values())
    rows: list[dict[str, Any]] = []
    for (step, _), reasons in by_cause.items():
        reason, count = most_frequent(reasons)
        rows.append(
            {
                "step": step if step in _ASKS else None,
                "asks": _ASKS.get(step),
                "count": len(reasons),
                "share": len(reasons) / total,
                "reason": reason,
                "reason_count": count,
            }
        )
    order = list(_ASKS)
    return sorted(rows, key=lambda r: (order.index(r["step"]) if r["step"] else len(order), -r["count"], r["reason"]))


def _score(scored: Recognition) -> dict[str, Any]:
    told = scored.to_dict()
    passages = scored.score.passages
    proper = [one for one in passages if scored.kinds[one.target] != "bay"]
    keys = (
        "precision", "recall", "recall_with_bays", "wrong", "median_error_m", "max_error_m", "max_error_deg", "first_m",
    )  # fmt: skip
    return {
        **{key: told[key] for key in keys},
        "passages": len(proper),
        "recognised": sum(one.recognised for one in proper),
        "passages_with_bays": len(passages),
        "recognised_with_bays": sum(one.recognised for one in passages),
    }


def _places(run: RunFolder, known: pl.DataFrame, scored: Recognition | None, way: Way) -> list[dict[str, Any]]:
    off = {} if scored is None or run.reference is None else errors_of(run, run.reference)
    origin = (run.manifest.get("map") or {}).get("grid_origin_m", [0.0, 0.0, 0.0])
    rows: list[dict[str, Any]] = []
    for one in encounters(run, known, None if scored is None else scored.score):
        place = known.row(one.row, named=True)
        accepted = run.fixes[one.accepted]
        errors = [off[row] for row in one.accepted.tolist() if row in off]
        error_m, error_deg = (max(each) for each in zip(*errors, strict=True)) if errors else (None, None)
        rows.append(
            {
                "id": place["id"],
                "name": place["name"],
                "kind": place["kind"],
                "position_m": {axis: place[f"{axis}_m"] + origin[k] for k, axis in enumerate("xyz")},
                "outcome": _outcome(one, error_m, error_deg),
                "at_m": float(way.metres(one.at_ns)),
                "nearest_m": one.nearest_m,
                "accepted": len(accepted),
                "refused": len(one.refused),
                **_times(one, accepted, way),
                **_refusal(run, one),
                **_numbers(run, one.best),
                "error_m": error_m,
                "error_deg": error_deg,
            }
        )
    return rows


def _outcome(one: Encounter, error_m: float | None, error_deg: float | None) -> str:
    if not len(one.accepted):
        return "missed" if one.is_passage else "refused"
    if error_m is not None and error_deg is not None and (error_m > WRONG_M or error_deg > WRONG_DEG):
        return "wrong"
    return "recognised"


def _times(one: Encounter, accepted: pl.DataFrame, way: Way) -> dict[str, float | None]:
    """Seconds since the first pose that metres are counted from."""
    start, stamps = int(way.stamps_ns[0]), accepted["stamp_ns"].to_list()
    return {
        "at_s": (one.at_ns - start) * 1e-9,
        "first_s": (stamps[0] - start) * 1e-9 if stamps else None,
        "last_s": (stamps[-1] - start) * 1e-9 if stamps else None,
    }


def _refusal(run: RunFolder, one: Encounter) -> dict[str, Any]:
    """The most frequent reason of the keyframes that did not recognise it, where none did."""
    reasons = run.fixes["reason"].gather(one.refused).to_list()
    if len(one.accepted) or not reasons:
        return {"reason": None, "reason_count": None}
    reason, count = most_frequent(reasons)
    return {"reason": reason, "reason_count": count}


def _numbers(run: RunFolder, row: int | None) -> dict[str, float | None]:
    told = {} if row is None else scores_of(run, row)
    similarity = told.get("matched_similarity")
    return {
        "similarity": told.get("similarity") if similarity is None else similarity,
        "matrix": told.get("matrix"),
        "inlier_ratio": told.get("inlier_ratio"),
        "residual_m": told.get("residual_m"),
    }


def _last_refusals(run: RunFolder, way: Way) -> list[dict[str, Any]]:
    """The last reasons that are worded differently, the last one first."""
    last: dict[str, dict[str, Any]] = {}
    refused = run.fixes.filter(~pl.col("trusted")).sort("stamp_ns", descending=True)
    for stamp_ns, reason in refused.select("stamp_ns", "reason").iter_rows():
        wording = wording_of(reason)
        if wording not in last and len(last) < _LAST:
            last[wording] = {"reason": reason, "at_s": (stamp_ns - int(way.stamps_ns[0])) * 1e-9}
    return list(last.values())
