"""Folders in which one process at a time works, under a lock that the kernel takes back when the process dies.

The lock is an OS file lock, held by a process and never by a file's existence: a killed holder blocks nobody, and a
folder whose lock is free was left by the dead and may be removed at once.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from mineloc.output import one_line_errors

POLL_S = 0.1


class Workspaces:
    """`tmp/<name>` folders and their locks, on the file system of the store."""

    def __init__(self, root: Path) -> None:
        self._temp = root / "tmp"
        self._locks = root / "locks"

    @contextmanager
    def hold(self, name: str, *, waiting: Callable[[], None] | None = None) -> Generator[Path]:
        """Yield the empty folder `tmp/<name>`; it is gone afterwards, whatever happened.

        Args:
            name: who holds the same name waits for the other.
            waiting: called once when somebody else holds it.

        Raises:
            OutputError: the store cannot be written.
        """
        with one_line_errors(self._temp):
            self._temp.mkdir(parents=True, exist_ok=True)
            self._locks.mkdir(parents=True, exist_ok=True)
            lock = self._lock(name)
            try:
                lock.acquire(timeout=0)
            except Timeout:
                if waiting is not None:
                    waiting()
                lock.acquire(poll_interval=POLL_S)
        folder = self._temp / name
        try:
            with one_line_errors(folder):
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            lock.release()

    def sweep(self) -> list[str]:
        """Remove what killed processes left behind; the names of what was removed.

        Raises:
            OutputError: the store cannot be written.
        """
        swept: list[str] = []
        for folder in sorted(self._temp.glob("*")):
            lock = self._lock(folder.name)
            try:
                with one_line_errors(folder):
                    lock.acquire(timeout=0)
            except Timeout:
                continue
            try:
                shutil.rmtree(folder, ignore_errors=True)
                swept.append(folder.name)
            finally:
                lock.release()
        return swept

    def _lock(self, name: str) -> FileLock:
        return FileLock(self._locks / f"{name}.lock")
