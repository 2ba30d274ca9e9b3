"""Names for content: sha256 of files, canonical JSON, and an index that saves hashing an unchanged file twice.

The index believes a file to be unchanged while its inode, size, modification time *and status-change time* are what
they were. Programs set modification times at will (`cp -p`, `touch`, a repaired file), but the kernel alone sets the
status-change time, on every write and every `utime`. What it cannot see is damage below the file system;
`Store.verify` re-hashes for that.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

from mineloc.errors import StoreError

Json: TypeAlias = Mapping[str, "Json"] | Sequence["Json"] | str | int | float | bool | None

BLOCK_BYTES = 1 << 20
# Clocks of network and removable file systems tick every 2 s: within a tick a second write leaves no trace.
SETTLE_NS = 2_000_000_000


def canonical_json(value: Json) -> str:
    """The one text of a JSON value: sorted keys, no spaces.

    Raises:
        ValueError: NaN, infinity, or something that JSON does not know (a set has no order).
    """
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    except TypeError as error:
        raise ValueError(f"not JSON: {error}") from None


def sha256_of_text(text: str) -> str:
    """Hex sha256 of UTF-8 text."""
    return hashlib.sha256(text.encode()).hexdigest()


def is_digest(text: object) -> bool:
    """Whether something is written like a hex sha256."""
    return isinstance(text, str) and len(text) == 64 and not text.strip("0123456789abcdef")


def sealed(body: str) -> str:
    """One line of text under the line of its own sha256, so that damage to either is seen."""
    return f"{sha256_of_text(body)}\n{body}\n"


def unsealed(text: str) -> str | None:
    """The text under a seal, None if it is damaged."""
    digest, _, body = text.partition("\n")
    body = body.removesuffix("\n")
    return body if text == f"{digest}\n{body}\n" and sha256_of_text(body) == digest else None


def sha256_of_file(path: Path) -> str:
    """Hex sha256 of a file, read once (the interpreter lock is free meanwhile)."""
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def copy_and_hash(source: Path, target: Path) -> str:
    """Copy a file and return the hex sha256 of what was copied: one pass, and no time between the two."""
    sha = hashlib.sha256()
    with source.open("rb") as reading, target.open("wb") as writing:
        while block := reading.read(BLOCK_BYTES):
            sha.update(block)
            writing.write(block)
        writing.flush()
        os.fsync(writing.fileno())
    return sha.hexdigest()


class DigestIndex:
    """Remembers the sha256 of files by what the kernel says of them; a cache, safe to delete at any time."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def digest(self, path: Path) -> str:
        """The sha256 of a file, from memory if nothing about it changed.

        Raises:
            OSError: it cannot be read.
        """
        known = self.recall(path)
        if known is not None:
            return known
        before = _signature(path)
        digest = sha256_of_file(path)
        if _signature(path) == before and time.time_ns() - before[-1] > SETTLE_NS:
            self._write(path, before, digest)
        return digest

    def recall(self, path: Path) -> str | None:
        """The sha256 of a file if it is remembered and the file is unchanged."""
        entry = self._entry(path)
        try:
            *signature, digest = json.loads(entry.read_text())
        except (OSError, ValueError, TypeError):
            return None
        return digest if signature == _signature(path) else None

    def copy(self, source: Path, target: Path) -> str:
        """Copy a file and return the sha256 of what was copied; the source is then known too.

        Raises:
            StoreError: the source changed while it was copied.
            OSError: it cannot be read, or the copy not be written.
        """
        before = _signature(source)
        digest = copy_and_hash(source, target)
        if _signature(source) != before:
            raise StoreError(source, "changed while it was copied", todo="run again when it is complete")
        if time.time_ns() - before[-1] > SETTLE_NS:
            self._write(source, before, digest)
        return digest

    def remember(self, path: Path, digest: str) -> None:
        """Note the sha256 of a file that only the caller can have written."""
        self._write(path, _signature(path), digest)

    def _entry(self, path: Path) -> Path:
        name = sha256_of_text(os.path.abspath(path))
        return self._folder / name[:2] / name

    def _write(self, path: Path, signature: list[int], digest: str) -> None:
        entry = self._entry(path)
        # A cache that cannot be written (full disk, read-only store) costs time, not truth.
        with suppress(OSError):
            entry.parent.mkdir(parents=True, exist_ok=True)
            # One small write: a torn or mixed entry is not JSON any more and counts as unknown.
            entry.write_text(json.dumps([*signature, digest]))


def _signature(path: Path) -> list[int]:
    s = path.stat()
    return [s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns]
