"""The figures of a survey's runs, as rows: for the terminal, for JSON, for the flows' tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mineloc.survey.plan import Plan, Run

KEYS = (
    "flight",
    "method",
    "trajectory",
    "coverage_percent",
    "ape_rmse_m",
    "ape_max_m",
    "ape_rmse_deg",
    "kitti_percent",
    "alignment",
)


def summary(plan: Plan, *, flight: str | None = None) -> list[dict[str, Any]]:
    """One row a run and trajectory, keys as in `KEYS`; None is unknown (no reference, too short for KITTI).

    Drift is KITTI's: translation error over sub-trajectories of 100 m and more, percent of their length.
    """
    return [row for run in plan.runs if flight in (None, run.flight) for row in _rows(run)]


def _rows(run: Run) -> list[dict[str, Any]]:
    found = _read(run.metrics)
    who: dict[str, Any] = {"flight": run.flight, "method": run.method}
    if not found["trajectories"]:
        return [dict.fromkeys(KEYS) | who]
    return [who | _figures(one) for one in found["trajectories"]]


def _figures(one: dict[str, Any]) -> dict[str, Any]:
    by_alignment = {aligned["alignment"]: aligned["ape"] for aligned in one["aligned"]}
    alignment = "origin" if "origin" in by_alignment else next(iter(by_alignment))
    ape = by_alignment[alignment]
    return {
        "trajectory": one["name"],
        "coverage_percent": _rounded(100.0 * one["coverage"]["time"], 1),
        "ape_rmse_m": _rounded(ape["translation_m"]["rmse"], 4),
        "ape_max_m": _rounded(ape["translation_m"]["max"], 4),
        "ape_rmse_deg": _rounded(ape["rotation_deg"]["rmse"], 4),
        "kitti_percent": _rounded(one["segments"]["percent"], 3),
        "alignment": alignment,
    }


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())
