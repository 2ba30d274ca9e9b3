"""The messages of a canonical flight, as bytes and back: what mineloc writes is all that these functions read.

Frames: points in `lidar`, inertial samples in `imu`, poses of `body` in `map` (reference) or `odom`. Stamps are the
time of the first point (sweeps) or the time for which the sample is true.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mineloc import se3
from mineloc.data import Calibration, ImuSamples, Sweep, Trajectory
from mineloc.io.cdr_layout import CdrLayout, Part, Text, fixed_layout, rows, stamps_ns
from mineloc.io.pointcloud2 import strided
from mineloc.io.ros import POINT_CLOUD2, STORE, TF_MESSAGE, stamp_parts

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

_FLOAT32, _UINT16, _UINT32, _FLOAT64 = 7, 4, 6, 8
_NUMPY = {_FLOAT32: "<f4", _UINT16: "<u2", _UINT32: "<u4", _FLOAT64: "<f8"}
# A double holds whole nanoseconds exactly up to here (104 days); a u32 up to 4.29 s.
_MAX_F64_NS = 2**53


def encode_sweep(sweep: Sweep) -> memoryview:
    """CDR PointCloud2: x y z [intensity] f32, [ring] u16, [t] u32 nanoseconds after `header.stamp` (f64 beyond 4.29 s).

    Fields that the sweep does not have are left out, so that "no point times" stays a declared fact.

    Raises:
        ValueError: a stamp or an offset that cannot be written exactly.
    """
    long_offsets = sweep.offsets_ns is not None and len(sweep) > 0 and int(sweep.offsets_ns.max()) >= 2**32
    if long_offsets and int(cast("I64", sweep.offsets_ns).max()) > _MAX_F64_NS:
        raise ValueError("offsets_ns beyond 2**53 cannot be written exactly")
    fields, step = _fields(
        sweep.intensity is not None, sweep.ring is not None, sweep.offsets_ns is not None, long_offsets
    )
    n = len(sweep)
    types = STORE.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*stamp_parts(sweep.stamp_ns)), "lidar")
    empty = types[POINT_CLOUD2](header, 1, n, list(fields), False, step, step * n, np.zeros(0, np.uint8), True)
    # The serializer makes all but the points; they are written into place, once. Its last five bytes are the
    # length of the data and `is_dense`.
    head = np.frombuffer(STORE.serialize_cdr(empty, POINT_CLOUD2), np.uint8)
    start = len(head) - 1
    out = np.empty(len(head) + n * step, np.uint8)
    out[:start], out[-1] = head[:start], head[-1]
    out[start - 4 : start] = np.frombuffer(struct.pack("<I", n * step), np.uint8)
    # x y z as one piece: a structured array takes three times as long.
    points = np.ascontiguousarray(sweep.points_lidar, dtype="<f4").view("V12").reshape(n)
    strided(out, "V12", start, n, step)[...] = points
    for field, values in zip(fields[3:], _extra_columns(sweep), strict=True):
        strided(out, _NUMPY[field.datatype], start + field.offset, n, step)[...] = values
    return out.data


def _extra_columns(sweep: Sweep) -> list[NDArray[Any]]:
    return [values for values in (sweep.intensity, sweep.ring, sweep.offsets_ns) if values is not None]


@lru_cache(maxsize=16)
def _fields(intensity: bool, ring: bool, times: bool, long_offsets: bool) -> tuple[tuple[Any, ...], int]:
    field = STORE.types["sensor_msgs/msg/PointField"]
    wanted = [("x", _FLOAT32), ("y", _FLOAT32), ("z", _FLOAT32)]
    wanted += [("intensity", _FLOAT32)] * intensity + [("ring", _UINT16)] * ring
    wanted += [("t", _FLOAT64 if long_offsets else _UINT32)] * times
    out: list[Any] = []
    at = 0
    for name, datatype in wanted:
        out.append(field(name, at, datatype, 1))
        at += np.dtype(_NUMPY[datatype]).itemsize
    return tuple(out), at


def decode_sweep(data: bytes | memoryview, *, period_ns: int) -> Sweep:
    """The sweep in a message written by `encode_sweep`, exactly as it was.

    Raises:
        ValueError: not such a message.
    """
    message = cast("Any", STORE.deserialize_cdr(data, POINT_CLOUD2))
    n, step = int(message.width), int(message.point_step)
    names = [str(field.name) for field in message.fields]
    if names[:3] != ["x", "y", "z"] or message.height != 1 or message.is_bigendian or len(message.data) != n * step:
        raise ValueError("not a canonical cloud")
    columns = {
        str(field.name): strided(message.data, _NUMPY[field.datatype], field.offset, n, step)
        for field in message.fields[3:]
    }
    offsets = columns.get("t")
    intensity, ring = columns.get("intensity"), columns.get("ring")
    return Sweep(
        int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec),
        strided(message.data, "V12", 0, n, step).copy().view("<f4").reshape(n, 3),
        None if offsets is None else offsets.astype(np.int64),
        None if ring is None else ring.copy(),
        None if intensity is None else intensity.copy(),
        period_ns,
    )


def _header(frame: str) -> list[Part]:
    return [("sec", "<i4", 1), ("nanosec", "<u4", 1), ("frame", Text(frame), 1)]


@lru_cache(maxsize=8)
def imu_layout(frame: str) -> CdrLayout:
    """sensor_msgs/Imu with a known `frame_id`."""
    return fixed_layout(
        [
            *_header(frame),
            ("orientation_xyzw", "<f8", 4),
            ("orientation_covariance", "<f8", 9),
            ("gyro_radps", "<f8", 3),
            ("gyro_covariance", "<f8", 9),
            ("accel_mps2", "<f8", 3),
            ("accel_covariance", "<f8", 9),
        ]
    )


@lru_cache(maxsize=8)
def pose_layout(frame: str) -> CdrLayout:
    """geometry_msgs/PoseStamped with a known `frame_id`."""
    return fixed_layout([*_header(frame), ("position_m", "<f8", 3), ("orientation_xyzw", "<f8", 4)])


@lru_cache(maxsize=8)
def odometry_layout(frame: str, child: str) -> CdrLayout:
    """nav_msgs/Odometry with known frames."""
    return fixed_layout(
        [
            *_header(frame),
            ("child", Text(child), 1),
            ("position_m", "<f8", 3),
            ("orientation_xyzw", "<f8", 4),
            ("pose_covariance", "<f8", 36),
            ("twist", "<f8", 6),
            ("twist_covariance", "<f8", 36),
        ]
    )


@lru_cache(maxsize=8)
def transform_layout(frame: str, child: str) -> CdrLayout:
    """tf2_msgs/TFMessage with one transform between known frames."""
    return fixed_layout(
        [
            ("transforms", "<u4", 1),
            *_header(frame),
            ("child", Text(child), 1),
            ("position_m", "<f8", 3),
            ("orientation_xyzw", "<f8", 4),
        ]
    )


def _stamped(layout: CdrLayout, stamps: I64) -> NDArray[np.void]:
    records = layout.new(len(stamps))
    records["sec"], records["nanosec"] = np.divmod(stamps, 1_000_000_000)
    return records


def encode_imu(imu: ImuSamples) -> U8:
    """(n, size) bytes: a row is one Imu message. Orientation is declared unknown (covariance −1, as ROS has it)."""
    records = _stamped(imu_layout("imu"), imu.stamps_ns)
    records["orientation_xyzw"][:, 3] = 1.0
    records["orientation_covariance"][:, 0] = -1.0
    records["gyro_radps"] = imu.gyro_radps
    records["accel_mps2"] = imu.accel_mps2
    return rows(records)


def decode_imu(messages: Sequence[bytes | memoryview], frame: str = "imu") -> ImuSamples:
    """The samples in Imu messages of one frame, in the order given.

    Raises:
        ValueError: a message of another layout, or times that do not increase.
    """
    records = imu_layout(frame).view(b"".join(messages))
    return ImuSamples(stamps_ns(records), records["gyro_radps"].copy(), records["accel_mps2"].copy())


def encode_poses(trajectory: Trajectory, layout: CdrLayout) -> U8:
    """(n, size) bytes of PoseStamped, Odometry or TFMessage rows, by the layout."""
    records = _stamped(layout, trajectory.stamps_ns)
    records["position_m"], records["orientation_xyzw"] = se3.to_xyzw(trajectory.poses)
    if "transforms" in (layout.dtype.names or ()):
        records["transforms"] = 1
    return rows(records)


def decode_poses(messages: Sequence[bytes | memoryview], layout: CdrLayout, *, parent: str, child: str) -> Trajectory:
    """The trajectory in messages of one layout.

    Raises:
        ValueError: a message of another layout, or times that do not increase.
    """
    records = layout.view(b"".join(messages))
    poses = se3.from_xyzw(records["position_m"], records["orientation_xyzw"])
    return Trajectory(stamps_ns(records), poses, parent, child)


def encode_calibration(calibration: Calibration, stamp_ns: int) -> bytes | memoryview:
    """The /tf_static message: `lidar`, `imu` and, if there is one, `camera` placed in `body`."""
    types = STORE.types
    placed = [("lidar", calibration.T_body_lidar), ("imu", calibration.T_body_imu)]
    placed += [] if calibration.T_body_camera is None else [("camera", calibration.T_body_camera)]
    transforms: list[Any] = []
    for child, T in placed:
        t, q = se3.to_xyzw(T)
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*stamp_parts(stamp_ns)), "body")
        transform = types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](*map(float, t)), types["geometry_msgs/msg/Quaternion"](*map(float, q))
        )
        transforms.append(types["geometry_msgs/msg/TransformStamped"](header, child, transform))
    return STORE.serialize_cdr(types[TF_MESSAGE](transforms), TF_MESSAGE)
