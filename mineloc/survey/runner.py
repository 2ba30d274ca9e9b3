"""Where the stages of a survey run: in processes of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, Self

from mineloc.errors import ConfigError
from mineloc.progress import Progress, quiet
from mineloc.stages.stage import Job
from mineloc.store.store import Outcome

_CLUSTER = 256
"""More jobs at a time than a survey office has cores."""


class Workers(AbstractContextManager["Workers"], Protocol):
    """Runs jobs, several at a time, each in a process of its own."""

    def run(
        self, job: Job, root: Path, *, progress: Progress = quiet, waiting: Callable[[], None] | None = None
    ) -> Outcome:
        """The result of a job, with the store at `root`; waits for a free worker.

        Raises:
            MinelocError: what the stage says.
            SurveyError: the worker died, or the program failed.
        """
        ...


@dataclass(frozen=True, slots=True)
class Runner:
    """Which workers.

    Attributes:
        kind: "process" or "dask".
        address: of the Dask scheduler, `tcp://host:8786`.
    """

    kind: Literal["process", "dask"] = "process"
    address: str | None = None

    @classmethod
    def named(cls, kind: str, address: str | None) -> Self:
        """From the words of the command line.

        Raises:
            ConfigError: no such runner, or an address where none belongs.
        """
        if kind == "process":
            if address is not None:
                raise ConfigError(
                    "--address", "processes of this machine have none", expected="--runner dask", todo="add it"
                )
            return cls()
        if kind != "dask":
            raise ConfigError("--runner", repr(kind), expected="process or dask", todo="choose one of them")
        if address is None:
            raise ConfigError(
                "--address", "is not given", expected="a Dask scheduler, tcp://host:8786", todo="start one and name it"
            )
        return cls("dask", address)

    def at_once(self, count: int) -> int:
        """How many jobs to hand out at a time, where a survey asks for `count`; a cluster queues the rest itself."""
        return count if self.kind == "process" else _CLUSTER

    def words(self) -> list[str]:
        """The same on a command line."""
        return [f"--runner={self.kind}", *([f"--address={self.address}"] if self.address else [])]

    def workers(self, count: int, log: Path) -> Workers:
        """The workers, ready; close them by leaving their context.

        Args:
            count: of processes of this machine; a cluster has as many as it has.
            log: what processes of this machine print.

        Raises:
            SurveyError: no Dask, no scheduler at the address, or no worker there.
        """
        if self.kind == "dask":
            from mineloc.survey.dask_workers import DaskWorkers

            assert self.address is not None
            return DaskWorkers(self.address)
        from mineloc.survey.pool import Pool

        return Pool(count, log)


PROCESSES = Runner()
