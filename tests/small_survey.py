"""A small survey of real stages that need no LiDAR, run in one process, and what a survey leaves."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Self, cast

from recording_files import IMU, POSE, START_NS, STEP_NS, imu, pose, write_mcap
from synthetic_run import SyntheticRun, write_synthetic_run

from mineloc.config import Config
from mineloc.progress import Progress, quiet
from mineloc.stages.stage import Job
from mineloc.store.store import Outcome, Store
from mineloc.survey.local import run_local
from mineloc.survey.plan import METRICS, Made, Plan, Step
from mineloc.survey.registry import EVALUATE, INGEST
from mineloc.survey.runner import Runner

FLIGHTS = 4
STEPS = 3 * FLIGHTS
# what takes how long differs, the report tells it, and equal Rerun recordings differ in their ids
TIMED = ("timing.json", "run.rrd", "report.html", "report.json")


def write_sources(folder: Path) -> Path:
    """Recordings and runs for `plan`."""
    for k in range(FLIGHTS):
        stamps = [START_NS + i * STEP_NS for i in range(300 + k)]
        entries = [("/imu", IMU, stamp, imu(stamp)) for stamp in stamps]
        entries += [("/pose", POSE, stamp, pose(stamp)) for stamp in stamps]
        write_mcap(folder / f"flight{k}.mcap", entries)
        write_synthetic_run(folder / f"flight{k}", SyntheticRun(poses=100 + k))
    return folder


def plan(sources: Path, out: Path) -> Plan:
    """Each flight is ingested, what came of it is ingested again, and a run of it is scored."""
    steps: list[Step] = []
    for k in range(FLIGHTS):
        name = f"flight{k}"
        first = {"recording": sources / f"{name}.mcap"}
        steps.append(Step(f"{name} ingest", name, INGEST, f"{name}.mcap", first, Config()))
        again = {"recording": Made(f"{name} ingest")}
        steps.append(Step(f"{name} ingest again", name, INGEST, f"{name}.again.mcap", again, Config()))
        run = {"run": sources / name}
        steps.append(Step(f"{name} evaluate", name, EVALUATE, f"runs/{name}/{METRICS}", run, Config()))
    return Plan(out, 1, tuple(steps), ())


class Here:
    """Runs stages in the process itself, which dies with them.

    Args:
        before: called with each job before it runs.
    """

    def __init__(self, before: Callable[[Job], None]) -> None:
        self._before = before

    def at_once(self, _: int) -> int:
        return 1

    def workers(self, _: int, __: Path) -> Self:
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(
        self, job: Job, root: Path, *, progress: Progress = quiet, waiting: Callable[[], None] | None = None
    ) -> Outcome:
        self._before(job)
        return job.run(Store(root), progress=progress, waiting=waiting)


def run_here(sources: Path, out: Path, before: Callable[[Job], None] = lambda _: None) -> dict[str, Outcome]:
    """The small survey; outcomes by step."""
    return run_local(plan(sources, out), lambda _: None, cast("Runner", Here(before)))


def store_of(out: Path) -> Store:
    """In a survey's folder."""
    return Store(out / ".mineloc" / "store")


def fingerprint(out: Path) -> dict[str, str]:
    """Hashes of a survey's results by their names below its folder, as far as nothing but the survey decides them."""
    found: dict[str, str] = {}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if not path.is_file() or name.startswith(".mineloc") or path.name in TIMED:
            continue
        found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found
