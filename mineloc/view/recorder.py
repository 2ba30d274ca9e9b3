"""`RunRecorder` turns what a run says into a Rerun recording; who tells it things knows nothing of Rerun.

Positions are sent as float32: `origin_m` is subtracted first, or a mine grid's large coordinates would lose
centimetres (PLATFORM 3). Clouds are rounded to centimetres, which makes the file a quarter smaller.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mineloc import se3
from mineloc.data import F32, F64, I64

TIMELINE = "time"
APPLICATION = "mineloc"
_DECIMALS = 2  # of metres
_SWEEPS_A_CHUNK = 64

Rgb = tuple[int, int, int]

# Okabe and Ito (2008), told apart by the colour-blind
WHITE: Rgb = (255, 255, 255)
ORANGE: Rgb = (230, 159, 0)
SKY: Rgb = (86, 180, 233)
GREEN: Rgb = (0, 158, 115)
YELLOW: Rgb = (240, 228, 66)
VERMILION: Rgb = (213, 94, 0)
_DIM: Rgb = (90, 90, 90)
_PLAN_LINE = rr.Radius.ui_points(1.5)


class RunRecorder:
    """Writes one `.rrd`. Use as a context manager: the file is complete when the block is left.

    Args:
        path: file to write.
        recording_id: fixed for equal content, so that a viewer replaces an older recording of the same run.
        name: shown in the viewer.
        origin_m: (3,) subtracted from every position.
        layout: what the viewer opens on.
    """

    def __init__(
        self, path: Path, *, recording_id: str, name: str, origin_m: F64, layout: rrb.Blueprint | None = None
    ) -> None:
        self._origin = np.asarray(origin_m, dtype=np.float64)
        # No automatic properties: they hold the time of writing, and equal runs shall give equal recordings.
        self._stream = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
        self._stream.save(path, default_blueprint=layout)
        self._stream.send_recording_name(name)
        self._stream.send_property("origin", rr.AnyValues(origin_m=self._origin.tolist()))
        self._stream.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.disconnect()

    @staticmethod
    def path(*parts: str) -> str:
        """An entity of parts that may hold any letter: names from outside."""
        return rr.new_entity_path(list(parts))

    def cloud(self, entity: str, points_map: F64 | F32, *, colors: NDArray[np.uint8] | Rgb, radius_m: float) -> None:
        """A cloud that is always there: (n, 3) map points, one colour or (n, 3) colours."""
        self._stream.log(
            entity, rr.Points3D(self._rounded(points_map), colors=np.asarray(colors), radii=radius_m), static=True
        )

    def lines(
        self, entity: str, strips_map: Sequence[F64], *, colors: Sequence[Rgb] | Rgb, width_px: float = 1.5
    ) -> None:
        """Polylines that are always there, each (n, 3) in the map."""
        strips = [self._local(strip) for strip in strips_map]
        radius = rr.Radius.ui_points(width_px / 2)
        self._stream.log(entity, rr.LineStrips3D(strips, colors=np.asarray(colors), radii=radius), static=True)

    def names(self, entity: str, points_map: F64, texts: Sequence[str], *, color: Rgb) -> None:
        """A text at each of (n, 3) map points, always there."""
        points = rr.Points3D(
            self._local(points_map), labels=list(texts), colors=np.asarray(color), radii=0.3, show_labels=True
        )
        self._stream.log(entity, points, static=True)

    def shares(self, entity: str, values: F64) -> None:
        """(rows, columns) numbers from 0 to 1 as a picture; the value shows under the pointer."""
        picture = rr.DepthImage(values.astype(np.float32), meter=1.0, colormap="viridis", depth_range=[0.0, 1.0])
        self._stream.log(entity, picture, static=True)

    def moving(self, entity: str, stamps_ns: I64, poses: F64, *, axis_m: float) -> None:
        """A frame that moves: `T_map_entity` (n, 4, 4) at its times, drawn as axes."""
        position, xyzw = se3.to_xyzw(poses)
        self._stream.send_columns(
            entity,
            [_times(stamps_ns)],
            rr.Transform3D.columns(translation=self._local(position), quaternion=xyzw.astype(np.float32)),
        )
        self._stream.log(entity, rr.TransformAxes3D(axis_m), static=True)

    def sweeps(self, entity: str, clouds: Iterable[tuple[int, F64]], *, color: Rgb, radius_m: float) -> None:
        """Sweeps in order of time, (stamp, (n, 3) points in the map), each shown until the next."""
        self._stream.log(entity, rr.Points3D.from_fields(colors=color, radii=radius_m), static=True)
        waiting: list[tuple[int, F32]] = []
        for stamp_ns, points_map in clouds:
            waiting.append((stamp_ns, self._rounded(points_map)))
            if len(waiting) == _SWEEPS_A_CHUNK:
                self._send(entity, waiting)
                waiting = []
        self._send(entity, waiting)

    def _send(self, entity: str, sweeps: list[tuple[int, F32]]) -> None:
        # columns, not `log`: that would add the time of writing, and equal runs shall give equal recordings
        if sweeps:
            columns = rr.Points3D.columns(positions=np.concatenate([points for _, points in sweeps]))
            stamps = np.array([stamp_ns for stamp_ns, _ in sweeps], dtype=np.int64)
            self._stream.send_columns(entity, [_times(stamps)], columns.partition([len(p) for _, p in sweeps]))

    def curve(self, entity: str, stamps_ns: I64, values: F64, *, name: str, color: Rgb) -> None:
        """A number over time; times without a value (NaN) are left out."""
        known = np.isfinite(values)
        self._stream.log(entity, rr.SeriesLines(colors=color, names=name, widths=1.5), static=True)
        if known.any():
            self._stream.send_columns(entity, [_times(stamps_ns[known])], rr.Scalars.columns(scalars=values[known]))

    def states(self, entity: str, changes: Mapping[int, str], *, colors: Mapping[str, Rgb]) -> None:
        """A state over time: {time: name}, each valid until the next."""
        look = rr.StateConfiguration(values=list(colors), colors=np.array(list(colors.values()), dtype=np.uint8))
        self._stream.log(entity, look, static=True)
        if changes:
            stamps = np.array(list(changes), dtype=np.int64)
            self._stream.send_columns(entity, [_times(stamps)], rr.StateChange.columns(state=list(changes.values())))

    def decisions(self, entity: str, lines: Sequence[tuple[int, str, str]]) -> None:
        """A log: (time, level, text) in order of time; levels are INFO, WARN, ERROR."""
        if lines:
            stamps, levels, texts = zip(*lines, strict=True)
            columns = rr.TextLog.columns(text=list(texts), level=list(levels))
            self._stream.send_columns(entity, [_times(np.array(stamps, dtype=np.int64))], columns)

    def document(self, entity: str, markdown: str) -> None:
        """A page of text that is always there."""
        self._stream.log(entity, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN), static=True)

    def documents(self, entity: str, pages: Sequence[tuple[int, str]]) -> None:
        """Pages of text over time, (time, markdown), each shown until the next."""
        if pages:
            stamps, texts = zip(*pages, strict=True)
            kinds = [rr.MediaType.MARKDOWN] * len(texts)
            columns = rr.TextDocument.columns(text=list(texts), media_type=kinds)
            self._stream.send_columns(entity, [_times(np.array(stamps, dtype=np.int64))], columns)

    def cloud_during(
        self, entity: str, span_ns: tuple[int, int | None], points_m: F64, *, color: Rgb, radius_m: float
    ) -> None:
        """(n, 3) points in a frame of their own, not moved to the local origin; gone at the end of the span."""
        self._stream.log(entity, rr.Points3D.from_fields(colors=color, radii=radius_m), static=True)
        columns = rr.Points3D.columns(positions=np.round(points_m, _DECIMALS).astype(np.float32))
        self._during(entity, span_ns, columns, len(points_m))

    def plan_during(self, entity: str, span_ns: tuple[int, int | None], strips_m: Sequence[F64], *, color: Rgb) -> None:
        """Polylines over ground, each (n, 2), x to the right and y up; gone at the end of the span."""
        self._stream.log(entity, rr.LineStrips2D.from_fields(colors=color, radii=_PLAN_LINE), static=True)
        if strips_m:
            columns = rr.LineStrips2D.columns(strips=[_upright(strip) for strip in strips_m])
            self._during(entity, span_ns, columns, len(strips_m))

    def circles(self, entity: str, radii_m: Sequence[float]) -> None:
        """Circles over ground around zero, always there."""
        bearing = np.linspace(0.0, 2 * np.pi, 91)
        rings = [r * np.column_stack([np.cos(bearing), np.sin(bearing)]) for r in radii_m]
        picture = rr.LineStrips2D(rings, colors=np.asarray(_DIM), radii=rr.Radius.ui_points(0.5))
        self._stream.log(entity, picture, static=True)

    def _during(self, entity: str, span_ns: tuple[int, int | None], columns: rr.ComponentColumnList, n: int) -> None:
        begin, end = span_ns
        # an empty picture ends it: a `Clear` would be written with the time of writing
        stamps, lengths = ([begin], [n]) if end is None else ([begin, end], [n, 0])
        self._stream.send_columns(entity, [_times(np.array(stamps, dtype=np.int64))], columns.partition(lengths))

    def _local(self, points_map: F64 | F32) -> F32:
        return (np.asarray(points_map, dtype=np.float64) - self._origin).astype(np.float32)

    def _rounded(self, points_map: F64 | F32) -> F32:
        return np.round(np.asarray(points_map, dtype=np.float64) - self._origin, _DECIMALS).astype(np.float32)


def _upright(strip_m: F64) -> F32:
    # pictures count y downwards
    return np.round(strip_m * np.array([1.0, -1.0]), _DECIMALS).astype(np.float32)


def _times(stamps_ns: I64) -> rr.TimeColumn:
    return rr.TimeColumn(TIMELINE, timestamp=stamps_ns.astype("datetime64[ns]"))
