"""Writing a canonical flight: sweeps, inertial samples, images, reference, facts."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np
from mcap.records import Attachment
from numpy.typing import NDArray

from mineloc import __version__
from mineloc.data import Calibration, CameraModel, DepthImage, FlightInfo, GreyImage, ImuSamples, Sweep, Trajectory
from mineloc.errors import FlightError
from mineloc.io import camera_images, canonical
from mineloc.io import flight_layout as layout
from mineloc.io.mcap_writer import McapWriter
from mineloc.io.ros import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    ODOMETRY,
    POINT_CLOUD2,
    POSE_STAMPED,
    TF_MESSAGE,
    definition,
)
from mineloc.output import new_file

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

# Viewers need no more; every pose is in /pose.
_TF_PERIOD_NS = 20_000_000
_CLOUDS, _REST = "clouds", "rest"
_LATCHED = (layout.TF_STATIC, layout.DEPTH_INFO, layout.GREY_INFO)
# Encoded images that may wait for the sweeps: a few megabytes.
_MOST_IMAGES = 16


@dataclass(slots=True)
class _Pending:
    """Messages of one channel that wait until the sweeps have come as far; encoded when they are due."""

    channel: int
    stamps_ns: I64
    encode: Callable[[slice], U8]
    done: int = 0


@dataclass(frozen=True, slots=True)
class _Picture:
    """An encoded image that waits until the sweeps have come as far."""

    stamp_ns: int
    channel: int
    topic: str
    data: memoryview


class FlightWriter:
    """Writes one flight file; nothing appears at `path` unless the `with` block ends without an error.

    Sweeps must come in order of time. Inertial samples and poses may come before, between or after the sweeps, in any
    portions, each in order; they are kept (unencoded) until the sweeps have reached their time, so that the file is in
    order of time. Images are kept encoded, and only so many that memory does not grow: add them near their sweeps.
    The same calls give the same bytes.

    Args:
        path: the file to make.
        info, calibration: facts for the `mineloc.flight` record and `/tf_static`.
        compression: "lz4", "zstd" or "none".
        chunk_bytes: uncompressed size of a chunk, at most 1 MiB.
        overwrite: replace an existing file.

    Raises:
        OutputError: `path` exists, cannot be written, or the disk is full (on leaving the `with` block, or earlier).
        FlightError: time goes backwards.
    """

    def __init__(
        self,
        path: Path,
        info: FlightInfo,
        calibration: Calibration,
        *,
        compression: str = "lz4",
        chunk_bytes: int = 1 << 20,
        overwrite: bool = False,
    ) -> None:
        self._path = Path(path)
        self._info = info
        self._calibration = calibration
        self._compression = compression
        self._chunk_bytes = chunk_bytes
        self._overwrite = overwrite
        self._stack = ExitStack()
        self._mcap: McapWriter | None = None
        self._channels: dict[tuple[str, str], int] = {}
        self._pending: list[_Pending] = []
        self._pictures: deque[_Picture] = deque()
        self._attachments: list[Attachment] = []
        self._health: Mapping[str, object] | None = None
        self._last_ns: dict[str, int] = {}
        self._first_ns: int | None = None
        self._end_ns = 0

    def __enter__(self) -> FlightWriter:
        with ExitStack() as stack:
            temp = stack.enter_context(new_file(self._path, overwrite=self._overwrite))
            stream: BinaryIO = stack.enter_context(temp.open("wb"))
            self._mcap = McapWriter(
                stream,
                profile="ros2",
                library=f"mineloc {__version__}",
                compression=self._compression,
                chunk_bytes=self._chunk_bytes,
            )
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if error is not None:
            self._open_mcap.abort()
            return self._stack.__exit__(kind, error, trace)
        with self._stack:
            try:
                self._finish()
            except BaseException:
                self._open_mcap.abort()
                raise
        return None

    @property
    def _open_mcap(self) -> McapWriter:
        if self._mcap is None:
            raise ValueError("FlightWriter must be used in a with statement")
        return self._mcap

    def add_sweep(self, sweep: Sweep, *, publish_ns: int | None = None) -> None:
        """Append a sweep; it is logged at the time of its last point.

        Args:
            sweep: starts later than the one before.
            publish_ns: when the recording received it.

        Raises:
            FlightError: it starts no later than the sweep before.
            ValueError: its times cannot be written.
        """
        data = canonical.encode_sweep(sweep)
        self.add_raw_sweep(
            data, stamp_ns=sweep.stamp_ns, end_ns=sweep.end_ns, period_ns=sweep.period_ns, publish_ns=publish_ns
        )

    def add_raw_sweep(
        self,
        data: bytes | memoryview,
        *,
        stamp_ns: int,
        end_ns: int,
        period_ns: int,
        publish_ns: int | None = None,
    ) -> None:
        """Append a sweep that is encoded already, exactly as `canonical.encode_sweep` does it."""
        self._check_order(layout.POINTS, np.array([stamp_ns]))
        self._emit_until(end_ns)
        channel = self._channel(layout.POINTS, POINT_CLOUD2, {layout.PERIOD_KEY: str(period_ns)} if period_ns else {})
        self._open_mcap.add_message(channel, end_ns, data, publish_ns=publish_ns, group=_CLOUDS)
        self._extend(stamp_ns, end_ns)

    def add_imu(self, imu: ImuSamples) -> None:
        """Add inertial samples, later than those added before: one message a sample.

        Raises:
            FlightError: they start before the samples added earlier end.
        """
        if len(imu):
            self._check_order(layout.IMU_TOPIC, imu.stamps_ns)
            channel = self._channel(layout.IMU_TOPIC, IMU)
            self._wait(channel, imu.stamps_ns, lambda part: canonical.encode_imu(_imu_part(imu, part)))

    def add_reference(self, reference: Trajectory) -> None:
        """Add reference poses `T_map_body`, later than those added before.

        Raises:
            FlightError: they start before the poses added earlier end.
            ValueError: it does not place `body` in `map`, or has no times.
        """
        _need_frames(reference, layout.MAP)
        self._add_poses(reference, layout.POSE, POSE_STAMPED, canonical.pose_layout(layout.MAP))
        buckets = reference.stamps_ns // _TF_PERIOD_NS
        keep = np.flatnonzero(np.diff(buckets, prepend=buckets[:1] - 1))
        thinned = replace(reference, stamps_ns=reference.stamps_ns[keep], poses=reference.poses[keep])
        self._add_poses(thinned, layout.TF, TF_MESSAGE, canonical.transform_layout(layout.MAP, layout.BODY))

    def add_odometry(self, odometry: Trajectory) -> None:
        """Add odometry that came with the recording, `T_odom_body`, later than what was added before.

        Raises:
            FlightError: it starts before the poses added earlier end.
            ValueError: it does not place `body` in `odom`, or has no times.
        """
        _need_frames(odometry, layout.ODOM_FRAME)
        made = canonical.odometry_layout(layout.ODOM_FRAME, layout.BODY)
        self._add_poses(odometry, layout.ODOM, ODOMETRY, made)

    def add_depth(self, image: DepthImage) -> None:
        """Append a depth image, later than the one before; its depths are rounded to millimetres.

        Raises:
            FlightError: it is taken no later than the image before.
            ValueError: the calibration does not place the camera, or a time that cannot be written.
        """
        self._add_image(image.stamp_ns, image.camera, layout.DEPTH, IMAGE, camera_images.encode_depth(image))

    def add_grey(self, image: GreyImage) -> None:
        """Append a grey image, later than the one before; JPEG changes its pixels a little.

        Raises:
            FlightError: it is taken no later than the image before.
            ValueError: the calibration does not place the camera, or a time that cannot be written.
        """
        self._add_image(image.stamp_ns, image.camera, layout.GREY, COMPRESSED_IMAGE, camera_images.encode_grey(image))

    def add_raw_grey(self, data: U8, *, stamp_ns: int, camera: CameraModel) -> None:
        """Append a grey image that is encoded already, exactly as `camera_images.encode_grey` does it."""
        self._add_image(stamp_ns, camera, layout.GREY, COMPRESSED_IMAGE, data)

    def _add_image(self, stamp_ns: int, camera: CameraModel, topic: str, msgtype: str, data: U8) -> None:
        if self._calibration.T_body_camera is None:
            raise ValueError("images need a calibration with T_body_camera")
        stamps = np.array([stamp_ns], np.int64)
        self._check_order(topic, stamps)
        geometry = camera_images.camera_json(camera)
        first = (topic, geometry) not in self._channels
        channel = self._channel(topic, msgtype, {layout.CAMERA_KEY: geometry})
        if first:
            info = camera_images.encode_camera_info(camera, stamp_ns)[None]
            about = layout.DEPTH_INFO if topic == layout.DEPTH else layout.GREY_INFO
            self._wait(self._channel(about, CAMERA_INFO), stamps, lambda part: info[part])
        self._pictures.append(_Picture(stamp_ns, channel, topic, data.data))
        self._extend(stamp_ns, stamp_ns)
        if len(self._pictures) > _MOST_IMAGES:
            self._put_picture(self._pictures.popleft())

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file (calibration, control points). A name may be used once."""
        if any(a.name == name for a in self._attachments):
            raise ValueError(f"attachment {name!r} exists")
        self._attachments.append(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))

    def set_health(self, health: Mapping[str, object]) -> None:
        """What ingest found out about the recording; any JSON values."""
        self._health = health

    def _add_poses(self, poses: Trajectory, topic: str, msgtype: str, made: canonical.CdrLayout) -> None:
        if len(poses):
            self._check_order(topic, poses.stamps_ns)
            channel = self._channel(topic, msgtype)
            self._wait(channel, poses.stamps_ns, lambda part: canonical.encode_poses(_pose_part(poses, part), made))

    def _channel(self, topic: str, msgtype: str, facts: Mapping[str, str] | None = None) -> int:
        """The channel of a topic and one set of facts about its messages, told in its metadata."""
        key = topic, "".join((facts or {}).values())
        channel = self._channels.get(key)
        if channel is None:
            metadata = {"offered_qos_profiles": layout.qos_profiles(latched=topic in _LATCHED), **(facts or {})}
            channel = self._open_mcap.add_channel(topic, msgtype, definition(msgtype), metadata)
            self._channels[key] = channel
        return channel

    def _check_order(self, topic: str, stamps_ns: I64) -> None:
        last, first = self._last_ns.get(topic), int(stamps_ns[0])
        if last is not None and first <= last:
            what = "repeats" if first == last else "goes backwards"
            raise FlightError(
                self._path,
                f"time {what} on {topic}: {first} ns after {last} ns",
                expected="increasing times",
                todo="leave the message out or sort the recording",
            )
        self._last_ns[topic] = int(stamps_ns[-1])

    def _wait(self, channel: int, stamps_ns: I64, encode: Callable[[slice], U8]) -> None:
        self._pending.append(_Pending(channel, stamps_ns, encode))
        self._extend(int(stamps_ns[0]), int(stamps_ns[-1]))

    def _extend(self, first_ns: int, last_ns: int) -> None:
        self._first_ns = first_ns if self._first_ns is None else min(first_ns, self._first_ns)
        self._end_ns = max(last_ns, self._end_ns)

    def _emit_until(self, end_ns: int | None) -> None:
        """Write the pending messages up to a time (all of them for None), in order of time."""
        if (layout.TF_STATIC, "") not in self._channels:
            self._emit_calibration(end_ns)
        self._put_pictures(end_ns)
        ready: list[tuple[int, I64, U8]] = []
        for batch in self._pending:
            stop = len(batch.stamps_ns)
            if end_ns is not None:
                stop = int(np.searchsorted(batch.stamps_ns, end_ns, side="right"))
            if stop > batch.done:
                part = slice(batch.done, stop)
                ready.append((batch.channel, batch.stamps_ns[part], batch.encode(part)))
                batch.done = stop
        self._pending = [batch for batch in self._pending if batch.done < len(batch.stamps_ns)]
        if len({channel for channel, _, _ in ready}) == 1:
            for channel, stamps_ns, rows in ready:
                self._open_mcap.add_messages(channel, stamps_ns, rows, group=_REST)
            return
        due = [
            (stamp_ns, channel, memoryview(row))
            for channel, stamps_ns, rows in ready
            for stamp_ns, row in zip(stamps_ns.tolist(), rows, strict=True)
        ]
        due.sort(key=lambda message: message[:2])
        for stamp_ns, channel, message in due:
            self._open_mcap.add_message(channel, stamp_ns, message, group=_REST)

    def _put_pictures(self, end_ns: int | None) -> None:
        due = [p for p in self._pictures if end_ns is None or p.stamp_ns <= end_ns]
        for picture in sorted(due, key=lambda p: p.stamp_ns):
            self._put_picture(picture)
        self._pictures = deque(p for p in self._pictures if end_ns is not None and p.stamp_ns > end_ns)

    def _put_picture(self, picture: _Picture) -> None:
        # chunks of their own: who reads sweeps does not unpack them
        self._open_mcap.add_message(picture.channel, picture.stamp_ns, picture.data, group=picture.topic)

    def _emit_calibration(self, end_ns: int | None) -> None:
        starts = [int(batch.stamps_ns[0]) for batch in self._pending]
        starts += [self._last_ns[layout.POINTS]] if layout.POINTS in self._last_ns else []
        first = min(starts, default=0 if end_ns is None else end_ns)
        channel = self._channel(layout.TF_STATIC, TF_MESSAGE)
        data = canonical.encode_calibration(self._calibration, first)
        self._open_mcap.add_message(channel, first, data, group=_REST)

    def _finish(self) -> None:
        self._emit_until(None)
        info = layout.encode_info(self._info, self._calibration, first_ns=self._first_ns or 0, last_ns=self._end_ns)
        metadata: dict[str, dict[str, str]] = {layout.FLIGHT_RECORD: info}
        if self._health is not None:
            metadata[layout.HEALTH_RECORD] = {"json": json.dumps(self._health, sort_keys=True)}
        self._open_mcap.finish(metadata, self._attachments)


def _need_frames(trajectory: Trajectory, parent: str) -> None:
    if (trajectory.parent, trajectory.child) != (parent, layout.BODY) or not trajectory.timed:
        raise ValueError(f"needs a timed trajectory of body in {parent}, not {trajectory.child} in {trajectory.parent}")


def _imu_part(imu: ImuSamples, part: slice) -> ImuSamples:
    return ImuSamples(imu.stamps_ns[part], imu.gyro_radps[part], imu.accel_mps2[part])


def _pose_part(poses: Trajectory, part: slice) -> Trajectory:
    return replace(poses, stamps_ns=poses.stamps_ns[part], poses=poses.poses[part])
