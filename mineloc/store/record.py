"""What was done: the key of an action, and the record of what came out of it.

The key is all that the result depends on: the stage, the version of its output's schema, the code behind it, its
arguments, the configuration sections that it names, and the content and names of its inputs. The record keeps these,
the output's hashes, and who made it when and with what. It carries its own hash, so a damaged one counts as absent.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mineloc.output import fsync_path, one_line_errors
from mineloc.store.digest import Json, canonical_json, sealed, sha256_of_text, unsealed
from mineloc.store.objects import Ref

RECORD_SCHEMA = 1


@dataclass(frozen=True)
class Action:
    """Something to be done, described by everything that its result depends on.

    Attributes:
        stage: its name.
        schema: version of what it writes.
        code: digest of the code behind it.
        arguments: JSON values.
        config: JSON values of the configuration sections that it reads, and of no others.
        inputs: by name: the file names under which it sees them, and their content (name, digest).
    """

    stage: str
    schema: int
    code: str
    arguments: Mapping[str, Json]
    config: Mapping[str, Json]
    inputs: Mapping[str, tuple[tuple[str, str], ...]]

    @cached_property
    def key(self) -> str:
        """Hex sha256 of the canonical JSON of all fields."""
        return sha256_of_text(canonical_json({"record": RECORD_SCHEMA, **asdict(self)}))


@dataclass(frozen=True, slots=True)
class Record:
    """What came out of an action.

    Attributes:
        output: its content.
        seconds: how long it took.
        made: versions, machine and time; no part of any key.
    """

    output: Ref
    seconds: float
    made: Mapping[str, Any]


class Records:
    """`actions/<stage>/<key>.json`, one a key, written atomically."""

    def __init__(self, root: Path) -> None:
        self._folder = root / "actions"

    def paths(self) -> list[Path]:
        """All records, sorted."""
        return sorted(self._folder.glob("*/*.json"))

    def read(self, action: Action) -> Record | None:
        """The record of an action, None if there is none or if it is damaged."""
        return read_record(self.path(action))

    def write(self, action: Action, output: Ref, seconds: float, *, workspace: Path) -> Record:
        """Keep what came out. Everything that it names must be on the disk already.

        Args:
            workspace: a folder on the same file system, for the unfinished record.

        Raises:
            OutputError: the disk is full, or fails.
        """
        record = Record(output, round(seconds, 3), _circumstances())
        body = canonical_json({"key": action.key, "action": asdict(action), **asdict(record)})
        with one_line_errors(self._folder):
            temp = workspace / "record.json"
            temp.write_text(sealed(body))
        self.adopt(temp, action)
        return record

    def path(self, action: Action) -> Path:
        """Where the record of an action lies, whether there is one or not."""
        return self._folder / action.stage / f"{action.key}.json"

    def adopt(self, temp: Path, action: Action) -> None:
        """Rename a finished record, written on the same file system, to its place.

        Raises:
            OutputError: the disk fails.
        """
        path = self.path(action)
        with one_line_errors(path):
            fsync_path(temp)
            path.parent.mkdir(parents=True, exist_ok=True)
            temp.replace(path)
            fsync_path(path.parent)


def read_record(path: Path) -> Record | None:
    """A record file, None if it is absent or damaged."""
    found = read_action(path)
    return None if found is None else found[1]


def read_action(path: Path) -> tuple[Action, Record] | None:
    """A record file with the action that it tells of, None if it is absent, damaged or not under its own key."""
    try:
        found = parse_record(path.read_text())
    except (OSError, ValueError):
        return None
    return found if found is not None and found[0].key == path.stem else None


def parse_record(text: str) -> tuple[Action, Record] | None:
    """What a record file says, None if it is damaged or its key is not that of its action."""
    body = unsealed(text)
    if body is None:
        return None
    try:
        raw: Any = json.loads(body)
        inputs = {name: tuple((str(n), str(d)) for n, d in many) for name, many in raw["action"]["inputs"].items()}
        action = Action(**(raw["action"] | {"inputs": inputs}))
        record = Record(Ref(**raw["output"]), raw["seconds"], raw["made"])
        return (action, record) if action.key == raw["key"] else None
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def _circumstances() -> dict[str, Json]:
    return {
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "mineloc": version("mineloc"),
        "python": platform.python_version(),
        "libraries": dict(_libraries()),
        "machine": {"node": platform.node(), "system": platform.platform(), "cpus": os.cpu_count()},
    }


@lru_cache
def _libraries() -> dict[str, str]:
    """Looked up once: it takes longer than all else of a record."""
    libraries = ("numpy", "scipy", "numba", "open3d", "gtsam", "polars", "rosbags", "mcap", "rerun-sdk")
    return {name: version(name) for name in libraries}
