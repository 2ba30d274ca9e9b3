"""Copies that are on their way into a store: hashed while they are written, not yet objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mineloc.errors import StoreError
from mineloc.output import one_line_errors
from mineloc.store.digest import DigestIndex, sha256_of_text
from mineloc.store.objects import Ref, files_below, tree_text


@dataclass(frozen=True, slots=True)
class Staged:
    """A copy of a file or folder in a workspace.

    Attributes:
        ref: its content.
        files: where each object to be lies, by sha256; a folder's tree last.
    """

    ref: Ref
    files: Mapping[str, Path]


def stage(path: Path, folder: Path, index: DigestIndex) -> Staged:
    """Copy a file or a folder into a workspace and hash it on the way.

    Args:
        folder: does not exist yet.

    Raises:
        StoreError: it cannot be read, or changed meanwhile; a folder holds something else than files and folders.
        OutputError: the disk is full, or fails.
    """
    _refuse_unreadable(path)
    with one_line_errors(folder):
        folder.mkdir(parents=True)
        if not path.is_dir():
            temp = folder / "0"
            digest = index.copy(path, temp)
            return Staged(Ref(digest, "file", temp.stat().st_size), {digest: temp})
        files: dict[str, Path] = {}
        tree: dict[str, tuple[str, int]] = {}
        for i, (name, file) in enumerate(files_below(path).items()):
            temp = folder / str(i)
            digest = index.copy(file, temp)
            tree[name] = (digest, temp.stat().st_size)
            files[digest] = temp
        text = stage_text(tree_text(tree), folder / "tree")
        return Staged(Ref(text.ref.digest, "folder", sum(size for _, size in tree.values())), {**files, **text.files})


def stage_text(text: str, path: Path) -> Staged:
    """Write a text that is to become an object.

    Raises:
        OutputError: the disk is full, or fails.
    """
    with one_line_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode())
    digest = sha256_of_text(text)
    return Staged(Ref(digest, "file", len(text.encode())), {digest: path})


def _refuse_unreadable(path: Path) -> None:
    """Before anything is copied; an error of the copy is then the store's."""
    try:
        for file in files_below(path).values() if path.is_dir() else (path,):
            file.open("rb").close()
    except OSError as error:
        raise StoreError(
            path, f"cannot be read ({error.strerror})", expected="a readable file or folder", todo="check the path"
        ) from error
