"""A version as one file that can be carried out of a mine: an uncompressed tar, the same bytes for the same content.

The first member, `mineloc-dataset`, is sealed JSON: dataset, version, tag, and name and size of every other member, in
order. Then come `objects/<sha256>` and, where results are taken along, `actions/<stage>/<key>.json`. Whoever reads it
so knows every byte that is not content, and asks for exactly these; content is hashed. Nothing in it can be changed
unseen, and nothing is visible before the last byte was checked.
"""

from __future__ import annotations

import hashlib
import json
import tarfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from mineloc.errors import StoreError
from mineloc.output import new_file, one_line_errors
from mineloc.progress import Progress, quiet
from mineloc.store.datasets import Datasets
from mineloc.store.digest import BLOCK_BYTES, canonical_json, is_digest, sealed, sha256_of_text, unsealed
from mineloc.store.objects import tree_files
from mineloc.store.record import Action, Record, parse_record
from mineloc.store.refs import split_reference
from mineloc.store.results import results_of
from mineloc.store.store import Store
from mineloc.store.versions import Version, is_name, reached

SCHEMA = "mineloc.dataset.export/1"
HEAD = "mineloc-dataset"
_MAX_HEAD_BYTES = 1 << 30
_END = bytes(2 * tarfile.BLOCKSIZE)
_TakenRecord: TypeAlias = tuple[Path, Action, Record]


@dataclass(frozen=True)
class Contents:
    """What an export says of itself.

    Attributes:
        dataset: its name where it was made.
        version: id.
        tag: by which it was asked for, None if by none.
        members: sizes by name, in order.
    """

    dataset: str
    version: str
    tag: str | None
    members: Mapping[str, int]

    def text(self) -> str:
        """The first member."""
        members = [[name, size] for name, size in self.members.items()]
        raw = {"dataset": self.dataset, "members": members, "schema": SCHEMA, "tag": self.tag, "version": self.version}
        return sealed(canonical_json(raw))


def export_version(
    datasets: Datasets, reference: str, out: Path, *, runs: bool = False, progress: Progress = quiet
) -> Contents:
    """Write a version with its history to one file.

    Args:
        runs: also the results that were made of its recordings.
        progress: told of megabytes.

    Raises:
        StoreError: no such version, or something of it is gone or damaged.
        OutputError: `out` exists or cannot be written.
    """
    name, which = split_reference(reference)
    version = datasets.get(reference)
    store = datasets.store
    results = results_of(store, version) if runs else {}
    digests = set(reached(datasets.read_text, version.id))
    for record in results.values():
        digests |= {record.output.digest, *store.objects.files(record.output).values()}
    paths = {f"objects/{digest}": store.objects.path(digest) for digest in sorted(digests)}
    paths |= {f"actions/{path.parent.name}/{path.name}": path for path in results}
    for path in paths.values():
        if not path.is_file():
            raise StoreError(path, "gone", expected="an intact object", todo="import or pull it anew")
    tag = which if which in datasets.refs.tags(name) else None
    contents = Contents(name, version.id, tag, {name: path.stat().st_size for name, path in paths.items()})
    with new_file(out) as temp, temp.open("wb") as writing:
        head = contents.text().encode()
        writing.write(_header(HEAD, len(head)) + head + _padding(len(head)))
        done, total = 0, sum(contents.members.values())
        for member, path in paths.items():
            _write_member(writing, member, path, contents.members[member])
            done += contents.members[member]
            progress(done / 1e6, total / 1e6, "MB")
        writing.write(_END)
    return contents


def _write_member(writing: BinaryIO, member: str, path: Path, size: int) -> None:
    sha = hashlib.sha256()
    writing.write(_header(member, size))
    with path.open("rb") as reading:
        while block := reading.read(BLOCK_BYTES):
            sha.update(block)
            writing.write(block)
    writing.write(_padding(size))
    if member.startswith("objects/") and member != f"objects/{sha.hexdigest()}":
        raise StoreError(path, "damaged", expected="an intact object", todo="import or pull it anew")


def import_version(
    datasets: Datasets, path: Path, *, name: str | None = None, progress: Progress = quiet
) -> tuple[str, Version]:
    """Take a version from a file; nothing is visible before all of it was checked.

    Args:
        name: of the dataset here; None: as it was called where it was exported.
        progress: told of megabytes.

    Returns:
        The dataset's name here, and the version.

    Raises:
        StoreError: no export, damaged or incomplete, or the dataset here would lose history.
        OutputError: the store cannot be written.
    """
    store = datasets.store
    try:
        reading = path.open("rb")
    except OSError as error:
        raise StoreError(path, f"cannot be read ({error.strerror})", todo="check the path") from None
    with reading, store.workspaces.hold(f"import-{sha256_of_text(str(path.absolute()))}") as workspace:
        contents = _read_head(reading, path)
        files, records = _read_members(reading, contents, workspace, path, progress)
        try:
            _refuse_incomplete(store, records, files)
        except (StoreError, UnicodeDecodeError):
            raise _damaged(path) from None
        with store.gate.adding():
            version = datasets.land(name or contents.dataset, contents.version, files, tag=contents.tag)
            _take_records(store, records, files)
    return name or contents.dataset, version


def _read_members(
    reading: BinaryIO, contents: Contents, workspace: Path, path: Path, progress: Progress
) -> tuple[dict[str, Path], list[_TakenRecord]]:
    """Copy everything into a workspace and check it: objects by sha256, and records."""
    files: dict[str, Path] = {}
    records: list[_TakenRecord] = []
    done, total = 0, sum(contents.members.values())
    for i, (member, size) in enumerate(contents.members.items()):
        temp = workspace / f"{i}"
        digest = _read_member(reading, member, size, temp, path)
        kind, _, rest = member.partition("/")
        if kind == "objects" and rest == digest:
            files[digest] = temp
        elif kind == "actions":
            records.append((temp, *_checked_record(temp, rest, path)))
        else:
            raise _damaged(path)
        done += size
        progress(done / 1e6, total / 1e6, "MB")
    if reading.read(len(_END) + 1) != _END:
        raise _damaged(path)
    return files, records


def _read_head(reading: BinaryIO, path: Path) -> Contents:
    block = reading.read(tarfile.BLOCKSIZE)
    try:
        size = tarfile.TarInfo.frombuf(block, "utf-8", "strict").size
    except (tarfile.TarError, ValueError):
        size = -1
    if not 0 <= size <= _MAX_HEAD_BYTES or block != _header(HEAD, size):
        raise StoreError(path, "no export of a dataset", expected="a file of `dataset export`", todo="check the path")
    text = reading.read(size)
    if reading.read(len(_padding(size))) != _padding(size):
        raise _damaged(path)
    try:
        body = unsealed(text.decode())
        raw: Any = json.loads(body or "")
        members = {str(member): int(size) for member, size in raw["members"]}
        contents = Contents(raw["dataset"], raw["version"], raw["tag"], members)
    except (ValueError, KeyError, TypeError):
        raise _damaged(path) from None
    named = is_name(contents.dataset) and is_digest(contents.version) and (raw["tag"] is None or is_name(raw["tag"]))
    if (
        raw["schema"] != SCHEMA
        or not named
        or min(members.values(), default=-1) < 0
        or contents.text().encode() != text
    ):
        raise _damaged(path)
    return contents


def _read_member(reading: BinaryIO, member: str, size: int, temp: Path, path: Path) -> str:
    """Copy the next member; its sha256."""
    if reading.read(tarfile.BLOCKSIZE) != _header(member, size):
        raise _damaged(path)
    sha = hashlib.sha256()
    with one_line_errors(temp), temp.open("wb") as writing:
        for block in _blocks(reading, size):
            sha.update(block)
            writing.write(block)
    # A file that ends early gives other content or other padding.
    if reading.read(len(_padding(size))) != _padding(size):
        raise _damaged(path)
    return sha.hexdigest()


def _blocks(reading: BinaryIO, size: int) -> Iterator[bytes]:
    while size and (block := reading.read(min(size, BLOCK_BYTES))):
        size -= len(block)
        yield block


def _checked_record(temp: Path, name: str, path: Path) -> tuple[Action, Record]:
    found = parse_record(temp.read_text(errors="replace"))
    if found is None or name != f"{found[0].stage}/{found[0].key}.json" or not is_name(found[0].stage):
        raise _damaged(path)
    return found


def _refuse_incomplete(store: Store, records: list[_TakenRecord], files: Mapping[str, Path]) -> None:
    """Every object of every result is in the file, or here."""
    for temp, _, record in records:
        wanted = [record.output.digest, *record.output.volatile.values()]
        if record.output.kind == "folder":
            wanted += tree_files(_text(store, record.output.digest, files), temp).values()
        for digest in wanted:
            if digest not in files and not store.objects.is_intact(digest):
                raise StoreError(temp, f"object {digest[:12]} is not there")


def _text(store: Store, digest: str, files: Mapping[str, Path]) -> str:
    return files[digest].read_text() if digest in files else store.objects.read_text(digest)


def _take_records(store: Store, records: list[_TakenRecord], files: Mapping[str, Path]) -> None:
    """Results that are known here stay as they are; of the others the objects come first."""
    for temp, action, _ in records:
        if store.lookup(action) is None:
            store.objects.commit({digest: file for digest, file in files.items() if file.exists()})
            store.records.adopt(temp, action)


def _header(name: str, size: int) -> bytes:
    """A tar header without time, owner and rights that could differ."""
    info = tarfile.TarInfo(name)
    info.size = size
    return info.tobuf(tarfile.GNU_FORMAT)


def _padding(size: int) -> bytes:
    return bytes(-size % tarfile.BLOCKSIZE)


def _damaged(path: Path) -> StoreError:
    return StoreError(path, "damaged or incomplete", expected="a whole export", todo="export or copy it anew")
