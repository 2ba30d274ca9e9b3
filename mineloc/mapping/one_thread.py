"""open3d on one thread: its registrations add up in the order in which threads come, and no two runs end in equal bits.

Rounding the result hides that until a digit lies on the edge: then a flight differs by a micrometre from run to run.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import open3d as o3d

_CREATE = "_ZN3tbb6detail2r16createERNS0_2d114global_controlE"
_DESTROY = "_ZN3tbb6detail2r17destroyERNS0_2d114global_controlE"
_MAX_ALLOWED_PARALLELISM = 0


class _GlobalControl(ctypes.Structure):
    """`tbb::global_control`, of which as many as like may live at a time; the least allowed parallelism counts."""

    _fields_ = (("value", ctypes.c_size_t), ("reserved", ctypes.c_ssize_t), ("parameter", ctypes.c_int))


@functools.cache
def _tbb() -> ctypes.CDLL | None:
    """The threads of open3d; None where it brings others than those of Linux."""
    found = sorted(Path(o3d.__file__).parent.glob("libtbb.so*"))
    if not found:
        return None
    library = ctypes.CDLL(str(found[0]))
    return library if hasattr(library, _CREATE) and hasattr(library, _DESTROY) else None


@contextmanager
def one_thread() -> Generator[None]:
    """Within: open3d computes in the calling thread alone, by a quarter slower and with the same result every time."""
    library = _tbb()
    if library is None:
        yield
        return
    control = _GlobalControl(1, 0, _MAX_ALLOWED_PARALLELISM)
    library[_CREATE](ctypes.byref(control))
    try:
        yield
    finally:
        library[_DESTROY](ctypes.byref(control))
