"""Who adds to a store, and who cleans it up: many may add at a time, and nobody while it is cleaned.

An object is on the disk before the record or reference that keeps it. Whoever writes both holds the gate meanwhile, so
that the collector never sees the one without the other. The kernel takes the gate back from the dead.
"""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from mineloc.output import one_line_errors


class Gate:
    """The lock file `locks/gate` of a store."""

    def __init__(self, root: Path) -> None:
        self._path = root / "locks" / "gate"

    @contextmanager
    def adding(self) -> Generator[None]:
        """Within: what is written is not collected. May be nested, and held by any number of processes.

        Raises:
            OutputError: the store cannot be written.
        """
        with self._held(fcntl.LOCK_SH, None):
            yield

    @contextmanager
    def collecting(self, waiting: Callable[[], None] | None = None) -> Generator[None]:
        """Within: nobody adds.

        Args:
            waiting: called once when somebody is at it.

        Raises:
            OutputError: the store cannot be written.
        """
        with self._held(fcntl.LOCK_EX, waiting):
            yield

    @contextmanager
    def _held(self, kind: int, waiting: Callable[[], None] | None) -> Generator[None]:
        with one_line_errors(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            handle = self._path.open("ab")
        # Each has a handle of its own, so threads of one process exclude each other too; closing it opens the gate.
        with handle:
            try:
                fcntl.flock(handle, kind | fcntl.LOCK_NB)
            except BlockingIOError:
                if waiting is not None:
                    waiting()
                fcntl.flock(handle, kind)
            yield
