"""How the peers' configurations in odometry_peers.py were found: several of each on a flight that no table reports.

    python benchmarks/peer_tuning.py [--flight FLIGHT.mcap] [--sweeps 2500]

Without a flight it makes one, of another seed than the comparison's. The table goes to results/peer_tuning.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from odometry_peers import HERE, MESH, ROOT, RUNNER
from odometry_scores import score

from mineloc import se3
from mineloc.io.flight import FlightReader

LENGTH_M, SEED = 600, 0
TRIED: dict[str, list[dict[str, Any]]] = {
    "kiss_icp": [
        {"voxel_m": 1.0},
        {"voxel_m": 0.5},
        {},
        {"voxel_m": 0.2},
        {"min_motion_m": 0.05},
        {"min_motion_m": 0.2},
    ],
    "genz_icp": [{"preset": "default"}, {"preset": "outdoor"}, {}, {"deskew": True}],
    "small_gicp": [{"leaf_m": 0.5}, {}, {"leaf_m": 0.15}, {"keyframes": 50}, {"deskew": False}],
    "small_vgicp": [{"voxel_m": 1.0}, {}, {"voxel_m": 0.3}],
    "rko_lio": [
        {"voxel_size": 1.0},
        {"voxel_size": 0.5},
        {},
        {"voxel_size": 0.2},
        {"voxel_size": 1.0, "double_downsample": True},
    ],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flight", type=Path)
    parser.add_argument("--work", type=Path, default=HERE / "work")
    parser.add_argument("--sweeps", type=int, default=2500)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    flight: Path = given.flight or given.work / f"edgar_{LENGTH_M}_{SEED}.mcap"
    if not flight.exists():
        options = ["--out", str(flight), "--length-m", str(LENGTH_M), "--seed", str(SEED)]
        subprocess.run([sys.executable, "-m", "mineloc.cli", "simulate", str(MESH), *options], check=True)
    with FlightReader(flight) as reader:
        reference, T_lidar_body = reader.reference(), se3.inverse(reader.calibration.T_body_lidar)
    assert reference is not None
    python, out = ROOT / ".venv-peers" / "bin" / "python", given.work / "tuning.npz"
    rows = ["| system | changed from the chosen | error over 100 m % | sweeps/s |", "| --- | --- | ---: | ---: |"]
    print(*rows, sep="\n", flush=True)
    for name, choices in TRIED.items():
        for options in choices:
            out.unlink(missing_ok=True)
            wanted = ["--sweeps", str(given.sweeps), "--options", json.dumps(options)]
            command = [str(python), str(RUNNER), name, str(flight), str(out), *wanted]
            ran = subprocess.run(command, capture_output=True, text=True)
            said = ", ".join(f"{key} = {value}" for key, value in options.items()) or "nothing"
            if ran.returncode:
                rows.append(f"| {name} | {said} | {ran.stderr.strip().splitlines()[-1]} | |")
            else:
                found = score(out, reference, T_lidar_body)
                percent = "–" if found.segment_percent is None else f"{found.segment_percent:.3f}"
                rows.append(f"| {name} | {said} | {percent}{found.stopped} | {found.sweeps_per_s:.0f} |")
            print(rows[-1], flush=True)
    made = f"`mineloc simulate {MESH.name} --length-m {LENGTH_M} --seed {SEED}`, its first {given.sweeps} sweeps"
    text = ["# What was tried of the peers' options", "", f"`python benchmarks/peer_tuning.py`; {made}.", "", *rows, ""]
    results = HERE / "results" / "peer_tuning.md"
    results.parent.mkdir(exist_ok=True)
    results.write_text("\n".join(text))


if __name__ == "__main__":
    main()
