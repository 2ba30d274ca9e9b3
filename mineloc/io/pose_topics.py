"""Poses in recordings: Odometry, PoseStamped and PoseWithCovarianceStamped topics of an MCAP."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from mcap.reader import McapReader, make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mineloc import se3
from mineloc.data import Trajectory
from mineloc.errors import FormatError, MinelocError
from mineloc.io.distinct_poses import first_of_each_time
from mineloc.io.flight_layout import FLIGHT_RECORD

ODOMETRY = "nav_msgs/msg/Odometry"
_POSE_OF: Mapping[str, Callable[[Any], Any]] = {
    ODOMETRY: lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
}


@dataclass(frozen=True, slots=True, eq=False)
class PoseTopic:
    """The poses of one topic; `duplicates` and `conflicts` as in `DistinctPoses`."""

    trajectory: Trajectory
    topic: str
    duplicates: int
    conflicts: int


def read_pose_topic(path: Path, topic: str | None = None) -> PoseTopic:
    """The poses of one topic of an MCAP, stamped by their headers, in rising order.

    Without `topic`: the only topic with poses.

    Raises:
        FormatError: no such file, damaged, no such topic, none or several with poses, no header times, a
            pose that is not finite.
    """
    return _guarded(path, lambda reader: _read(path, reader, topic))


def is_flight(path: Path) -> bool:
    """Whether an MCAP is a canonical flight.

    Raises:
        FormatError: no such file, or damaged.
    """
    return _guarded(path, lambda reader: any(m.name == FLIGHT_RECORD for m in reader.iter_metadata()))


T = TypeVar("T")


def _guarded(path: Path, work: Callable[[McapReader], T]) -> T:
    try:
        with path.open("rb") as f:
            # one flipped byte otherwise goes unnoticed
            return work(make_reader(f, validate_crcs=True))
    except MinelocError:
        raise
    except FileNotFoundError:
        raise FormatError(path, "no such file", expected="an MCAP recording", todo="check the path") from None
    except Exception as error:
        # The libraries raise thirteen kinds of exception on damaged files, MemoryError and KeyError among them.
        raise FormatError(
            path,
            f"cannot be read ({type(error).__name__}: {error})",
            expected="a whole MCAP recording",
            todo="recover what is left of it: mineloc ingest",
        ) from error


def _read(path: Path, reader: McapReader, topic: str | None) -> PoseTopic:
    kinds = _pose_topics(path, reader)
    topic = topic if topic is not None else _only_topic(path, kinds)
    if topic not in kinds:
        raise FormatError(path, f"no poses on {topic}", expected=_list(kinds), todo="name one: FILE.mcap:/topic")
    pose_of = _POSE_OF[kinds[topic]]
    typestore = get_typestore(Stores.EMPTY)
    stamps: list[int] = []
    values: list[tuple[float, ...]] = []
    parent, child = "map", "body"
    for schema, channel, message in reader.iter_messages(topics=[topic]):
        if schema is None or channel.message_encoding != "cdr":
            raise FormatError(
                f"{path}:{topic}",
                f"message encoding {channel.message_encoding}",
                expected="cdr (ROS 2)",
                todo="make a flight of it first: mineloc ingest",
            )
        if not stamps:
            typestore.register(get_types_from_msg(schema.data.decode(), schema.name))
        decoded: Any = typestore.deserialize_cdr(message.data, schema.name)
        p, q = pose_of(decoded).position, pose_of(decoded).orientation
        stamps.append(decoded.header.stamp.sec * 1_000_000_000 + decoded.header.stamp.nanosec)
        values.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        parent = decoded.header.frame_id or parent
        child = decoded.child_frame_id or child if schema.name == ODOMETRY else child
    return _checked(path, topic, stamps, values, parent=parent, child=child)


def _pose_topics(path: Path, reader: McapReader) -> dict[str, str]:
    """Topics with poses and messages, and their types."""
    summary = reader.get_summary()
    if summary is None:
        raise FormatError(
            path, "has no summary", expected="a finished MCAP", todo="recover what is left of it: mineloc ingest"
        )
    counts = summary.statistics.channel_message_counts if summary.statistics is not None else None
    found: dict[str, str] = {}
    for channel in summary.channels.values():
        schema = summary.schemas.get(channel.schema_id)
        if schema is not None and schema.name in _POSE_OF and (counts is None or counts.get(channel.id, 0)):
            found[channel.topic] = schema.name
    return found


def _only_topic(path: Path, kinds: Mapping[str, str]) -> str:
    if len(kinds) == 1:
        return next(iter(kinds))
    if kinds:
        raise FormatError(
            path,
            f"{len(kinds)} topics with poses ({', '.join(sorted(kinds))})",
            expected="to be told which",
            todo=f"name one: {path}:{min(kinds)}",
        )
    raise FormatError(path, "no topic with poses", expected=_list(kinds), todo="give a file with a reference")


def _list(kinds: Mapping[str, str]) -> str:
    return f"one of {', '.join(sorted(kinds))}" if kinds else f"one of the types {', '.join(_POSE_OF)}"


def _checked(
    path: Path, topic: str, stamps: list[int], values: list[tuple[float, ...]], *, parent: str, child: str
) -> PoseTopic:
    where = f"{path}:{topic}"
    t = np.array(stamps, dtype=np.int64)
    v = np.array(values, dtype=np.float64).reshape(-1, 7)
    norm = np.linalg.norm(v[:, 3:], axis=1)
    bad = np.flatnonzero(~np.isfinite(v).all(axis=1) | ~(np.abs(norm - 1.0) < 0.1))
    if bad.size:
        raise FormatError(
            where, f"message {bad[0]} is not a pose ({bad.size} such)", expected="finite positions, unit quaternions"
        )
    if len(t) > 1 and not t.any():
        raise FormatError(where, "all header times are zero", expected="the times at which the poses are true")
    # Messages may be recorded out of order; each knows its own time.
    order = np.argsort(t, kind="stable")
    t, v = t[order], v[order]
    distinct = first_of_each_time(where, t, v)
    poses = se3.from_xyzw(distinct.values[:, :3], distinct.values[:, 3:]) if len(t) else np.zeros((0, 4, 4))
    trajectory = Trajectory(distinct.stamps_ns, poses, parent=parent, child=child)
    return PoseTopic(trajectory, topic, distinct.duplicates, distinct.conflicts)
