"""Which topic of a recording is LiDAR, IMU, reference, odometry: by type, or as the sequence file says."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mineloc.errors import IngestError
from mineloc.io.recording import Topic
from mineloc.io.ros import IMU, ODOMETRY, POINT_CLOUD2, POSE_COVARIANCE, POSE_STAMPED, TF_MESSAGE, TRANSFORM_STAMPED
from mineloc.io.sequence import Topics

# in place of a topic's name: leave this role empty whatever there is
NONE = "none"
_POSES = (POSE_STAMPED, POSE_COVARIANCE, TRANSFORM_STAMPED)
_REFERENCES = (*_POSES, ODOMETRY, TF_MESSAGE)
_TRUTH = re.compile(r"truth|reference|(^|[/_])gt([/_]|$)|mocap|motion_capture|vicon|optitrack|qualisys|rtk")
_COMMAND = re.compile(r"goal|setpoint|target|command|cmd|waypoint|initialpose|plan")
# what sensors send before their driver has made clouds of it
_PACKETS = {
    "PacketMsg": ("ouster packets", "the ouster driver"),
    "VelodyneScan": ("velodyne packets", "velodyne_pointcloud"),
    "RslidarPacket": ("robosense packets", "rslidar_sdk"),
    "rslidarScan": ("robosense packets", "rslidar_sdk"),
    "HesaiScan": ("hesai packets", "the hesai driver"),
    "PandarScan": ("hesai packets", "the hesai driver"),
    "UdpFrame": ("hesai packets", "the hesai driver"),
    "CustomMsg": ("livox CustomMsg clouds", "livox_ros_driver2 (xfer_format 0)"),
    "LaserScan": ("planar laser scans", "a driver that publishes PointCloud2"),
    "foxglove.PointCloud": ("foxglove PointCloud messages", "a ROS 2 recorder"),
}


@dataclass(frozen=True, slots=True)
class Roles:
    """The topics that become the flight; None where there is none.

    Attributes:
        assumed: remarks on choices that the recording does not force, one line each.
    """

    lidar: Topic | None
    imu: Topic | None
    reference: Topic | None
    odometry: Topic | None
    assumed: tuple[str, ...] = ()

    @property
    def used(self) -> list[Topic]:
        """All that are there."""
        return [t for t in (self.lidar, self.imu, self.reference, self.odometry) if t is not None]


def choose_roles(path: Path, topics: Mapping[str, Topic], told: Topics) -> Roles:
    """Give the topics their roles.

    Args:
        path: of the recording, for errors.
        topics: by name; those known to be empty are no candidates.
        told: the sequence file's `[topics]`.

    Raises:
        IngestError: a named topic is missing or of another type, several could be meant, or there is nothing to use.
    """
    filled = {name: topic for name, topic in topics.items() if topic.count != 0}
    assumed: list[str] = []
    lidar = _only(path, topics, filled, "lidar", told.lidar, (POINT_CLOUD2,))
    imu = _only(path, topics, filled, "imu", told.imu, (IMU,))
    reference = _named(path, topics, "reference", told.reference, _REFERENCES)
    odometry = _named(path, topics, "odometry", told.odometry, (ODOMETRY, *_POSES))
    if reference is None and told.reference != NONE:
        reference = _guess_reference(path, filled, odometry, assumed, needed=lidar is None)
    if odometry is None and told.odometry != NONE:
        odometry = _guess_odometry(filled, reference, assumed)
    roles = Roles(lidar, imu, reference, odometry, tuple(assumed))
    if lidar is None and reference is None and odometry is None:
        raise _nothing(path, filled)
    return roles


def _named(path: Path, topics: Mapping[str, Topic], role: str, name: str, types: tuple[str, ...]) -> Topic | None:
    if name in ("", NONE):
        return None
    topic = topics.get(name)
    if topic is None:
        raise IngestError(
            path,
            f"no topic {name}, which the sequence file names as {role}",
            expected=_listed(topics.values()) or "topics",
            todo="correct [topics] in the sequence file",
        )
    if topic.msgtype not in types:
        raise IngestError(
            path,
            f"topic {name} holds {topic.msgtype or 'messages without a type'}",
            expected=" or ".join(types),
            todo=f"correct {role} in [topics] of the sequence file",
        )
    return topic


def _only(
    path: Path,
    topics: Mapping[str, Topic],
    filled: Mapping[str, Topic],
    role: str,
    name: str,
    types: tuple[str, ...],
) -> Topic | None:
    """The topic that is named, or the only one of its types."""
    named = _named(path, topics, role, name, types)
    if named is not None or name == NONE:
        return named
    found = [topic for topic in filled.values() if topic.msgtype in types]
    if len(found) > 1:
        lines = " or ".join(f'{role} = "{topic.name}"' for topic in found)
        raise IngestError(
            path,
            f"{len(found)} topics of type {types[0]}: {_listed(found)}",
            expected="one, or a sequence file that tells them apart",
            todo=f"put {lines} under [topics] of a file and pass it with --sequence",
        )
    return found[0] if found else None


def _guess_reference(
    path: Path, filled: Mapping[str, Topic], odometry: Topic | None, assumed: list[str], *, needed: bool
) -> Topic | None:
    poses = [t for t in filled.values() if t.msgtype in (*_POSES, ODOMETRY) and t != odometry]
    poses = [t for t in poses if not _COMMAND.search(t.name.lower())]
    truths = [t for t in poses if _TRUTH.search(t.name.lower())]
    found = truths or [t for t in poses if t.msgtype in _POSES]
    if len(found) == 1:
        if not truths:
            assumed.append(f"{found[0].name} is taken for the reference: it is the only topic of poses")
        return found[0]
    if not found:
        return None
    if needed:
        lines = " or ".join(f'reference = "{topic.name}"' for topic in found)
        raise IngestError(
            path,
            f"{len(found)} topics of poses and no LiDAR: {_listed(found)}",
            expected="one reference",
            todo=f"put {lines} under [topics] of a file and pass it with --sequence",
        )
    assumed.append(f"no reference is taken: it could be any of {_listed(found)}; a sequence file can name it")
    return None


def _guess_odometry(filled: Mapping[str, Topic], reference: Topic | None, assumed: list[str]) -> Topic | None:
    found = [t for t in filled.values() if t.msgtype == ODOMETRY and t != reference]
    if not found and reference is not None:
        # beside a reference, other poses are an estimate; some front ends publish it as PoseStamped
        found = [t for t in filled.values() if t.msgtype in _POSES and t != reference]
        found = [t for t in found if not _COMMAND.search(t.name.lower())]
    if len(found) > 1:
        assumed.append(f"no odometry is taken: it could be any of {_listed(found)}; a sequence file can name it")
    return found[0] if len(found) == 1 else None


def _nothing(path: Path, filled: Mapping[str, Topic]) -> IngestError:
    expected = "a PointCloud2 topic, or poses (PoseStamped, Odometry)"
    for name, (what, driver) in _PACKETS.items():
        found = [t.name for t in filled.values() if t.msgtype == name or t.msgtype.endswith(f"/{name}")]
        if found:
            return IngestError(
                path, f"holds {what} ({', '.join(found)})", expected="PointCloud2", todo=f"convert with {driver}"
            )
    if not filled:
        return IngestError(path, "holds no messages", expected=expected, todo="check that the recorder was running")
    return IngestError(path, f"holds {_listed(filled.values())}", expected=expected, todo="record the LiDAR's topic")


def _listed(topics: object) -> str:
    return ", ".join(f"{t.name} ({t.msgtype or 'no type'})" for t in topics)  # type: ignore[attr-defined]
