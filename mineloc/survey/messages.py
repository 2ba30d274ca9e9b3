"""What a worker process is told, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from mineloc.errors import MinelocError
from mineloc.stages.stage import Job
from mineloc.store.store import Outcome


@dataclass(frozen=True, slots=True)
class Request:
    """Run a job with the store at `root`."""

    root: Path
    job: Job


@dataclass(frozen=True, slots=True)
class Progressed:
    """The stage tells how far it is."""

    done: float
    total: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class Waiting:
    """Another process runs the same job; this one waits for its result."""


@dataclass(frozen=True, slots=True)
class Crashed:
    """The stage raised something that is no word to the user: a fault of the program, told in the log."""

    what: str


Reply: TypeAlias = Outcome | MinelocError | Crashed | Progressed | Waiting
