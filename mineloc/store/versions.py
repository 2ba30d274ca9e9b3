"""Versions of a dataset: which recordings it holds, and which version it follows.

A version's id is the sha256 of its manifest, which is an object of the store. Who made it and when is no part of it
(the references' log tells): equal content has equal ids on all machines.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias

from mineloc.errors import StoreError
from mineloc.store.digest import canonical_json, is_digest, sha256_of_text
from mineloc.store.objects import Ref, tree_files

SCHEMA = "mineloc.dataset/1"
# Of datasets, tags and flights, which become flights of surveys.
NAME = r"[A-Za-z0-9][A-Za-z0-9._-]*"
MAX_NAME = 100

ReadText: TypeAlias = Callable[[str], str]


@dataclass(frozen=True, slots=True)
class Recording:
    """One flight's recording in a version.

    Attributes:
        flight: its id, once in a version.
        file: the file or folder name that it came with.
        sha256: its content; of a folder, of its tree.
        bytes: its size.
        kind: a folder is a rosbag2 folder.
        sequence: sha256 of the sequence file that says what the recording does not.
        health: sha256 of its health report (JSON).
    """

    flight: str
    file: str
    sha256: str
    bytes: int
    kind: Literal["file", "folder"]
    sequence: str | None = None
    health: str | None = None

    @property
    def ref(self) -> Ref:
        """Its content, for the store."""
        return Ref(self.sha256, self.kind, self.bytes)


@dataclass(frozen=True)
class Version:
    """A dataset at one time.

    Attributes:
        dataset: its name where the version was made.
        parent: id of the version before, None for the first.
        recordings: sorted by flight.
        note: one line of the one who made it.
    """

    dataset: str
    parent: str | None
    recordings: tuple[Recording, ...]
    note: str = ""

    @cached_property
    def manifest(self) -> str:
        """The canonical JSON of all of it."""
        return canonical_json({"schema": SCHEMA, **asdict(self)})

    @cached_property
    def id(self) -> str:
        """Hex sha256 of the manifest."""
        return sha256_of_text(self.manifest)

    @property
    def bytes(self) -> int:
        """Size of all recordings."""
        return sum(one.bytes for one in self.recordings)

    @property
    def file_text(self) -> str:
        """The manifest for people and git, a fact a line; `read_manifest` takes it."""
        return json.dumps(json.loads(self.manifest), indent=1, ensure_ascii=False) + "\n"

    def flights(self) -> dict[str, Recording]:
        """The recordings by flight."""
        return {one.flight: one for one in self.recordings}


def parse_version(text: str, where: str | Path) -> Version:
    """A version from its manifest.

    Raises:
        StoreError: it is no manifest, or not the canonical one of what it says.
    """
    try:
        raw = json.loads(text)
        if raw.pop("schema") != SCHEMA:
            raise ValueError("schema")
        recordings = tuple(Recording(**one) for one in raw.pop("recordings"))
        version = Version(recordings=recordings, **raw)
        if version.manifest == text and _is_valid(version):
            return version
    except (ValueError, KeyError, TypeError, AttributeError):
        pass
    raise StoreError(where, "no manifest of a dataset's version", expected=SCHEMA, todo="check the file") from None


def read_manifest(path: Path) -> Version:
    """A version from a manifest file, as git keeps it.

    Raises:
        StoreError: it cannot be read, or is no manifest.
    """
    try:
        text = canonical_json(json.loads(path.read_text()))
    except OSError as error:
        raise StoreError(path, f"cannot be read ({error.strerror})", todo="check the path") from None
    except ValueError:
        text = ""
    return parse_version(text, path)


def _is_valid(version: Version) -> bool:
    flights = [one.flight for one in version.recordings]
    return (
        is_name(version.dataset)
        and (version.parent is None or is_digest(version.parent))
        and type(version.note) is str
        and flights == sorted(set(flights))
        and all(_is_recording(one) for one in version.recordings)
    )


def _is_recording(one: Recording) -> bool:
    file: Any = one.file
    return (
        is_name(one.flight)
        and isinstance(file, str)
        and is_file_name(file)
        and is_digest(one.sha256)
        and type(one.bytes) is int
        and one.bytes >= 0
        and one.kind in ("file", "folder")
        and all(digest is None or is_digest(digest) for digest in (one.sequence, one.health))
    )


def is_name(text: object) -> bool:
    """Whether something may name a dataset, a tag or a flight."""
    return isinstance(text, str) and len(text) <= MAX_NAME and re.fullmatch(NAME, text) is not None


def is_file_name(text: str) -> bool:
    """Whether something is one plain file name."""
    return text not in ("", ".", "..") and not set("/\0\n") & set(text)


def check_name(text: str, what: str) -> str:
    """The name, if it may be one.

    Raises:
        StoreError: it may not.
    """
    if not is_name(text):
        raise StoreError(
            what, repr(text), expected=f"letters, digits and ._-, {MAX_NAME} at most", todo="choose another name"
        )
    return text


def history(read: ReadText, version_id: str) -> Iterator[Version]:
    """A version and those before it, newest first.

    Args:
        read: the text of an object, checked by its hash.

    Raises:
        StoreError: a manifest is gone or damaged.
    """
    following: str | None = version_id
    while following is not None:
        version = parse_version(read(following), f"version {following[:12]}")
        yield version
        following = version.parent


def reached(read: ReadText, version_id: str) -> dict[str, None]:
    """All objects of a version and of those before it, what names others after what it names.

    Args:
        read: the text of an object, checked by its hash.

    Raises:
        StoreError: a manifest or a folder's tree is gone or damaged.
    """
    found: dict[str, None] = {}
    manifests: list[str] = []
    for version in history(read, version_id):
        manifests.append(version.id)
        for one in version.recordings:
            if one.kind == "folder" and one.sha256 not in found:
                found |= dict.fromkeys(tree_files(read(one.sha256), Path(one.file)).values())
            found |= dict.fromkeys(d for d in (one.sha256, one.sequence, one.health) if d is not None)
    return found | dict.fromkeys(reversed(manifests))


def named(read: ReadText, version_id: str) -> dict[str, None]:
    """As `reached`, of a store that may be damaged: what cannot be read is named and not followed."""
    found: dict[str, None] = {}
    following: str | None = version_id
    while following is not None:
        found[following] = None
        try:
            version = parse_version(read(following), "")
        except StoreError:
            break
        for one in version.recordings:
            found |= dict.fromkeys(d for d in (one.sha256, one.sequence, one.health) if d is not None)
            if one.kind == "folder":
                with suppress(StoreError):
                    found |= dict.fromkeys(tree_files(read(one.sha256), Path(one.file)).values())
        following = version.parent
    return found
