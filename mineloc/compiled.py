"""numba, with a cache that cannot be stale.

numba keys a cached kernel by its own file alone: when a function that it calls *in another file* changes, the old
machine code is used without a word. Here the cache folder carries the digest of every file with a kernel, so a change
in any of them compiles all anew (about half a minute, once).

Kernel modules write `from mineloc.compiled import njit, prange` in place of importing numba.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from pathlib import Path

import numba
from numba import prange as prange

_KEPT_S = 30 * 86400.0


def _sources() -> list[Path]:
    return [path for path in sorted(Path(__file__).parent.rglob("*.py")) if b"njit" in path.read_bytes()]


def cache_folder() -> Path:
    """The folder of machine code that belongs to the sources as they are now."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in _sources():
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "mineloc" / "numba" / digest.hexdigest()[:16]


def _use_own_cache() -> None:
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        for other in folder.parent.iterdir():
            if time.time() - other.stat().st_mtime > _KEPT_S:
                shutil.rmtree(other, ignore_errors=True)
    except OSError:
        return  # a home that cannot be written: numba finds a place of its own
    numba.config.CACHE_DIR = str(folder)  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


def _prefer_openmp() -> None:
    """open3d brings a TBB that is too old for numba, which would try it first and warn."""
    if not os.environ.get("NUMBA_THREADING_LAYER_PRIORITY"):
        layers = ["omp", "workqueue", "tbb"]
        numba.config.THREADING_LAYER_PRIORITY = layers  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


def _wait_asleep() -> None:
    """OpenMP's threads wait for each other by spinning; where anything else wants a core, they spin most of the time.

    Beside two other busy processes on two cores, odometry that waits asleep is twice as fast and takes a quarter of the
    CPU time; alone it is as fast. OpenMP reads this when its first parallel loop begins.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


_use_own_cache()
_prefer_openmp()
_wait_asleep()
njit = numba.njit
