"""A few worker processes that are leased for one job at a time."""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, cast

from mineloc.errors import MinelocError, SurveyError
from mineloc.progress import Progress, quiet
from mineloc.stages.stage import Job
from mineloc.store.store import Outcome
from mineloc.survey.messages import Crashed, Progressed, Reply, Request, Waiting

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
STOP_S = 3.0


class StoppedError(SurveyError):
    """The pool was closed, on purpose; nobody needs to be told."""

    def __init__(self) -> None:
        super().__init__("survey", "stopped", todo="run again; what is done is kept")


class Pool:
    """Runs jobs in processes; `run` is called from as many threads as like, `close` from any.

    Args:
        workers: how many processes.
        log: where they write what libraries print, and what went wrong in the program.
    """

    def __init__(self, workers: int, log: Path) -> None:
        self._log = log
        self._environment = _environment(workers)
        self._free: queue.SimpleQueue[subprocess.Popen[bytes] | None] = queue.SimpleQueue()
        self._started: list[subprocess.Popen[bytes]] = []
        self._guard = threading.Lock()
        self._closed = False
        for _ in range(workers):
            self._free.put(None)

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def run(
        self, job: Job, root: Path, *, progress: Progress = quiet, waiting: Callable[[], None] | None = None
    ) -> Outcome:
        """The result of a job, with the store at `root`; waits for a free process.

        Raises:
            MinelocError: what the stage says.
            SurveyError: the process died, or the program failed.
            StoppedError: the pool was closed.
        """
        worker = self._free.get()
        try:
            if worker is None or worker.poll() is not None:
                worker = self._start()
            return self._converse(worker, Request(root, job), progress, waiting)
        finally:
            self._free.put(worker)

    def close(self) -> None:
        """End all processes, whatever they do; their temporaries are swept from the store by whoever closes."""
        with self._guard:
            self._closed = True
            started, self._started = self._started, []
        for worker in started:
            worker.terminate()
        for worker in started:
            try:
                worker.wait(STOP_S)
            except subprocess.TimeoutExpired:
                worker.kill()
                worker.wait()
            for pipe in (worker.stdin, worker.stdout):
                if pipe is not None:
                    with suppress(OSError):  # what a dead worker was to be told goes nowhere
                        pipe.close()

    def _start(self) -> subprocess.Popen[bytes]:
        with self._guard, self._log.open("ab") as log:
            if self._closed:
                raise StoppedError
            worker = subprocess.Popen(
                [sys.executable, "-P", "-m", "mineloc.survey.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=self._environment,
            )
            self._started.append(worker)
            return worker

    def _converse(
        self,
        worker: subprocess.Popen[bytes],
        request: Request,
        progress: Progress,
        waiting: Callable[[], None] | None,
    ) -> Outcome:
        stdin, stdout = cast("IO[bytes]", worker.stdin), cast("IO[bytes]", worker.stdout)
        name = request.job.stage.name
        try:
            pickle.dump(request, stdin)
            stdin.flush()
            while True:
                reply: Reply = pickle.load(stdout)
                match reply:
                    case Outcome():
                        return reply
                    case Progressed(done, total, unit):
                        progress(done, total, unit)
                    case Waiting():
                        if waiting is not None:
                            waiting()
                    case MinelocError():
                        raise reply
                    case Crashed(what):
                        raise SurveyError(
                            name, f"the program failed ({what})", todo=f"the whole story is in {self._log}"
                        )
        except (EOFError, BrokenPipeError, pickle.UnpicklingError, ValueError):
            if self._closed:
                raise StoppedError from None
            code = worker.wait()
            raise SurveyError(
                name, f"its process died ({_cause(code)})", todo=f"free memory or use fewer workers; see {self._log}"
            ) from None


def _cause(code: int) -> str:
    return f"signal {-code}, perhaps out of memory" if code < 0 else f"exit code {code}"


def _environment(workers: int) -> Mapping[str, str]:
    """The environment of a worker: each gets its share of the cores, unless the user said otherwise."""
    share = str(max(1, len(os.sched_getaffinity(0)) // workers))
    return {**dict.fromkeys(THREAD_VARIABLES, share), **os.environ}
