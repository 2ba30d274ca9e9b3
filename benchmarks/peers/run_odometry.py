"""Runs one odometry over a flight in this process and writes its poses and its times.

    python benchmarks/peers/run_odometry.py SYSTEM FLIGHT.mcap OUT.npz [--sweeps N] [--options '{"voxel_m": 0.5}']

SYSTEM is a key of `odometries.SYSTEMS`; the peers want the environment of requirements.txt. All systems read the same
way: a block of sweeps is read and prepared, then each of its sweeps is stepped and timed.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import traceback
from collections.abc import Generator, Iterator
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from odometries import SYSTEMS, Odometry, version_of

from mineloc.data import ImuSamples, Sweep
from mineloc.io.flight import FlightReader

BLOCK = 50
"""Sweeps that are in memory at a time: large against the reader's look-ahead of 4, small against the memory."""


def blocks(
    steps: Iterator[tuple[Sweep, ImuSamples]], system: Odometry, wanted: int | None
) -> Generator[tuple[list[tuple[int, int, Any]], float]]:
    """(start, end, prepared) of each sweep of a block, and the seconds that reading it took."""
    steps = islice(steps, wanted)
    while True:
        start = perf_counter()
        block = [(s.stamp_ns, s.end_ns, system.prepare(s, imu)) for s, imu in islice(steps, BLOCK)]
        if not block:
            return
        yield block, perf_counter() - start


def run(flight: Path, name: str, options: dict[str, Any], wanted: int | None) -> dict[str, Any]:
    """Arrays of what happened; a system that raises ends its run there, and `error` says why."""
    make, chosen = SYSTEMS[name]
    stamps, poses, seconds, read_seconds, error = [], [], [], [], ""
    with FlightReader(flight) as reader:
        system = make(reader.calibration, **(chosen | options))
        total = min(reader.sweep_count, wanted or reader.sweep_count)
        for block, read_s in blocks(reader.steps(), system, wanted):
            read_seconds.append(read_s)
            try:
                for begin_ns, end_ns, prepared in block:
                    start = perf_counter()
                    pose = system.step(prepared)
                    seconds.append(perf_counter() - start)
                    stamps.append((begin_ns, end_ns))
                    poses.append(np.full((4, 4), np.nan) if pose is None else np.array(pose, dtype=np.float64))
            except Exception as problem:  # noqa: BLE001 - a peer's failure is a result, not ours
                traceback.print_exc()
                error = f"{type(problem).__name__}: {problem}"
                break
    return {
        "stamps_ns": np.array(stamps, np.int64).reshape(-1, 2),
        "poses": np.array(poses).reshape(-1, 4, 4),
        "step_s": np.array(seconds),
        "read_s": np.array(read_seconds),
        "facts": json.dumps(
            {
                "system": name,
                "version": version_of(system.package),
                "configuration": system.configuration,
                "pose_at": system.pose_at,
                "sweeps": total,
                "block": BLOCK,
                "error": error,
                "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            }
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("system", choices=SYSTEMS)
    parser.add_argument("flight", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sweeps", type=int, help="only so many from the start")
    parser.add_argument("--options", type=json.loads, default={}, help="JSON: instead of the best configuration")
    given = parser.parse_args()
    np.savez_compressed(given.out, **run(given.flight, given.system, given.options, given.sweeps))


if __name__ == "__main__":
    main()
