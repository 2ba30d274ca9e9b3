"""From the raw messages of one topic into a flight, watched on the way."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from mineloc.data import F32, Sweep, Trajectory
from mineloc.errors import IngestError
from mineloc.io.cloud_transcoder import CanonicalCloud, CanonicalView, CloudTranscoder, learn
from mineloc.io.findings import Finding
from mineloc.io.flight_layout import PERIOD_KEY
from mineloc.io.flight_writer import FlightWriter
from mineloc.io.header_stamps import header_stamps_ns
from mineloc.io.health import PointsHealth
from mineloc.io.imu_monitor import ImuMonitor
from mineloc.io.messages import ImuDecoder, PoseDecoder
from mineloc.io.motion_watch import MotionWatch
from mineloc.io.recording import RawMessage
from mineloc.io.sequence import LidarRules
from mineloc.io.stream_statistics import Sampler
from mineloc.io.sweep_decoder import DecodedSweep, SweepDecoder
from mineloc.io.topic_monitor import TopicMonitor

# Small messages are decoded so many at once.
_PORTION = 256
# What nouns and encoders raise over values that are beyond any clock or frame: a checksum holds for what was written,
# and a driver may write anything.
ABSURD = (ValueError, ArithmeticError, struct.error)


class Intake(Protocol):
    """Takes the messages of one topic."""

    @property
    def monitor(self) -> TopicMonitor:
        """What was seen of the topic's times."""
        ...

    @property
    def findings(self) -> Sequence[Finding]:
        """What was found in the messages themselves."""
        ...

    @property
    def unreadable(self) -> Unreadable:
        """The messages that could not be decoded."""
        ...

    def take(self, raw: RawMessage) -> None:
        """Take the next message."""
        ...

    def flush(self) -> None:
        """Hand to the writer what is held back."""
        ...


class Unreadable:
    """Counts messages whose bytes do not fit their schema, or whose values fit no clock, and keeps the first error."""

    def __init__(self) -> None:
        self.count = 0
        self.first: IngestError | None = None

    def add(self, error: Exception, where: str) -> None:
        """One more."""
        self.count += 1
        if self.first is None:
            told = error if isinstance(error, IngestError) else None
            self.first = told or IngestError(where, f"values that no sensor sends ({error})", expected="measurements")


class LidarIntake:
    """Clouds to sweeps.

    Args:
        monitor: of the topic.
        decoder: for clouds of any driver; those of a canonical flight are passed on as they are.
        told: the sequence file's `[lidar]` section.
        motion: told of the sweeps.
        writer: where they go.
    """

    def __init__(
        self,
        monitor: TopicMonitor,
        decoder: SweepDecoder,
        told: LidarRules,
        motion: MotionWatch,
        writer: FlightWriter,
    ) -> None:
        self.monitor = monitor
        self.unreadable = Unreadable()
        self._decoder = decoder
        self._told = told
        self._transcoder: CloudTranscoder | None = None
        self._canonical = CanonicalView()
        self._may_learn = True
        self._motion = motion
        self._writer = writer
        self._points = Sampler()
        self._message_points = 0
        self._kept_points = 0
        self._fields: frozenset[str] = frozenset()
        self.clouds = 0

    @property
    def findings(self) -> Sequence[Finding]:
        """See `Intake`."""
        return self._decoder.findings

    def take(self, raw: RawMessage) -> None:
        """Take the next cloud; see `Intake`.

        Raises:
            IngestError: clouds without x y z, or whose point times fit no rule.
        """
        self.clouds += 1
        try:
            message = raw.message
        except IngestError as error:
            self.unreadable.add(error, raw.topic)
            return
        try:
            self._take(raw, message)
        except ABSURD as error:
            self.unreadable.add(error, raw.topic)

    def _take(self, raw: RawMessage, message: object) -> None:
        if self._pass_on(raw, message) or self._rewrite(raw, message):
            return
        for decoded in self._decoder.decode(message, log_ns=raw.log_ns):
            self._write(decoded)
        if self._may_learn and self._decoder.time_rule is not None:
            self._may_learn = False
            self._transcoder = learn(self._decoder, self._told, message)

    def flush(self) -> None:
        """See `Intake`."""
        try:
            for decoded in self._decoder.finish():
                self._write(decoded)
        except ABSURD as error:
            self.unreadable.add(error, self.monitor.topic.name)
        self.monitor.catch_up()

    def _pass_on(self, raw: RawMessage, message: object) -> bool:
        """Write a sweep of a canonical flight as it stands; False if it is none."""
        period = raw.notes.get(PERIOD_KEY, "")
        cloud = self._canonical(raw.data, message) if period.isdigit() and self._told == LidarRules() else None
        if cloud is None:
            return False
        self._write_raw(cloud, int(period), raw.log_ns, raw.publish_ns)
        return True

    def _rewrite(self, raw: RawMessage, message: object) -> bool:
        """Write a cloud that is like those before without decoding it; False if it is not."""
        if self._transcoder is None:
            return False
        cloud = self._transcoder.transcode(message)
        if cloud is None:
            return False
        self._write_raw(cloud, self._transcoder.period_ns, raw.log_ns, max(raw.log_ns, 0))
        return True

    def _write_raw(self, cloud: CanonicalCloud, period_ns: int, log_ns: int, publish_ns: int) -> None:
        n = len(cloud.points)
        if self._accept(cloud.stamp_ns, log_ns, cloud.header_ns, cloud.points, n):
            self._fields = self._fields or cloud.fields
            self._writer.add_raw_sweep(
                cloud.data,
                stamp_ns=cloud.stamp_ns,
                end_ns=cloud.end_ns,
                period_ns=period_ns,
                publish_ns=publish_ns,
            )

    def _write(self, decoded: DecodedSweep) -> None:
        sweep = decoded.sweep
        if self._accept(sweep.stamp_ns, decoded.log_ns, decoded.header_ns, sweep.points_lidar, decoded.message_points):
            self._fields = self._fields or _fields_of(sweep)
            self._writer.add_sweep(sweep, publish_ns=max(decoded.log_ns, 0))

    def _accept(self, stamp_ns: int, log_ns: int, header_ns: int, points: F32, message_points: int) -> bool:
        """Watch a sweep; False if its time has been before."""
        if not self.monitor.take_one(stamp_ns, log_ns, header_ns):
            return False
        self._points.add_one(float(len(points)))
        self._message_points += message_points
        self._kept_points += len(points)
        self._motion.take_sweep(stamp_ns, points)
        return True

    def points_health(self) -> PointsHealth | None:
        """What was seen of the points; None without a sweep."""
        if not self.monitor.used:
            return None
        empty = sum(finding.count for finding in self.findings if finding.name == "empty_sweeps")
        return PointsHealth(
            median=round(self._points.median),
            least=round(self._points.smallest),
            most=round(self._points.largest),
            dropped=self._message_points - self._kept_points,
            empty_sweeps=empty,
            point_times="t" in self._fields,
            rings="ring" in self._fields,
            intensity="intensity" in self._fields,
        )


def _fields_of(sweep: Sweep) -> frozenset[str]:
    there = {"t": sweep.has_point_times, "ring": sweep.ring is not None, "intensity": sweep.intensity is not None}
    return frozenset(["x", *(name for name, is_there in there.items() if is_there)])


class _Portions:
    """Holds messages back until there are enough of them to be decoded at once."""

    def __init__(self, monitor: TopicMonitor) -> None:
        self.monitor = monitor
        self.unreadable = Unreadable()
        self._held: list[RawMessage] = []

    def take(self, raw: RawMessage) -> None:
        """Take the next message; see `Intake`."""
        self._held.append(raw)
        if len(self._held) >= _PORTION:
            self.flush()

    def flush(self) -> None:
        """See `Intake`."""
        held, self._held = self._held, []
        if held:
            logs = np.array([raw.log_ns for raw in held], dtype=np.int64)
            self.monitor.take(header_stamps_ns(held), logs)
            self._write_all(held)

    def _write_all(self, held: list[RawMessage]) -> None:
        """All at once; if something in them is absurd one by one, to lose only what is."""
        try:
            self._write(held)
        except ABSURD as error:
            if len(held) == 1:
                self.unreadable.add(error, held[0].topic)
                return
            for raw in held:
                self._write_all([raw])

    def _write(self, held: list[RawMessage]) -> None:
        raise NotImplementedError

    def _readable(self, held: Sequence[RawMessage]) -> list[RawMessage]:
        """Those that decode; the others are counted."""
        good: list[RawMessage] = []
        for raw in held:
            try:
                _ = raw.message
            except IngestError as error:
                self.unreadable.add(error, raw.topic)
            else:
                good.append(raw)
        return good


class ImuIntake(_Portions):
    """Imu messages to inertial samples."""

    def __init__(self, monitor: TopicMonitor, decoder: ImuDecoder, writer: FlightWriter) -> None:
        super().__init__(monitor)
        self.samples = ImuMonitor()
        self._decoder = decoder
        self._writer = writer

    @property
    def findings(self) -> Sequence[Finding]:
        """See `Intake`."""
        return self._decoder.findings

    def _write(self, held: list[RawMessage]) -> None:
        try:
            samples = self._decoder.decode(held)
        except IngestError:
            readable = self._readable(held)
            if len(readable) == len(held):
                raise
            samples = self._decoder.decode(readable)
        self.samples.take(samples.gyro_radps, samples.accel_mps2)
        self._writer.add_imu(samples)


class PoseIntake(_Portions):
    """Pose messages to reference or odometry.

    Args:
        write: `FlightWriter.add_reference` or `.add_odometry`.
        motion: told of the positions, None if they do not count as truth.
    """

    def __init__(
        self,
        monitor: TopicMonitor,
        decoder: PoseDecoder,
        write: Callable[[Trajectory], None],
        motion: MotionWatch | None,
    ) -> None:
        super().__init__(monitor)
        self._decoder = decoder
        self._write_poses = write
        self._motion = motion

    @property
    def findings(self) -> Sequence[Finding]:
        """See `Intake`."""
        return self._decoder.findings

    def _write(self, held: list[RawMessage]) -> None:
        for raw in held:
            try:
                message = raw.message
            except IngestError as error:
                self.unreadable.add(error, raw.topic)
                continue
            self._decoder.add(message)
        poses = self._decoder.take()
        if poses is not None:
            self._write_poses(poses)
            if self._motion is not None:
                self._motion.take_positions(poses.positions_m)
