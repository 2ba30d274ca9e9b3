"""Files and folders under the hash of their content: `objects/ab/<sha256>`, read-only, written once.

A folder is a *tree*: a JSON object of its own that lists path, hash and size of every file. Files of which a stage
says that they change from run to run although nothing else does (timings) are *volatile*: they are kept and come back
with the folder, but are no part of its identity.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mineloc.errors import OutputError, StoreError
from mineloc.output import TEMP_PREFIX, fsync_path, new_folder, one_line_errors
from mineloc.store.digest import DigestIndex, Json, canonical_json, is_digest, sha256_of_file

READ_ONLY = 0o444
_FICLONE = 0x40049409  # Linux: share the blocks of another file until one of the two is written


@dataclass(frozen=True, slots=True)
class Ref:
    """Which content: small, and all that stages, flows and records hand to each other.

    Attributes:
        digest: sha256 of the file, or of the folder's tree.
        kind: what it is.
        size_bytes: sum of the files' sizes, volatile ones left out.
        volatile: path and sha256 of a folder's files that are no part of its identity.
    """

    digest: str
    kind: Literal["file", "folder"]
    size_bytes: int
    volatile: Mapping[str, str] = field(default_factory=dict)


class Objects:
    """The objects below a store's root; all its folders must be on one file system, commits are renames."""

    def __init__(self, root: Path, index: DigestIndex) -> None:
        self._folder = root / "objects"
        self._index = index

    def path(self, digest: str) -> Path:
        """Where the object lies, whether it exists or not."""
        return self._folder / digest[:2] / digest

    def digests(self) -> list[str]:
        """The names of all objects, sorted."""
        return sorted(p.name for p in self._folder.glob("??/*"))

    def adopt(self, path: Path, *, volatile: Collection[str] = ()) -> Ref:
        """Move a file or folder, written on the same file system and used by nobody else, into the store.

        Raises:
            StoreError: it holds something else than files and folders.
            OutputError: the disk is full, or fails.
        """
        with one_line_errors(self._folder):
            if path.is_file():
                size = path.stat().st_size
                return Ref(self._commit(path, sha256_of_file(path)), "file", size)
            return self._adopt_folder(path, volatile)

    def commit(self, files: Mapping[str, Path]) -> None:
        """Move files, hashed while they were written on the same file system, into the store; in the order given.

        Args:
            files: by sha256.

        Raises:
            OutputError: the disk is full, or fails.
        """
        with one_line_errors(self._folder):
            for digest, temp in files.items():
                self._commit(temp, digest)

    def _adopt_folder(self, folder: Path, volatile: Collection[str]) -> Ref:
        files: dict[str, tuple[str, int]] = {}
        apart: dict[str, str] = {}
        total = 0
        for name, file in files_below(folder).items():
            size = file.stat().st_size
            digest = self._commit(file, sha256_of_file(file))
            if name in volatile:
                apart[name] = digest
            else:
                files[name] = (digest, size)
                total += size
        tree = folder.with_name(folder.name + ".tree")
        tree.write_text(tree_text(files))
        return Ref(self._commit(tree, sha256_of_file(tree)), "folder", total, apart)

    def _commit(self, temp: Path, digest: str) -> str:
        """Rename a finished file to its object; an object of that name, damaged or not, is replaced by the same."""
        target = self.path(digest)
        os.chmod(temp, READ_ONLY)
        fsync_path(temp)
        if not target.parent.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            fsync_path(self._folder)
        temp.replace(target)
        fsync_path(target.parent)
        self._index.remember(target, digest)
        return digest

    def files(self, ref: Ref) -> dict[str, str]:
        """Path and sha256 of every file of a folder, volatile ones with them; of a file, itself under the empty path.

        Raises:
            StoreError: the tree is gone or damaged.
        """
        if ref.kind == "file":
            return {"": ref.digest}
        if not all(_is_inside(name) for name in ref.volatile):
            raise _damaged(self.path(ref.digest), "files outside of its folder")
        return tree_files(self.read_text(ref.digest), self.path(ref.digest)) | dict(ref.volatile)

    def damage(self, ref: Ref) -> list[str]:
        """The objects of a ref that are gone or are not what their name says, as far as the file system tells."""
        if ref.kind == "folder" and not self.is_intact(ref.digest):
            return [ref.digest]
        return [digest for digest in sorted(set(self.files(ref).values())) if not self.is_intact(digest)]

    def is_intact(self, digest: str, *, rehash: bool = False) -> bool:
        """Whether the object exists and is what its name says; unchanged files are believed unless `rehash`."""
        path = self.path(digest)
        try:
            if rehash:
                return sha256_of_file(path) == digest
            return self._index.digest(path) == digest
        except OSError:
            return False

    def discard(self, digest: str) -> None:
        """Remove an object if it is damaged."""
        with one_line_errors(self._folder):
            if not self.is_intact(digest, rehash=True):
                self.path(digest).unlink(missing_ok=True)

    def expose(self, ref: Ref, to: Path) -> Path:
        """Let a stage read the content at `to`: symbolic links, which cost nothing and cannot be written through.

        Raises:
            StoreError: an object is gone or damaged.
        """
        for digest in self.damage(ref):
            raise _damaged(self.path(digest), "gone or damaged")
        if ref.kind == "folder":
            to.mkdir(parents=True)
        for name, digest in self.files(ref).items():
            link = to / name if name else to
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(os.path.abspath(self.path(digest)))
        return to

    def place(self, ref: Ref, to: Path, *, beside: Collection[str] = ()) -> None:
        """Make `to` hold the content: shared blocks, else a hard link (then read-only), else a copy.

        What is right already stays. A folder is replaced whole when anything in it differs, except for files
        named in `beside`, which others put there.

        Raises:
            StoreError: an object is gone or damaged.
            OutputError: `to` cannot be written.
        """
        for digest in self.damage(ref):
            raise _damaged(self.path(digest), "gone or damaged")
        files = self.files(ref)
        with one_line_errors(to):
            if ref.kind == "file":
                self._place_file(ref.digest, to)
            elif not self._holds(to, files, beside):
                with new_folder(to, overwrite=True) as temp:
                    for name, digest in files.items():
                        self._place_file(digest, temp / name)

    def _holds(self, folder: Path, files: Mapping[str, str], beside: Collection[str]) -> bool:
        if not folder.is_dir():
            return False
        there = files_below(folder)
        return set(there) - set(files) <= set(beside) and all(
            name in there and self._same(there[name], digest) for name, digest in files.items()
        )

    def _same(self, path: Path, digest: str) -> bool:
        if not path.is_file() or path.is_symlink():
            return False
        source = self.path(digest)
        if path.samefile(source):
            return True
        return path.stat().st_size == source.stat().st_size and self._index.digest(path) == digest

    def _place_file(self, digest: str, to: Path) -> None:
        if self._same(to, digest):
            return
        if to.is_dir():
            raise OutputError(to, "is a folder", expected="a file name", todo="remove it or choose another --out")
        source = self.path(digest)
        to.parent.mkdir(parents=True, exist_ok=True)
        temp = to.with_name(f"{TEMP_PREFIX}{os.getpid()}-{digest[:16]}")
        temp.unlink(missing_ok=True)
        try:
            _share(source, temp)
            temp.replace(to)
        except BaseException:
            temp.unlink(missing_ok=True)
            raise
        # A new hard link changes the object's status-change time, but not what we know of it.
        self._index.remember(source, digest)
        self._index.remember(to, digest)

    def read_text(self, digest: str) -> str:
        """A small object as text (a tree, a manifest), checked by its hash.

        Raises:
            StoreError: it is gone or damaged.
        """
        try:
            content = self.path(digest).read_bytes()
            if hashlib.sha256(content).hexdigest() == digest:
                return content.decode()
        except (OSError, UnicodeDecodeError):
            pass
        raise _damaged(self.path(digest), "gone or damaged")


def tree_text(files: Mapping[str, tuple[str, int]]) -> str:
    """The tree of a folder: its sha256 is the folder's name.

    Args:
        files: sha256 and size, by path relative to the folder (with `/`).
    """
    entries: dict[str, Json] = {name: {"bytes": size, "sha256": sha} for name, (sha, size) in files.items()}
    return canonical_json({"files": entries, "tree": 1})


def tree_files(text: str, where: Path) -> dict[str, str]:
    """The sha256 of every file of a tree, by path.

    Raises:
        StoreError: it is no tree, or leads out of its folder.
    """
    try:
        files = {str(name): str(entry["sha256"]) for name, entry in json.loads(text)["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise _damaged(where, "not a tree") from None
    if any(not _is_inside(name) or not is_digest(digest) for name, digest in files.items()):
        raise _damaged(where, "not a tree")
    return files


def _is_inside(name: str) -> bool:
    return all(part not in ("", ".", "..") for part in name.split("/")) and "\0" not in name


def files_below(folder: Path) -> dict[str, Path]:
    """Relative path (with `/`) and path of every file below a folder, sorted.

    Raises:
        StoreError: something below it is neither file nor folder (a link, a pipe).
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise StoreError(path, "neither a file nor a folder", expected="plain files", todo="remove it")
        if path.is_file():
            found[path.relative_to(folder).as_posix()] = path
    return found


def _share(source: Path, target: Path) -> None:
    """The content of `source` at `target`, as cheaply as the file system can."""
    with source.open("rb") as reading, target.open("xb") as writing:
        try:
            fcntl.ioctl(writing.fileno(), _FICLONE, reading.fileno())
            return
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
                raise
    target.unlink()
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP):
            raise
        shutil.copyfile(source, target)
    fsync_path(target)


def _damaged(path: Path, found: str) -> StoreError:
    return StoreError(path, found, expected="an intact object", todo="run again, it is made anew")
