"""Maps as PCD (version 0.7, binary): the format has float32 alone, so positions are relative to an origin."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from mineloc.data import F64, MapCloud
from mineloc.errors import FormatError
from mineloc.io.cloud_columns import NORMALS, Rows, cloud_of, heard, placed, rows_of, words
from mineloc.io.ply_clouds import exactly
from mineloc.output import new_file

_NORMALS = ("normal_x", "normal_y", "normal_z")
_LONGEST_HEADER = 1 << 16
_WANTED = ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA")


def write_pcd(
    path: Path, cloud: MapCloud, *, origin_m: F64 | None = None, frame: str | None = None, overwrite: bool = False
) -> None:
    """Write a PCD file, whole or not at all; comments tell the origin, the viewpoint stays at zero.

    Args:
        path: the file.
        cloud: the map.
        origin_m: (3,) where the origin of the cloud's frame lies in `frame`; None: it is the same frame.
        frame: name of the file's frame; None: the cloud's.
        overwrite: replace an existing file.

    Raises:
        OutputError: `path` exists (unless `overwrite`) or cannot be written.
        ValueError: an origin that is not three numbers.
    """
    origin, name = placed(cloud, origin_m, frame)
    rows = rows_of(cloud, cloud.points_m)
    kinds = [rows.dtype[column] for column in rows.dtype.names or ()]
    names: dict[str, str] = dict(zip(NORMALS, _NORMALS, strict=True))
    lines = ["# .PCD v0.7 - Point Cloud Data file format"]
    lines += [f"# {line}" for line in words(origin, name, cloud.voxel_m, relative=True)]
    lines += ["VERSION 0.7"]
    lines += ["FIELDS " + " ".join(names.get(column, column) for column in rows.dtype.names or ())]
    lines += ["SIZE " + " ".join(str(kind.itemsize) for kind in kinds)]
    lines += ["TYPE " + " ".join(kind.kind.upper() for kind in kinds)]
    lines += ["COUNT " + " ".join("1" for _ in kinds)]
    lines += [f"WIDTH {len(rows)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(rows)}", "DATA binary"]
    with new_file(path, overwrite=overwrite) as temp, temp.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        rows.tofile(file)


def read_pcd(path: Path) -> MapCloud:
    """A PCD cloud; one of another program may lack normals and counts, and an origin.

    Raises:
        FormatError: no such file, not PCD, not binary, shorter than its header says.
    """
    try:
        with path.open("rb") as file:
            header, comments = _header(path, file)
            rows = _rows(path, file, header)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})", expected="a PCD file") from None
    return cloud_of(path, rows, heard(path, comments))


def _header(path: Path, file: BinaryIO) -> tuple[dict[str, list[str]], list[str]]:
    entries: dict[str, list[str]] = {}
    comments: list[str] = []
    while "DATA" not in entries:
        line = file.readline(_LONGEST_HEADER).decode("latin-1")
        if not line.endswith("\n") or file.tell() > _LONGEST_HEADER:
            raise FormatError(path, "no PCD header", expected=", ".join(_WANTED), todo="check the file")
        head, *rest = line.split() or [""]
        if head.startswith("#"):
            comments.append(line[1:].strip())
        elif head:
            entries[head] = rest
    missing = [name for name in _WANTED if not entries.get(name)]
    if missing:
        raise FormatError(path, f"a header without {missing[0]}", expected=", ".join(_WANTED), todo="check the file")
    return entries, comments


def _rows(path: Path, file: BinaryIO, header: dict[str, list[str]]) -> Rows:
    if header["DATA"] != ["binary"]:
        raise FormatError(path, f"DATA {' '.join(header['DATA'])}", expected="DATA binary", todo="export it as binary")
    names = {theirs: ours for ours, theirs in zip(NORMALS, _NORMALS, strict=True)}
    fields, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    columns: list[tuple[str, str]] = []
    try:
        (points,) = (int(value) for value in header["POINTS"])
        counts = [int(value) for value in header.get("COUNT", ["1"] * len(fields))]
        for number, (field, size, kind, count) in enumerate(zip(fields, sizes, types, counts, strict=True)):
            if kind not in "FUI" or size not in "1248" or not 0 < count < 1000 or points < 0:
                raise ValueError
            # padding is called "_", as often as it comes
            name = f"_{number}" if field == "_" or count > 1 else names.get(field, field)
            columns.append((name, f"V{count * int(size)}" if name[0] == "_" else f"<{kind.lower()}{size}"))
        return exactly(path, file, columns, points)
    except (ValueError, TypeError):
        raise FormatError(
            path, "fields, sizes, types and counts that do not fit together", expected="PCD 0.7", todo="export it again"
        ) from None
