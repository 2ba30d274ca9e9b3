"""A whole recording into a flight: who takes which topic, and what was seen of all of them together."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from mineloc.config import IngestConfig
from mineloc.data import Calibration, FlightInfo
from mineloc.errors import IngestError
from mineloc.io import flight_layout as layout
from mineloc.io.depth_intake import DepthIntake, DepthTopic, find_depth, why_left_out
from mineloc.io.findings import Finding
from mineloc.io.flight_writer import FlightWriter
from mineloc.io.grey_intake import GreyIntake
from mineloc.io.health import Health, HealthFinding, Severity, sorted_findings
from mineloc.io.imu_monitor import ImuMonitor
from mineloc.io.intake import ImuIntake, Intake, LidarIntake, PoseIntake
from mineloc.io.messages import ImuDecoder, PoseDecoder
from mineloc.io.motion_watch import MotionWatch
from mineloc.io.recording import RawMessage, Recording, Topic
from mineloc.io.ros import TF_MESSAGE
from mineloc.io.sequence import ReferenceRules, Sequence
from mineloc.io.static_frames import StaticFrames, frame_name
from mineloc.io.sweep_decoder import SweepDecoder
from mineloc.io.topic_monitor import TopicMonitor
from mineloc.io.topic_roles import Roles, choose_roles

_NS = 1e-9
# A clock that goes back further was set anew: leaving out what is repeated would leave out the flight.
_DEEPEST_NS = 1_000_000_000
_TF_STATIC_SPAN_NS = 10_000_000_000
# What ingest does as a matter of course; everything else that a decoder finds is a warning.
_INFO = frozenset(
    {"points_not_finite", "points_at_origin", "point_times", "header_at_end", "rings_recovered", "rings_renamed"}
    | {"azimuth_times"}
)
# The topic monitors tell these with more detail.
_TOLD_BY_MONITOR = frozenset({"imu_time_not_increasing", "pose_time_not_increasing"})


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What a recording will become.

    Attributes:
        roles: which topic is what.
        info, calibration: facts for the flight.
        remarks: where they come from, one finding each.
        earlier: the health record of a recording that is a flight already.
        depth: the topic of depth images that can be used.
    """

    roles: Roles
    info: FlightInfo
    calibration: Calibration
    remarks: tuple[HealthFinding, ...]
    earlier: Mapping[str, Any] | None
    depth: DepthTopic | None = None


def plan_flight(recording: Recording, told: Sequence) -> Plan:
    """Decide what each topic is and where the sensors sit.

    Args:
        recording: opened.
        told: the sequence file; an empty one if there is none.

    Raises:
        IngestError: ambiguous, missing or undecodable topics.
    """
    roles = choose_roles(recording.path, recording.topics, told.topics)
    depth, assumed = find_depth(recording, told.topics.depth)
    remarks = [*(HealthFinding("topic_assumed", "info", 1, line) for line in roles.assumed), *assumed]
    facts = _own_facts(recording)
    info = told.flight_info(source=recording.path.name)
    calibration, earlier = told.calibration, None
    if facts is not None:
        own, calibration, earlier = facts
        remarks = []  # the topics of a flight are what they are called
        info = _override(own, info)
    if "T_body" in told.model_fields_set:
        calibration = told.calibration
    elif facts is None and (found := _static_calibration(recording, roles, depth)) is not None:
        calibration, body = found
        line = f"sensors are placed by /tf_static: {body} counts as the body"
        remarks.append(HealthFinding("calibration_from_tf", "info", 1, line))
    if (
        depth is not None
        and (left_out := why_left_out(depth, placed=calibration.T_body_camera is not None)) is not None
    ):
        remarks.append(left_out)
        depth = None
    return Plan(roles, info, calibration, tuple(remarks), earlier, depth)


def _own_facts(recording: Recording) -> tuple[FlightInfo, Calibration, Mapping[str, Any]] | None:
    """What a recording that is a flight already says about itself."""
    record = recording.metadata.get(layout.FLIGHT_RECORD)
    if record is None:
        return None
    info, calibration, _, _ = layout.decode_info(recording.path, record)
    text = recording.metadata.get(layout.HEALTH_RECORD, {}).get("json", "{}")
    try:
        health: object = json.loads(text)
    except ValueError:
        health = {}
    return info, calibration, cast("Mapping[str, Any]", health) if isinstance(health, dict) else {}


def _override(own: FlightInfo, told: FlightInfo) -> FlightInfo:
    """The flight's own facts, except where a sequence file says otherwise; the source stays the first one."""
    values = {name: getattr(told, name) or getattr(own, name) for name in FlightInfo.__dataclass_fields__}
    return FlightInfo(**{**values, "source": own.source or told.source})


def _static_calibration(recording: Recording, roles: Roles, depth: DepthTopic | None) -> tuple[Calibration, str] | None:
    names = [t.name for t in recording.topics.values() if t.msgtype == TF_MESSAGE and t.name.endswith("tf_static")]
    if not names:
        return None
    frames = StaticFrames()
    until_ns: int | None = None
    # latched transforms stand at the beginning; some systems repeat them until the end
    with closing(_stream(recording, names)) as messages:
        for raw in messages:
            until_ns = raw.log_ns + _TF_STATIC_SPAN_NS if until_ns is None else until_ns
            if raw.log_ns > until_ns:
                break
            with suppress(IngestError):  # one that does not decode places nothing
                frames.add(raw.message)
    camera = "" if depth is None else depth.frame
    return frames.calibration(_frame_of(recording, roles.lidar), _frame_of(recording, roles.imu), camera)


def _frame_of(recording: Recording, topic: Topic | None) -> str:
    if topic is None:
        return ""
    with closing(_stream(recording, [topic.name])) as messages:
        for raw in messages:
            with suppress(IngestError):
                return frame_name(raw.message.header.frame_id)
    return ""


def _stream(recording: Recording, names: Iterable[str]) -> Any:
    return recording.messages(list(names))


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
        if plan.depth is not None and plan.depth.camera is not None:
            topic = plan.depth.topic
            self._takers[topic.name] = DepthIntake(TopicMonitor("depth", topic), plan.depth.camera, writer)
        grey = recording.topics.get(layout.GREY)
        if grey is not None and plan.earlier is not None and plan.calibration.T_body_camera is not None:
            self._takers[grey.name] = GreyIntake(TopicMonitor("grey", grey), writer)

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
        with closing(_stream(self._recording, self._takers)) as messages, np.errstate(all="ignore"):
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
