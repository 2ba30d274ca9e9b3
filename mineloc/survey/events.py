"""What happens while a survey runs, told to whoever listens; over a pipe as lines of JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal, TypeAlias

State: TypeAlias = Literal["started", "progress", "waiting", "known", "done", "failed"]


@dataclass(frozen=True, slots=True)
class Event:
    """Something happened to a step.

    Attributes:
        step: its name.
        state: `known`: its result was found; `done`: it was executed; `waiting`: another process executes it.
        done, total, unit: of `progress`.
        seconds: of `done` and `known`: how long the execution took (took then).
        line: of `failed`: what the user is told.
    """

    step: str
    state: State
    done: float = 0.0
    total: float | None = None
    unit: str = ""
    seconds: float = 0.0
    line: str = ""

    def to_line(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self), separators=(",", ":")) + "\n"

    @staticmethod
    def from_line(line: str) -> Event:
        """The event of a line."""
        return Event(**json.loads(line))


Listener: TypeAlias = Callable[[Event], None]


def nobody(event: Event) -> None:
    """Nobody listens."""
