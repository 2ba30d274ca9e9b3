"""A second place for objects: any URL that fsspec knows (S3, a network folder, memory).

It is laid out like a store, `objects/ab/<sha256>` and `refs/datasets/...`, without locks: two that push different
versions of one dataset at the same moment are not kept apart, only one after the other. What arrives is read back and
hashed; what is fetched is hashed on the way in.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Generator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

from mineloc.errors import MinelocError, StoreError
from mineloc.output import new_file, one_line_errors
from mineloc.store.digest import BLOCK_BYTES
from mineloc.store.refs import move_text, parse_move

REMEMBERED = "remote"


class Remote:
    """A place behind a URL.

    Args:
        url: as fsspec writes it: `s3://bucket/folder`, `file:///mnt/nas/store`, `memory://store`.

    Raises:
        StoreError: no URL. Whether fsspec knows it is seen when it is used.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        if "://" not in url:
            raise StoreError(url, "no URL", expected="s3://, file://, …", todo="write file:///FOLDER for a folder")

    @cached_property
    def _place(self) -> tuple[Any, str]:
        """The file system and the folder in it; found when it is needed, a remembered remote may never be."""
        from fsspec.core import url_to_fs

        with self._one_line(self.url):
            return url_to_fs(self.url)

    @property
    def _fs(self) -> Any:
        return self._place[0]

    @property
    def _root(self) -> str:
        return self._place[1]

    def has(self, digest: str, size: int) -> bool:
        """Whether an object of that name and size lies there."""
        path = self._object(digest)
        with self._one_line(path):
            try:
                return int(self._fs.info(path)["size"]) == size
            except FileNotFoundError:
                return False

    def put(self, digest: str, source: Path, *, check: bool = True) -> None:
        """Bring an object there: written under another name, then renamed.

        Args:
            check: read back and hashed before it is renamed.

        Raises:
            StoreError: the object is not what its name says, here or there, or the remote fails.
        """
        path = self._object(digest)
        temp = f"{self._root}/tmp/{uuid.uuid4().hex}"
        with self._one_line(path):
            self._make_folders(temp, path)
            try:
                with source.open("rb") as reading, self._fs.open(temp, "wb") as writing:
                    sent = _copy(reading, writing)
                if sent != digest:
                    raise StoreError(source, "damaged", expected="an intact object", todo="import or pull it anew")
                if check and self._hash(temp) != digest:
                    raise StoreError(self.url, f"object {digest[:12]} arrived damaged", todo="push again")
                self._fs.mv(temp, path)
            except BaseException:
                self._forget(temp)
                raise

    def fetch(self, digest: str, to: Path) -> bool:
        """Write an object to a file; False if it does not lie there.

        Raises:
            StoreError: it is damaged there, or the remote fails.
        """
        path = self._object(digest)
        with self._one_line(path):
            try:
                reading = self._fs.open(path, "rb")
            except FileNotFoundError:
                return False
            with reading, one_line_errors(to), to.open("wb") as writing:
                found = _copy(reading, writing)
        if found != digest:
            raise StoreError(path, "damaged", expected="an intact object", todo="push it anew from where it is whole")
        return True

    def read_ref(self, dataset: str, ref: str) -> str | None:
        """The version that a reference names there, None if there is none.

        Raises:
            StoreError: it is damaged, or the remote fails.
        """
        path = self._ref(dataset, ref)
        with self._one_line(path):
            try:
                text = bytes(self._fs.cat_file(path)).decode(errors="replace")
            except FileNotFoundError:
                return None
        move = parse_move(text)
        if move is None:
            raise StoreError(path, "a damaged reference", todo="push it anew")
        return move.version

    def write_ref(self, dataset: str, ref: str, version: str) -> None:
        """Let a reference name a version there."""
        path = self._ref(dataset, ref)
        before = self.read_ref(dataset, ref)
        with self._one_line(path):
            temp = f"{self._root}/tmp/{uuid.uuid4().hex}"
            self._make_folders(temp, path)
            self._fs.pipe_file(temp, move_text(ref, version, before).encode())
            self._fs.mv(temp, path)

    def remember(self, root: Path) -> None:
        """Note it as the remote of a store.

        Raises:
            OutputError: the store cannot be written.
        """
        with new_file(root / REMEMBERED, overwrite=True) as temp:
            temp.write_text(f"{self.url}\n")

    def _object(self, digest: str) -> str:
        return f"{self._root}/objects/{digest[:2]}/{digest}"

    def _ref(self, dataset: str, ref: str) -> str:
        return f"{self._root}/refs/datasets/{dataset}/{ref}"

    def _make_folders(self, *paths: str) -> None:
        for path in paths:
            self._fs.makedirs(path.rpartition("/")[0], exist_ok=True)

    def _hash(self, path: str) -> str:
        # Caches of listings and contents would tell what was sent, not what arrived.
        self._fs.invalidate_cache()
        with self._fs.open(path, "rb") as reading:
            return _copy(reading, None)

    def _forget(self, temp: str) -> None:
        try:
            self._fs.rm_file(temp)
        except Exception:  # noqa: BLE001  # each protocol has its own errors, and the first one is what matters
            return

    @contextmanager
    def _one_line(self, where: str) -> Generator[None]:
        """Within: whatever the protocol's library raises becomes one line."""
        try:
            yield
        except MinelocError:
            raise
        except ImportError as error:
            raise StoreError(where, str(error), todo="install the library for it, e.g. mineloc[s3]") from error
        except Exception as error:
            found = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            raise StoreError(where, found, expected="a remote that can be used", todo="check URL and access") from error


def remembered_remote(root: Path) -> Remote | None:
    """The remote of a store, None if it has none."""
    try:
        url = (root / REMEMBERED).read_text().strip()
    except FileNotFoundError:
        return None
    return Remote(url) if url else None


def _copy(reading: Any, writing: Any) -> str:
    sha = hashlib.sha256()
    while block := reading.read(BLOCK_BYTES):
        sha.update(block)
        if writing is not None:
            writing.write(block)
    return sha.hexdigest()
