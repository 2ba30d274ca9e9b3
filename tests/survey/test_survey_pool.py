"""Stages in processes of their own: what comes back, and what is left when one dies."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from synthetic_run import SyntheticRun, write_synthetic_run

from mineloc.errors import EvaluationError, FormatError, SurveyError
from mineloc.stages.stage import Input, Job, Stage
from mineloc.store.store import Store
from mineloc.store.workspace import Workspaces
from mineloc.survey.pool import THREAD_VARIABLES, Pool, StoppedError
from mineloc.survey.registry import EVALUATE


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("survey") / "run"
    return write_synthetic_run(folder, SyntheticRun(poses=200))


@pytest.fixture(scope="module")
def pool(tmp_path_factory):
    with Pool(1, tmp_path_factory.mktemp("pool") / "stages.log") as pool:
        yield pool


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def source(store: Store, path: Path) -> Input:
    return Input(path, store.source(path), is_source=True)


def evaluate(store: Store, run: Path) -> Job:
    return Job(EVALUATE, "metrics.json", {"run": source(store, run)})


def worker(pool: Pool) -> int:
    return pool._started[-1].pid  # pyright: ignore[reportPrivateUsage]


def test_a_stage_runs_elsewhere_and_its_result_is_in_the_store(pool, store, run, tmp_path):
    outcome = pool.run(evaluate(store, run), store.root)
    assert not outcome.hit
    assert evaluate(store, run).lookup(store).output == outcome.output
    store.place(outcome.output, tmp_path / "metrics.json")
    text = (tmp_path / "metrics.json").read_text()
    assert '"smoothed"' in text
    assert str(run.parent) not in text, "where the run lies is no part of the result"
    assert worker(pool) != os.getpid()


def test_what_a_stage_says_arrives_as_it_was_said(pool, store, tmp_path):
    (tmp_path / "not-a-run").mkdir()
    (tmp_path / "not-a-run" / "x").write_text("")
    with pytest.raises((FormatError, EvaluationError)) as error:
        pool.run(evaluate(store, tmp_path / "not-a-run"), store.root)
    assert "not-a-run" in error.value.where


def test_an_error_about_an_input_from_the_store_names_it_as_the_user_knows_it(pool, store, tmp_path):
    (tmp_path / "reference.tum").write_text("1 2 3\n")
    ref = store.add(tmp_path / "reference.tum")
    run = write_synthetic_run(tmp_path / "r", SyntheticRun(poses=20))
    known = Path("survey/references/north.tum")
    job = Job(EVALUATE, "m.json", {"run": source(store, run), "reference": Input(known, ref, is_source=False)})
    with pytest.raises(FormatError) as error:
        pool.run(job, store.root)
    assert str(known) in error.value.line()
    assert "store" not in error.value.line()


def test_a_fault_of_the_program_is_one_line_with_the_story_in_the_log(pool, store, run):
    wrong = Job(Stage("wrong", 1, "mineloc.se3:inverse"), "x", {"run": source(store, run)})
    with pytest.raises(SurveyError, match=r"the program failed \(TypeError: .*stages\.log") as error:
        pool.run(wrong, store.root)
    assert not pool.run(evaluate(store, run), store.root).hit, "the process lives on"
    assert "Traceback" in Path(error.value.todo.split()[-1]).read_text()


def test_a_source_that_changes_while_it_is_read_gives_no_result(pool, store, tmp_path):
    run = write_synthetic_run(tmp_path / "r", SyntheticRun(poses=50))
    job = evaluate(store, run)
    (run / "timing.json").write_text((run / "timing.json").read_text() + "\n")
    with pytest.raises(Exception, match="changed while it was read"):
        pool.run(job, store.root)
    assert job.lookup(store) is None


def test_a_process_that_is_killed_costs_its_job_and_nothing_else(tmp_path, store, run):
    job = evaluate(store, run)
    with Pool(1, tmp_path / "log") as pool:
        # its result is being made by somebody else, so the process waits, until it is killed
        with (
            Workspaces(store.root).hold(job.action().key),
            pytest.raises(SurveyError, match="signal 9, perhaps out of memory"),
        ):
            pool.run(job, store.root, waiting=lambda: os.kill(worker(pool), signal.SIGKILL))
        assert not pool.run(job, store.root).hit
    assert store.verify().is_sound


def test_closing_ends_everything_at_once(tmp_path, store, run):
    pool = Pool(1, tmp_path / "log")
    began = threading.Event()
    ended: list[BaseException] = []
    job = evaluate(store, run)

    def wait_for_ever() -> None:
        try:
            pool.run(job, store.root, waiting=began.set)
        except StoppedError as error:
            ended.append(error)

    with Workspaces(store.root).hold(job.action().key):
        threads = [threading.Thread(target=wait_for_ever) for _ in range(2)]
        for thread in threads:
            thread.start()
        assert began.wait(60)
        pid = worker(pool)
        start = time.monotonic()
        pool.close()
        for thread in threads:
            thread.join(10)
    assert len(ended) == 2, "the one at work and the one that waits for a process"
    assert time.monotonic() - start < 5
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_cores_are_shared_among_the_processes_unless_the_user_said_otherwise(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    for name in THREAD_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "5")
    given = Pool(3, tmp_path / "log")._environment  # pyright: ignore[reportPrivateUsage]
    assert [given[name] for name in THREAD_VARIABLES] == ["2", "2", "2", "5"]
