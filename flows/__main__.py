"""The process in which a survey's flow runs, started by `mineloc run`: `python -m flows SURVEY.toml --out FOLDER`."""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import signal
import sys
import threading
import traceback
from pathlib import Path

from flows.api import Api
from mineloc.errors import MinelocError, SurveyError
from mineloc.survey.flow_process import error_to_line


def main() -> int:
    """Run the flow of a survey; the error of one that failed goes to the events, its story to stderr."""
    parser = argparse.ArgumentParser(prog="flows")
    parser.add_argument("survey", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--server")
    parser.add_argument("--runner", default="process")
    parser.add_argument("--address")
    parser.add_argument("--events", type=int, help="file descriptor that takes events as lines of JSON")
    given = parser.parse_args()
    if given.events is not None:
        threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        _run(given)
    except MinelocError as error:
        return _fail(given.events, error)
    except KeyboardInterrupt:
        return 130
    except Exception as error:  # noqa: BLE001  # the user gets one line, the log the rest
        todo = f"the whole story is in {given.out / '.mineloc/logs/flow.log'}"
        return _fail(given.events, SurveyError("flow", f"the program failed ({error!r})", todo=todo))
    return 0


def _run(given: argparse.Namespace) -> None:
    with Api.named(given.server, given.out / ".mineloc" / "prefect").running() as wait:
        importlib.import_module("flows.survey")  # takes seconds, as the server does: both at once
        wait()
        _flow(given)


def _flow(given: argparse.Namespace) -> None:
    from flows.survey import survey

    try:
        survey(
            str(given.survey),
            out=str(given.out),
            overrides=given.overrides,
            events=given.events,
            runner=given.runner,
            address=given.address,
        )
    finally:
        logging.shutdown()  # sends what was logged while the server is there


def _fail(events: int | None, error: MinelocError) -> int:
    traceback.print_exc()
    os.write(2 if events is None else events, error_to_line(error).encode())
    return 1


def _end_with_parent() -> None:
    """The parent holds the other end of stdin; when it is gone, so is the reason for this process group to be."""
    os.read(0, 1)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
