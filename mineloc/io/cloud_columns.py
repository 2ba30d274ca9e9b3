"""What all files of a map have in common: columns a point, and who and where they are, told in words.

float32 keeps 3 cm of an easting of half a million metres and half a metre of a northing of seven million. So files
that hold float32 hold positions relative to an origin, and every file tells its unit, its frame and that origin.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mineloc.data import F32, F64, MapCloud, SurfaceKind
from mineloc.errors import FormatError

Rows = NDArray[Any]

POSITION = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
KNOWN = (("count", "<i4"), ("visits", "<i4"), ("thickness", "<f4"), ("near", "<f4"), ("surface", "u1"))
"""Measured points, keyframes that saw it, σ across the surface (m), least distance seen from (m), `SurfaceKind`."""
FARTHEST_M = 1e7


@dataclass(frozen=True, slots=True)
class Told:
    """What the words in a file say.

    Attributes:
        origin_m: (3,) as a tuple; None: not told.
        frame: name, empty: not told.
        voxel_m: NaN: not told.
        relative: positions are relative to the origin.
    """

    origin_m: tuple[float, float, float] | None = None
    frame: str = ""
    voxel_m: float = field(default=float("nan"))
    relative: bool = False


def placed(cloud: MapCloud, origin_m: F64 | None, frame: str | None) -> tuple[F64, str]:
    """Where a cloud's own origin lies in the frame that a file tells, and the name of that frame."""
    shift = np.zeros(3) if origin_m is None else np.asarray(origin_m, dtype=np.float64)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise ValueError(f"origin_m must be three finite numbers, not {origin_m}")
    name = cloud.frame if frame is None else frame
    if not name or len(name.split()) != 1:
        raise ValueError(f"a frame is one word, not {name!r}")
    return cloud.origin_m + shift, name


def words(origin_m: F64, frame: str, voxel_m: float, *, relative: bool) -> list[str]:
    """Lines for comments."""
    lines = [
        "mineloc map",
        "unit metre",
        f"frame {frame}",
        f"origin_m {' '.join(repr(float(value)) for value in origin_m)}",
        f"voxel_m {voxel_m!r}",
        f"surface {' '.join(f'{kind.value}={kind.name.lower()}' for kind in SurfaceKind)}",
    ]
    return [*lines, "positions relative to origin_m"] if relative else lines


def heard(path: Path, lines: Iterable[str]) -> Told:
    """What comments say.

    Raises:
        FormatError: another unit, an origin that is not three numbers.
    """
    origin: tuple[float, float, float] | None = None
    frame, voxel, relative = "", float("nan"), False
    for line in lines:
        head, *rest = line.split() or [""]
        try:
            if head == "unit" and rest != ["metre"]:
                raise FormatError(path, f"unit {' '.join(rest)}", expected="metre", todo="convert the file")
            if head == "frame" and len(rest) == 1:
                frame = rest[0]
            elif head == "origin_m":
                x, y, z = (float(value) for value in rest)
                origin = (x, y, z)
                if not np.isfinite(origin).all():
                    raise ValueError
            elif head == "voxel_m":
                voxel = float(rest[0])
            elif line == "positions relative to origin_m":
                relative = True
        except (ValueError, IndexError):
            raise FormatError(path, f"comment {line!r}", expected="numbers", todo="correct the header") from None
    return Told(origin, frame, voxel, relative)


def rows_of(cloud: MapCloud, positions: F32 | F64) -> Rows:
    """(n,) structured: positions, normals and what is known of each point, little endian, without gaps."""
    kind = "<f4" if positions.dtype == np.float32 else "<f8"
    dtype = [(name, kind) for name in POSITION] + [(name, "<f4") for name in NORMALS] + list(KNOWN)
    out = np.empty(len(cloud), dtype)
    for axis in range(3):
        out[POSITION[axis]] = positions[:, axis]
        out[NORMALS[axis]] = cloud.normals[:, axis]
    values = (cloud.counts, cloud.visits, cloud.thickness_m, cloud.near_m, cloud.surface)
    for (name, _), column in zip(KNOWN, values, strict=True):
        out[name] = column
    return out


def cloud_of(path: Path, rows: Rows, told: Told) -> MapCloud:
    """A map of the rows of a file; what a file does not tell is 0, unknown lengths are NaN.

    Raises:
        FormatError: no positions, or such as are not finite.
    """
    names = rows.dtype.names or ()
    if not set(POSITION) <= set(names):
        raise FormatError(path, f"columns {', '.join(names)}", expected="x, y, z", todo="this is no cloud")
    with np.errstate(invalid="ignore"):  # a signalling NaN
        positions = np.stack([rows[name].astype(np.float64) for name in POSITION], axis=1)
    if not np.isfinite(positions).all():
        raise FormatError(path, "positions that are not finite", expected="numbers", todo="remove those points")
    if told.origin_m is not None:
        origin = np.array(told.origin_m)
    else:
        origin = np.round(positions.mean(axis=0)) if len(rows) else np.zeros(3)
    if not told.relative:
        positions = positions - origin
    if np.abs(positions).max(initial=0.0) > FARTHEST_M:
        raise FormatError(path, "points more than 10 000 km apart", expected="a mine", todo="check unit and origin")
    # columns of other programs may hold what ours cannot
    with np.errstate(over="ignore", invalid="ignore"):
        normals = np.zeros((len(rows), 3), np.float32)
        if set(NORMALS) <= set(names):
            normals = np.stack([rows[name].astype(np.float32) for name in NORMALS], axis=1)
        unknown = {"count": 1, "thickness": np.nan, "near": np.nan}
        known = {
            name: (rows[name] if name in names else np.full(len(rows), unknown.get(name, 0))).astype(np.dtype(kind))
            for name, kind in KNOWN
        }
    return MapCloud(
        origin_m=origin,
        points_m=positions.astype(np.float32),
        normals=normals,
        counts=known["count"],
        visits=known["visits"],
        thickness_m=known["thickness"],
        near_m=known["near"],
        surface=known["surface"],
        voxel_m=told.voxel_m,
        frame=told.frame or "map",
    )
