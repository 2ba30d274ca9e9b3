"""The README's result table: one long flight through the Edgar Mine, from simulation to error.

    .venv/bin/python benchmarks/edgar_flight.py --work FOLDER

flies `--length-m` through the mesh (a seed used for nothing else), ingests the flight, localizes it by every
method, scores the smoothed and the online trajectory, and writes the table between the markers in README.md. What is in
FOLDER already is not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from readme_table import write_readme

ROOT = Path(__file__).resolve().parents[1]
MESH = ROOT.parent / "shared" / "data" / "meshes" / "edgar_mine" / "edgar_mine_rough_200k.ply"
RUNS = {
    "odometry": ("odometry", "odometry", []),
    "odometry_no_imu": ("odometry, no IMU", "odometry", ["--set", "odometry.use_imu=false"]),
    "loam": ("loam (baseline)", "loam", []),
}
COLUMNS = (
    "method", "trajectory", "RMSE m (origin)", "max m (origin)", "RMSE m (se3)", "max m (se3)",
    "REP-1 %", "REP-2 %", "REP-3 %", "REP-4 %", "REP-5 %", "per 100 m %", "coverage %", "sweeps/s",
)  # fmt: skip


def mineloc(*arguments: str | Path) -> str:
    """Run the command line; its standard output."""
    command = [sys.executable, "-m", "mineloc.cli", *map(str, arguments)]
    print("$ mineloc", *map(str, arguments), file=sys.stderr, flush=True)
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def run_all(work: Path, mesh: Path, length_m: float, seed: int) -> dict[str, dict[str, Any]]:
    """Make what is missing; evaluations by name of the run."""
    raw, flight = work / "raw.mcap", work / "flight.mcap"
    if not flight.exists():
        if not raw.exists():
            mineloc("simulate", mesh, "--out", raw, "--length-m", str(length_m), "--seed", str(seed))
        mineloc("ingest", raw, "--out", flight)
    results: dict[str, dict[str, Any]] = {}
    for name, (_, method, options) in RUNS.items():
        run = work / name
        if not run.exists():
            mineloc("localize", flight, "--method", method, "--out", run, "--no-recording", *options)
        results[name] = {
            "evaluation": json.loads(mineloc("evaluate", run, "--json")),
            "timing": json.loads((run / "timing.json").read_text()),
        }
    return results


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown, a row a trajectory."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "| --- " * 2 + "| ---: " * (len(COLUMNS) - 2) + "|"]
    for name, result in results.items():
        trajectories = {scored["name"]: _cells(scored) for scored in result["evaluation"]["trajectories"]}
        if len({tuple(cells) for cells in trajectories.values()}) == 1:
            trajectories = {"smoothed = online": next(iter(trajectories.values()))}
        for which, cells in trajectories.items():
            row = [RUNS[name][0], which, *cells, f"{result['timing']['sweeps_per_s']:.0f}"]
            lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def _cells(scored: dict[str, Any]) -> list[str]:
    errors = {row["alignment"]: row["ape"]["translation_m"] for row in scored["aligned"]}
    cells = [f"{errors[align][key]:.3f}" for align in ("origin", "se3") for key in ("rmse", "max")]
    cells += [f"{row['literal']['mean']:.3f}" for row in scored["rep"]]
    hundred_m = scored["segments"]["by_length"][0]["percent"]
    return [*cells, f"{hundred_m:.3f}", f"{100 * scored['coverage']['path']:.1f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for the flight (15 GB each) and the runs")
    parser.add_argument("--mesh", type=Path, default=MESH)
    parser.add_argument("--length-m", type=float, default=5680.0)
    parser.add_argument("--seed", type=int, default=101)
    chosen = parser.parse_args()
    if not chosen.mesh.exists():
        parser.error(f"{chosen.mesh}: no such mesh; give one with --mesh")
    chosen.work.mkdir(parents=True, exist_ok=True)
    results = run_all(chosen.work, chosen.mesh, chosen.length_m, chosen.seed)
    (chosen.work / "results.json").write_text(json.dumps(results, indent=1))
    reference = results["odometry"]["evaluation"]["trajectories"][0]["coverage"]
    flown = (
        f"`python benchmarks/edgar_flight.py --length-m {chosen.length_m:g} --seed {chosen.seed}`: "
        f"{reference['reference_path_m']:.0f} m in {reference['reference_duration_s']:.0f} s, VLP-16, "
        f"mesh `{chosen.mesh.stem}`."
    )
    write_readme("edgar", table(results), flown)


if __name__ == "__main__":
    main()
