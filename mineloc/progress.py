"""How long work tells how far it is, without knowing who listens."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called now and then by long work; the command line draws a bar, the flows log a line, tests pass `quiet`."""

    def __call__(self, done: float, total: float | None, unit: str) -> None:
        """`done` of `total` (None: unknown) in `unit`, for example sweeps."""
        ...


def quiet(done: float, total: float | None, unit: str) -> None:
    """Nobody listens."""
