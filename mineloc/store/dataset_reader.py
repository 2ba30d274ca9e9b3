"""Looking into datasets: which there are, which version a reference names, where its recordings can be read."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mineloc.errors import StoreError
from mineloc.store.objects import Ref
from mineloc.store.refs import LATEST, Refs, split_reference
from mineloc.store.remote import Remote, remembered_remote
from mineloc.store.store import Findings, Store
from mineloc.store.versions import Recording, Version, history, named, parse_version

VARIABLE = "MINELOC_STORE"
DEFAULT = Path(".mineloc") / "store"
SHORTEST_ID = 4
# Under one name wherever it came from: a stage's key holds the names of its inputs.
SEQUENCE = "sequence.toml"


@dataclass(frozen=True, slots=True)
class Entry:
    """A dataset as `list` shows it.

    Attributes:
        latest: its newest version.
        versions: how many there are, from the first to the newest.
        tags: the ids of versions by tag.
    """

    name: str
    latest: Version
    versions: int
    tags: Mapping[str, str]


class DatasetReader:
    """The datasets of a store, to be read.

    Args:
        store: where they are kept.
        remote: where objects are fetched from that are missing here; None: the one that the store remembers, if any.
    """

    def __init__(self, store: Store, *, remote: Remote | None = None) -> None:
        self.store = store
        self.refs = Refs(store.root)
        self.remote = remote if remote is not None else remembered_remote(store.root)

    def list(self) -> list[Entry]:
        """All datasets, by name.

        Raises:
            StoreError: a reference or a manifest is gone or damaged.
        """
        return [self._entry(name) for name in self.refs.datasets()]

    def _entry(self, name: str) -> Entry:
        latest = self.get(name)
        tags = {tag: self._known(name, f"tags/{tag}") for tag in self.refs.tags(name)}
        return Entry(name, latest, sum(1 for _ in history(self.read_text, latest.id)), tags)

    def get(self, reference: str) -> Version:
        """A version by `name`, `name@latest`, `name@tag` or `name@<beginning of its id>`.

        Raises:
            StoreError: there is none, or several; with those that there are.
        """
        name, which = split_reference(reference)
        if name not in self.refs.datasets():
            names = ", ".join(self.refs.datasets()) or "none yet"
            raise StoreError(self.store.root, f"no dataset {name!r}", expected=f"one of: {names}")
        if which == LATEST:
            return self.version(self._known(name, LATEST))
        tagged = self.refs.read(name, f"tags/{which}") if which in self.refs.tags(name) else None
        if tagged is not None:
            return self.version(tagged)
        return self._by_id(name, which)

    def _known(self, name: str, ref: str) -> str:
        version = self.refs.read(name, ref)
        if version is None:
            raise StoreError(f"{name}@{ref}", "was taken away meanwhile", todo="run again")
        return version

    def _by_id(self, name: str, beginning: str) -> Version:
        known = {version.id: version for version in self.versions(name)}
        found = [one for one in known if one.startswith(beginning)] if len(beginning) >= SHORTEST_ID else []
        if len(found) == 1:
            return known[found[0]]
        where = f"{name}@{beginning}"
        if found:
            several = ", ".join(one[: len(beginning) + 4] for one in found)
            raise StoreError(where, f"the beginning of {len(found)} versions", expected=several, todo="give more of it")
        tags = ", ".join(self.refs.tags(name)) or "no tags"
        some = ", ".join(one[:12] for one in list(known)[:5]) + (", …" if len(known) > 5 else "")
        raise StoreError(where, "no such version", expected=f"latest, a tag ({tags}) or an id ({some})")

    def versions(self, name: str) -> list[Version]:
        """All versions that the dataset's references reach, newest first along each.

        Raises:
            StoreError: a reference or a manifest is gone or damaged.
        """
        found: dict[str, Version] = {}
        for ref in (ref for dataset, ref in self.refs.all() if dataset == name):
            for version in history(self.read_text, self._known(name, ref)):
                if version.id in found:
                    break
                found[version.id] = version
        return list(found.values())

    def version(self, version_id: str) -> Version:
        """A version by its whole id.

        Raises:
            StoreError: its manifest is gone or damaged.
        """
        return parse_version(self.read_text(version_id), f"version {version_id[:12]}")

    def read_text(self, digest: str) -> str:
        """A small object as text; fetched from the remote where it is missing."""
        self._fetch([digest])
        return self.store.objects.read_text(digest)

    def path(self, recording: Recording) -> Path:
        """Where a recording can be read, under the file name that it came with.

        Raises:
            StoreError: it is gone or damaged, and no remote has it.
        """
        self._fetch([recording.sha256])
        if recording.kind == "folder":
            self._fetch(self.store.objects.files(recording.ref).values())
        return self._placed(recording.ref, recording.file)

    def sequence_path(self, recording: Recording) -> Path | None:
        """Where its sequence file can be read, None if it has none.

        Raises:
            StoreError: it is gone or damaged, and no remote has it.
        """
        if recording.sequence is None:
            return None
        self._fetch([recording.sequence])
        return self._placed(Ref(recording.sequence, "file", 0), SEQUENCE)

    def health(self, recording: Recording) -> dict[str, Any] | None:
        """Its health report, None if it has none.

        Raises:
            StoreError: it is gone or damaged, and no remote has it.
        """
        return None if recording.health is None else json.loads(self.read_text(recording.health))

    def _placed(self, ref: Ref, file: str) -> Path:
        with self.store.gate.adding():
            to = self.store.root / "recordings" / ref.digest / file
            self.store.place(ref, to)
        return to

    def _fetch(self, digests: Collection[str]) -> None:
        """Bring what is missing or damaged here from the remote, if there is one."""
        if self.remote is None:
            return
        for digest in dict.fromkeys(digests):
            if self.store.objects.is_intact(digest):
                continue
            with self.store.workspaces.hold(f"fetch-{digest}") as workspace:
                if self.remote.fetch(digest, workspace / "object"):
                    self.store.objects.commit({digest: workspace / "object"})

    def verify(self) -> Findings:
        """Re-hash every object, and follow every record and reference to what it names."""
        found = self.store.verify()
        objects = self.store.objects
        wanted = set(found.missing)
        broken: list[str] = []
        for dataset, ref in self.refs.all():
            try:
                version = self.refs.read(dataset, ref)
            except StoreError:
                broken.append(f"{dataset}/{ref}")
                continue
            wanted |= set() if version is None else named(objects.read_text, version).keys()
        return replace(found, missing=tuple(sorted(wanted - set(objects.digests()))), refs=tuple(broken))

    def lacking(self, version_id: str) -> list[str]:
        """The objects of a version and its history that are gone or damaged; every one is read."""
        objects = self.store.objects
        wanted = named(objects.read_text, version_id)
        return [digest for digest in sorted(wanted) if not objects.is_intact(digest, rehash=True)]


def store_root(given: Path | None = None) -> Path:
    """The folder of the store: what was given, else the environment's word, else the one in the current folder."""
    return given if given is not None else Path(os.environ.get(VARIABLE) or DEFAULT)
