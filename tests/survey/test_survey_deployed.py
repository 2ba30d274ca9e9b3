"""The files with which a service is set up: they name what exists, and a work pool really runs the survey."""

from __future__ import annotations

import inspect
import os
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
SERVICE = ROOT / "docs" / "service"


def deployments() -> list[dict[str, Any]]:
    return yaml.safe_load((SERVICE / "prefect.yaml").read_text())["deployments"]


def test_deployments_name_flows_and_parameters_that_exist() -> None:
    from prefect.schedules import Cron

    from flows.survey import survey

    for one in deployments():
        file, _, flow = one["entrypoint"].partition(":")
        assert (ROOT / file).exists()
        assert flow == "survey"
        assert set(one["parameters"]) <= set(inspect.signature(survey.fn).parameters)
        for schedule in one["schedules"]:
            Cron(schedule["cron"], timezone=schedule["timezone"])


def commands() -> Iterator[list[str]]:
    for unit in SERVICE.glob("*.service"):
        (line,) = (line for line in unit.read_text().splitlines() if line.startswith("ExecStart="))
        yield line.removeprefix("ExecStart=").split()
    for service in yaml.safe_load((SERVICE / "compose.yaml").read_text())["services"].values():
        yield service.get("entrypoint", ["mineloc"]) + service.get("command", [])


@pytest.mark.parametrize("command", list(commands()), ids=lambda words: " ".join(Path(w).name for w in words[:3]))
def test_services_call_commands_that_exist_with_options_that_they_have(command: list[str]) -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    program = Path(command[0]).name
    assert program in {*scripts, "prefect"}
    if program == "prefect":
        return
    words = [sys.executable, "-m", "mineloc.cli", command[1], "--help"]
    told = subprocess.run(words, capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "200"})
    for word in command:
        if word.startswith("--"):
            assert word in told.stdout


SURVEY = """
methods = ["odometry"]
[config.simulate]
hover_s = 1.0
length_m = 8.0
[[flight]]
name = "north"
mine = "straight"
"""


@contextmanager
def running(log: Path, *words: str, cwd: Path, **environment: str) -> Iterator[None]:
    with log.open("ab") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", "prefect", *words],
            cwd=cwd,
            stdout=sink,
            stderr=sink,
            env=os.environ | environment,
            start_new_session=True,
        )
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.slow
@pytest.mark.prefect
def test_a_work_pool_runs_the_survey(tmp_path: Path) -> None:
    from flows.settings import answers

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (tmp_path / "survey.toml").write_text(SURVEY)
    environment = {
        "PREFECT_HOME": str(tmp_path / "home"),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "DO_NOT_TRACK": "1",
        "MINELOC_HOME": str(ROOT),
        "MINELOC_SURVEY": str(tmp_path / "survey.toml"),
        "MINELOC_OUT": str(tmp_path / "results"),
    }

    def prefect(*words: str) -> str:
        command = [sys.executable, "-m", "prefect", "--no-prompt", *words]
        ran = subprocess.run(command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return ran.stdout

    log = tmp_path / "log"
    with running(log, "server", "start", "--port", str(port), cwd=tmp_path, **environment):
        deadline = time.monotonic() + 120
        while not answers(environment["PREFECT_API_URL"]):
            assert time.monotonic() < deadline
            time.sleep(0.5)
        prefect("work-pool", "create", "mine", "--type", "process")
        prefect("deploy", "--all", "--prefect-file", str(SERVICE / "prefect.yaml"))
        with running(log, "worker", "start", "--pool", "mine", cwd=tmp_path, **environment):
            prefect("deployment", "run", "survey/nightly")
            report = tmp_path / "results" / "report" / "report.html"
            deadline = time.monotonic() + 240
            while not report.exists():
                assert time.monotonic() < deadline, log.read_text()
                time.sleep(0.5)
