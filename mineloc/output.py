"""Results appear whole or not at all: written beside their place, flushed to the disk, then renamed.

A crash, a full disk or Ctrl-C leaves at most a hidden temporary that the next run may delete.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from mineloc.errors import OutputError

TEMP_PREFIX = ".mineloc-tmp-"


@contextmanager
def new_file(path: Path, *, overwrite: bool = False) -> Generator[Path]:
    """Yield a temporary path beside `path`; on success it is fsynced and renamed to `path`, on failure removed.

    Raises:
        OutputError: `path` exists (unless `overwrite`), the folder is missing or not writable, the disk is full.
    """
    path = Path(path)
    if path.is_dir():
        raise OutputError(path, "is a folder", expected="a file name", todo="choose another --out")
    _refuse_existing(path, overwrite=overwrite)
    with one_line_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=TEMP_PREFIX, suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temp = Path(name)
        try:
            yield temp
            os.chmod(temp, 0o644)
            fsync_path(temp)
            temp.replace(path)
            fsync_path(path.parent)
        except BaseException:
            with suppress(OSError):
                temp.unlink(missing_ok=True)
            raise


@contextmanager
def new_folder(path: Path, *, overwrite: bool = False) -> Generator[Path]:
    """Yield a temporary folder beside `path`; on success its files are fsynced and it becomes `path`.

    Raises:
        OutputError: `path` exists (unless `overwrite`), is a file, or cannot be written.
    """
    path = Path(path)
    if path.is_file():
        raise OutputError(path, "is a file", expected="a folder name", todo="choose another --out")
    if path.is_dir() and any(path.iterdir()):
        _refuse_existing(path, overwrite=overwrite)
    with one_line_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temp = Path(tempfile.mkdtemp(prefix=TEMP_PREFIX, dir=path.parent))
        try:
            yield temp
            os.chmod(temp, 0o755)
            for file in sorted(temp.rglob("*")):
                if file.is_file():
                    fsync_path(file)
            _replace_folder(temp, path)
            fsync_path(path.parent)
        except BaseException:
            shutil.rmtree(temp, ignore_errors=True)
            raise


def _replace_folder(temp: Path, path: Path) -> None:
    if not path.exists():
        temp.replace(path)
        return
    old = Path(tempfile.mkdtemp(prefix=TEMP_PREFIX, dir=path.parent))
    path.replace(old / "old")
    try:
        temp.replace(path)
    except OSError:
        (old / "old").replace(path)
        raise
    finally:
        shutil.rmtree(old, ignore_errors=True)


def fsync_path(path: Path) -> None:
    """Flush a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _refuse_existing(path: Path, *, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise OutputError(path, "exists", expected="a new name", todo="choose another --out or remove it")


@contextmanager
def one_line_errors(path: Path) -> Generator[None]:
    """Within: a full disk, a missing permission or a failing device becomes one `OutputError` line about `path`."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise OutputError(path, "the disk is full", todo="free space and run again; nothing was written") from error
        if error.errno == errno.EFBIG:
            raise OutputError(
                path, "larger than the file system allows", todo="choose another --out; nothing was written"
            ) from error
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            raise OutputError(
                path, f"cannot be written ({os.strerror(error.errno)})", todo="check the permissions of the folder"
            ) from error
        if error.errno == errno.EIO:
            raise OutputError(path, "input/output error", todo="check the disk; nothing was written") from error
        raise
