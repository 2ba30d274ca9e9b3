"""What every noun does at birth."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from mineloc.data.arrays import F64


def freeze(obj: object) -> None:
    """Make the arrays of a frozen dataclass read-only."""
    for f in fields(obj):  # type: ignore[arg-type]
        value = getattr(obj, f.name)
        if isinstance(value, np.ndarray):
            view = value.view()
            view.flags.writeable = False
            object.__setattr__(obj, f.name, view)


def need(ok: bool, what: str) -> None:
    """Raise `ValueError(what)` unless `ok`."""
    if not ok:
        raise ValueError(what)


def is_rigid(T: F64) -> bool:
    """Whether (…, 4, 4) are finite rigid transforms, to 1e-6."""
    r = T[..., :3, :3]
    return bool(
        np.isfinite(T).all()
        and np.abs(r @ np.swapaxes(r, -1, -2) - np.eye(3)).max(initial=0.0) < 1e-6
        and (np.linalg.det(r) > 0).all()
    )
