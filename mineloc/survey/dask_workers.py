"""Stages on several machines: the workers of a Dask cluster, which share the store and the recordings.

Dask only says where a job runs. What it does is the store's: a job whose worker was killed runs again elsewhere, two
workers that get the same job execute it once, and a result exists whole or not at all.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from uuid import uuid4

from mineloc.errors import MinelocError, StoreError, SurveyError
from mineloc.progress import Progress, quiet
from mineloc.stages.stage import Job
from mineloc.store.store import Outcome, Store
from mineloc.survey.messages import Crashed, Progressed, Waiting

CONNECT_S = 15.0
_PROGRESS_EVERY_S = 0.5


class DaskWorkers:
    """Runs jobs on a Dask cluster; `run` is called from as many threads as like.

    Args:
        address: of the scheduler.

    Raises:
        SurveyError: Dask is not installed, nobody answers at the address, or there is no worker.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise SurveyError(
                "--runner dask", "Dask is not installed", expected="the extra mineloc[dask]", todo="install it"
            ) from None
        try:
            self._client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise SurveyError(
                address, f"no Dask scheduler answers ({error})", expected="tcp://host:8786", todo="start one there"
            ) from error
        self._address = address
        if not self._client.nthreads():
            self._client.close()
            raise SurveyError(address, "the scheduler has no worker", todo="start `dask worker` on each machine")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close()

    def run(
        self, job: Job, root: Path, *, progress: Progress = quiet, waiting: Callable[[], None] | None = None
    ) -> Outcome:
        """As `Workers.run`; `root` and the recordings have these paths on every machine."""
        topic = f"mineloc-{uuid4().hex}"

        def hear(event: tuple[float, dict[str, Any]]) -> None:
            told = event[1]
            if told:
                progress(told["done"], told["total"], told["unit"])
            elif waiting is not None:
                waiting()

        self._client.subscribe_topic(topic, hear)
        try:
            future = self._client.submit(
                run_job, job, str(root.absolute()), job.action().key, topic, key=topic, pure=False
            )
            answer = future.result()
        except MinelocError:
            raise
        except Exception as error:
            raise SurveyError(
                job.stage.name,
                f"its Dask workers failed ({type(error).__name__}: {error})",
                todo=f"see the workers' output at {self._address}",
            ) from error
        finally:
            self._client.unsubscribe_topic(topic)
        if isinstance(answer, MinelocError):
            raise answer
        if isinstance(answer, Crashed):
            raise SurveyError(job.stage.name, f"the program failed ({answer.what})", todo="see the worker's output")
        return answer


def run_job(job: Job, root: str, key: str, topic: str) -> Outcome | MinelocError | Crashed:
    """On a worker: the result of a job, or what went wrong as a value.

    Args:
        root: the store, under the path that this machine must know it by.
        key: of the job's action as the survey sees it; another one here means other code.
        topic: of the events that progress is told by.
    """
    from distributed import get_worker

    worker, last = get_worker(), 0.0

    def tell(message: Progressed | Waiting) -> None:
        worker.log_event(topic, asdict(message))

    def progress(done: float, total: float | None, unit: str) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _PROGRESS_EVERY_S or done == total:
            last = now
            tell(Progressed(done, total, unit))

    try:
        if not (Path(root) / "LAYOUT").is_file():
            raise StoreError(
                root, f"worker {worker.address} sees no store there", expected="a folder that all machines share",
                todo="mount it under the same path everywhere",
            )  # fmt: skip
        if job.action().key != key:
            raise SurveyError(
                worker.address,
                "runs another version of mineloc or of its libraries",
                todo="install the same everywhere",
            )
        return job.run(Store(Path(root)), progress=progress, waiting=lambda: tell(Waiting()))
    except MinelocError as error:
        return error
    except Exception as error:  # noqa: BLE001  # whatever it is, the survey must hear of it and the worker lives on
        return Crashed(f"{type(error).__name__}: {error}")
