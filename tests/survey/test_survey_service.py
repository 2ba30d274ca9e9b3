"""A service that watches an inbox: what lands becomes a version of the survey's dataset, and a reason to run."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from recording_files import IMU, START_NS, STEP_NS, imu, write_mcap

from mineloc.errors import ConfigError, OutputError
from mineloc.store.datasets import Datasets
from mineloc.survey.inbox import Inbox
from mineloc.survey.service import Service

SURVEY = """
dataset = "level-4@latest"
store = "store"
methods = ["odometry"]
"""


def recording(path: Path, messages: int = 50) -> Path:
    stamps = [START_NS + k * STEP_NS for k in range(messages)]
    return write_mcap(path, [("/imu", IMU, stamp, imu(stamp)) for stamp in stamps])


class Watched:
    """A survey, its inbox and a clock that is set by hand."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.now_s = folder, 0.0
        (folder / "inbox").mkdir(exist_ok=True)
        (folder / "survey.toml").write_text(SURVEY)
        self.service = self.started()

    def started(self) -> Service:
        inbox = Inbox(self.folder / "inbox", settle_s=10.0)
        return Service(self.folder / "survey.toml", inbox, clock=lambda: self.now_s)

    def later(self, seconds: float) -> bool:
        self.now_s += seconds
        return self.service.is_due()

    @property
    def flights(self) -> list[str]:
        return list(Datasets.open(self.folder / "store").get("level-4").flights())


@pytest.fixture
def watched(tmp_path: Path) -> Watched:
    return Watched(tmp_path)


def test_what_lands_is_added_and_run_once(watched: Watched) -> None:
    assert not watched.later(0.0), "there is nothing to run yet"
    recording(watched.folder / "inbox" / "north.mcap")
    assert not watched.later(1.0)
    assert watched.later(11.0)
    assert watched.flights == ["north"]
    assert not watched.later(100.0)
    recording(watched.folder / "inbox" / "south.mcap", 60)
    recording(watched.folder / "inbox" / "west.mcap", 70)
    assert not watched.later(1.0)
    assert watched.later(11.0)
    assert watched.flights == ["north", "south", "west"]


def test_a_service_that_was_killed_goes_on_where_it_was(watched: Watched) -> None:
    recording(watched.folder / "inbox" / "north.mcap")
    watched.later(0.0)
    watched.later(11.0)
    versions = len(list(Datasets.open(watched.folder / "store").versions("level-4")))
    watched.service = watched.started()
    assert watched.later(0.0), "the run may have been interrupted"
    assert not watched.later(11.0), "what lies in the inbox is known"
    assert len(list(Datasets.open(watched.folder / "store").versions("level-4"))) == versions


def test_other_content_under_a_known_name_is_told_and_holds_up_nobody(
    watched: Watched, caplog: pytest.LogCaptureFixture
) -> None:
    recording(watched.folder / "inbox" / "north.mcap")
    watched.later(0.0)
    watched.later(11.0)
    recording(watched.folder / "inbox" / "north.mcap", 80)
    recording(watched.folder / "inbox" / "south.mcap", 90)
    with caplog.at_level(logging.INFO, "mineloc.serve"):
        watched.later(1.0)
        assert watched.later(11.0)
    assert watched.flights == ["north", "south"]
    assert "other content" in caplog.text


def test_a_disk_that_is_full_for_a_while_loses_no_recording(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    recording(watched.folder / "inbox" / "north.mcap")
    watched.later(0.0)

    def full(*_: object, **__: object) -> None:
        raise OutputError(watched.folder, "the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(Datasets, "add", full)
        with pytest.raises(OutputError):
            watched.later(11.0)
    assert watched.later(1.0)
    assert watched.flights == ["north"]


@pytest.mark.parametrize("dataset", ["", 'dataset = "level-4@2026-10"'])
def test_what_lands_needs_a_dataset_that_grows(tmp_path: Path, dataset: str) -> None:
    (tmp_path / "survey.toml").write_text(f'{dataset}\n[[flight]]\nname = "a"\nmine = "demo"\n')
    with pytest.raises(ConfigError, match="latest"):
        Service(tmp_path / "survey.toml", Inbox(tmp_path))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--cron", "every night"], "five fields"),
        (["--cron", "99 99 * * *"], "five fields"),
        (["--cron", "0 2 * * *", "--timezone", "Atlantis/Mine"], "--timezone"),
        (["--watch", "nowhere"], "no such folder"),
        (["--cron", "0 2 * * *", "--runner", "ray"], "process or dask"),
    ],
)
def test_wrong_words_are_told_before_anything_starts(tmp_path: Path, options: list[str], said: str) -> None:
    (tmp_path / "survey.toml").write_text('[[flight]]\nname = "a"\nmine = "demo"\n')
    command = [sys.executable, "-m", "mineloc.cli", "serve", "survey.toml", *options]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["survey.toml"]


FLOWN = """
dataset = "level-4@latest"
store = "store"
methods = ["odometry"]
out = "results"
workers = 1
"""


def until(what, *, seconds: float = 300.0) -> None:
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.5)


def served(folder: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "mineloc.cli", "serve", "survey.toml", *options]
    with (folder / "log").open("ab") as log:
        return subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, start_new_session=True)


@pytest.mark.slow
@pytest.mark.prefect
def test_a_schedule_fires_and_recordings_that_land_are_processed(tmp_path: Path) -> None:
    from mineloc.config import Config
    from mineloc.stages.simulate import simulate

    (tmp_path / "survey.toml").write_text(FLOWN)
    (tmp_path / "inbox").mkdir()
    for seed, name in enumerate(("north", "south")):
        config = Config()
        short = config.simulate.model_copy(update={"length_m": 12.0, "seed": seed})
        simulate("straight", out=tmp_path / f"{name}.mcap", config=config.model_copy(update={"simulate": short}))
    report = tmp_path / "results" / "report" / "report.html"
    runs = tmp_path / "results" / "runs"
    log = tmp_path / "log"
    process = served(tmp_path, "--watch", "inbox", "--cron", "* * * * *", "--every-s", "0.5", "--settle-s", "1")
    try:
        (tmp_path / "north.mcap").rename(tmp_path / "inbox" / "north.mcap")
        until(report.exists)
        assert [path.name for path in runs.iterdir()] == ["north-odometry"]
        # killed without a word; what lands meanwhile is found by the next
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        (tmp_path / "south.mcap").rename(tmp_path / "inbox" / "south.mcap")
        process = served(tmp_path, "--watch", "inbox", "--cron", "* * * * *", "--every-s", "0.5", "--settle-s", "1")
        until(lambda: (runs / "south-odometry" / "metrics.json").exists())
        # by the schedule alone: nothing lands, and what was deleted comes back
        until(lambda: "finished in state Completed" in log.read_text() or log.read_text().count("Completed") > 0)
        report.unlink()
        until(report.exists, seconds=150.0)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
