"""What a canonical flight file holds: topics, quality of service, and the `mineloc.flight` metadata.

| topic | type | content |
| --- | --- | --- |
| `/lidar/points` | PointCloud2 | sweeps; logged at the time of their last point |
| `/imu` | Imu | one message a sample |
| `/tf` | TFMessage | reference as `map` → `body`, at most 50 Hz |
| `/tf_static` | TFMessage | `body` → `lidar`, `body` → `imu`, `body` → `camera` if there is one |
| `/pose` | PoseStamped | reference, every pose |
| `/odom` | Odometry | odometry that came with the recording: `body` in `odom` |
| `/camera/depth/image` | Image | 16UC1: millimetres along the optical axis, 0 where unknown |
| `/camera/grey/image` | CompressedImage | JPEG |
| `/camera/…/camera_info` | CameraInfo | geometry, once, at the time of the first image |
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from mineloc.data import Calibration, FlightInfo
from mineloc.errors import IngestError

POINTS = "/lidar/points"
IMU_TOPIC = "/imu"
TF = "/tf"
TF_STATIC = "/tf_static"
POSE = "/pose"
ODOM = "/odom"
DEPTH = "/camera/depth/image"
DEPTH_INFO = "/camera/depth/camera_info"
GREY = "/camera/grey/image"
GREY_INFO = "/camera/grey/camera_info"

FLIGHT_RECORD = "mineloc.flight"
HEALTH_RECORD = "mineloc.health"
SCHEMA = "mineloc.flight/1"
# Channel metadata of /lidar/points: the nominal duration of a revolution.
PERIOD_KEY = "period_ns"
# Channel metadata of images: the geometry of their camera.
CAMERA_KEY = "camera"

MAP, BODY, ODOM_FRAME = "map", "body", "odom"
F64 = NDArray[np.float64]


def qos_profiles(*, latched: bool) -> str:
    """The YAML text that rosbag2 keeps of a publisher's quality of service: reliable, and kept for late joiners."""
    forever = "{sec: 9223372036, nsec: 854775807}"
    return (
        f"- history: 1\n  depth: {1 if latched else 100}\n  reliability: 1\n  durability: {1 if latched else 2}\n"
        f"  deadline: {forever}\n  lifespan: {forever}\n  liveliness: 1\n  liveliness_lease_duration: {forever}\n"
        "  avoid_ros_namespace_conventions: false\n"
    )


def encode_info(info: FlightInfo, calibration: Calibration, *, first_ns: int, last_ns: int) -> dict[str, str]:
    """The `mineloc.flight` record: names and values, with a checksum because MCAP has none for metadata."""
    record = {key: str(value) for key, value in asdict(info).items()}
    record["schema"] = SCHEMA
    record["T_body_lidar"] = json.dumps(calibration.T_body_lidar.tolist())
    record["T_body_imu"] = json.dumps(calibration.T_body_imu.tolist())
    if calibration.T_body_camera is not None:
        record["T_body_camera"] = json.dumps(calibration.T_body_camera.tolist())
    record["first_ns"], record["last_ns"] = str(first_ns), str(last_ns)
    record["checksum"] = _checksum(record)
    return record


def decode_info(path: Path, record: Mapping[str, str]) -> tuple[FlightInfo, Calibration, int, int]:
    """Info, calibration, and the times of the first and last measurement.

    Raises:
        IngestError: another schema, or a record that was changed after it was written.
    """
    if record.get("schema") != SCHEMA:
        raise IngestError(
            path, f"flight schema {record.get('schema')!r}", expected=SCHEMA, todo="run mineloc ingest first"
        )
    rest = {key: value for key, value in record.items() if key != "checksum"}
    if record.get("checksum") != _checksum(rest):
        raise IngestError(path, "the mineloc.flight record is damaged", todo="run mineloc ingest again")
    info = FlightInfo(**{f.name: record.get(f.name, "") for f in fields(FlightInfo)})
    camera = record.get("T_body_camera")
    calibration = Calibration(
        _matrix(record["T_body_lidar"]), _matrix(record["T_body_imu"]), None if camera is None else _matrix(camera)
    )
    return info, calibration, int(record["first_ns"]), int(record["last_ns"])


def _matrix(text: str) -> F64:
    return np.asarray(cast("list[list[float]]", json.loads(text)), dtype=np.float64)


def _checksum(record: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(dict(sorted(record.items()))).encode()):08x}"
