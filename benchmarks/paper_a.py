"""Paper A's experiment: a mapping flight, its map and database, then other flights localized by six methods.

    .venv/bin/python benchmarks/paper_a.py --work FOLDER [--seeds 301 302 303]

simulates the flights (a mapping flight past surveyed targets, and one of 5.68 km a seed, used for nothing else), writes
FOLDER/survey.toml and runs `mineloc run` on it: everything that is scored comes out of that one command, from MCAP to
the report. The prior map is the project's own reconstruction of the mapping flight, never the truth. Where each flight
takes off is told to 0.1 m and 1 degree, as a surveyor would. The table goes between the markers in README.md, error
maps to `--pictures`.

Needs 34 GB for the mapping flight and 34 GB a seed. What is in FOLDER already is not made again. The numbers of each
flight are kept in results/paper_a/, and the table is made of all flights there: on a smaller disk, fly the seeds one by
one, each with an empty FOLDER/results/.mineloc/store. LOAM and what is built on it take three times as long as all
others: `--baseline-seeds` flies them on fewer flights.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from edgar_map import MESH, mineloc
from error_maps import error_maps, similarity_matrices
from paper_a_table import IN_MAP, KEPT, METHODS, keep, kept, table
from readme_table import write_readme

from mineloc.io.flight import FlightReader

BASELINES = ("loam", "loam_scan_context", "link3d_scan_context")
GRID = {"grid_e_m": 512_000, "grid_n_m": 4_398_000, "grid_z_m": 2_300, "grid_yaw_deg": 30}


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


def survey_of(
    mapping: Path, flights: Mapping[str, Path], methods: Mapping[str, Sequence[str]], *, workers: int = 1
) -> str:
    """The survey file: maps are made of the mapping flight alone; `methods` by flight."""
    lines = ['title = "Paper A: six methods in the Edgar Mine"', f"workers = {workers}"]
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
    """Simulate the flights and run their survey; a flight that left all of its runs is not flown again."""
    missing = {
        name: of
        for name, of in methods.items()
        if not all((run_folder(work / "results", name, method) / "metrics.json").exists() for method in of)
    }
    if not missing:
        return
    targets = {"target_every_m": 250.0}
    mapping = simulated(work / "mapping.mcap", chosen.mesh, chosen.mapping_m, chosen.mapping_seed, targets)
    flights = {
        name: simulated(work / f"{name}.mcap", chosen.mesh, chosen.length_m, int(name.removeprefix("seed")), {})
        for name in missing
    }
    survey = survey_of(mapping, flights, missing, workers=chosen.workers)
    (work / "survey.toml").write_text(survey, encoding="utf-8")
    mineloc("run", work / "survey.toml", "--local", "--out", work / "results")


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
    parser.add_argument("--workers", type=int, default=1, help="runs at once; speeds are of one at a time")
    parser.add_argument("--kept", type=Path, default=KEPT, help="folder of the numbers, a file a flight")
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
    setting = {"mesh": chosen.mesh.stem, "length_m": chosen.length_m}
    setting |= {"mapping_m": chosen.mapping_m, "mapping_seed": chosen.mapping_seed}
    for name, of in methods.items():
        keep(name, {method: run_folder(results, name, method) for method in of}, setting, into=chosen.kept)
    names = sorted(path.stem for path in chosen.kept.glob("seed*.json"))
    flights = [one for one in kept(names, of=chosen.kept) if one["setting"] == setting]
    lines = table(flights)
    if chosen.pictures is not None:
        name = next(iter(methods))
        folders = {method: run_folder(results, name, method) for method in methods[name]}
        error_maps(folders, chosen.pictures / "paper_a_error_maps.png", in_map=IN_MAP)
        similarity_matrices(results / "maps" / "edgar.intersections.mcap", chosen.pictures / "paper_a_similarity.png")
    flown = (
        f"`python benchmarks/paper_a.py --length-m {chosen.length_m:g}`, seeds "
        f"{', '.join(name.removeprefix('seed') for name in names)}: map and database of a mapping flight of "
        f"{chosen.mapping_m:g} m (seed {chosen.mapping_seed}, control points every 250 m), VLP-16, mesh "
        f"`{chosen.mesh.stem}`; of each number the worst of as many flights as are told "
        "([flight by flight](benchmarks/results/paper_a))."
    )
    print(flown, *lines, sep="\n")
    if not chosen.no_readme:
        write_readme("paper a", "\n".join(lines), flown)


if __name__ == "__main__":
    sys.exit(main())
