"""The process in which stages run: `python -m mineloc.survey.worker`, jobs on stdin, what happens on stdout.

A process of its own, because some libraries hold the interpreter lock for seconds, and because one that is killed
(out of memory) then takes one stage with it and not the survey. When the other end of stdin goes, so does the worker:
an orphan is impossible. What libraries print goes to stderr, which is the survey's log.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import sys
import threading
import time
import traceback
from typing import BinaryIO

from mineloc.errors import MinelocError
from mineloc.store.store import Store
from mineloc.survey.messages import Crashed, Progressed, Reply, Request, Waiting

PROGRESS_EVERY_S = 0.1


def main() -> None:
    """Serve jobs until stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C means
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    requests: queue.SimpleQueue[Request] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(sys.stdin.buffer, requests), daemon=True).start()
    while True:
        request = requests.get()
        _send(replies, _answer(request, replies))


def _read(stdin: BinaryIO, requests: queue.SimpleQueue[Request]) -> None:
    while True:
        try:
            requests.put(pickle.load(stdin))
        except EOFError:
            os._exit(0)


def _answer(request: Request, replies: BinaryIO) -> Reply:
    last = 0.0

    def progress(done: float, total: float | None, unit: str) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= PROGRESS_EVERY_S or done == total:
            last = now
            _send(replies, Progressed(done, total, unit))

    try:
        store = Store(request.root)
        return request.job.run(store, progress=progress, waiting=lambda: _send(replies, Waiting()))
    except MinelocError as error:
        return error
    except Exception as error:  # noqa: BLE001  # whatever it is, the parent must hear of it and the worker lives on
        traceback.print_exc()
        return Crashed(f"{type(error).__name__}: {error}")


def _send(replies: BinaryIO, reply: Reply) -> None:
    pickle.dump(reply, replies)
    replies.flush()


if __name__ == "__main__":
    main()
