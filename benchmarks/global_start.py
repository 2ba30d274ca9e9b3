"""How far a flight that may begin anywhere flies until it knows where it is.

    .venv/bin/python benchmarks/global_start.py FLIGHT.mcap --database DB.mcap [--every 25]

The front end runs over the flight once. Then the flight is taken to begin at every 25th of its keyframes, in turn,
knowing nothing of what came before, and is shown what follows until its intersections find it, as `intersections_map`
does without `prior_map.start_m`. Starts with less than `--least-m` of flight left are not counted. Prints a table;
with `--out` it is added to that file under the flight's title.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, IntersectionDatabase, Keyframe, RelativePose
from mineloc.errors import FlightError
from mineloc.io.flight import FlightReader
from mineloc.localize.flown import Flown, fly
from mineloc.localize.localization import FlightData
from mineloc.localize.map_tracker import IntersectionTracker
from mineloc.localize.method import method_named
from mineloc.localize.recognition import Recognizer
from mineloc.localize.relocalization import Relocalizer
from mineloc.localize.sequence import RoadwaySequence
from mineloc.metrics.recognition import WRONG_DEG, WRONG_M
from mineloc.progress import quiet
from mineloc.stages.known_map import KnownMap

COLUMNS = ("case", "starts", "found", "wrong", "median m", "p90 m", "max m")


@dataclass(frozen=True, slots=True)
class Found:
    """One start: metres flown until found (infinite: never), and whether the pose was wrong then."""

    flown_m: float
    wrong: bool


def flown_with_truth(path: Path, database: Path, config: Config) -> tuple[Flown, F64, IntersectionDatabase]:
    """A flight by odometry, (k, 4, 4) where its keyframes truly are in the map, and the database."""
    known = KnownMap.open(None, database, config)
    assert known is not None
    assert known.prior.database is not None
    with FlightReader(path) as reader:
        front_end = method_named("intersections_map").make_front_end(config, reader.calibration)
        flown = fly(front_end, FlightData(reader.steps(), reader.calibration), config, progress=quiet)
        reference = known.reference_of(reader)
        if reference is None:
            raise FlightError(str(path), "no reference", expected="a flight with one", todo="choose another")
        T_body_lidar = reader.calibration.T_body_lidar
    return flown, reference.at(flown.keyframe_stamps_ns) @ T_body_lidar, known.prior.database


def found_from(
    start: int, keyframes: list[Keyframe], edges: list[RelativePose | None], truth: F64,
    recognizer: Recognizer, database: IntersectionDatabase, config: Config,
) -> Found:  # fmt: skip
    """Begin at a keyframe and fly until found."""
    lost = Relocalizer(
        recognizer,
        config,
        lambda known: IntersectionTracker(recognizer, RoadwaySequence(database, config.intersections), config, known),
    )
    flown_m = 0.0
    for k in range(start, len(keyframes)):
        if k > start:
            flown_m += float(np.linalg.norm(truth[k, :3, 3] - truth[k - 1, :3, 3]))
        lost.follow(keyframes[k], edges[k] if k > start else None)
        if lost.filter is not None:
            error = se3.inverse(truth[k]) @ lost.filter.T_map_lidar
            off_m, off_deg = float(np.linalg.norm(error[:3, 3])), float(np.degrees(se3.angle_rad(error)))
            return Found(flown_m, off_m > WRONG_M or off_deg > WRONG_DEG)
    return Found(float("inf"), False)


def global_starts(
    flown: Flown, truth: F64, database: IntersectionDatabase, config: Config, *, every: int, least_m: float
) -> list[Found]:
    """One `Found` a start."""
    keyframes, edges = list(flown.keyframes), list(flown.edges)
    left = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)[::-1].cumsum()[::-1]
    starts = [k for k in range(0, len(keyframes) - 1, every) if left[k] >= least_m]
    return [found_from(k, keyframes, edges, truth, Recognizer(config, database), database, config) for k in starts]


def row(case: str, found: list[Found]) -> str:
    """One line of the table; who was never found counts as infinitely far."""
    flown = np.array([one.flown_m for one in found])
    told = [f"{v:.0f}" if np.isfinite(v) else "never" for v in np.quantile(flown, [0.5, 0.9, 1.0], method="higher")]
    cells = [case, str(len(found)), str(int(np.isfinite(flown).sum())), str(sum(one.wrong for one in found)), *told]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--database", type=Path, required=True)
    parser.add_argument("--case", help="how the row is called; else the name of the flight")
    parser.add_argument("--every", type=int, default=25, help="keyframes from start to start")
    parser.add_argument("--least-m", type=float, default=300.0)
    parser.add_argument("--out", type=Path, help="file to add the table to")
    chosen = parser.parse_args()
    config = Config()
    flown, truth, database = flown_with_truth(chosen.flight, chosen.database, config)
    found = global_starts(flown, truth, database, config, every=chosen.every, least_m=chosen.least_m)
    head = "| " + " | ".join(COLUMNS) + " |\n| --- " + "| ---: " * (len(COLUMNS) - 1) + "|\n"
    line = row(chosen.case or chosen.flight.stem, found) + "\n"
    print(head + line, end="")
    if chosen.out is not None:
        before = chosen.out.read_text() if chosen.out.exists() else head
        chosen.out.write_text(before + line)


if __name__ == "__main__":
    main()
