"""A whole recording into a flight: who takes which topic, and what was seen of all of them together."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from typing import Any, cast

import numpy as np

from mineloc.config import IngestConfig
from mineloc.errors import IngestError
from mineloc.io import flight_layout as layout
from mineloc.io.findings import Finding
from mineloc.io.flight_plan import Plan
from mineloc.io.flight_writer import FlightWriter
from mineloc.io.health import Health, HealthFinding, Severity, sorted_findings
from mineloc.io.image_intake import CanonicalGreyIntake, ImageIntake
from mineloc.io.imu_monitor import ImuMonitor
from mineloc.io.intake import ImuIntake, Intake, LidarIntake, PoseIntake
from mineloc.io.messages import ImuDecoder, PoseDecoder
from mineloc.io.motion_watch import MotionWatch
from mineloc.io.recording import RawMessage, Recording, Topic
from mineloc.io.ros_images import depth_image, grey_image
from mineloc.io.sequence import ReferenceRules, Sequence
from mineloc.io.sweep_decoder import SweepDecoder
from mineloc.io.topic_monitor import TopicMonitor

_NS = 1e-9
# A clock that goes back further was set anew: leaving out what is repeated would leave out the flight.
_DEEPEST_NS = 1_000_000_000
# What ingest does as a matter of course; everything else that a decoder finds is a warning.
_INFO = frozenset(
    {"points_not_finite", "points_at_origin", "point_times", "header_at_end", "rings_recovered", "rings_renamed"}
    | {"azimuth_times"}
)
# The topic monitors tell these with more detail.
_TOLD_BY_MONITOR = frozenset({"imu_time_not_increasing", "pose_time_not_increasing"})


class FlightIntake:
    """Hands each message of a recording to whoever takes its topic.

    Args:
        recording: opened.
        plan: of that recording.
        told: the sequence file.
        writer: of the flight, entered.
        config: ingest section.
    """

    def __init__(
        self, recording: Recording, plan: Plan, told: Sequence, writer: FlightWriter, config: IngestConfig
    ) -> None:
        self._recording = recording
        self._plan = plan
        self._config = config
        self._motion = MotionWatch()
        self.lidar: LidarIntake | None = None
        self._imu: ImuIntake | None = None
        self._takers: dict[str, Intake] = {}
        roles = plan.roles
        if roles.imu is not None:
            decoder = ImuDecoder(told.imu, where=self._where(roles.imu))
            self._imu = ImuIntake(TopicMonitor("imu", roles.imu), decoder, writer)
            self._takers[roles.imu.name] = self._imu
        if roles.lidar is not None:
            sweeps = SweepDecoder(told.lidar, where=self._where(roles.lidar))
            monitor = TopicMonitor("lidar", roles.lidar)
            self.lidar = LidarIntake(monitor, sweeps, told.lidar, self._motion, writer)
            self._takers[roles.lidar.name] = self.lidar
        if roles.reference is not None:
            monitor = TopicMonitor("reference", roles.reference)
            poses = self._pose_decoder(roles.reference, told.reference, told.T_places_body, layout.MAP)
            self._takers[roles.reference.name] = PoseIntake(monitor, poses, writer.add_reference, self._motion)
        if roles.odometry is not None:
            monitor = TopicMonitor("odometry", roles.odometry)
            poses = self._pose_decoder(roles.odometry, ReferenceRules(), np.eye(4), layout.ODOM_FRAME)
            self._takers[roles.odometry.name] = PoseIntake(monitor, poses, writer.add_odometry, None)
        self._take_images(writer)

    def _take_images(self, writer: FlightWriter) -> None:
        depth, grey = self._plan.depth, self._plan.grey
        if depth is not None and depth.camera is not None:
            monitor = TopicMonitor("depth", depth.topic)
            self._takers[depth.topic.name] = ImageIntake(monitor, depth.camera, depth_image, writer.add_depth)
        if grey is not None and grey.camera is not None:
            monitor = TopicMonitor("grey", grey.topic)
            # what is JPEG in a flight already would lose a little more
            as_it_is = self._plan.earlier is not None and grey.topic.name == layout.GREY
            self._takers[grey.topic.name] = (
                CanonicalGreyIntake(monitor, writer)
                if as_it_is
                else ImageIntake(monitor, grey.camera, grey_image, writer.add_grey)
            )

    def _where(self, topic: Topic) -> str:
        return f"{self._recording.path}: {topic.name}"

    def _pose_decoder(self, topic: Topic, rules: ReferenceRules, T_places_body: Any, parent: str) -> PoseDecoder:
        return PoseDecoder(topic.msgtype, rules, T_places_body, parent=parent, where=self._where(topic))

    def run(self, step: Callable[[RawMessage], None]) -> None:
        """Take all messages; `step` is called after each.

        Raises:
            IngestError: clouds that cannot be understood, wrong units, time that goes back by more than a second.
        """
        # absurd values overflow; what comes of them is looked at
        with closing(cast("Any", self._recording.messages(list(self._takers)))) as messages, np.errstate(all="ignore"):
            for raw in messages:
                taker = self._takers[raw.topic]
                taker.take(raw)
                if taker.monitor.deepest_ns > _DEEPEST_NS:
                    raise self._goes_back(taker.monitor)
                step(raw)
        for taker in self._takers.values():
            with np.errstate(all="ignore"):
                taker.flush()
            if taker.monitor.deepest_ns > _DEEPEST_NS:
                raise self._goes_back(taker.monitor)

    def _goes_back(self, monitor: TopicMonitor) -> IngestError:
        return IngestError(
            self._where(monitor.topic),
            f"time goes backwards by {monitor.deepest_ns * _NS:.3f} s to {monitor.deepest_at_ns * _NS:.3f} s",
            expected="increasing times",
            todo="cut the recording where the clock was set, and ingest the parts",
        )

    def health(self, further: Iterable[HealthFinding] = ()) -> Health:
        """What was seen, with further findings of the caller; call it after `run`.

        Raises:
            IngestError: what was seen makes no flight.
        """
        self._refuse_unusable()
        factor = self._config.gap_factor
        takers = sorted(self._takers.values(), key=lambda t: _ROLE_ORDER.index(t.monitor.role))
        findings = [*self._plan.remarks, *further]
        for taker in takers:
            findings += taker.monitor.findings(gap_factor=factor)
            findings += [_graded(f) for f in taker.findings if f.name not in _TOLD_BY_MONITOR]
            findings += _unreadable(taker)
        findings += self._sensor_findings()
        return Health(
            source=self._recording.path.name,
            kind=self._recording.kind,
            topics=tuple(taker.monitor.result(gap_factor=factor) for taker in takers),
            points=None if self.lidar is None else self.lidar.points_health(),
            damage=tuple(self._recording.damage),
            findings=sorted_findings(findings),
            earlier=self._plan.earlier,
        )

    def _sensor_findings(self) -> list[HealthFinding]:
        found: list[HealthFinding] = []
        points = None if self.lidar is None else self.lidar.points_health()
        if points is not None and not points.point_times:
            line = "sweeps have no point times: they count as instants, motion within them stays in the points"
            found.append(HealthFinding("no_point_times", "warning", 1, line))
        samples: ImuMonitor | None = None
        if self._imu is not None:
            samples = self._imu.samples
            found += samples.findings(self._imu.monitor.topic.name)
        if self._motion.stood_still and (samples is None or samples.is_quiet or self._has("reference")):
            line = "nothing moved: the drone stood still, or the roadway has no features along it"
            found.append(HealthFinding("stationary", "warning", 1, line))
        return found

    def _has(self, role: str) -> bool:
        return any(taker.monitor.role == role for taker in self._takers.values())

    def _refuse_unusable(self) -> None:
        for taker in self._takers.values():
            monitor = taker.monitor
            if monitor.messages >= 2 and monitor.used * 2 < monitor.messages:
                raise self._few_times(monitor)
        if self.lidar is not None:
            self._refuse_lidar(self.lidar)
        elif not any(taker.monitor.used for taker in self._takers.values()):
            raise self._first_error() or IngestError(
                self._recording.path, "not a single pose can be used", expected="poses", todo="check the recording"
            )

    def _few_times(self, monitor: TopicMonitor) -> IngestError:
        return IngestError(
            self._where(monitor.topic),
            f"{monitor.messages} messages have only {monitor.used} increasing times "
            f"(the first is {monitor.first_ns * _NS:.9f} s)",
            expected="a header.stamp for each message",
            todo="record with a driver that sets header.stamp",
        )

    def _refuse_lidar(self, lidar: LidarIntake) -> None:
        used, where = lidar.monitor.used, self._where(lidar.monitor.topic)
        if used >= 2:
            return
        if not lidar.clouds:
            raise IngestError(where, "no clouds", expected="a flight", todo="check that the LiDAR's driver was running")
        if used == 1:
            raise IngestError(
                where,
                "one sweep" if lidar.clouds == 1 else f"one usable sweep of {lidar.clouds} clouds",
                expected="a flight of at least two sweeps",
                todo="record the whole flight",
            )
        raise self._first_error() or IngestError(
            where,
            f"{lidar.clouds} clouds without a single return (NaN or zero points, or empty)",
            expected="points",
            todo="check the LiDAR and its driver",
        )

    def _first_error(self) -> IngestError | None:
        errors = [taker.unreadable.first for taker in self._takers.values()]
        return next((error for error in errors if error is not None), None)


_ROLE_ORDER = ("lidar", "imu", "reference", "odometry", "depth", "grey")


def _graded(finding: Finding) -> HealthFinding:
    severity: Severity = "info" if finding.name in _INFO else "warning"
    return HealthFinding(finding.name, severity, finding.count, finding.detail)


def _unreadable(taker: Intake) -> list[HealthFinding]:
    bad = taker.unreadable
    if bad.first is None:
        return []
    line = f"{bad.count} messages on {taker.monitor.topic.name} could not be decoded: {bad.first.found}"
    return [HealthFinding(f"{taker.monitor.role}_unreadable", "warning", bad.count, line)]
