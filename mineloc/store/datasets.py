"""Datasets: named, versioned sets of recordings in a store; what commands, surveys and the inbox call.

A recording is copied into a workspace and hashed on the way, then all that is new is moved into the store and
`latest` moved to the new version under the dataset's lock. So a refused or killed `add` leaves nothing, and of two at
the same time the second follows the first.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace as changed
from pathlib import Path

from mineloc.errors import StoreError
from mineloc.store.dataset_reader import SEQUENCE, VARIABLE, DatasetReader, store_root
from mineloc.store.digest import Json, canonical_json, sha256_of_text
from mineloc.store.refs import LATEST, split_reference
from mineloc.store.staging import Staged, stage, stage_text
from mineloc.store.store import Store
from mineloc.store.versions import Recording, Version, check_name, history, is_file_name, reached


class Datasets(DatasetReader):
    """The datasets of a store, to be read and changed."""

    @classmethod
    def open(cls, root: Path | None = None, *, create: bool = False) -> Datasets:
        """The datasets of the store at `root` (see `store_root`).

        Raises:
            StoreError: there is no store (unless `create`), or it is something else.
        """
        root = store_root(root)
        if not create and not (root / "LAYOUT").exists():
            raise StoreError(
                root, "no store", expected="one that `dataset add` made", todo=f"give --store, or set {VARIABLE}"
            )
        return cls(Store(root))

    def add(
        self,
        name: str,
        recordings: Mapping[str, Path],
        *,
        sequence: Path | None = None,
        health: Mapping[str, Json] | None = None,
        note: str = "",
        replace: bool = False,
    ) -> Version:
        """Add flights to a dataset; the version that holds them, the newest one if it holds them all already.

        Args:
            name: of the dataset; a new one is made.
            recordings: files or rosbag2 folders by flight id; they are copied.
            sequence: the sequence file of all of them.
            health: health reports (JSON) by flight id.
            note: one line, kept with the version.
            replace: a flight id that has other content gets the new one.

        Raises:
            StoreError: a name or a recording cannot be taken, or a flight id has other content.
            OutputError: the store cannot be written.
        """
        check_name(name, "dataset")
        for flight in recordings:
            check_name(flight, f"{name}: flight")
        if not recordings:
            raise StoreError(name, "no recording", expected="one or more", todo="name them")
        who = canonical_json([name, *(str(path.absolute()) for path in recordings.values())])
        with self.store.workspaces.hold(f"add-{sha256_of_text(who)}") as workspace:
            taken, files = self._stage(recordings, sequence, health or {}, workspace)
            with self._moving(name) as own:
                latest = self._latest(name)
                known = {} if latest is None else latest.flights()
                merged = [_merged(name, known.get(one.flight), one, replace=replace) for one in taken]
                used = {digest for one in merged for digest in (one.sha256, one.sequence, one.health)}
                for copy in files:
                    self.store.objects.commit(copy.files if copy.ref.digest in used else {})
                return self._advance(name, latest, known | {one.flight: one for one in merged}, note, own)

    def _stage(
        self, recordings: Mapping[str, Path], sequence: Path | None, health: Mapping[str, Json], workspace: Path
    ) -> tuple[list[Recording], list[Staged]]:
        """Copies of all files, and what a version would say of them."""
        told = None if sequence is None else stage(sequence, workspace / "sequence", self.store.index)
        taken: list[Recording] = []
        files: list[Staged] = [] if told is None else [told]
        for i, (flight, path) in enumerate(recordings.items()):
            copy = stage(path, workspace / f"{i}", self.store.index)
            report = _staged_report(health.get(flight), workspace / f"{i}.json")
            taken.append(_recording(flight, path, copy, told, report))
            files += [copy, *([] if report is None else [report])]
        return taken, files

    def refuse_other_content(
        self, name: str, recordings: Mapping[str, Path], *, sequence: Path | None = None, replace: bool = False
    ) -> None:
        """Say what `add` would say of flights that are known, before anything is computed or copied.

        Raises:
            StoreError: a name or a recording cannot be taken, or a flight id has other content.
        """
        check_name(name, "dataset")
        latest = self._latest(name)
        known = {} if latest is None else latest.flights()
        told = None if sequence is None else Staged(self.store.source(sequence), {})
        for flight, path in recordings.items():
            check_name(flight, f"{name}: flight")
            content = Staged(self.store.source(path), {})
            _merged(name, known.get(flight), _recording(flight, path, content, told, None), replace=replace)

    def keep_sequence(self, path: Path) -> Path:
        """Where a sequence file can be read as flights that are added with it will name it.

        Raises:
            StoreError: it cannot be read.
            OutputError: the store cannot be written.
        """
        return self._placed(self.store.add(path), SEQUENCE)

    def remove(self, name: str, flights: Collection[str], *, note: str = "") -> Version:
        """A version without some flights; earlier versions keep them.

        Raises:
            StoreError: there is no such dataset or flight.
        """
        self.get(name)
        with self._moving(name) as own:
            latest = self.get(name)
            known = latest.flights()
            for flight in flights:
                if known.pop(flight, None) is None:
                    raise StoreError(f"{name}@latest", f"no flight {flight!r}", expected=_one_of(latest))
            return self._advance(name, latest, known, note, own)

    def _latest(self, name: str) -> Version | None:
        version = self.refs.read(name)
        return None if version is None else self.version(version)

    def _advance(
        self, name: str, latest: Version | None, flights: Mapping[str, Recording], note: str, workspace: Path
    ) -> Version:
        recordings = tuple(flights[flight] for flight in sorted(flights))
        if latest is not None and latest.recordings == recordings:
            return latest
        version = Version(name, None if latest is None else latest.id, recordings, " ".join(note.split()))
        self.store.objects.commit(stage_text(version.manifest, workspace / "manifest").files)
        self.refs.move(name, LATEST, version.id, workspace)
        return version

    @contextmanager
    def _moving(self, name: str) -> Generator[Path]:
        """Within: nobody else moves the dataset's references, and nothing that is written is collected."""
        with self.store.gate.adding(), self.store.workspaces.hold(f"dataset-{name}") as workspace:
            yield workspace

    def tag(self, reference: str, tag: str, *, move: bool = False) -> Version:
        """Give a version a name of its own.

        Args:
            move: also if the tag names another version.

        Raises:
            StoreError: no such version, the tag cannot be taken, or names another version.
        """
        name, _ = split_reference(reference)
        check_name(tag, f"{name}: tag")
        if tag == LATEST:
            raise StoreError(f"{name}@latest", "is the newest version", expected="another tag")
        self.get(reference)
        with self._moving(name) as workspace:
            version = self.get(reference)
            now = self.refs.read(name, f"tags/{tag}")
            if now is not None and now != version.id and not move:
                raise StoreError(f"{name}@{tag}", f"names version {now[:12]}", todo="choose another tag, or move it")
            if now != version.id:
                self.refs.move(name, f"tags/{tag}", version.id, workspace)
        return version

    def untag(self, name: str, tag: str) -> None:
        """Take a tag away; the version stays while something else reaches it.

        Raises:
            StoreError: there is no such tag.
        """
        self.get(f"{name}@latest")
        with self._moving(name):
            if tag not in self.refs.tags(name):
                tags = ", ".join(self.refs.tags(name)) or "no tags"
                raise StoreError(f"{name}@{tag}", "no such tag", expected=tags)
            self.refs.remove(name, f"tags/{tag}")

    def forget(self, name: str) -> None:
        """Take a dataset away, with its tags and log; its recordings go with the next collection.

        Raises:
            StoreError: there is no such dataset.
        """
        self.get(name)
        with self._moving(name) as workspace:
            self.refs.forget(name, workspace)

    def land(
        self,
        name: str,
        version_id: str,
        files: Mapping[str, Path],
        *,
        tag: str | None = None,
    ) -> Version:
        """Take a version that comes from elsewhere; a dataset of that name only ever moves on.

        Args:
            files: objects in a workspace of this store, checked, by sha256.
            tag: also names it.

        Raises:
            StoreError: something of the version is missing, history would be lost, or the tag names another version.
        """
        check_name(name, "dataset")

        def read(digest: str) -> str:
            return files[digest].read_text() if digest in files else self.read_text(digest)

        with self._moving(name) as workspace:
            wanted = reached(read, version_id)
            for digest in wanted:
                if digest not in files and not self.store.objects.is_intact(digest):
                    raise StoreError(
                        f"{name}@{version_id[:12]}", f"object {digest[:12]} is not there", todo="get it anew"
                    )
            moves = self._refuse_lost_history(name, version_id, [one.id for one in history(read, version_id)])
            tagged = None if tag is None else self.refs.read(name, f"tags/{tag}")
            if tagged not in (None, version_id):
                raise StoreError(f"{name}@{tag}", f"names version {tagged[:12]} here", todo="take that tag away first")
            self.store.objects.commit({digest: files[digest] for digest in wanted if digest in files})
            if moves:
                self.refs.move(name, LATEST, version_id, workspace)
            if tag is not None and tagged is None:
                self.refs.move(name, f"tags/{check_name(tag, 'tag')}", version_id, workspace)
            return self.version(version_id)

    def _refuse_lost_history(self, name: str, version_id: str, before: Collection[str]) -> bool:
        """Whether `latest` moves to a version with that history."""
        latest = self.refs.read(name)
        if latest is None or (latest in before and latest != version_id):
            return True
        if any(one.id == version_id for one in history(self.read_text, latest)):
            return False
        raise StoreError(
            f"{name}@{version_id[:12]}",
            f"does not follow {name}@latest ({latest[:12]}), whose history would be lost",
            todo="import it as another dataset",
        )


def _staged_report(report: Json, path: Path) -> Staged | None:
    return None if report is None else stage_text(canonical_json(report), path)


def _recording(flight: str, path: Path, copy: Staged, told: Staged | None, report: Staged | None) -> Recording:
    file = path.absolute().name
    if not is_file_name(file):
        raise StoreError(path, "no file name", expected="a recording", todo="check the path")
    return Recording(
        flight=flight,
        file=file,
        sha256=copy.ref.digest,
        bytes=copy.ref.size_bytes,
        kind=copy.ref.kind,
        sequence=None if told is None else told.ref.digest,
        health=None if report is None else report.ref.digest,
    )


def _merged(name: str, known: Recording | None, new: Recording, *, replace: bool) -> Recording:
    """What a version holds of a flight that may be known. The same content keeps its first file name and report."""
    if known is None:
        return new
    if known.sha256 == new.sha256 and new.sequence in (None, known.sequence):
        return changed(known, health=known.health or new.health)
    if replace:
        return changed(new, sequence=new.sequence or known.sequence)
    other = "other content" if known.sha256 != new.sha256 else "another sequence file"
    raise StoreError(
        f"{name}: flight {new.flight}",
        f"is there with {other} (sha256 {known.sha256[:12]}, new {new.sha256[:12]})",
        todo="give it another flight id, or say that it replaces the one that is there",
    )


def _one_of(version: Version) -> str:
    return f"one of {', '.join(version.flights())}"
