"""What names versions: `latest` and tags of datasets, small sealed files that are replaced whole.

`refs/datasets/<name>/latest` and `.../tags/<tag>` say which version, since when, by whom, and which it was before;
`.../log` keeps all earlier moves. Who moves one holds the dataset's lock and the gate.
"""

from __future__ import annotations

import getpass
import json
import os
import platform
import shutil
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from mineloc.errors import StoreError
from mineloc.output import fsync_path, one_line_errors
from mineloc.store.digest import canonical_json, is_digest, sealed, unsealed

LATEST = "latest"


@dataclass(frozen=True, slots=True)
class Move:
    """A reference's way to a version.

    Attributes:
        ref: `latest` or `tags/<tag>`.
        version: id, None where the reference was taken away.
        before: what it named before, None if it was new.
        utc, who, node: when, by which user, on which machine.
    """

    ref: str
    version: str | None
    before: str | None
    utc: str
    who: str
    node: str


class Refs:
    """The references below a store's root."""

    def __init__(self, root: Path) -> None:
        self._folder = root / "refs" / "datasets"

    def datasets(self) -> list[str]:
        """The names of all datasets, sorted."""
        return sorted(path.name for path in self._folder.glob("*") if (path / LATEST).exists())

    def read(self, dataset: str, ref: str = LATEST) -> str | None:
        """The version that a reference names, None if there is no such reference.

        Raises:
            StoreError: it is damaged.
        """
        path = self._folder / dataset / ref
        try:
            move = parse_move(path.read_text())
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError):
            move = None
        if move is None or move.version is None or move.ref != ref:
            raise StoreError(path, "a damaged reference", todo="see its log, then remove the file, and tag or import")
        return move.version

    def tags(self, dataset: str) -> list[str]:
        """The tags of a dataset, sorted."""
        return sorted(path.name for path in (self._folder / dataset / "tags").glob("*"))

    def all(self) -> list[tuple[str, str]]:
        """Every dataset with each of its references; also of those whose `latest` was lost."""
        found: list[tuple[str, str]] = []
        for folder in sorted(self._folder.glob("*")):
            found += [(folder.name, LATEST)] if (folder / LATEST).exists() else []
            found += [(folder.name, f"tags/{tag}") for tag in self.tags(folder.name)]
        return found

    def move(self, dataset: str, ref: str, version: str, workspace: Path) -> None:
        """Let a reference name a version; that is on the disk when this returns.

        Args:
            workspace: a folder on the same file system, for the unfinished file.

        Raises:
            OutputError: the disk is full, or fails.
        """
        path = self._folder / dataset / ref
        with one_line_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            before = self._log_current(dataset, path)
            temp = workspace / "reference"
            temp.write_text(move_text(ref, version, before))
            fsync_path(temp)
            temp.replace(path)
            fsync_path(path.parent)

    def remove(self, dataset: str, ref: str) -> None:
        """Take a reference away.

        Raises:
            OutputError: the disk is full, or fails.
        """
        path = self._folder / dataset / ref
        with one_line_errors(path):
            before = self._log_current(dataset, path)
            self._append(dataset, move_text(ref, None, before))
            path.unlink(missing_ok=True)
            fsync_path(path.parent)

    def forget(self, dataset: str, workspace: Path) -> None:
        """Take a dataset's references and their log away.

        Raises:
            OutputError: the disk fails.
        """
        with one_line_errors(self._folder):
            (self._folder / dataset).replace(workspace / "forgotten")
            fsync_path(self._folder)
            shutil.rmtree(workspace / "forgotten")

    def log(self, dataset: str) -> list[Move]:
        """All moves of a dataset's references, oldest first; torn lines are left out."""
        folder = self._folder / dataset
        texts = (folder / "log").read_text(errors="replace").split("\n\n") if (folder / "log").exists() else []
        texts += [p.read_text(errors="replace") for p in (folder / LATEST, *folder.glob("tags/*")) if p.is_file()]
        moves = [move for text in texts if (move := parse_move(f"{text.strip()}\n")) is not None]
        return sorted(dict.fromkeys(moves), key=lambda move: move.utc)

    def _log_current(self, dataset: str, path: Path) -> str | None:
        """Keep the move that is about to be replaced: a crash in between repeats it, and never loses it."""
        if not path.exists():
            return None
        text = path.read_text(errors="replace")
        self._append(dataset, text)
        move = parse_move(text)
        return None if move is None else move.version

    def _append(self, dataset: str, text: str) -> None:
        with (self._folder / dataset / "log").open("ab") as log:
            # Empty lines on the way in too: an entry that was torn by a crash must not spoil the next.
            log.write(f"\n\n{text}".encode())
            log.flush()
            os.fsync(log.fileno())


def move_text(ref: str, version: str | None, before: str | None) -> str:
    """The file of a reference that is moved now."""
    now = datetime.now(UTC).isoformat(timespec="microseconds")
    return sealed(canonical_json(asdict(Move(ref, version, before, now, _user(), platform.node()))))


def parse_move(text: str) -> Move | None:
    """What the file of a reference says, None if it is damaged."""
    body = unsealed(text)
    try:
        move = None if body is None else Move(**json.loads(body))
    except (ValueError, TypeError):
        return None
    return move if move is None or move.version is None or is_digest(move.version) else None


def split_reference(text: str) -> tuple[str, str]:
    """`name`, `name@latest`, `name@tag` or `name@<beginning of an id>` as name and what follows (`latest`)."""
    name, _, which = text.partition("@")
    return name, which or LATEST


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a user id without a name (containers)
        return str(os.getuid())
