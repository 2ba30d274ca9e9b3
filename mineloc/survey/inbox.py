"""A folder in which recordings land: which of them are complete.

A copy that is still being written grows, or has not ended yet; a copy program may also stand still for minutes. So a
recording is complete when nothing in it changed for a while and its reader finds its end. One that has no end although
it stood still for long was broken off for good: it is taken as it is, for ingest recovers what can be recovered.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mineloc.errors import MinelocError, OutputError
from mineloc.io.recordings import has_end, open_recording
from mineloc.store.versions import NAME
from mineloc.survey.spec import slug

UNFINISHED = (".part", ".partial", ".tmp", ".crdownload", ".filepart", ".incomplete")
"""What programs call a copy that is not done."""


@dataclass(frozen=True, slots=True)
class Landed:
    """A recording in the inbox.

    Attributes:
        path: file or rosbag2 folder.
        flight: the name of its flight.
    """

    path: Path
    flight: str


@dataclass(frozen=True, slots=True)
class _State:
    """What a recording looked like, and since when: bytes and modification times of all its files."""

    look: tuple[tuple[str, int, int], ...]
    since_s: float


class Inbox:
    """Looks at a folder from time to time.

    Args:
        folder: where recordings land; it exists.
        settle_s: a recording is looked into after so long without a change.
        broken_s: one without an end is taken as broken off after so long without a change.
        ends: whether a recording is whole; the reader's word by default.

    Attributes:
        refused: by path, what is no recording, and why.

    Raises:
        OutputError: no such folder.
    """

    def __init__(
        self,
        folder: Path,
        *,
        settle_s: float = 10.0,
        broken_s: float = 600.0,
        ends: Callable[[Path], bool] | None = None,
    ) -> None:
        if not folder.is_dir():
            raise OutputError(folder, "no such folder", expected="the inbox", todo="make it or check the path")
        self._folder, self._settle_s, self._broken_s = folder, settle_s, broken_s
        self._ends = is_whole if ends is None else ends
        self._seen: dict[Path, _State] = {}
        self._taken: dict[Path, _State] = {}
        self.refused: dict[Path, MinelocError] = {}

    def complete(self, now_s: float) -> list[Landed]:
        """Recordings that became complete since the last look, by name; each is told once, until it changes.

        Args:
            now_s: of any clock that only goes forward.
        """
        looks = self._looks()
        self._seen = {
            path: self._seen[path] if path in self._seen and self._seen[path].look == look else _State(look, now_s)
            for path, look in looks.items()
        }
        self._taken = {p: state for p, state in self._taken.items() if p in looks and state.look == looks[p]}
        self.refused = {path: error for path, error in self.refused.items() if path in self._taken}
        found: list[Landed] = []
        for path, state in self._seen.items():
            if path not in self._taken and self._is_complete(path, now_s - state.since_s):
                self._taken[path] = state
                if path not in self.refused:
                    found.append(Landed(path, flight_name(path)))
        return found

    def put_back(self, landed: Landed) -> None:
        """A recording that could not be used just now is told again."""
        self._taken.pop(landed.path, None)

    def _is_complete(self, path: Path, still_s: float) -> bool:
        """Whether it is time to take it; what is no recording is taken too, and refused."""
        if still_s < self._settle_s:
            return False
        try:
            return self._ends(path) or still_s >= self._broken_s
        except MinelocError as error:
            if still_s < self._broken_s:
                return False
            self.refused[path] = error
            return True

    def _looks(self) -> Mapping[Path, tuple[tuple[str, int, int], ...]]:
        found: dict[Path, tuple[tuple[str, int, int], ...]] = {}
        for path in sorted(self._folder.iterdir()):
            if path.name.startswith(".") or path.name.endswith(UNFINISHED):
                continue
            files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
            try:
                stats = [(str(file.relative_to(self._folder)), file.stat()) for file in files]
            except FileNotFoundError:
                continue  # renamed while it was looked at: the next look sees it under its name
            if stats and not any(name.endswith(UNFINISHED) for name, _ in stats):
                found[path] = tuple((name, stat.st_size, stat.st_mtime_ns) for name, stat in stats)
        return found


def flight_name(path: Path) -> str:
    """The name of a recording's flight: its file's without suffix, in the letters that a survey allows."""
    name = path.name if path.is_dir() else path.stem
    if re.fullmatch(NAME, name):
        return name
    # two names in letters that are not allowed must not become one
    return "-".join(part for part in (slug(name), hashlib.sha256(name.encode()).hexdigest()[:8]) if part)


def is_whole(path: Path) -> bool:
    """Whether a recording has its end and its reader finds nothing broken off.

    Raises:
        IngestError: it is no recording, or damaged beyond recovery.
    """
    if not has_end(path):
        return False
    with open_recording(path) as recording:
        return not recording.damage
