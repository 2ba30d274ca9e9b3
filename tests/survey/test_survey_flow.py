"""The real command with a real Prefect server: names, artifacts, failures without noise, Ctrl-C without orphans."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.prefect

SHORT = """
workers = 2
[config.simulate]
hover_s = 1.0
length_m = 6.0
[[flight]]
name = "Loop_1"
mine = "loop"
[[flight]]
name = "broken"
recording = "broken.mcap"
"""
LONG = SHORT.replace("6.0", "60000.0")


def mineloc(*args: str) -> list[str]:
    return [sys.executable, "-P", "-m", "mineloc.cli", *args]


def processes_of(folder: Path) -> list[str]:
    """Command lines and environments that name a folder: everything that a run started knows its own."""
    found: list[str] = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            said = (process / "cmdline").read_bytes() + (process / "environ").read_bytes()
        except OSError:
            continue
        if str(folder).encode() in said and int(process.name) != os.getpid():
            found.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode())
    return found


def told(out: Path, query: str) -> set[tuple[str, ...]]:
    with sqlite3.connect(out / ".mineloc" / "prefect" / "prefect.db") as history:
        return set(history.execute(query).fetchall())


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "broken.mcap").write_bytes(b"this is no recording")
    return tmp_path


def test_a_flow_does_what_it_can_tells_what_it_cannot_and_shares_its_results_with_local(folder):
    (folder / "s.toml").write_text(SHORT)
    out = folder / "out"
    ran = subprocess.run(
        mineloc("run", str(folder / "s.toml"), "--out", str(out)), capture_output=True, text=True, check=False
    )
    assert ran.returncode == 1
    # one line about what failed, nothing else
    assert ran.stderr.startswith(f"mineloc: {folder / 'broken.mcap'}: ")
    assert ran.stderr.count("\n") == 1
    assert "Traceback" not in ran.stdout
    assert (out / "runs" / "Loop_1-odometry" / "trajectory.tum").exists()
    assert (out / "runs" / "Loop_1-odometry" / "run.rrd").exists()
    assert not (out / "report").exists(), "a report without one of its flights would look whole"
    names = told(out, "select name, state_name from task_run")
    assert {
        ("Loop_1 simulate [miss]", "Completed"),
        ("Loop_1 localize odometry [miss]", "Completed"),
        ("Loop_1 qa", "Completed"),
        ("broken ingest [miss]", "Failed"),
    } <= names
    assert told(out, "select key, type from artifact where key is not null") == {("qa-loop-1", "table")}
    assert told(out, "select state_name from flow_run") == {("Failed",)}
    assert processes_of(out) == []

    again = subprocess.run(
        mineloc("run", str(folder / "s.toml"), "--out", str(out), "--local"),
        capture_output=True,
        text=True,
        check=False,
        # without Prefect means without it: its import would fail here
        env=os.environ | {"PYTHONPATH": str(_without_prefect(folder))},
    )
    assert (again.returncode, again.stderr) == (1, ran.stderr)
    assert again.stdout.count(" known") == 5, "what the flow did is known without it"


def _without_prefect(folder: Path) -> Path:
    (folder / "path").mkdir()
    (folder / "path" / "prefect.py").write_text("raise ImportError('prefect was imported')\n")
    return folder / "path"


def test_ctrl_c_ends_flow_server_and_workers_and_leaves_nothing_half_done(folder):
    (folder / "s.toml").write_text(LONG)
    out = folder / "out"
    running = subprocess.Popen(
        mineloc("run", str(folder / "s.toml"), "--out", str(out)),
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    temporary = out / ".mineloc" / "store" / "tmp"
    deadline = time.monotonic() + 120
    while not (temporary.exists() and list(temporary.glob("*/out"))):
        assert running.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    running.send_signal(signal.SIGINT)
    _, said = running.communicate(timeout=30)
    assert (running.returncode, said.count("\n")) == (1, 1)
    assert "interrupted" in said
    assert list(temporary.iterdir()) == []
    assert processes_of(out) == []
