"""sensor_msgs/PointCloud2 to arrays: fields by name, type and offset, never by an assumed struct (METHOD 9.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mineloc.errors import IngestError

F32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Column = NDArray[Any]

INTENSITY_NAMES = ("intensity", "i", "reflectivity", "signal")
RING_NAMES = ("ring", "channel", "line", "laser_id", "scan")
TIME_NAMES = ("time", "t", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")

# sensor_msgs/PointField constants INT8 … FLOAT64.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MAX_POINTS = 10_000_000

# name, offset, datatype, count: the part of a PointField that matters, hashable
FieldKey = tuple[str, int, int, int]


@dataclass(frozen=True, slots=True)
class CloudLayout:
    """Where the values of a point stand. Formats are numpy's, with byte order.

    Attributes:
        xyz: format and offset of x, y, z.
        intensity, ring, time: format and offset, None where there is no such field.
        time_name: the field's name.
    """

    xyz: tuple[tuple[str, int], ...]
    intensity: tuple[str, int] | None
    ring: tuple[str, int] | None
    time: tuple[str, int] | None
    time_name: str


@dataclass(frozen=True, slots=True, eq=False)
class RawCloud:
    """The columns of one message, one value a point, before anything is dropped.

    Attributes:
        header_ns: `header.stamp`.
        points: (n, 3) float32 as they are: NaN and (0, 0, 0) included.
        intensity: (n,) float32 or None.
        ring: (n,) as stored, or None.
        time: (n,) as stored, or None.
        shape: height and width of the message.
        time_name: the time field's name, empty without one.
    """

    header_ns: int
    points: F32
    intensity: F32 | None
    ring: Column | None
    time: Column | None
    shape: tuple[int, int]
    time_name: str = ""

    def __len__(self) -> int:
        return len(self.points)

    def keep(self, mask: Bool) -> RawCloud:
        """Only the masked points, all columns together."""
        return replace(
            self,
            points=self.points[mask],
            intensity=None if self.intensity is None else self.intensity[mask],
            ring=None if self.ring is None else self.ring[mask],
            time=None if self.time is None else self.time[mask],
        )


def read_cloud(message: object, *, where: str, time_field: str = "", ring_field: str = "") -> RawCloud:
    """The columns of a decoded rosbags PointCloud2 message (ROS 1 or 2).

    Args:
        message: with `header`, `height`, `width`, `fields`, `is_bigendian`, `point_step`, `row_step`, `data`.
        where: recording and topic, for errors.
        time_field, ring_field: names where the usual ones do not hold.

    Raises:
        IngestError: fields missing or outside the point, data shorter than it should be.
    """
    cloud = cast("Any", message)
    keys = tuple((str(f.name), int(f.offset), int(f.datatype), int(f.count)) for f in cloud.fields)
    height, width, step = int(cloud.height), int(cloud.width), int(cloud.point_step)
    layout = cloud_layout(keys, step, bool(cloud.is_bigendian), where, time_field, ring_field)
    row_step = _row_step(cloud, where)
    data = np.asarray(cloud.data, dtype=np.uint8)

    def column(place: tuple[str, int] | None) -> Column | None:
        if place is None:
            return None
        return _column(data, place, (height, width), (row_step, step)).copy().reshape(-1)

    intensity = column(layout.intensity)
    stamp = cloud.header.stamp
    return RawCloud(
        int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec),
        _points(data, layout, (height, width), (row_step, step)),
        None if intensity is None else intensity.astype(np.float32, copy=False),
        column(layout.ring),
        column(layout.time),
        (height, width),
        layout.time_name,
    )


def _row_step(cloud: Any, where: str) -> int:
    """Bytes from row to row; drivers that leave `row_step` 0 or wrong for one row mean packed points."""
    height, width, step = int(cloud.height), int(cloud.width), int(cloud.point_step)
    if height * width > _MAX_POINTS:
        raise IngestError(where, f"a cloud of {height} x {width} points", expected=f"at most {_MAX_POINTS} points")
    packed, row_step = width * step, int(cloud.row_step)
    if height <= 1 or row_step == 0:
        row_step = packed
    need = (height - 1) * row_step + packed if height and width else 0
    if row_step < packed or len(cloud.data) < need:
        raise IngestError(
            where,
            f"{height} x {width} points of {step} bytes with row_step {row_step} in {len(cloud.data)} bytes",
            expected=f"rows of at least {packed} bytes and {need} bytes in all",
            todo="the recording is damaged, or its driver writes wrong sizes",
        )
    return row_step


def strided(buffer: NDArray[np.uint8], form: str, offset: int, n: int, step: int) -> Column:
    """A view of n values of a numpy format, `step` bytes apart; writable when the buffer is."""
    # numpy refuses strides over an empty buffer
    return np.ndarray((n,), form, buffer, offset, (step,)) if n else np.empty(0, form)


def _column(
    data: NDArray[np.uint8], place: tuple[str, int], shape: tuple[int, int], strides: tuple[int, int]
) -> Column:
    n = shape[0] * shape[1]
    if shape[0] == 1 or strides[0] == shape[1] * strides[1] or n == 0:
        # one run of points: numpy copies it twice as fast as rows
        return strided(data, place[0], place[1], n, strides[1])
    return np.ndarray(shape, place[0], data, place[1], strides)


def _points(data: NDArray[np.uint8], layout: CloudLayout, shape: tuple[int, int], strides: tuple[int, int]) -> F32:
    n = shape[0] * shape[1]
    first = layout.xyz[0][1]
    if layout.xyz == tuple(("<f4", first + 4 * axis) for axis in range(3)):
        # Twelve bytes a point in one piece: three times as fast as three columns.
        return _column(data, ("V12", first), shape, strides).copy().view("<f4").reshape(n, 3)
    out = np.empty((n, 3), np.float32)
    for axis, place in enumerate(layout.xyz):
        out[:, axis] = _column(data, place, shape, strides).reshape(-1)
    return out


@lru_cache(maxsize=64)
def cloud_layout(
    fields: tuple[FieldKey, ...], step: int, big_endian: bool, where: str, time_field: str = "", ring_field: str = ""
) -> CloudLayout:
    """Find the fields that a sweep needs by name; names are compared in lower case, the first alias wins.

    Raises:
        IngestError: x, y or z missing, a field outside the point, an unknown datatype, a named field missing.
    """
    order = ">" if big_endian else "<"
    places: dict[str, tuple[str, int]] = {}
    for name, offset, datatype, _ in fields:
        form = _DATATYPES.get(datatype)
        wanted = name in (time_field, ring_field) or name.lower() in _WANTED
        if not wanted:
            continue
        if form is None:
            raise IngestError(where, f"field {name} has datatype {datatype}", expected="1 to 8 (int8 to float64)")
        if offset + int(form[1]) > step:
            raise IngestError(where, f"field {name} at byte {offset} does not fit a point of {step} bytes")
        # A field of several values (count > 1) gives its first.
        places.setdefault(name if name in (time_field, ring_field) else name.lower(), (order + form, offset))
    missing = [axis for axis in "xyz" if axis not in places]
    if missing:
        names = " ".join(name for name, *_ in fields) or "none"
        raise IngestError(where, f"no field {' '.join(missing)}", expected="x y z", todo=f"the cloud has: {names}")
    time_name = _pick(places, (time_field,) if time_field else TIME_NAMES, named=bool(time_field), where=where)
    ring_name = _pick(places, (ring_field,) if ring_field else RING_NAMES, named=bool(ring_field), where=where)
    intensity_name = _pick(places, INTENSITY_NAMES, named=False, where=where)
    return CloudLayout(
        tuple(places[axis] for axis in "xyz"),
        places.get(intensity_name),
        places.get(ring_name),
        places.get(time_name),
        time_name,
    )


def _pick(places: dict[str, tuple[str, int]], names: Sequence[str], *, named: bool, where: str) -> str:
    found = next((name for name in names if name in places), "")
    if named and not found:
        raise IngestError(where, f"no field {names[0]}", expected="the field that the sequence file names")
    return found


_WANTED = frozenset(("x", "y", "z", *INTENSITY_NAMES, *RING_NAMES, *TIME_NAMES))


def returns(cloud: RawCloud) -> tuple[Bool | None, int, int, int]:
    """Which points are returns: finite, not (0, 0, 0), with a finite time.

    Returns:
        the mask (None: all of them), and how many are not finite, at the origin, without a finite time.
    """
    points = cloud.points
    mask: Bool | None = None
    not_finite = at_origin = without_time = 0
    # Two passes settle the usual case; the masks are made only when something is wrong.
    finite = np.isfinite(points)
    if not finite.all():
        mask = np.asarray(finite.all(axis=1), dtype=np.bool_)
        not_finite = len(points) - int(np.count_nonzero(mask))
    x_zero = points[:, 0] == 0
    if x_zero.any():
        origin = x_zero & (points[:, 1] == 0) & (points[:, 2] == 0)
        at_origin = int(np.count_nonzero(origin))
        if at_origin:
            mask = ~origin if mask is None else mask & ~origin
    if cloud.time is not None and cloud.time.dtype.kind == "f":
        timed = np.isfinite(cloud.time)
        if not timed.all():
            before = len(points) if mask is None else int(np.count_nonzero(mask))
            mask = timed if mask is None else mask & timed
            without_time = before - int(np.count_nonzero(mask))
    return mask, not_finite, at_origin, without_time
