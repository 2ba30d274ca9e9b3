"""A survey as a Prefect flow, in a process of its own: `python -m flows`, which this side only starts and hears.

The process leads a process group, with its server and its workers in it, and watches its stdin: when this side goes,
so does all of it. Events come over a pipe; everything else that it says goes to a log.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mineloc import errors
from mineloc.errors import MinelocError, SurveyError
from mineloc.output import one_line_errors
from mineloc.survey.events import Event, Listener
from mineloc.survey.plan import Plan
from mineloc.survey.runner import Runner

STOP_S = 15.0


def run_flow(
    survey: Path,
    plan: Plan,
    listener: Listener,
    runner: Runner,
    *,
    overrides: Sequence[str] = (),
    server: str | None = None,
) -> None:
    """Run a survey's flow.

    Args:
        survey: the survey file; `plan` is its plan.
        runner: which workers.
        overrides: `section.key=value`.
        server: address of a running Prefect server; None starts one for this run alone.

    Raises:
        MinelocError: what the flow says; of the first step that failed.
        SurveyError: no server, or the program failed.
    """
    log = plan.state / "logs" / "flow.log"
    with one_line_errors(log):
        log.parent.mkdir(parents=True, exist_ok=True)
        listening, telling = os.pipe()
        command = [sys.executable, "-P", "-m", "flows", str(survey.absolute()), "--out", str(plan.out.absolute())]
        command += [*runner.words(), *(f"--set={text}" for text in overrides)]
        command += [f"--events={telling}", *([f"--server={server}"] if server else [])]
        with log.open("wb") as sink:
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=sink,
                stderr=sink,
                pass_fds=[telling],
                start_new_session=True,
            )
        os.close(telling)
    try:
        with os.fdopen(listening) as lines:
            failure = _listen(lines, listener)
        _wait(process)
    except BaseException:
        _interrupt(process)
        raise
    finally:
        _end_group(process)
    if failure is not None:
        raise failure
    if process.returncode:
        raise SurveyError("flow", f"ended with exit code {process.returncode}", todo=f"the whole story is in {log}")


def _listen(lines: Any, listener: Listener) -> MinelocError | None:
    failure: MinelocError | None = None
    for line in lines:
        raw = json.loads(line)
        if "error" in raw:
            failure = _error(raw)
        else:
            listener(Event.from_line(line))
    return failure


def error_to_line(error: MinelocError) -> str:
    """An error as one line of JSON."""
    fields = {"where": error.where, "found": error.found, "expected": error.expected, "todo": error.todo}
    return json.dumps({"error": type(error).__name__, **fields}) + "\n"


def _error(raw: dict[str, str]) -> MinelocError:
    kind = getattr(errors, raw["error"], MinelocError)
    return kind(raw["where"], raw["found"], expected=raw["expected"], todo=raw["todo"])


def _wait(process: subprocess.Popen[bytes], timeout_s: float = math.inf) -> None:
    """Wait for the end, but leave the dead process in the table: its group keeps its number as long as it is there."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None:
            return
        time.sleep(0.02)


def _interrupt(process: subprocess.Popen[bytes]) -> None:
    """Ask as Ctrl-C does, so that the flow counts as cancelled and the server ends in order; a second one hurries."""
    os.kill(process.pid, signal.SIGINT)
    with suppress(KeyboardInterrupt):
        _wait(process, STOP_S)


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """Whatever is left of the process group goes now."""
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdin is not None:
        process.stdin.close()
