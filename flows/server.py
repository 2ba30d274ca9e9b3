"""A Prefect server of our own, which ends with whoever started it."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from flows.settings import START_S, answers
from mineloc.errors import SurveyError

STOP_S = 5.0
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True, slots=True)
class Starting:
    """A server that was just started."""

    address: str
    process: subprocess.Popen[bytes]

    def wait(self) -> None:
        """Until it answers.

        Raises:
            SurveyError: it ended, or it takes too long.
        """
        deadline = time.monotonic() + START_S
        while not answers(self.address):
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise SurveyError("prefect server", "did not start", todo="see server.log, or run with --local")
            time.sleep(0.1)


def free_address() -> str:
    """Of an API on a free port of this machine alone."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{free.getsockname()[1]}/api"


@contextmanager
def own_server(home: Path, address: str) -> Generator[Starting]:
    """A server at a free address, with its history in `home`; ends with the block."""
    home.mkdir(parents=True, exist_ok=True)
    where = urlsplit(address)
    with (home / "server.log").open("wb") as log:
        process = subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "prefect",
                "server",
                "start",
                "--host",
                "127.0.0.1",
                "--port",
                f"{where.port}",
            ],
            env=os.environ | {"PREFECT_API_URL": address, "PREFECT_UI_API_URL": address},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            preexec_fn=end_with_parent,
        )
    try:
        yield Starting(address, process)
    finally:
        process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def end_with_parent() -> None:
    """In a new process: when its parent is killed, so is it (Linux); a second server on one history would lock it."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
