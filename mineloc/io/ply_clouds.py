"""Maps as PLY: binary, little endian, positions in double so that any program sees the mine grid."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from mineloc.data import F64, MapCloud
from mineloc.errors import FormatError
from mineloc.io.cloud_columns import Rows, cloud_of, heard, placed, rows_of, words
from mineloc.output import new_file

_NAMES = {"<f4": "float", "<f8": "double", "<i4": "int", "|u1": "uchar"}
_TYPES = {
    **dict.fromkeys(("char", "int8"), "<i1"),
    **dict.fromkeys(("uchar", "uint8"), "<u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_LONGEST_HEADER = 1 << 16


def write_ply(
    path: Path,
    cloud: MapCloud,
    *,
    origin_m: F64 | None = None,
    frame: str | None = None,
    float32: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a PLY file, whole or not at all.

    Args:
        path: the file.
        cloud: the map.
        origin_m: (3,) where the origin of the cloud's frame lies in `frame`; None: it is the same frame.
        frame: name of the file's frame; None: the cloud's.
        float32: positions as float relative to the origin that the header tells, for programs without double.
        overwrite: replace an existing file.

    Raises:
        OutputError: `path` exists (unless `overwrite`) or cannot be written.
        ValueError: an origin that is not three numbers.
    """
    origin, name = placed(cloud, origin_m, frame)
    rows = rows_of(cloud, cloud.points_m if float32 else cloud.points_m + origin)
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {line}" for line in words(origin, name, cloud.voxel_m, relative=float32)]
    lines += [f"element vertex {len(rows)}"]
    lines += [f"property {_NAMES[rows.dtype[column].str]} {column}" for column in rows.dtype.names or ()]
    with new_file(path, overwrite=overwrite) as temp, temp.open("wb") as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))
        rows.tofile(file)


def read_ply(path: Path) -> MapCloud:
    """A PLY cloud; one of another program may lack normals and counts.

    Raises:
        FormatError: no such file, not PLY, not binary little endian, shorter than its header says.
    """
    try:
        with path.open("rb") as file:
            lines = _header(path, file)
            rows = _vertices(path, file, lines)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})", expected="a PLY file") from None
    told = heard(path, [line[8:] for line in lines if line.startswith("comment ")])
    return cloud_of(path, rows, told)


def _header(path: Path, file: BinaryIO) -> list[str]:
    if file.read(3) != b"ply":
        raise FormatError(path, "not a PLY file", expected="a cloud", todo="check the file")
    head = file.read(_LONGEST_HEADER)
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    if end < 0 or newline < 0:
        raise FormatError(path, "a header without an end", expected="PLY", todo="check what wrote the file")
    file.seek(3 + newline + 1)
    return [line.strip() for line in head[:end].decode("latin-1").splitlines()]


def _vertices(path: Path, file: BinaryIO, lines: list[str]) -> Rows:
    count, columns, format_, inside = -1, list[tuple[str, str]](), "", False
    for line in lines:
        head, *rest = line.split() or [""]
        if head == "format":
            format_ = " ".join(rest)
        elif head == "element":
            if inside:
                break
            if len(rest) != 2 or rest[0] != "vertex" or not rest[1].isdigit():
                raise FormatError(path, line, expected="element vertex first", todo="export the points alone")
            count, inside = int(rest[1]), True
        elif head == "property" and inside:
            if len(rest) != 2 or rest[0] not in _TYPES:
                raise FormatError(path, line, expected="a number a vertex", todo="export the points alone")
            columns.append((rest[1], _TYPES[rest[0]]))
    if format_ != "binary_little_endian 1.0":
        raise FormatError(
            path, f"format {format_ or 'missing'}", expected="binary_little_endian 1.0", todo="export it as binary"
        )
    if count < 0 or not columns or len({name for name, _ in columns}) != len(columns):
        raise FormatError(path, "no vertices with columns of their own", expected="element vertex", todo="export again")
    return exactly(path, file, columns, count)


def exactly(path: Path, file: BinaryIO, columns: list[tuple[str, str]], count: int) -> Rows:
    """So many rows from here on.

    Raises:
        FormatError: the file ends before.
    """
    dtype = np.dtype(columns)
    left = path.stat().st_size - file.tell()
    if left < count * dtype.itemsize:
        raise FormatError(
            path,
            f"ends after {left // dtype.itemsize} of {count} points",
            expected=f"{count * dtype.itemsize} bytes",
            todo="the file is cut off: copy it again",
        )
    return np.fromfile(file, dtype, count)
