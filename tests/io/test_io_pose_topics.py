from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from mineloc import se3
from mineloc.errors import FormatError
from mineloc.io.pose_topics import read_pose_topic
from mineloc.io.trajectories import load_trajectory, read_trajectory

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
STORE = get_typestore(Stores.ROS2_HUMBLE)
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def _message(kind: str, stamp_ns: int, T, *, frame: str, child: str):
    types = STORE.types
    p, q = se3.to_xyzw(T)
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*p), types["geometry_msgs/msg/Quaternion"](*q)
    )
    time = types["builtin_interfaces/msg/Time"](int(stamp_ns // 10**9), int(stamp_ns % 10**9))
    header = types["std_msgs/msg/Header"](time, frame)
    if kind == POSE_STAMPED:
        return types[kind](header, pose)
    with_covariance = types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
    if kind == WITH_COVARIANCE:
        return types[kind](header, with_covariance)
    vector = types["geometry_msgs/msg/Vector3"](0, 0, 0)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](
        types["geometry_msgs/msg/Twist"](vector, vector), np.zeros(36)
    )
    return types[kind](header, child, with_covariance, twist)


def _record(
    path: Path,
    topics: Sequence[tuple[str, str, Sequence[tuple[int, object]]]],
    *,
    encoding: str = "cdr",
) -> Path:
    with path.open("wb") as f:
        writer = Writer(f, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        for topic, kind, poses in topics:
            text, _ = STORE.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channel = writer.register_channel(topic, encoding, schema)
            for k, (stamp, T) in enumerate(poses):
                message = _message(kind, stamp, T, frame="map", child="lidar")
                data = bytes(STORE.serialize_cdr(message, kind))
                writer.add_message(channel, log_time=1000 + k, data=data, publish_time=1000 + k)
        writer.finish()
    return path


def _poses(n: int = 5, *, start_ns: int = 1_790_000_000_123_456_789):
    xi = np.random.default_rng(0).normal(size=(n, 6))
    return [(start_ns + k * 100_000_001, T) for k, T in enumerate(se3.exp(xi))]


@pytest.mark.parametrize("kind", [POSE_STAMPED, ODOMETRY, WITH_COVARIANCE])
def test_every_kind_of_pose_is_read_to_the_nanosecond(tmp_path, kind):
    poses = _poses()
    loaded = load_trajectory(_record(tmp_path / "r.mcap", [("/a/pose", kind, poses)]))
    assert loaded.kind == "mcap"
    assert loaded.source.endswith("r.mcap:/a/pose")
    assert loaded.trajectory.stamps_ns.tolist() == [stamp for stamp, _ in poses]
    np.testing.assert_allclose(loaded.trajectory.poses, [T for _, T in poses], atol=1e-12)
    assert loaded.trajectory.parent == "map"
    assert loaded.trajectory.child == ("lidar" if kind == ODOMETRY else "body")


def test_topics_are_chosen_by_type_or_by_name(tmp_path):
    two = [("/a", POSE_STAMPED, _poses(3)), ("/pose", ODOMETRY, _poses(4)), ("/silent", ODOMETRY, [])]
    path = _record(tmp_path / "two.mcap", two)
    with pytest.raises(FormatError, match=r"2 topics with poses \(/a, /pose\).*two.mcap:/a"):
        read_trajectory(path)
    assert len(read_trajectory(f"{path}:/a")) == 3
    with pytest.raises(FormatError, match="no poses on /b; expected one of /a, /pose"):
        read_trajectory(f"{path}:/b")
    with pytest.raises(FormatError, match="no topic with poses"):
        read_trajectory(_record(tmp_path / "none.mcap", []))


def test_messages_out_of_order_repeated_and_in_conflict(tmp_path):
    a, b, c = _poses(3)
    other = (b[0], c[1])
    found = read_pose_topic(_record(tmp_path / "r.mcap", [("/p", POSE_STAMPED, [b, a, b, c, other])]))
    assert (found.duplicates, found.conflicts) == (1, 1)
    assert found.trajectory.stamps_ns.tolist() == [a[0], b[0], c[0]]
    np.testing.assert_allclose(found.trajectory.poses, [a[1], b[1], c[1]], atol=1e-12)


def test_times_and_values_that_mean_nothing_are_refused(tmp_path):
    zero = [(0, T) for _, T in _poses(4)]
    with pytest.raises(FormatError, match="all header times are zero"):
        read_trajectory(_record(tmp_path / "zero.mcap", [("/p", POSE_STAMPED, zero)]))
    lost = np.eye(4)
    lost[0, 3] = np.nan
    with pytest.raises(FormatError, match="message 5 is not a pose"):
        read_trajectory(_record(tmp_path / "nan.mcap", [("/p", POSE_STAMPED, [*_poses(5), (2 * 10**18, lost)])]))
    with pytest.raises(FormatError, match="message encoding json"):
        read_trajectory(_record(tmp_path / "json.mcap", [("/p", POSE_STAMPED, _poses())], encoding="json"))


@pytest.mark.parametrize("damage", ["empty", "foreign", "cut", "flipped", "missing"])
def test_damaged_recordings_are_one_line(tmp_path, damage):
    path = _record(tmp_path / "r.mcap", [("/p", POSE_STAMPED, _poses(200))])
    whole = bytearray(path.read_bytes())
    if damage == "missing":
        path.unlink()
    else:
        whole[len(whole) // 3] ^= 0x40
        part = {"empty": b"", "foreign": b"hello" * 40, "cut": whole[: len(whole) // 2], "flipped": bytes(whole)}
        path.write_bytes(part[damage])
    with pytest.raises(FormatError) as caught:
        read_trajectory(path)
    assert "\n" not in str(caught.value)
    assert "r.mcap" in str(caught.value)


@pytest.mark.data
def test_real_recordings():
    folder = DATA / "recordings"
    if not folder.exists():
        pytest.skip("no ../shared/data beside the repository")
    loaded = load_trajectory(f"{folder}/evo_glim_1.mcap:/lidarodom/ground_truth/pose")
    # motion capture that gives its clock once for two poses
    assert (len(loaded.trajectory), loaded.conflicts) == (5003 - 1949, 1949)
    assert load_trajectory(f"{folder}/evo_glim_2.mcap:/glim_ros_node/odom").trajectory.child == "imu"
