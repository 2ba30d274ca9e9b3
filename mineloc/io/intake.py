"""From the raw messages of one topic into a flight, watched on the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from mineloc.data import Sweep, Trajectory
from mineloc.errors import IngestError
from mineloc.io import canonical
from mineloc.io.findings import Finding
from mineloc.io.flight_layout import PERIOD_KEY
from mineloc.io.flight_writer import FlightWriter
from mineloc.io.header_stamps import header_stamps_ns
from mineloc.io.health import PointsHealth
from mineloc.io.imu_monitor import ImuMonitor
from mineloc.io.messages import ImuDecoder, PoseDecoder
from mineloc.io.motion_watch import MotionWatch
from mineloc.io.recording import RawMessage
from mineloc.io.stream_statistics import Sampler
from mineloc.io.sweep_decoder import SweepDecoder
from mineloc.io.topic_monitor import TopicMonitor

# Small messages are decoded so many at once.
_PORTION = 256


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
    """Counts messages whose bytes do not fit their schema, and keeps the first error."""

    def __init__(self) -> None:
        self.count = 0
        self.first: IngestError | None = None

    def add(self, error: IngestError) -> None:
        """One more."""
        self.count += 1
        self.first = error if self.first is None else self.first


class LidarIntake:
    """Clouds to sweeps.

    Args:
        monitor: of the topic.
        decoder: for clouds of any driver; those of a canonical flight are passed on as they are.
        motion: told of the sweeps.
        writer: where they go.
        before_sweep: called before each sweep is written, so that inertial samples of its time go first.
    """

    def __init__(
        self,
        monitor: TopicMonitor,
        decoder: SweepDecoder,
        motion: MotionWatch,
        writer: FlightWriter,
        before_sweep: Callable[[], None],
    ) -> None:
        self.monitor = monitor
        self.unreadable = Unreadable()
        self._decoder = decoder
        self._motion = motion
        self._writer = writer
        self._before_sweep = before_sweep
        self._points = Sampler()
        self._message_points = 0
        self._kept_points = 0
        self._last: Sweep | None = None
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
        if PERIOD_KEY in raw.notes and self._pass_on(raw):
            return
        try:
            message = raw.message
        except IngestError as error:
            self.unreadable.add(error)
            return
        for decoded in self._decoder.decode(message, log_ns=raw.log_ns):
            self._write(decoded.sweep, decoded.log_ns, decoded.header_ns, decoded.message_points)

    def flush(self) -> None:
        """See `Intake`."""
        for decoded in self._decoder.finish():
            self._write(decoded.sweep, decoded.log_ns, decoded.header_ns, decoded.message_points)

    def _pass_on(self, raw: RawMessage) -> bool:
        """Write a canonical sweep as it stands; False if it is none, or holds what a canonical sweep must not."""
        try:
            sweep = canonical.decode_sweep(raw.data, period_ns=int(raw.notes[PERIOD_KEY]))
        except Exception:  # noqa: BLE001  # whatever it is, it is not ours: the decoder will look at it
            return False
        if not len(sweep) or not bool(np.isfinite(sweep.points_lidar).all()):
            return False
        if self._accept(sweep, raw.log_ns, sweep.stamp_ns, len(sweep)):
            self._writer.add_raw_sweep(
                raw.data,
                stamp_ns=sweep.stamp_ns,
                end_ns=sweep.end_ns,
                period_ns=sweep.period_ns,
                publish_ns=raw.publish_ns,
            )
        return True

    def _write(self, sweep: Sweep, log_ns: int, header_ns: int, message_points: int) -> None:
        if self._accept(sweep, log_ns, header_ns, message_points):
            self._writer.add_sweep(sweep, publish_ns=max(log_ns, 0))

    def _accept(self, sweep: Sweep, log_ns: int, header_ns: int, message_points: int) -> bool:
        stamp, log, header = (np.array([t], dtype=np.int64) for t in (sweep.stamp_ns, log_ns, header_ns))
        if not self.monitor.take(stamp, log, headers_ns=header)[0]:
            return False
        self._points.add(np.array([float(len(sweep))]))
        self._message_points += message_points
        self._kept_points += len(sweep)
        self._last = sweep
        self._motion.take_sweep(sweep)
        self._before_sweep()
        return True

    def points_health(self) -> PointsHealth | None:
        """What was seen of the points; None without a sweep."""
        if self._last is None:
            return None
        empty = sum(finding.count for finding in self.findings if finding.name == "empty_sweeps")
        return PointsHealth(
            median=round(self._points.median),
            least=round(self._points.smallest),
            most=round(self._points.largest),
            dropped=self._message_points - self._kept_points,
            empty_sweeps=empty,
            point_times=self._last.has_point_times,
            rings=self._last.ring is not None,
            intensity=self._last.intensity is not None,
        )


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
            self._write(held)

    def _write(self, held: list[RawMessage]) -> None:
        raise NotImplementedError

    def _readable(self, held: Sequence[RawMessage]) -> list[RawMessage]:
        """Those that decode; the others are counted."""
        good: list[RawMessage] = []
        for raw in held:
            try:
                _ = raw.message
            except IngestError as error:
                self.unreadable.add(error)
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
                self.unreadable.add(error)
                continue
            self._decoder.add(message)
        poses = self._decoder.take()
        if poses is not None:
            self._write_poses(poses)
            if self._motion is not None:
                self._motion.take_positions(poses.positions_m)
