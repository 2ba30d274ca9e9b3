"""The exception family: what mineloc raises when the world (a file, a configuration, a folder) is not as it must be.

`ValueError` stays for a caller's mistake in code. Every message is one line: where, what was found, what was
expected, what to do.
"""

from __future__ import annotations

from pathlib import Path


class MinelocError(Exception):
    """Something outside the code is wrong; the command line prints it as one line and exits with 1.

    Args:
        where: the file, topic, key or folder.
        found: what was there.
        expected: what should have been there.
        todo: what the reader of the line can do.
    """

    def __init__(self, where: str | Path, found: str, *, expected: str = "", todo: str = "") -> None:
        self.where = str(where)
        self.found = found
        self.expected = expected
        self.todo = todo
        super().__init__(self.line())

    def line(self) -> str:
        """The whole message on one line."""
        parts = [f"{self.where}: {self.found}"]
        if self.expected:
            parts.append(f"expected {self.expected}")
        if self.todo:
            parts.append(self.todo)
        return " ".join("; ".join(parts).split())

    def __reduce__(self) -> tuple[object, ...]:
        # Errors cross process borders (guarded parsing, process pools); the default would drop the keywords.
        return (_rebuild, (type(self), self.where, self.found, self.expected, self.todo))


def _rebuild(kind: type[MinelocError], where: str, found: str, expected: str, todo: str) -> MinelocError:
    return kind(where, found, expected=expected, todo=todo)


class ConfigError(MinelocError):
    """A configuration, sequence or survey file, or a `--set` override, is wrong."""


class IngestError(MinelocError):
    """A recording cannot be read, or does not hold what a flight needs."""


class FormatError(MinelocError):
    """A trajectory, cloud, mesh or plan file is not in the format that it claims."""


class OutputError(MinelocError):
    """The result cannot be written (folder exists, disk full, no permission)."""


class StoreError(MinelocError):
    """The dataset store is damaged or refuses an operation."""


class FlightError(MinelocError):
    """A flight is readable but cannot be processed (one sweep, no points, time going backwards)."""


class MapError(MinelocError):
    """A map is whole but cannot serve as asked (no intersection in it)."""


class SimulationError(MinelocError):
    """A mine or tour cannot be simulated as asked."""


class EvaluationError(MinelocError):
    """Estimate and reference cannot be compared (no overlap in time, too few poses)."""


class SurveyError(MinelocError):
    """A survey stopped: a stage's process died, the server does not answer, the program failed."""
