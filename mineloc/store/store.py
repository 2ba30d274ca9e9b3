"""The store: an action is executed once, and its result is found again by everything that it depends on.

Rules that make a crash at any moment harmless: work happens in a temporary folder of the same file system under the
action's lock; every file is flushed and renamed; objects are on the disk before the record that names them. So a
record is only ever followed to whole objects, and an interrupted action leaves a temporary and nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from mineloc.errors import StoreError
from mineloc.output import TEMP_PREFIX, new_file, one_line_errors
from mineloc.store.digest import DigestIndex, sha256_of_text
from mineloc.store.gate import Gate
from mineloc.store.objects import Objects, Ref, files_below, tree_text
from mineloc.store.record import Action, Record, Records, read_record
from mineloc.store.staging import stage
from mineloc.store.workspace import Workspaces

LAYOUT = "mineloc store 1\n"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run of an action gave.

    Attributes:
        output: the content; `Store.place` brings it to a folder.
        hit: it was known already and nothing was executed.
        seconds: how long the execution took, now or when it was made.
    """

    output: Ref
    hit: bool
    seconds: float


@dataclass(frozen=True, slots=True)
class Findings:
    """What `Store.verify` found; all empty when the store is sound.

    Attributes:
        damaged: objects that are not what their name says.
        missing: objects that an intact record or tree names and that are not there.
        records: record files that are damaged.
        refs: references that are damaged, `<dataset>/latest` or `<dataset>/tags/<tag>`.
    """

    damaged: tuple[str, ...]
    missing: tuple[str, ...]
    records: tuple[Path, ...]
    refs: tuple[str, ...] = ()

    @property
    def is_sound(self) -> bool:
        """Whether nothing was found."""
        return not (self.damaged or self.missing or self.records or self.refs)


class Store:
    """Objects, records and locks below one folder, which may be shared by processes and surveys.

    Raises:
        StoreError: the folder is something else.
        OutputError: it cannot be made.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.index = DigestIndex(root / "index")
        self.objects = Objects(root, self.index)
        self.records = Records(root)
        self.workspaces = Workspaces(root)
        self.gate = Gate(root)
        self._open()

    def _open(self) -> None:
        mark = self.root / "LAYOUT"
        with one_line_errors(self.root):
            if not mark.exists():
                self.root.mkdir(parents=True, exist_ok=True)
                others = any(not p.name.startswith((TEMP_PREFIX, mark.name)) for p in self.root.iterdir())
                # Asked again: another process may have made the store just now.
                if others and not mark.exists():
                    raise StoreError(self.root, "a folder that is not a store", todo="choose an empty folder")
                with new_file(mark, overwrite=True) as temp:
                    temp.write_text(LAYOUT)
            found = mark.read_text()
        if found != LAYOUT:
            raise StoreError(mark, repr(found.strip()), expected=LAYOUT.strip(), todo="use the mineloc that made it")

    def run(
        self,
        action: Action,
        execute: Callable[[Path], Path],
        *,
        volatile: Collection[str] = (),
        waiting: Callable[[], None] | None = None,
    ) -> Outcome:
        """The result of an action, from the store or by executing it; at most one process executes it at a time.

        Args:
            execute: takes an empty folder, works in it and returns the file or folder in it that is the result.
            volatile: files of a result folder that may differ although everything is the same.
            waiting: called once when another process is at it.

        Raises:
            OutputError: the store cannot be written.
            Exception: whatever `execute` raises; nothing is kept then.
        """
        known = self.lookup(action)
        if known is not None:
            return known
        with self.workspaces.hold(action.key, waiting=waiting) as workspace:
            known = self.lookup(action)
            if known is not None:
                return known
            self._discard_damage(action)
            start = time.perf_counter()
            with one_line_errors(self.root):
                output = execute(workspace)
            seconds = time.perf_counter() - start
            with self.gate.adding():
                ref = self.objects.adopt(output, volatile=volatile)
                record = self.records.write(action, ref, seconds, workspace=workspace)
        return Outcome(ref, hit=False, seconds=record.seconds)

    def lookup(self, action: Action) -> Outcome | None:
        """The known result of an action, None if there is none or if an object of it is gone or damaged."""
        record = self.records.read(action)
        if record is None or self._damage(record):
            return None
        return Outcome(record.output, hit=True, seconds=record.seconds)

    def _damage(self, record: Record) -> list[str]:
        try:
            return self.objects.damage(record.output)
        except StoreError:
            return [record.output.digest]

    def _discard_damage(self, action: Action) -> None:
        """What is made anew need not come out the same; what is damaged must not stay behind then."""
        record = self.records.read(action)
        for digest in self._damage(record) if record is not None else ():
            self.objects.discard(digest)

    def add(self, path: Path) -> Ref:
        """Bring a copy of a file or folder into the store; nothing keeps it there but its youth.

        Raises:
            StoreError: it cannot be read, or changed meanwhile.
            OutputError: the store cannot be written.
        """
        with self.workspaces.hold(f"add-{sha256_of_text(str(path.absolute()))}") as workspace:
            staged = stage(path, workspace / "staged", self.index)
            with self.gate.adding():
                self.objects.commit(staged.files)
        return staged.ref

    def source(self, path: Path) -> Ref:
        """The content of a file or folder outside, which stays there; unchanged files are not read again.

        Raises:
            StoreError: it cannot be read.
        """
        try:
            if path.is_dir():
                files = {name: (self.index.digest(f), f.stat().st_size) for name, f in files_below(path).items()}
                return Ref(sha256_of_text(tree_text(files)), "folder", sum(size for _, size in files.values()))
            return Ref(self.index.digest(path), "file", path.stat().st_size)
        except OSError as error:
            raise StoreError(
                path, f"cannot be read ({error.strerror})", expected="a readable file", todo="check the path"
            ) from error

    def place(self, ref: Ref, to: Path, *, beside: Collection[str] = ()) -> None:
        """Make a file or folder outside hold the content; see `Objects.place`."""
        self.objects.place(ref, to, beside=beside)

    def verify(self) -> Findings:
        """Re-hash every object, and follow every record and tree to its objects."""
        names = self.objects.digests()
        damaged = [name for name in names if not self.objects.is_intact(name, rehash=True)]
        broken: list[Path] = []
        wanted: set[str] = set()
        for path in self.records.paths():
            record = read_record(path)
            if record is None:
                broken.append(path)
                continue
            wanted |= {record.output.digest, *record.output.volatile.values()}
            if record.output.digest in names and record.output.digest not in damaged:
                wanted |= set(self.objects.files(record.output).values())
        return Findings(tuple(damaged), tuple(sorted(wanted - set(names))), tuple(broken))

    def sweep(self) -> list[str]:
        """Remove the temporary folders of killed processes; those of living ones stay."""
        return self.workspaces.sweep()
