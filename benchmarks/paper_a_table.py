"""What is kept of each flight of paper A's experiment, and the table made of it.

A flight needs 34 GB and an hour; its numbers need a few kilobytes. They are kept under results/paper_a/, a file a
flight, so that flights that were flown one by one, on another day or another machine, stand in one table.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

KEPT = Path(__file__).resolve().parent / "results" / "paper_a"
METHODS = (
    "loam", "loam_scan_context", "link3d_scan_context", "intersections", "intersections_map", "map_tracking",
)  # fmt: skip
IN_MAP = ("intersections_map", "map_tracking")
PUBLISHED = {
    "loam": ("10.15", "39.15", "2.18", "1.32", "0.84", "1.04", "0.51"),
    "loam_scan_context": ("2.63", "6.62", "1.09", "0.52", "0.32", "0.32", "0.22"),
    "intersections": ("1.22", "2.22", "1.26", "0.67", "0.19", "0.28", "0.17"),
    "intersections_map": ("0.60", "2.06", "1.38", "0.66", "0.22", "0.31", "0.13"),
}
_MADE_BY = ("code", "machine")
COLUMNS = (
    "method", "trajectory", "flights", "aligned", "RMSE m", "max m",
    "REP-1 %", "REP-2 %", "REP-3 %", "REP-4 %", "REP-5 %", "coverage %", "precision %", "recall %", "times real time",
)  # fmt: skip


def alignment_of(method: str) -> str:
    """A method that knows the map is judged in it; the first pose of another is laid on the reference's."""
    return "none" if method in IN_MAP else "origin"


def keep(flight: str, runs: Mapping[str, Path], setting: Mapping[str, Any], *, into: Path = KEPT) -> Path:
    """Write or complete the file of a flight by its run folders, by method; other methods' numbers stay.

    Args:
        setting: length and seeds; numbers of another setting are dropped, they do not belong to this flight.
    """
    path = into / f"{flight}.json"
    old = json.loads(path.read_text()) if path.exists() else {"setting": {}}
    methods = old["methods"] if old["setting"] == dict(setting) else {}
    for method, folder in runs.items():
        new, known = _numbers(folder, method), methods.get(method, {})
        # told again and not flown again: it stays a number of the code that flew it
        if any(new[key] != known.get(key) for key in new if key not in _MADE_BY):
            methods[method] = new
    into.mkdir(parents=True, exist_ok=True)
    text = json.dumps(
        {"setting": dict(setting), "methods": {one: methods[one] for one in METHODS if one in methods}}, indent=1
    )
    path.write_text(text + "\n")
    return path


def kept(flights: Iterable[str], *, of: Path = KEPT) -> list[dict[str, Any]]:
    """What is kept of flights; none of them may be missing.

    Raises:
        FileNotFoundError: nothing is kept of a flight.
    """
    return [json.loads((of / f"{flight}.json").read_text()) for flight in flights]


def _numbers(folder: Path, method: str) -> dict[str, Any]:
    """Of one run: errors of both trajectories, recognition, speed, and the code that made it."""
    evaluation = json.loads((folder / "metrics.json").read_text())
    out: dict[str, Any] = {"code": _commit(), "machine": f"{platform.machine()}, {len(os.sched_getaffinity(0))} cores"}
    out["times_real_time"] = json.loads((folder / "timing.json").read_text())["real_time_factor"]
    for scored in evaluation["trajectories"]:
        aligned = next(row for row in scored["aligned"] if row["alignment"] == alignment_of(method))
        error = aligned["ape"]["translation_m"]
        out[scored["name"]] = {
            "rmse_m": error["rmse"],
            "max_m": error["max"],
            "rep": [row["literal"]["mean"] for row in scored["rep"]],
            "coverage": scored["coverage"]["path"],
        }
    if evaluation["recognition"] is not None:
        known = evaluation["recognition"]
        out["recognition"] = {key: known[key] for key in ("precision", "recall", "accepted", "wrong")}
    return out


def _commit() -> str:
    asked = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=7"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


def table(flights: list[dict[str, Any]]) -> list[str]:
    """A row a method and trajectory: of each number the worst of the flights that flew the method."""
    lines = [_line(list(COLUMNS)), "| --- | --- | ---: | --- " + "| ---: " * (len(COLUMNS) - 4) + "|"]
    for method in METHODS:
        runs = [flight["methods"][method] for flight in flights if method in flight["methods"]]
        if method in PUBLISHED:
            lines.append(_line([method, "published", "1", "not told", *PUBLISHED[method], "", "", "", ""]))
        for trajectory in ("smoothed", "online") if runs else ():
            scored = [run[trajectory] for run in runs]
            cells = [method, trajectory, str(len(runs)), alignment_of(method)]
            cells += [f"{max(one[key] for one in scored):.3f}" for key in ("rmse_m", "max_m")]
            cells += [f"{rep:.3f}" for rep in np.array([one["rep"] for one in scored]).max(axis=0)]
            cells.append(f"{100 * min(one['coverage'] for one in scored):.1f}")
            cells += [_worst(runs, key) if method == "intersections_map" else "" for key in ("precision", "recall")]
            lines.append(_line([*cells, f"{min(run['times_real_time'] for run in runs):.1f}"]))
    return lines


def _worst(runs: list[dict[str, Any]], key: str) -> str:
    return f"{100 * min(run['recognition'][key] for run in runs):.1f}"


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"
