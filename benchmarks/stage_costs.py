"""What each stage takes of a machine: cores, memory, disk. What docs/sizing.md reckons with.

    .venv/bin/python benchmarks/stage_costs.py --work FOLDER [--length-m 1200]

flies once through the Edgar Mine and runs every command on that flight, each in a process of its own, one after the
other. Writes results/stage_costs.md: per minute of flight, for a VLP-16 at 10 Hz.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from edgar_map import MESH, mineloc

from mineloc.io.flight import FlightReader

ROOT = Path(__file__).resolve().parents[1]
COLUMNS = ("stage", "wall s", "core s", "cores", "peak GB", "reads GB", "writes GB")
BLOCK_BYTES = 512
"""What `ru_inblock` and `ru_oublock` count."""


@dataclass(frozen=True)
class Cost:
    """Of one command."""

    wall_s: float
    core_s: float
    peak_gb: float
    written_gb: float


def cost_of(words: Sequence[str | Path]) -> Cost:
    """Run a command of mineloc."""
    print("$ mineloc", *words, file=sys.stderr, flush=True)
    start = perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "mineloc.cli", *map(str, words)], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"failed: {' '.join(map(str, words))}")
    core_s = usage.ru_utime + usage.ru_stime
    return Cost(perf_counter() - start, core_s, usage.ru_maxrss / 1e6, usage.ru_oublock * BLOCK_BYTES / 1e9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for the flight and results (10 GB)")
    parser.add_argument("--length-m", type=float, default=1200.0)
    parser.add_argument("--mesh", type=Path, default=MESH)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "stage_costs.md")
    chosen = parser.parse_args()
    work = chosen.work.absolute()
    work.mkdir(parents=True, exist_ok=True)
    recording, flight = work / "recording.mcap", work / "flight.mcap"
    if not recording.exists():
        mineloc("simulate", chosen.mesh, "--out", recording, "--length-m", str(chosen.length_m), "--seed", "41")
    steps: dict[str, tuple[Sequence[str | Path], float]] = {"ingest": (("ingest", recording, "--out", flight), 1.0)}
    steps["reconstruct"] = (("reconstruct", flight, "--out", work / "map"), 1.0)
    steps["database"] = (("database", work / "map", "--out", work / "map.intersections.mcap"), 0.0)
    for method, known in (
        ("odometry", ()),
        ("intersections", ()),
        ("intersections_map", ("--database", work / "map.intersections.mcap")),
        ("map_tracking", ("--map", work / "map", "--database", work / "map.intersections.mcap")),
        ("loam", ()),
    ):
        words = ("localize", flight, "--method", method, *known, "--out", work / method, "--no-recording")
        steps[f"localize, {method}"] = (words, 1.0)
    steps["evaluate"] = (("evaluate", work / "odometry"), 0.0)
    steps["record"] = (("view", work / "odometry", "--flight", flight, "--save", work / "run.rrd"), 1.0)
    steps["report"] = (("report", work / "odometry", "--out", work / "report.html"), 0.0)
    costs = {name: cost_of(words) for name, (words, _) in steps.items()}
    with FlightReader(flight) as reader:
        minutes, length_m = reader.duration_s / 60.0, chosen.length_m
    size_gb = flight.stat().st_size / 1e9
    rows: list[str] = []
    for name, c in costs.items():
        per_minute = f"{c.wall_s / minutes:.2f} | {c.core_s / minutes:.2f} | {c.core_s / c.wall_s:.2f}"
        moved = f"{steps[name][1] * size_gb / minutes:.3f} | {c.written_gb / minutes:.3f}"
        rows.append(f"| {name} | {per_minute} | {c.peak_gb:.2f} | {moved} |")
    table = "\n".join(["| " + " | ".join(COLUMNS) + " |", "| --- " + "| ---: " * (len(COLUMNS) - 1) + "|", *rows])
    head = (
        f"`python benchmarks/stage_costs.py --length-m {length_m:g}`: {minutes:.1f} min of flight, {size_gb:.2f} GB "
        f"(seed 41), on {len(os.sched_getaffinity(0))} cores; seconds and gigabytes per minute of flight, start of the "
        "interpreter included; cores: how many were busy; reads: of the flight, which may lie in the disk cache."
    )
    chosen.out.write_text(f"# What a stage takes\n\n{head}\n\n{table}\n")
    print(head, table, sep="\n")


if __name__ == "__main__":
    main()
