"""Kill -9 at any moment of a survey: what was recorded stays and is not made again, and the next run completes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from small_survey import STEPS, fingerprint, run_here, store_of, write_sources

from mineloc.config import Config
from mineloc.stages.stage import Job
from mineloc.store.store import Store

# Processes that have the libraries loaded and have computed nothing: children of those that did may hang.
PRELOADED = ["mineloc.survey.local", "mineloc.stages.ingest", "mineloc.survey.score"]


class Running(Protocol):
    """A run of a survey, in a process of its own."""

    def wait(self, seconds: float | None) -> int | None:
        """Its exit code, None if it is still at it."""
        ...

    def kill(self) -> None:
        """-9, and wait until it is dead."""
        ...


@dataclass
class Round:
    """A survey from nothing to its end, however often it is killed on the way.

    Attributes:
        out: its folder, with the store in it.
        start: runs it, once more.
    """

    out: Path
    start: Callable[[], Running]
    kills: int = 0
    seen: dict[str, tuple[int, int]] = field(default_factory=dict)

    @property
    def store(self) -> Store:
        return store_of(self.out)

    def check(self) -> None:
        """Nothing dangles, nothing is wrong, and no record that was there is gone or was written again."""
        if not (self.out / ".mineloc" / "store").exists():
            return
        assert self.store.verify().is_sound
        records = {p.name: (p.stat().st_ino, p.stat().st_mtime_ns) for p in self.store.records.paths()}
        assert {name: records.get(name) for name in self.seen} == self.seen
        self.seen = records

    def survive(self, kills: int, moments_s: Callable[[], float]) -> int:
        """Kill until it ends by itself, or as often as given, and let it end then; how often it was killed."""
        while True:
            running = self.start()
            code = running.wait(None if self.kills == kills else moments_s())
            if code is not None:
                assert code == 0
                self.check()
                assert list((self.store.root / "tmp").iterdir()) == []
                return self.kills
            running.kill()
            self.kills += 1
            self.check()


def survive_all(rounds: Iterator[Round], kills: int, longest_s: float, *, seed: int) -> list[Round]:
    """Rounds, one after the other, until there were so many kills."""
    rng = np.random.default_rng(seed)
    done: list[Round] = []
    while sum(one.kills for one in done) < kills:
        one = next(rounds)
        one.survive(kills - sum(one.kills for one in done), lambda: float(rng.uniform(0.0, longest_s)))
        done.append(one)
    return done


def _run_noting(sources: Path, out: Path) -> None:
    started = out.with_suffix(".started")

    def note(job: Job) -> None:
        with started.open("a") as notes:
            notes.write(f"{job.stage.name}\n")

    run_here(sources, out, note)


class Forked:
    """A process that begins with everything loaded."""

    def __init__(self, sources: Path, out: Path) -> None:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(PRELOADED)
        self._process = context.Process(target=_run_noting, args=(sources, out))
        self._process.start()

    def wait(self, seconds: float | None) -> int | None:
        self._process.join(seconds)
        return self._process.exitcode

    def kill(self) -> None:
        self._process.kill()
        self._process.join()


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sources(tmp_path_factory.mktemp("sources"))


@pytest.mark.parametrize("kills", [60, pytest.param(500, marks=pytest.mark.slow)])
def test_stages_killed_at_any_moment(sources: Path, tmp_path: Path, kills: int) -> None:
    whole = Forked(sources, tmp_path / "undisturbed")
    assert whole.wait(None) == 0
    begun = time.monotonic()
    assert Forked(sources, tmp_path / "measured").wait(None) == 0
    stage_s = (time.monotonic() - begun) / STEPS

    def rounds() -> Iterator[Round]:
        for k in range(kills):
            out = tmp_path / f"round{k}"
            yield Round(out, lambda out=out: Forked(sources, out))

    for one in survive_all(rounds(), kills, 4.0 * stage_s, seed=11):
        assert fingerprint(one.out) == fingerprint(tmp_path / "undisturbed")
        started = one.out.with_suffix(".started").read_text().count("\n")
        assert started <= STEPS + one.kills, "of each kill one stage at most is repeated"


SURVEY = """
workers = 2
methods = ["odometry"]
[[flight]]
name = "north"
recording = "north.mcap"
[[flight]]
name = "south"
recording = "south.mcap"
"""


KILLS = int(os.environ.get("MINELOC_KILLS", "60"))
"""Ten seconds each, most of them the start of processes and of their libraries."""


class Commanded:
    """`mineloc run`, of which the command alone or everything that it started is killed, in turn."""

    turn = 0

    def __init__(self, folder: Path, out: Path) -> None:
        command = [sys.executable, "-P", "-m", "mineloc.cli", "run", "survey.toml", "--local", "--out", str(out)]
        with (folder / "log").open("ab") as log:
            self._process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, start_new_session=True)

    def wait(self, seconds: float | None) -> int | None:
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def kill(self) -> None:
        Commanded.turn += 1
        if Commanded.turn % 2:
            os.kill(self._process.pid, signal.SIGKILL)
        else:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


@pytest.mark.slow
def test_a_survey_killed_at_any_moment(tmp_path: Path) -> None:
    from mineloc.stages.simulate import simulate

    for seed, name in enumerate(("north", "south")):
        config = Config()
        short = config.simulate.model_copy(update={"length_m": 8.0, "hover_s": 1.0, "seed": seed})
        simulate("straight", out=tmp_path / f"{name}.mcap", config=config.model_copy(update={"simulate": short}))
    (tmp_path / "survey.toml").write_text(SURVEY)
    assert Commanded(tmp_path, tmp_path / "undisturbed").wait(None) == 0
    begun = time.monotonic()
    assert Commanded(tmp_path, tmp_path / "measured").wait(None) == 0
    whole_s = time.monotonic() - begun

    def rounds() -> Iterator[Round]:
        for k in range(KILLS):
            out = tmp_path / f"round{k}"
            yield Round(out, lambda out=out: Commanded(tmp_path, out))

    done = survive_all(rounds(), KILLS, whole_s, seed=13)
    assert len(done) > KILLS // 10, "killed too early to say anything"
    for one in done:
        assert fingerprint(one.out) == fingerprint(tmp_path / "undisturbed")
