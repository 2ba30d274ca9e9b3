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
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mineloc.output import fsync_path, one_line_errors
from mineloc.store.digest import Json, canonical_json, sha256_of_text
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
        return read_record(self._path(action))

    def write(self, action: Action, output: Ref, seconds: float, *, workspace: Path) -> Record:
        """Keep what came out. Everything that it names must be on the disk already.

        Args:
            workspace: a folder on the same file system, for the unfinished record.

        Raises:
            OutputError: the disk is full, or fails.
        """
        record = Record(output, round(seconds, 3), _circumstances())
        body = canonical_json({"key": action.key, "action": asdict(action), **asdict(record)})
        path = self._path(action)
        with one_line_errors(path):
            temp = workspace / "record.json"
            temp.write_text(f"{sha256_of_text(body)}\n{body}\n")
            fsync_path(temp)
            path.parent.mkdir(parents=True, exist_ok=True)
            temp.replace(path)
            fsync_path(path.parent)
        return record

    def _path(self, action: Action) -> Path:
        return self._folder / action.stage / f"{action.key}.json"


def read_record(path: Path) -> Record | None:
    """A record file, None if it is absent or damaged."""
    try:
        digest, body = path.read_text().split("\n", 1)
        if sha256_of_text(body.rstrip("\n")) != digest:
            return None
        raw = json.loads(body)
        return Record(Ref(**raw["output"]), raw["seconds"], raw["made"]) if raw["key"] == path.stem else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _circumstances() -> dict[str, Json]:
    libraries = ("numpy", "scipy", "numba", "open3d", "gtsam", "polars", "rosbags", "mcap", "rerun-sdk")
    return {
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "mineloc": version("mineloc"),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in libraries},
        "machine": {"node": platform.node(), "system": platform.platform(), "cpus": os.cpu_count()},
    }
