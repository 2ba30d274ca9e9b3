"""Stages on the workers of a Dask cluster that share the store: one of them killed in the middle."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from synthetic_run import SyntheticRun, write_synthetic_run

from mineloc.config import Config
from mineloc.errors import ConfigError, FormatError, SurveyError
from mineloc.stages.stage import Input, Job
from mineloc.store.store import Store
from mineloc.survey.dask_workers import DaskWorkers
from mineloc.survey.local import run_local
from mineloc.survey.plan import METRICS, Plan, Run, Step
from mineloc.survey.registry import EVALUATE
from mineloc.survey.runner import Runner

FLIGHTS = 6
QUIET = {"DASK_DISTRIBUTED__DASHBOARD__LINK": "", "DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "false"}


@contextmanager
def process(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", *words]
    running = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **QUIET, "OMP_NUM_THREADS": "1"},
    )
    try:
        yield running
    finally:
        running.kill()
        running.wait()


@contextmanager
def scheduler() -> Iterator[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    with process("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"):
        yield address


def wait_for(address: str, workers: int) -> None:
    from distributed import Client

    with Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=60)


@pytest.fixture(scope="module")
def cluster() -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and two worker processes on this machine."""
    with scheduler() as address, ExitStack() as stack:
        words = ("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        workers = [stack.enter_context(process(*words, "--host", "127.0.0.1")) for _ in range(2)]
        wait_for(address, 2)
        yield address, workers


def evaluate(store: Store, run: Path) -> Job:
    return Job(EVALUATE, "metrics.json", {"run": Input(run, store.source(run), is_source=True)})


@pytest.mark.slow
def test_what_a_stage_says_arrives_as_it_was_said(cluster, tmp_path: Path) -> None:
    address, _ = cluster
    (tmp_path / "not-a-run").mkdir()
    (tmp_path / "not-a-run" / "x").write_text("")
    store = Store(tmp_path / "store")
    with DaskWorkers(address) as workers, pytest.raises(FormatError, match="not-a-run"):
        workers.run(evaluate(store, tmp_path / "not-a-run"), store.root)


@pytest.mark.slow
def test_a_worker_without_the_store_says_so(cluster, tmp_path: Path) -> None:
    address, _ = cluster
    run = write_synthetic_run(tmp_path / "run", SyntheticRun(poses=50))
    job = evaluate(Store(tmp_path / "store"), run)
    with DaskWorkers(address) as workers, pytest.raises(Exception, match="sees no store there"):
        workers.run(job, tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.slow
def test_a_survey_completes_when_a_worker_is_killed_in_the_middle(cluster, tmp_path: Path) -> None:
    address, workers = cluster
    steps, runs = [], []
    for k in range(FLIGHTS):
        run = write_synthetic_run(tmp_path / f"flight{k}", SyntheticRun(poses=1500 + k))
        to = f"runs/flight{k}/{METRICS}"
        steps.append(Step(f"flight{k} evaluate", f"flight{k}", EVALUATE, to, {"run": run}, Config()))
        runs.append(Run(f"flight{k}", "odometry", tmp_path / "out" / "runs" / f"flight{k}"))
    plan = Plan(tmp_path / "out", 1, tuple(steps), tuple(runs))
    temp = plan.state / "store" / "tmp"
    events: list[tuple[str, str]] = []

    def kill_one_at_work() -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not any(temp.glob("*")):
            time.sleep(0.005)
        workers[0].send_signal(signal.SIGKILL)

    killer = threading.Thread(target=kill_one_at_work)
    killer.start()
    made = run_local(plan, lambda event: events.append((event.step, event.state)), Runner("dask", address))
    killer.join()
    assert workers[0].wait() == -signal.SIGKILL
    assert sorted(made) == sorted(step.name for step in steps)
    # every result was made once, lies in the store whole, and nothing is left of the one that was killed
    assert sorted(events.count((step.name, "done")) for step in steps) == [1] * FLIGHTS
    store = Store(plan.state / "store")
    assert len(store.records.paths()) == FLIGHTS
    assert store.verify().is_sound
    assert not list(temp.glob("*"))
    for run in runs:
        assert json.loads(run.metrics.read_text())["trajectories"]


@pytest.mark.slow
def test_nobody_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mineloc.survey.dask_workers.CONNECT_S", 0.5)
    with pytest.raises(SurveyError, match="no Dask scheduler answers"):
        DaskWorkers("tcp://127.0.0.1:9")
    with scheduler() as address:
        monkeypatch.setattr("mineloc.survey.dask_workers.CONNECT_S", 30.0)
        with pytest.raises(SurveyError, match="has no worker"):
            DaskWorkers(address)


def test_a_runner_is_named_in_full() -> None:
    assert Runner.named("dask", "tcp://a:1").words() == ["--runner=dask", "--address=tcp://a:1"]
    for kind, address in (("dask", None), ("process", "tcp://a:1"), ("ray", None)):
        with pytest.raises(ConfigError):
            Runner.named(kind, address)
