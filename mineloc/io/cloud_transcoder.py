"""Clouds of a driver rewritten as canonical ones without becoming sweeps in between, where nothing is to be decided.

Most clouds of a flight are alike: all points are returns, in order of time, in one layout. For those this gives the
very bytes that `SweepDecoder` and `canonical.encode_sweep` give, in a third of the time; for any other it gives None,
and the caller goes the long way.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mineloc.data import F32, Sweep
from mineloc.io import canonical, point_times
from mineloc.io.point_times import TimeRule
from mineloc.io.pointcloud2 import CloudLayout, cloud_layout, strided
from mineloc.io.rings import RingRule
from mineloc.io.ros import stamp_parts
from mineloc.io.sequence import LidarRules
from mineloc.io.sweep_decoder import SweepDecoder

U8 = NDArray[np.uint8]
Offsets = NDArray[np.float64] | NDArray[np.int64]
_MAX_OFFSET_NS = 2**32 - 1
# name and PointField datatype of a canonical flight's fields, and their bytes
_CANONICAL = {("x", 7): 4, ("y", 7): 4, ("z", 7): 4, ("intensity", 7): 4, ("ring", 4): 2, ("t", 6): 4, ("t", 8): 8}


@dataclass(frozen=True, slots=True, eq=False)
class CanonicalCloud:
    """A canonical message and what is in it.

    Attributes:
        data: the serialised message.
        stamp_ns, end_ns: times of the first and the last point.
        header_ns: `header.stamp` as recorded.
        points: (n, 3) view of the coordinates.
        fields: names of the fields.
    """

    data: memoryview
    stamp_ns: int
    end_ns: int
    header_ns: int
    points: F32
    fields: frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class _Column:
    """Where a value stands in the driver's points and in ours."""

    form: str
    source: int
    target_form: str
    target: int


class CloudTranscoder:
    """Rewrites the clouds of one layout.

    Args:
        times, rings, period_ns: what the decoder decided.
        told: the sequence file's `[lidar]` section.
        message: a cloud in the layout that is to be learned.

    Raises:
        ValueError: the layout or the rules need the long way; `learn` says so with None.
    """

    def __init__(self, times: TimeRule, rings: RingRule, period_ns: int, told: LidarRules, message: object) -> None:
        cloud = cast("Any", message)
        if cloud.is_bigendian:
            raise ValueError("big-endian")
        self._fields = cloud.fields
        self._step = int(cloud.point_step)
        keys = tuple((str(f.name), int(f.offset), int(f.datatype), int(f.count)) for f in cloud.fields)
        layout = cloud_layout(keys, self._step, False, "", told.time_field, told.ring_field)
        self._xyz = _place(layout)
        self._times = times
        self._scratch = np.empty(0)
        self._returns = _Returns()
        self.period_ns = period_ns
        self._time = self._time_column(layout, told)
        ring = layout.ring if rings.source == "field" else None
        if rings.source not in ("field", "none") or rings.table is not None:
            raise ValueError("rings are made, not read")
        self._columns, self._target_step, self._head = _plan(layout, ring, timed=self._time is not None)
        names = {"intensity": layout.intensity is not None, "ring": ring is not None, "t": self._time is not None}
        self._names = frozenset(["x", "y", "z", *(name for name, is_there in names.items() if is_there)])
        self._same = self._step == self._target_step and all(c.source == c.target for c in self._columns)

    def _time_column(self, layout: CloudLayout, told: LidarRules) -> tuple[str, int] | None:
        if self._times.source == "field":
            if layout.time is None:
                raise ValueError("no time field")
            return layout.time
        if told.times == "none" or (told.times == "auto" and layout.time is None):
            return None
        raise ValueError("whether there are times is decided cloud by cloud")

    def transcode(self, message: object) -> CanonicalCloud | None:
        """The canonical form of a cloud; None when it is not like the others and must be decoded."""
        cloud = cast("Any", message)
        n = int(cloud.width) * int(cloud.height)
        data: U8 = cloud.data
        if (
            n == 0
            or cloud.is_bigendian
            or int(cloud.point_step) != self._step
            or (int(cloud.height) > 1 and int(cloud.row_step) != int(cloud.width) * self._step)
            or len(data) < n * self._step
            or cloud.fields != self._fields
        ):
            return None
        if not self._returns.are_all(data, self._xyz, n, self._step):
            return None
        header_ns = int(cloud.header.stamp.sec) * 1_000_000_000 + int(cloud.header.stamp.nanosec)
        timed = self._stamp_and_offsets(data, n, header_ns)
        return None if timed is None else self._write(data, n, header_ns, *timed)

    def _stamp_and_offsets(self, data: U8, n: int, header_ns: int) -> tuple[int, Offsets | None] | None:
        """Time of the first point, and the nanoseconds of all points after it; None if they need a closer look."""
        rule = self._times
        start_ns = header_ns - (self.period_ns if rule.header == "end" else 0)
        if self._time is None:
            return start_ns, None
        # once in one piece, since it is looked at several times
        time = strided(data, *self._time, n, self._step).copy()
        first, last = time[0].item(), time[-1].item()
        if not bool((time[1:] >= time[:-1]).all()) or not np.isfinite(last - first) or first == last:
            return None
        # the ends tell the stamp and whether the sweep fits the rule; they are the extremes of a rising sequence
        stamp_ns, ends = point_times.times_ns(time[[0, -1]], header_ns, rule)
        if int(ends[1]) > _MAX_OFFSET_NS or abs(stamp_ns - start_ns) > self.period_ns:
            return None
        if point_times.contradiction(stamp_ns, ends, header_ns, rule, self.period_ns):
            return None
        return stamp_ns, self._offsets(time, first)

    def _offsets(self, time: NDArray[Any], first: float) -> Offsets:
        """As `point_times.times_ns`, in memory that the next cloud uses again."""
        factor = point_times.UNIT_NS[self._times.unit]
        if time.dtype.kind != "f":
            return (time.astype(np.int64) - int(first)) * factor
        if len(self._scratch) < len(time):
            self._scratch = np.empty(2 * len(time))
        since = self._scratch[: len(time)]
        np.subtract(time, first, out=since, dtype=np.float64)
        np.multiply(since, factor, out=since)
        return np.rint(since, out=since)

    def _write(self, data: U8, n: int, header_ns: int, stamp_ns: int, offsets: Offsets | None) -> CanonicalCloud:
        step, start = self._target_step, len(self._head)
        out = np.empty(start + n * step + 1, np.uint8)
        out[:start] = self._head
        out[-1] = 1
        _patch(out, start, stamp_ns, n, step)
        if self._same:
            out[start:-1] = data[: n * step]
        else:
            for c in self._columns:
                strided(out, c.target_form, start + c.target, n, step)[...] = strided(
                    data, c.form, c.source, n, self._step
                )
        if offsets is not None:
            np.copyto(strided(out, "<u4", start + step - 4, n, step), offsets, casting="unsafe")
        points = np.ndarray((n, 3), "<f4", out, start, (step, 4))
        end_ns = stamp_ns if offsets is None else stamp_ns + int(offsets[-1])
        return CanonicalCloud(out.data, stamp_ns, end_ns, header_ns, points, self._names)


def learn(decoder: SweepDecoder, told: LidarRules, message: object) -> CloudTranscoder | None:
    """A transcoder for clouds like this one, None if there can be none."""
    times, rings, period_ns = decoder.time_rule, decoder.ring_rule, decoder.period_ns
    if times is None or rings is None or period_ns is None:
        return None
    try:
        return CloudTranscoder(times, rings, period_ns, told, message)
    except ValueError:
        return None


class _Returns:
    """Looks for points that are no returns, in memory that is used again: fresh memory costs more than the looking."""

    def __init__(self) -> None:
        self._scratch = np.empty(0, np.uint8)

    def are_all(self, data: U8, place: _Place, n: int, step: int) -> bool:
        """Whether all points are finite and none is at the origin."""
        width = np.dtype(place.form).itemsize
        if len(self._scratch) < n * width:
            self._scratch = np.empty(2 * n * width, np.uint8)
        # in one piece; numpy copies 16 bytes five times as fast as 12
        piece = self._scratch[: n * width]
        piece.view(place.form)[...] = strided(data, place.form, place.offset, n, step)
        flat = piece.view("<f4")
        if not (np.isfinite(np.maximum.reduce(flat)) and np.isfinite(np.minimum.reduce(flat))):
            return False
        points = flat.reshape(n, -1)[:, :3]
        return not bool((points[np.flatnonzero(points[:, 0] == 0)] == 0).all(axis=1).any())


class CanonicalView:
    """Recognises the clouds of a canonical flight, which pass as they stand."""

    def __init__(self) -> None:
        self._returns = _Returns()

    def __call__(self, data: bytes | memoryview, message: object) -> CanonicalCloud | None:
        """What is in the message; None if it is none of a canonical flight, or holds what such a flight does not.

        Args:
            data: serialised.
            message: the same, decoded.
        """
        cloud = cast("Any", message)
        n, step, points = int(cloud.width), int(cloud.point_step), cast("U8", cloud.data)
        if not n or cloud.height != 1 or cloud.is_bigendian or not cloud.is_dense or cloud.header.frame_id != "lidar":
            return None
        at = 0
        for field in cloud.fields:
            if (str(field.name), int(field.datatype)) not in _CANONICAL or int(field.offset) != at or field.count != 1:
                return None
            at += _CANONICAL[str(field.name), int(field.datatype)]
        names = [str(field.name) for field in cloud.fields]
        place = _Place(0, "V16" if "intensity" in names else "V12")
        if (
            names[:3] != ["x", "y", "z"]
            or at != step
            or len(points) != n * step
            or not self._returns.are_all(points, place, n, step)
        ):
            return None
        stamp_ns = end_ns = int(cloud.header.stamp.sec) * 1_000_000_000 + int(cloud.header.stamp.nanosec)
        if names[-1] == "t":
            form = "<u4" if cloud.fields[-1].datatype == 6 else "<f8"
            end_ns += int(strided(points, form, step - int(form[2]), n, step).max())
        xyz = np.ndarray((n, 3), "<f4", points, 0, (step, 4))
        return CanonicalCloud(memoryview(data), stamp_ns, end_ns, stamp_ns, xyz, frozenset(names))


def _patch(out: U8, start: int, stamp_ns: int, n: int, step: int) -> None:
    """Put time and sizes into the head of a message; after the frame's name `lidar` come height and width."""
    out[4:12] = np.frombuffer(struct.pack("<iI", *stamp_parts(stamp_ns)), np.uint8)
    out[28:32] = np.frombuffer(struct.pack("<I", n), np.uint8)
    out[start - 8 : start] = np.frombuffer(struct.pack("<II", n * step, n * step), np.uint8)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the coordinates stand, and the bytes that are looked at together: intensity too, if it follows them."""

    offset: int
    form: str


def _place(layout: CloudLayout) -> _Place:
    first = layout.xyz[0][1]
    if layout.xyz != tuple(("<f4", first + 4 * axis) for axis in range(3)):
        raise ValueError("coordinates are not three floats side by side")
    return _Place(first, "V16" if layout.intensity == ("<f4", first + 12) else "V12")


def _plan(layout: CloudLayout, ring: tuple[str, int] | None, *, timed: bool) -> tuple[list[_Column], int, U8]:
    """Columns to copy, our point size, and the bytes before the first point of an otherwise equal message."""
    if layout.intensity is not None and layout.intensity[0] != "<f4":
        raise ValueError("intensity is converted")
    if ring is not None and ring[0] not in ("<u2", "<u1"):
        raise ValueError("rings are converted")
    columns, at = [_Column("V12", layout.xyz[0][1], "V12", 0)], 12
    if layout.intensity is not None:
        columns.append(_Column("<f4", layout.intensity[1], "<f4", at))
        at += 4
    if ring is not None:
        columns.append(_Column(ring[0], ring[1], "<u2", at))
        at += 2
    one = Sweep(
        0,
        np.zeros((1, 3), np.float32),
        np.zeros(1, np.int64) if timed else None,
        None if ring is None else np.zeros(1, np.uint16),
        None if layout.intensity is None else np.zeros(1, np.float32),
    )
    step = at + 4 * timed
    whole = np.frombuffer(canonical.encode_sweep(one), np.uint8)
    return columns, step, whole[: len(whole) - step - 1].copy()
