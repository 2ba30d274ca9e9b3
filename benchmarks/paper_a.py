"""Paper A's experiment: a mapping flight, its map and database, then other flights localized by six methods.

    .venv/bin/python benchmarks/paper_a.py --work FOLDER [--seeds 301 302 303]

simulates the flights (a mapping flight past surveyed targets, and one of 5.68 km a seed, used for nothing else), writes
FOLDER/survey.toml and runs `mineloc run` on it: everything that is scored comes out of that one command, from MCAP to
the report. The prior map is the project's own reconstruction of the mapping flight, never the truth. Where each flight
takes off is told to 0.1 m and 1 degree, as a surveyor would. The table goes between the markers in README.md, error
maps to `--pictures`.

Needs 34 GB for the mapping flight and 34 GB a seed. What is in FOLDER already is not made again. On a smaller disk, fly
the seeds one by one and remove each recording (and FOLDER/results/.mineloc/store, where its copy is) afterwards: a
flight whose recording is gone is told by the runs that it left. LOAM and what is built on it take three times as long
as all others: `--baseline-seeds` flies them on fewer flights.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from edgar_map import MESH, mineloc
from error_maps import error_maps, similarity_matrices
from readme_table import write_readme

from mineloc.io.flight import FlightReader

METHODS = (
    "loam", "loam_scan_context", "link3d_scan_context", "intersections", "intersections_map", "map_tracking",
)  # fmt: skip
BASELINES = ("loam", "loam_scan_context", "link3d_scan_context")
IN_MAP = ("intersections_map", "map_tracking")
GRID = {"grid_e_m": 512_000, "grid_n_m": 4_398_000, "grid_z_m": 2_300, "grid_yaw_deg": 30}
PUBLISHED = {
    "loam": ("10.15", "39.15", "2.18", "1.32", "0.84", "1.04", "0.51"),
    "loam_scan_context": ("2.63", "6.62", "1.09", "0.52", "0.32", "0.32", "0.22"),
    "intersections": ("1.22", "2.22", "1.26", "0.67", "0.19", "0.28", "0.17"),
    "intersections_map": ("0.60", "2.06", "1.38", "0.66", "0.22", "0.31", "0.13"),
}
COLUMNS = (
    "method", "trajectory", "flights", "aligned", "RMSE m", "max m",
    "REP-1 %", "REP-2 %", "REP-3 %", "REP-4 %", "REP-5 %", "coverage %", "precision %", "recall %", "times real time",
)  # fmt: skip


def simulated(out: Path, mesh: Path | str, length_m: float, seed: int, options: Mapping[str, float | str]) -> Path:
    """A flight through the mesh, in a grid that is neither the mesh's frame nor small."""
    if not out.exists():
        sets = [word for key, value in {**GRID, **options}.items() for word in ("--set", f"simulate.{key}={value}")]
        mineloc("simulate", mesh, "--out", out, "--length-m", str(length_m), "--seed", str(seed), *sets)
    return out


def start_of(flight: Path) -> tuple[list[float], int]:
    """Where a flight takes off in the grid, to 0.1 m, and its heading there, to a degree."""
    with FlightReader(flight) as reader:
        reference = reader.reference()
        assert reference is not None
        T = np.array(json.loads(reader.attachment("grid.json"))["T_grid_map"]) @ reference.poses[0]
    return np.round(T[:3, 3], 1).tolist(), round(float(np.degrees(np.arctan2(T[1, 0], T[0, 0]))))


def survey_of(mapping: Path, flights: Mapping[str, Path], methods: Mapping[str, Sequence[str]]) -> str:
    """The survey file: maps are made of the mapping flight alone; `methods` by flight."""
    lines = ['title = "Paper A: six methods in the Edgar Mine"', "workers = 1"]
    lines += ["", "[[flight]]", 'name = "mapping"', f"recording = {json.dumps(str(mapping))}", "methods = []"]
    for name, flight in flights.items():
        start_m, yaw_deg = start_of(flight)
        lines += ["", "[[flight]]", f"name = {json.dumps(name)}", f"recording = {json.dumps(str(flight))}"]
        lines += ['map = "edgar"', f"methods = {json.dumps(list(methods[name]))}", "[flight.config.prior_map]"]
        lines += [f"start_m = {start_m}", f"start_yaw_deg = {yaw_deg}"]
    lines += ["", "[[map]]", 'name = "edgar"', 'flights = ["mapping"]', "intersections = true", ""]
    return "\n".join(lines)


def run_folder(results: Path, name: str, method: str) -> Path:
    """Of one flight by one method."""
    return results / "runs" / f"{name}-{method}"


def fly_all(chosen: argparse.Namespace, work: Path, methods: Mapping[str, Sequence[str]]) -> None:
    """Simulate the flights and run their survey; a flight with runs and without its recording stays as it is."""
    missing = {
        name: of
        for name, of in methods.items()
        if (work / f"{name}.mcap").exists()
        or not all((run_folder(work / "results", name, method) / "metrics.json").exists() for method in of)
    }
    if not missing:
        return
    targets = {"target_every_m": 250.0}
    mapping = simulated(work / "mapping.mcap", chosen.mesh, chosen.mapping_m, chosen.mapping_seed, targets)
    flights = {
        name: simulated(work / f"{name}.mcap", chosen.mesh, chosen.length_m, int(name.removeprefix("seed")), {})
        for name in missing
    }
    (work / "survey.toml").write_text(survey_of(mapping, flights, missing), encoding="utf-8")
    mineloc("run", work / "survey.toml", "--local", "--out", work / "results")


def rows(results: Path, methods: Mapping[str, Sequence[str]]) -> list[str]:
    """A row a method and trajectory: of each number the worst of the flights, `methods` by flight."""
    out: list[str] = []
    for method in METHODS:
        folders = [run_folder(results, name, method) for name, of in methods.items() if method in of]
        if not folders:
            continue
        evaluations = [json.loads((folder / "metrics.json").read_text()) for folder in folders]
        speeds = [json.loads((folder / "timing.json").read_text())["real_time_factor"] for folder in folders]
        alignment = "none" if method in IN_MAP else "origin"
        if method in PUBLISHED:
            rep = list(PUBLISHED[method][2:])
            out.append(_line([method, "published", "1", "not told", *PUBLISHED[method][:2], *rep, "", "", "", ""]))
        for trajectory in ("smoothed", "online"):
            scored = [
                next(one for one in evaluation["trajectories"] if one["name"] == trajectory)
                for evaluation in evaluations
            ]
            cells = [method, trajectory, str(len(folders)), alignment, *_errors(scored, alignment)]
            cells.append(f"{100 * min(one['coverage']['path'] for one in scored):.1f}")
            cells += _recognition(evaluations) if method == "intersections_map" else ["", ""]
            out.append(_line([*cells, f"{min(speeds):.1f}"]))
    return out


def _errors(scored: list[dict[str, Any]], alignment: str) -> list[str]:
    """RMSE, max and REP-1 … REP-5, the worst of the flights."""
    apes = [
        next(row for row in one["aligned"] if row["alignment"] == alignment)["ape"]["translation_m"] for one in scored
    ]
    reps = np.array([[row["literal"]["mean"] for row in one["rep"]] for one in scored]).max(axis=0)
    return [f"{max(ape[key] for ape in apes):.3f}" for key in ("rmse", "max")] + [f"{rep:.3f}" for rep in reps]


def _recognition(evaluations: list[dict[str, Any]]) -> list[str]:
    found = [evaluation["recognition"] for evaluation in evaluations]
    return [f"{100 * min(one[key] for one in found):.1f}" for key in ("precision", "recall")]


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for flights and results")
    parser.add_argument("--mesh", type=Path, default=MESH)
    parser.add_argument("--mapping-m", type=float, default=5000.0)
    parser.add_argument("--mapping-seed", type=int, default=201)
    parser.add_argument("--length-m", type=float, default=5680.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[301, 302, 303])
    parser.add_argument("--baseline-seeds", type=int, nargs="*", help="of them, those that LOAM flies too")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--pictures", type=Path, help="folder for the error maps")
    parser.add_argument("--no-readme", action="store_true", help="print the table only")
    chosen = parser.parse_args()
    if not chosen.mesh.exists():
        parser.error(f"{chosen.mesh}: no such mesh; give one with --mesh")
    work = chosen.work.absolute()
    work.mkdir(parents=True, exist_ok=True)
    baseline_seeds = chosen.seeds if chosen.baseline_seeds is None else chosen.baseline_seeds
    methods = {
        f"seed{seed}": [one for one in chosen.methods if one not in BASELINES or seed in baseline_seeds]
        for seed in chosen.seeds
    }
    fly_all(chosen, work, methods)
    results = work / "results"
    lines = [_line(list(COLUMNS)), "| --- | --- | ---: | --- " + "| ---: " * (len(COLUMNS) - 4) + "|"]
    lines += rows(results, methods)
    if chosen.pictures is not None:
        name = next(iter(methods))
        folders = {method: run_folder(results, name, method) for method in methods[name]}
        error_maps(folders, chosen.pictures / "paper_a_error_maps.png", in_map=IN_MAP)
        similarity_matrices(results / "maps" / "edgar.intersections.mcap", chosen.pictures / "paper_a_similarity.png")
    seeds = " ".join(map(str, chosen.seeds))
    options = f" --baseline-seeds {' '.join(map(str, baseline_seeds))}" if baseline_seeds != chosen.seeds else ""
    options += "" if chosen.methods == list(METHODS) else f" --methods {' '.join(chosen.methods)}"
    flown = (
        f"`python benchmarks/paper_a.py --length-m {chosen.length_m:g} --seeds {seeds}{options}`: "
        f"map and database of a mapping flight of {chosen.mapping_m:g} m (seed {chosen.mapping_seed}, control points "
        f"every 250 m), VLP-16, mesh `{chosen.mesh.stem}`; of each number the worst of as many flights as are told."
    )
    print(flown, *lines, sep="\n")
    if not chosen.no_readme:
        write_readme("paper a", "\n".join(lines), flown)


if __name__ == "__main__":
    sys.exit(main())
