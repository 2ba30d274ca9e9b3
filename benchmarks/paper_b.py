"""Paper B's comparison on simulated roadways and halls with loops: A-LOAM before, LinK3D and Scan Context after.

    .venv/bin/python benchmarks/paper_b.py --work FOLDER

flies three built-in mines (seeds used for nothing else), localizes each flight by four methods, and writes APE as the
paper prints it (max, min, mean, rmse, std; whole trajectory aligned, as M2DGR recommends) to results/paper_b.md. A
false loop is an accepted one whose relative pose is wrong by more than a metre or five degrees.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from mineloc import se3
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.run_tables import poses_of

FLIGHTS = {"loop": (400, 111), "demo": (700, 112), "hall": (400, 113)}
METHODS = ("loam", "loam_scan_context", "link3d", "link3d_scan_context")
FALSE_M, FALSE_DEG = 1.0, 5.0
RESULTS = Path(__file__).parent / "results" / "paper_b.md"


def mineloc(*arguments: str | Path) -> str:
    """Run the command line; its standard output."""
    print("$ mineloc", *map(str, arguments), file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "mineloc.cli", *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def loops_of(run: RunFolder) -> tuple[int, int]:
    """Accepted closures, and how many of them are false."""
    accepted = run.fixes.filter(run.fixes["trusted"])
    assert run.reference is not None
    calibration = np.array(run.manifest["calibration"]["T_body_lidar"])
    stamps = run.keyframes["stamp_ns"].to_numpy()
    truth = run.reference.at(np.clip(stamps, run.reference.stamps_ns[0], run.reference.stamps_ns[-1])) @ calibration
    false = 0
    for (j, target), T in zip(accepted.select("keyframe", "target").iter_rows(), poses_of(accepted), strict=True):
        i = int(target.removeprefix("keyframe "))
        believed = se3.inverse(run.keyframe_poses[i]) @ T
        error = se3.inverse(se3.inverse(truth[i]) @ truth[j]) @ believed
        false += bool(np.linalg.norm(error[:3, 3]) > FALSE_M or np.degrees(se3.angle_rad(error)) > FALSE_DEG)
    return len(accepted), false


def ape_of(folder: Path) -> dict[str, float]:
    """Translation error of the smoothed trajectory, se3-aligned."""
    found = json.loads(mineloc("evaluate", folder, "--align", "se3", "--json"))
    smoothed = next(one for one in found["trajectories"] if one["name"] == "smoothed")
    return {**smoothed["aligned"][0]["ape"]["translation_m"], "coverage": 100 * smoothed["coverage"]["path"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    work = parser.parse_args().work
    work.mkdir(parents=True, exist_ok=True)
    lines = [
        "`python benchmarks/paper_b.py`: VLP-16 with motion distortion, no IMU used; APE in metres, se3-aligned.",
        "",
        "| flight | method | max | min | mean | rmse | std | rmse against loam "
        "| loops | false | fallback % | coverage % |",
        "| --- | --- " + "| ---: " * 10 + "|",
    ]
    for mine, (length_m, seed) in FLIGHTS.items():
        flight = work / f"{mine}-{seed}.mcap"
        if not flight.exists():
            mineloc("simulate", mine, "--out", flight, "--length-m", str(length_m), "--seed", str(seed))
        before: float | None = None
        for method in METHODS:
            folder = work / f"{mine}-{seed}-{method}"
            if not folder.exists():
                mineloc("localize", flight, "--method", method, "--out", folder, "--no-recording")
            lines.append(_row(f"{mine}, {length_m} m, seed {seed}", method, folder, before))
            before = before if before is not None else ape_of(folder)["rmse"]
    text = "\n".join(lines) + "\n"
    print(text)
    RESULTS.write_text(text, encoding="utf-8")


def _row(flight: str, method: str, folder: Path, before: float | None) -> str:
    run, ape = RunFolder.open(folder), ape_of(folder)
    counts: dict[str, Any] = dict(run.manifest["counts"])
    loops, false = loops_of(run)
    aided, alone = counts.get("link3d_sweeps", 0), counts.get("fallback_sweeps", 0)
    cells = [
        flight,
        method,
        *(f"{ape[key]:.4f}" for key in ("max", "min", "mean", "rmse", "std")),
        "-" if before is None else f"{100 * (ape['rmse'] / before - 1):+.1f} %",
        str(loops),
        str(false),
        f"{100 * alone / (aided + alone):.1f}" if aided + alone else "-",
        f"{ape['coverage']:.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
