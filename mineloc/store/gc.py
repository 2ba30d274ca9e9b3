"""The collector: removes what nothing needs any more.

What is kept:

1. everything that a reference reaches: versions, the versions before them, their recordings and reports;
2. what is younger than the grace period, and what a running stage has before it;
3. a record whose output is whole and whose inputs are kept, or came from outside the store, or were made by such a
   record; with its output. So results stay as long as the recordings that they were made of. Records older than
   `actions_older_than_s`, if that is given, go nevertheless, and what only they made with them.

A young record keeps its inputs too. Damaged references and manifests hide what is needed: then nothing is removed.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mineloc.errors import StoreError
from mineloc.output import one_line_errors
from mineloc.store.record import Action, Record, read_action
from mineloc.store.refs import Refs
from mineloc.store.store import Store
from mineloc.store.versions import reached

DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Collected:
    """What was removed, or would be.

    Attributes:
        objects: their names.
        records: record files.
        freed_bytes: size of the objects.
        kept: how many objects stay.
        swept: temporary folders of killed processes.
    """

    objects: tuple[str, ...]
    records: tuple[Path, ...]
    freed_bytes: int
    kept: int
    swept: tuple[str, ...]


def collect(
    store: Store,
    *,
    grace_s: float = DAY_S,
    actions_older_than_s: float | None = None,
    dry_run: bool = False,
    now_s: float | None = None,
    waiting: Callable[[], None] | None = None,
) -> Collected:
    """Remove what nothing needs any more; nobody adds to the store meanwhile.

    Args:
        grace_s: what is younger is kept.
        actions_older_than_s: results that were made longer ago go although they could be used again; None: none do.
        dry_run: only say what would be removed.
        now_s: the time, seconds since the epoch.
        waiting: called once when somebody adds to the store just now.

    Raises:
        StoreError: a reference or manifest is damaged: it is not known what is needed.
        OutputError: something cannot be removed.
    """
    now_s = time.time() if now_s is None else now_s
    with store.gate.collecting(waiting):
        swept = () if dry_run else tuple(store.sweep())
        marks = _Marks(store, now_s, grace_s)
        records = marks.useless_records(actions_older_than_s)
        objects = [digest for digest in marks.objects if digest not in marks.kept]
        freed = sum(store.objects.path(digest).stat().st_size for digest in objects)
        if not dry_run:
            with one_line_errors(store.root):
                _remove(store, records, objects)
    return Collected(tuple(objects), tuple(records), freed, len(marks.objects) - len(objects), swept)


@dataclass(frozen=True, slots=True)
class _Made:
    """What a record says of objects: which it read, which came out (the folder's tree first)."""

    inputs: list[str]
    objects: list[str]
    is_young: bool


class _Marks:
    """What is kept; begins with everything but records."""

    def __init__(self, store: Store, now_s: float, grace_s: float) -> None:
        self._store = store
        self._young_since_s = now_s - grace_s
        self._now_s = now_s
        self.objects = store.objects.digests()
        self._there = frozenset(self.objects)
        self.kept: set[str] = set()
        for dataset, ref in Refs(store.root).all():
            self._keep_version(dataset, ref)
        self.kept |= {digest for digest in self.objects if self._is_young(store.objects.path(digest))}
        self.kept |= _in_use(store)

    def _keep_version(self, dataset: str, ref: str) -> None:
        try:
            version = Refs(self._store.root).read(dataset, ref)
            if version is not None:
                self.kept |= reached(self._store.objects.read_text, version).keys()
        except StoreError as error:
            raise StoreError(
                error.where,
                f"{error.found}; so it is unknown what {dataset}/{ref} needs, nothing was removed",
                todo="import or pull it anew, or take the reference away",
            ) from error

    def useless_records(self, oldest_s: float | None) -> list[Path]:
        """The records that go; what the others made is marked."""
        known: dict[Path, _Made] = {}
        useless: list[Path] = []
        for path in self._store.records.paths():
            found = read_action(path)
            made = None if found is None else self._made(found[1])
            if found is not None and made is not None:
                known[path] = _Made(_inputs(found[0]), made, self._is_young(path))
            elif not self._is_young(path):
                useless.append(path)
        self._keep_inputs_of_young(known)
        for path in self._unfounded(known):
            useless.append(path)
            del known[path]
        for path, one in known.items():
            if oldest_s is not None and not one.is_young and path.stat().st_ctime < self._now_s - oldest_s:
                useless.append(path)
            else:
                self.kept |= set(one.objects)
        return sorted(useless)

    def _keep_inputs_of_young(self, known: Mapping[Path, _Made]) -> None:
        """Else they would go, and later look as if they had come from outside."""
        folders = {one.objects[0]: one.objects for one in known.values()}
        for digest in (digest for one in known.values() if one.is_young for digest in one.inputs):
            self.kept |= set(folders.get(digest, [digest]))

    def _unfounded(self, known: Mapping[Path, _Made]) -> list[Path]:
        """Records with an input that lies here and that nothing founded made."""
        founded = set(self.kept)
        left = dict(known)
        while ready := [
            path
            for path, one in left.items()
            if one.is_young or all(digest in founded or digest not in self._there for digest in one.inputs)
        ]:
            for path in ready:
                founded |= set(left.pop(path).objects)
        return list(left)

    def _made(self, record: Record) -> list[str] | None:
        """The objects of an output, None if one is gone."""
        try:
            made = [record.output.digest, *self._store.objects.files(record.output).values()]
        except StoreError:
            return None
        return made if self._there.issuperset(made) else None

    def _is_young(self, path: Path) -> bool:
        # The kernel alone sets this time: when it came here, or was last linked to.
        return path.stat().st_ctime > self._young_since_s


def _inputs(action: Action) -> list[str]:
    return [digest for many in action.inputs.values() for _, digest in many]


def _in_use(store: Store) -> set[str]:
    """The objects to which links lead in workspaces: what running stages read."""
    found: set[str] = set()
    for folder, folders, files in os.walk(store.root / "tmp"):
        for name in (*folders, *files):
            path = Path(folder) / name
            if path.is_symlink():
                found.add(path.readlink().name)
    return found


def _remove(store: Store, records: Iterable[Path], objects: Iterable[str]) -> None:
    """Records before the objects that they name; then what was placed for reading."""
    for path in records:
        path.unlink(missing_ok=True)
    gone = set(objects)
    for digest in gone:
        store.objects.path(digest).unlink(missing_ok=True)
    for folder in (store.root / "recordings").glob("*"):
        if folder.name in gone or not store.objects.path(folder.name).exists():
            shutil.rmtree(folder)
