"""Recordings as rosbag2, rosbag and the mcap library leave them, and ways to damage them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Chunk
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
CLOUD, IMU = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"
POSE, ODOMETRY, TF = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
START_NS, STEP_NS = 1_760_000_000_000_000_000, 100_000_000

# topic, type, log time, message
Entry = tuple[str, str, int, Any]


def header(types: Any, stamp_ns: int, frame: str = "lidar", *, seq: int | None = None) -> Any:
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return types["std_msgs/msg/Header"](*([] if seq is None else [seq]), stamp, frame)


def imu(stamp_ns: int, gyro=(0.0, 0.0, 0.1), accel=(0.0, 0.0, 9.81), *, frame="imu", types=None, seq=None) -> Any:
    types = types or ROS2.types
    vector = types["geometry_msgs/msg/Vector3"]
    unknown = np.zeros(9)
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    at = header(types, stamp_ns, frame, seq=seq)
    return types[IMU](at, turn, unknown, vector(*map(float, gyro)), unknown, vector(*map(float, accel)), unknown)


def pose(stamp_ns: int, xyz=(0.0, 0.0, 0.0), *, frame="map") -> Any:
    types = ROS2.types
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    at = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*map(float, xyz)), turn)
    return types[POSE](header(types, stamp_ns, frame), at)


def odometry(stamp_ns: int, xyz=(0.0, 0.0, 0.0)) -> Any:
    types = ROS2.types
    vector = types["geometry_msgs/msg/Vector3"]
    still = types["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    with_covariance = types["geometry_msgs/msg/PoseWithCovariance"](pose(stamp_ns, xyz).pose, np.zeros(36))
    twist = types["geometry_msgs/msg/TwistWithCovariance"](still, np.zeros(36))
    return types[ODOMETRY](header(types, stamp_ns, "odom"), "base_link", with_covariance, twist)


def transforms(stamp_ns: int, *edges: tuple[str, str, tuple[float, ...]]) -> Any:
    """`edges`: parent, child, translation of a tf2_msgs/TFMessage."""
    types = ROS2.types
    made = []
    for parent, child, xyz in edges:
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        move = types["geometry_msgs/msg/Transform"](types["geometry_msgs/msg/Vector3"](*map(float, xyz)), turn)
        made.append(types["geometry_msgs/msg/TransformStamped"](header(types, stamp_ns, parent), child, move))
    return types[TF](made)


def serialized(msgtype: str, message: Any) -> bytes:
    return bytes(ROS2.serialize_cdr(message, msgtype))


def write_mcap(
    path: Path,
    entries: Iterable[Entry],
    *,
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 1 << 16,
    finish: bool = True,
    metadata: dict[str, dict[str, str]] | None = None,
    attachments: dict[str, bytes] | None = None,
    **options: Any,
) -> Path:
    """As rosbag2 with MCAP storage; `finish=False`: as a crash leaves it."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=chunk_size, **options)
        writer.start("ros2")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, msgtype, log_ns, message in entries:
            if topic not in channels:
                if msgtype not in schemas:
                    text = ROS2.generate_msgdef(msgtype, ros_version=2)[0].encode()
                    schemas[msgtype] = writer.register_schema(msgtype, "ros2msg", text)
                channels[topic] = writer.register_channel(topic, "cdr", schemas[msgtype])
            data = message if isinstance(message, bytes) else serialized(msgtype, message)
            writer.add_message(channels[topic], log_ns, data, log_ns)
        for name, values in (metadata or {}).items():
            writer.add_metadata(name, values)
        for name, data in (attachments or {}).items():
            writer.add_attachment(0, 0, name, "text/plain", data)
        if finish:
            writer.finish()
    return path


def write_ros1_mcap(path: Path, entries: Iterable[Entry]) -> Path:
    """As Foxglove converts a ROS 1 bag."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.LZ4)
        writer.start("ros1")
        channels: dict[str, int] = {}
        for topic, msgtype, log_ns, message in entries:
            if topic not in channels:
                text = ROS1.generate_msgdef(msgtype, ros_version=1)[0].encode()
                schema = writer.register_schema(msgtype.replace("/msg/", "/"), "ros1msg", text)
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            writer.add_message(channels[topic], log_ns, bytes(ROS1.serialize_ros1(message, msgtype)), log_ns)
        writer.finish()
    return path


def write_bag(path: Path, entries: Iterable[Entry], *, compression: Any = None) -> Path:
    """A ROS 1 bag."""
    writer = Bag1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, log_ns, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=ROS1)
            writer.write(connections[topic], log_ns, ROS1.serialize_ros1(message, msgtype))
    return path


def write_rosbag2(path: Path, entries: Iterable[Entry], *, plugin: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    """A rosbag2 folder."""
    with Bag2Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, log_ns, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=ROS2)
            writer.write(connections[topic], log_ns, serialized(msgtype, message))
    return path


def imus(count: int, *, start_ns: int = START_NS, step_ns: int = STEP_NS, padding: int = 0) -> Iterator[Entry]:
    """Inertial messages of varied content; `padding` makes them larger, by frame names that do not compress."""
    rng = np.random.default_rng(count)
    for k in range(count):
        name = rng.integers(97, 123, padding, dtype="u1").tobytes().decode() or "imu"
        stamp = start_ns + k * step_ns
        yield "/imu", IMU, stamp, imu(stamp, rng.normal(size=3), rng.normal([0, 0, 9.81]), frame=name)


def chunks_of(path: Path) -> list[tuple[int, list[tuple[int, bytes]]]]:
    """End of each chunk in the file and its messages (log time, data), by the mcap library: the oracle of recovery."""
    with path.open("rb") as stream:
        reader = StreamReader(stream, emit_chunks=True, validate_crcs=True)
        found = []
        for record in reader.records:
            if isinstance(record, Chunk):
                inside = [r for r in breakup_chunk(record) if hasattr(r, "log_time")]
                found.append((stream.tell(), [(r.log_time, bytes(r.data)) for r in inside]))
    return found
