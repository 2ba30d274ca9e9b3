"""Inertial and pose messages of a recording, as arrays: units, order and finiteness checked, oddities counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from mineloc import se3
from mineloc.data import ImuSamples, Trajectory
from mineloc.errors import IngestError
from mineloc.io.canonical import imu_layout
from mineloc.io.cdr_layout import stamps_ns
from mineloc.io.findings import Finding, FindingCounter
from mineloc.io.ros import ODOMETRY, POSE_COVARIANCE, POSE_STAMPED, TF_MESSAGE, TRANSFORM_STAMPED
from mineloc.io.sequence import ImuRules, ReferenceRules

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]

POSE_TYPES = (ODOMETRY, POSE_STAMPED, POSE_COVARIANCE, TRANSFORM_STAMPED, TF_MESSAGE)

STANDARD_GRAVITY_MPS2 = 9.80665
# A flying drone feels about 1 g on average and turns slower than this; anything else is a wrong unit.
_PLAUSIBLE_ACCEL_MPS2 = (4.0, 25.0)
_FASTEST_GYRO_RADPS = 8.0
_CHECKED_SAMPLES = 200


class RawImu(Protocol):
    """A message as stored and as decoded (see `recording.RawMessage`)."""

    @property
    def data(self) -> bytes | memoryview:
        """The serialised message."""
        ...

    @property
    def message(self) -> object:
        """The decoded message."""
        ...


class ImuDecoder:
    """Turns Imu messages into samples with increasing times, in portions.

    Samples that are not finite or not later than the one before are dropped and counted.

    Args:
        rules: the sequence file's `[imu]` section.
        where: recording and topic, for errors.
    """

    def __init__(self, rules: ImuRules, *, where: str) -> None:
        self._accel = STANDARD_GRAVITY_MPS2 if rules.accel_unit == "g" else 1.0
        self._gyro = np.pi / 180 if rules.gyro_unit == "degps" else 1.0
        self._where = where
        self._last_ns: int | None = None
        self._unchecked: list[ImuSamples] = []
        self._checked = False
        self._found = FindingCounter()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was dropped so far."""
        return self._found.findings

    def decode(self, messages: Sequence[RawImu]) -> ImuSamples:
        """The samples in the next messages of the topic.

        Raises:
            IngestError: a message that does not decode, or values that cannot be m/s² and rad/s.
        """
        if not messages:
            return ImuSamples.empty()
        rows = _fixed_size_rows([m.data for m in messages]) or _decoded_rows([m.message for m in messages])
        samples = self._in_order(rows[0], rows[1] * self._gyro, rows[2] * self._accel)
        if not self._checked:
            self._check_units(samples)
        return samples

    def _in_order(self, stamps: I64, gyro: F64, accel: F64) -> ImuSamples:
        good = np.asarray(np.isfinite(np.hstack([gyro, accel])).all(axis=1), dtype=np.bool_)
        self._found.add("imu_not_finite", "inertial samples with NaN were dropped", count=int((~good).sum()))
        later = increasing(stamps, good, self._last_ns)
        self._found.add(
            "imu_time_not_increasing",
            "inertial samples no later than the one before were dropped",
            count=int((good & ~later).sum()),
        )
        if later.any():
            self._last_ns = int(stamps[later][-1])
        return ImuSamples(stamps[later], gyro[later], accel[later])

    def _check_units(self, samples: ImuSamples) -> None:
        """Refuse wrong units once enough samples have been seen."""
        self._unchecked.append(samples)
        if sum(map(len, self._unchecked)) < _CHECKED_SAMPLES:
            return
        accel = float(np.median(np.linalg.norm(np.concatenate([s.accel_mps2 for s in self._unchecked]), axis=1)))
        gyro = float(np.median(np.linalg.norm(np.concatenate([s.gyro_radps for s in self._unchecked]), axis=1)))
        self._checked, self._unchecked = True, []
        # a dead sensor, all zero, is no unit mistake
        if accel and not _PLAUSIBLE_ACCEL_MPS2[0] <= accel <= _PLAUSIBLE_ACCEL_MPS2[1]:
            raise IngestError(
                self._where,
                f"median acceleration {accel:.3g} m/s²",
                expected="about 9.8 (specific force, with gravity)",
                todo='set accel_unit in the [imu] section of a sequence file, or topics.imu = "none"',
            )
        if gyro > _FASTEST_GYRO_RADPS:
            raise IngestError(
                self._where,
                f"median angular rate {gyro:.3g} rad/s",
                expected=f"less than {_FASTEST_GYRO_RADPS:g}",
                todo='set gyro_unit in the [imu] section of a sequence file, or topics.imu = "none"',
            )


def _fixed_size_rows(payloads: Sequence[bytes | memoryview]) -> tuple[I64, F64, F64] | None:
    """All messages at once, where they are little-endian CDR with one `frame_id`; None where they are not."""
    try:
        length = int.from_bytes(payloads[0][12:16], "little")
        frame = bytes(payloads[0][16 : 16 + length]).decode()
        if not frame.endswith("\0") or len(frame) > 256:
            return None
        records = imu_layout(frame[:-1]).view(b"".join(payloads))
    except ValueError:
        return None
    if len(records) != len(payloads):
        return None
    return stamps_ns(records), records["gyro_radps"].copy(), records["accel_mps2"].copy()


def _decoded_rows(messages: Sequence[object]) -> tuple[I64, F64, F64]:
    stamps = np.empty(len(messages), np.int64)
    values = np.empty((len(messages), 6))
    for i, message in enumerate(messages):
        imu = cast("Any", message)
        gyro, accel = imu.angular_velocity, imu.linear_acceleration
        stamps[i] = message_stamp_ns(imu)
        values[i] = gyro.x, gyro.y, gyro.z, accel.x, accel.y, accel.z
    return stamps, values[:, :3], values[:, 3:]


def message_stamp_ns(message: object) -> int:
    """`header.stamp` in nanoseconds."""
    stamp = cast("Any", message).header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def increasing(stamps: I64, good: NDArray[np.bool_], last_ns: int | None) -> NDArray[np.bool_]:
    """Which good rows are later than all good ones before them (and than `last_ns`)."""
    floor = np.iinfo(np.int64).min if last_ns is None else last_ns
    high = np.maximum.accumulate(np.where(good, stamps, floor))
    before = np.concatenate([[floor], np.maximum(high[:-1], floor)])
    return good & (stamps > before)


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """A pose as a message gives it.

    Attributes:
        stamp_ns: `header.stamp`.
        values: (7,) position and xyzw quaternion.
        frame: `header.frame_id`.
        child: `child_frame_id`, empty where the type has none.
    """

    stamp_ns: int
    values: tuple[float, ...]
    frame: str
    child: str


def poses_of(message: object, msgtype: str) -> list[StampedPose]:
    """The poses in a decoded message of one of `POSE_TYPES`.

    Raises:
        ValueError: another type.
    """
    m = cast("Any", message)
    if msgtype == TF_MESSAGE:
        return [pose for transform in m.transforms for pose in poses_of(transform, TRANSFORM_STAMPED)]
    if msgtype == TRANSFORM_STAMPED:
        position, orientation = m.transform.translation, m.transform.rotation
    elif msgtype == POSE_STAMPED:
        position, orientation = m.pose.position, m.pose.orientation
    elif msgtype in (ODOMETRY, POSE_COVARIANCE):
        position, orientation = m.pose.pose.position, m.pose.pose.orientation
    else:
        raise ValueError(f"{msgtype} holds no pose")
    values = (position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w)
    child = str(m.child_frame_id) if msgtype in (ODOMETRY, TRANSFORM_STAMPED) else ""
    return [StampedPose(message_stamp_ns(m), tuple(map(float, values)), str(m.header.frame_id), child)]


class PoseDecoder:
    """Turns the pose messages of one topic into poses of `body` with increasing times, in portions.

    Poses that are not finite, have no quaternion, or are not later than the one before are dropped and counted.

    Args:
        msgtype: one of `POSE_TYPES`.
        rules: the sequence file's `[reference]` section.
        T_places_body: takes body coordinates to those of what the messages place.
        parent: name of the frame in which the result places `body`.
        where: recording and topic, for errors.
    """

    def __init__(self, msgtype: str, rules: ReferenceRules, T_places_body: F64, *, parent: str, where: str) -> None:
        self._msgtype = msgtype
        self._rules = rules
        self._T_places_body = T_places_body
        self._parent = parent
        self._where = where
        self._rows: list[StampedPose] = []
        self._frames: tuple[str, str] | None = None
        self._last_ns: int | None = None
        self._found = FindingCounter()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was dropped so far."""
        return self._found.findings

    @property
    def frames(self) -> tuple[str, str] | None:
        """The recording's own names of parent and child, None before the first pose."""
        return self._frames

    def add(self, message: object) -> None:
        """Take one decoded message.

        Raises:
            IngestError: TF with several pairs of frames and nobody said which.
        """
        for pose in poses_of(message, self._msgtype):
            if self._wanted(pose):
                self._rows.append(pose)

    def _wanted(self, pose: StampedPose) -> bool:
        parent, child = self._rules.parent_frame, self._rules.child_frame
        if (parent and pose.frame != parent) or (child and pose.child and pose.child != child):
            return False
        pair = (pose.frame, pose.child)
        if self._frames is None:
            self._frames = pair
        if pair == self._frames:
            return True
        if self._msgtype == TF_MESSAGE:
            raise IngestError(
                self._where,
                f"{self._frames[0]} → {self._frames[1]} and {pair[0]} → {pair[1]}",
                expected="one transform",
                todo="name parent_frame and child_frame in the [reference] section of a sequence file",
            )
        self._found.add("pose_frames_differ", f"poses of {pair[1]} in {pair[0]} were dropped")
        return False

    def take(self) -> Trajectory | None:
        """The poses added since the last call, None without any."""
        rows, self._rows = self._rows, []
        if not rows:
            return None
        stamps = np.array([row.stamp_ns for row in rows], dtype=np.int64) + round(self._rules.shift_s * 1e9)
        values = np.array([row.values for row in rows])
        good = np.isfinite(values).all(axis=1) & (np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1.0) < 0.1)
        self._found.add(
            "poses_not_rigid", "poses that are not finite or without quaternion were dropped", count=int((~good).sum())
        )
        later = increasing(stamps, good, self._last_ns)
        self._found.add(
            "pose_time_not_increasing",
            "poses no later than the one before were dropped",
            count=int((good & ~later).sum()),
        )
        if not later.any():
            return None
        self._last_ns = int(stamps[later][-1])
        poses = se3.from_xyzw(values[later, :3], values[later, 3:])
        return Trajectory(stamps[later], poses @ self._T_places_body, self._parent, "body")
