"""Maps as LAZ, what mine offices take: LAS 1.4, point format 6, a millimetre, classified.

Classes: 2 ground (ASPRS) for the floor, 64 walls and 65 roof (user classes), 1 unclassified for the rest. Extra
dimensions: `count` measured points, `visits` keyframes, `thickness` and `near` in metres. Unit, frame and origin stand
in a variable length record of user `mineloc`; the normals stay behind, LAS has no place for them.
"""

from __future__ import annotations

import struct
from datetime import date
from pathlib import Path
from typing import Any, BinaryIO

import laspy
import numpy as np

from mineloc.data import F64, MapCloud, SurfaceKind
from mineloc.errors import FormatError
from mineloc.io.cloud_columns import KNOWN, cloud_of, heard, placed, words
from mineloc.output import new_file

SCALE_M = 0.001
CLASSES = {SurfaceKind.OTHER: 1, SurfaceKind.FLOOR: 2, SurfaceKind.WALL: 64, SurfaceKind.ROOF: 65}
UNKNOWN_DAY = date(1970, 1, 1)
_USER, _RECORD = "mineloc", 1
_EXTRA = [(name, kind) for name, kind in KNOWN if name != "surface"]
_CHUNK = 1 << 20
_RECORD_BYTES = 54
_CHUNK_BYTES = 20  # a chunk begins with a whole point
_BEST_COMPRESSION = 100.0  # points a byte that nobody reaches
_SYSTEM = "mineloc"


def write_laz(
    path: Path,
    cloud: MapCloud,
    *,
    origin_m: F64 | None = None,
    frame: str | None = None,
    flown: date | None = None,
    overwrite: bool = False,
) -> None:
    """Write a LAZ file (LAS if that is its suffix), whole or not at all.

    Args:
        path: the file.
        cloud: the map.
        origin_m: (3,) where the origin of the cloud's frame lies in `frame`; None: it is the same frame.
        frame: name of the file's frame; None: the cloud's.
        flown: day of the flight, the header's creation date: that of writing would make every copy another file.
        overwrite: replace an existing file.

    Raises:
        OutputError: `path` exists (unless `overwrite`) or cannot be written.
        ValueError: an origin that is not three numbers, a point 2000 km from it.
    """
    origin, name = placed(cloud, origin_m, frame)
    if np.abs(cloud.points_m).max(initial=0.0) > 2e6:
        raise ValueError("a point is more than 2000 km from the origin")
    header = _header(origin, words(origin, name, cloud.voxel_m, relative=False), flown or UNKNOWN_DAY)
    with (
        new_file(path, overwrite=overwrite) as temp,
        laspy.open(temp, mode="w", header=header, do_compress=path.suffix.lower() != ".las") as writer,
    ):
        for begin in range(0, len(cloud), _CHUNK):
            writer.write_points(_record(cloud.keep(np.arange(begin, min(begin + _CHUNK, len(cloud)))), header))


def _header(origin_m: F64, lines: list[str], day: date) -> Any:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = origin_m, np.full(3, SCALE_M)
    header.creation_date = day
    header.system_identifier, header.generating_software = _SYSTEM, _SYSTEM
    header.global_encoding.wkt = True  # the format wants it of point format 6; without a record: no known datum
    header.vlrs.append(laspy.VLR(_USER, _RECORD, "unit, frame, origin", "\n".join(lines).encode("ascii")))
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, kind in _EXTRA])
    return header


def _record(cloud: MapCloud, header: Any) -> Any:
    out = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    for axis, name in enumerate("XYZ"):
        out[name] = np.rint(cloud.points_m[:, axis].astype(np.float64) / SCALE_M).astype(np.int32)
    class_of = np.zeros(256, np.uint8)
    for kind, number in CLASSES.items():
        class_of[kind] = number
    out["classification"] = class_of[cloud.surface]
    out["return_number"] = out["number_of_returns"] = np.ones(len(cloud), np.uint8)
    for (name, _), values in zip(_EXTRA, (cloud.counts, cloud.visits, cloud.thickness_m, cloud.near_m), strict=True):
        out[name] = values
    return out


def read_laz(path: Path) -> MapCloud:
    """A LAS or LAZ cloud, without normals; of another program's, classes 2, 64 and 65 are believed.

    Raises:
        FormatError: no such file, not LAS, damaged or cut off.
    """
    _check_sizes(path)
    try:
        # the parallel backend believes the sizes of chunks and gathers them all first
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            las: Any = reader.read()
            expected = reader.header.point_count
            rows = _columns(las)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # noqa: BLE001  # hostile files: a panic of the decoder is no Exception
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise FormatError(path, f"cannot be read as LAS or LAZ ({reason})", todo="copy or export it again") from None
    if len(las.points) != expected:
        raise FormatError(
            path, f"ends after {len(las.points)} of {expected} points", expected="a whole file", todo="copy it again"
        )
    lines = [vlr.record_data.decode("ascii", "replace") for vlr in las.header.vlrs if vlr.user_id == _USER]
    return cloud_of(path, rows, heard(path, "\n".join(lines).splitlines()))


def _check_sizes(path: Path) -> None:
    """Refuse what a damaged header promises before the parser goes looking for it: it believes any number.

    LAS 1.4: offset to the points at 96, number of records 100, record length 105, points 107 (until 1.3) or 247, number
    of extended records 243.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(375)
            chunks = _chunks(file, head, size)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})", expected="a LAS or LAZ file") from None
    if head[:4] != b"LASF" or len(head) < 227:
        raise FormatError(path, "not a LAS or LAZ file", expected="a cloud", todo="check the file")
    (offset, records), (length, points) = struct.unpack_from("<II", head, 96), struct.unpack_from("<HI", head, 105)
    extended = 0
    if head[25] >= 4 and len(head) == 375:
        extended, points = struct.unpack_from("<IQ", head, 243)
    packed = length if head[104] < 128 else 1.0 / _BEST_COMPRESSION
    promised = (records * _RECORD_BYTES, extended * _RECORD_BYTES, points * packed, chunks * _CHUNK_BYTES)
    if offset > size or promised[0] > offset or max(promised) > size:
        raise FormatError(
            path,
            f"{size} bytes for {points} points and {records + extended} records",
            expected="a whole file",
            todo="copy or export it again",
        )


def _chunks(file: BinaryIO, head: bytes, size: int) -> int:
    """How many chunks the table of a LAZ file promises; 0 for LAS."""
    if len(head) < 227 or head[104] < 128:
        return 0
    file.seek(struct.unpack_from("<I", head, 96)[0])
    (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\xff"))
    if not 0 <= table <= size - 8:
        return size
    file.seek(table + 4)
    return struct.unpack("<I", file.read(4))[0]


@np.errstate(over="ignore", invalid="ignore")
def _columns(las: Any) -> Any:
    names = set(las.point_format.extra_dimension_names)
    extra = [(name, kind) for name, kind in _EXTRA if name in names]
    rows = np.zeros(len(las.points), [*((name, "<f8") for name in "xyz"), *extra, ("surface", "u1")])
    for name in "xyz":
        rows[name] = las[name]
    for name, _ in extra:
        rows[name] = las[name]
    classes = np.asarray(las.classification)
    for kind, number in CLASSES.items():
        rows["surface"][classes == number] = kind
    return rows
