"""What ingest measures on the way: streams in constant memory, times, units, motion, roles, mountings."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import recording_files as files
from driver_clouds import vlp16_sweep
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_files import CLOUD, IMU, ODOMETRY, POSE, START_NS, STEP_NS, TF

from mineloc.errors import IngestError
from mineloc.io.health import Health, HealthFinding, sorted_findings
from mineloc.io.imu_monitor import ImuMonitor
from mineloc.io.motion_watch import MotionWatch
from mineloc.io.recording import Damage, Topic, share_losses
from mineloc.io.sequence import Topics
from mineloc.io.static_frames import StaticFrames
from mineloc.io.stream_statistics import IntervalHistogram, Sampler
from mineloc.io.topic_monitor import TopicMonitor
from mineloc.io.topic_roles import choose_roles
from mineloc.stages.health_table import recovered_line

TOPIC = Topic("/points", CLOUD, None, "cdr", "ros2msg")

# --- statistics ----------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(values=st.lists(st.integers(2_000, 10**12), min_size=1, max_size=300), factor=st.floats(1.2, 5))
def test_the_histogram_of_intervals_is_right_to_two_percent(values: list[int], factor: float) -> None:
    histogram = IntervalHistogram()
    intervals = np.array(values, dtype=np.int64)
    for part in np.array_split(intervals, 3):
        histogram.add(part)
    ranked = np.sort(intervals)
    middle = ranked[(len(ranked) - 1) // 2]
    assert middle / 1.021 <= histogram.median_ns <= middle * 1.021
    assert histogram.longest_ns == ranked[-1]
    limit = factor * histogram.median_ns
    count, total = histogram.longer_than(limit)
    assert np.count_nonzero(ranked > limit * 1.021) <= count <= np.count_nonzero(ranked > limit / 1.021)
    assert total <= ranked.sum()


def test_the_median_of_a_steady_rate_is_exact() -> None:
    histogram = IntervalHistogram()
    histogram.add(np.full(100, 99_999_997, dtype=np.int64))
    assert histogram.median_ns == 99_999_997
    assert np.isnan(IntervalHistogram().median_ns)


@settings(max_examples=40, deadline=None)
@given(count=st.integers(1, 5000), size=st.integers(2, 64).map(lambda n: 2 * n), parts=st.integers(1, 9))
def test_a_sample_is_spread_evenly_over_the_stream(count: int, size: int, parts: int) -> None:
    together, single = Sampler(size), Sampler(size)
    values = np.arange(count, dtype=np.float64)
    for part in np.array_split(values, parts):
        together.add(part)
    for value in values:
        single.add_one(float(value))
    for sampler in (together, single):
        assert (sampler.smallest, sampler.largest) == (0, count - 1)
        assert sampler.median == pytest.approx((count - 1) / 2, abs=max(2.5 * count / size, 0.6))
    assert together.median == single.median
    assert np.isnan(Sampler().median)


# --- times ---------------------------------------------------------------------------------------------------------


def stream(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps with repeats, steps back and gaps; recorder's times; header times."""
    rng = np.random.default_rng(seed)
    stamps = START_NS + np.cumsum(rng.choice([STEP_NS, STEP_NS, STEP_NS, 0, -STEP_NS // 3, 5 * STEP_NS], count))
    logs = stamps + rng.integers(0, 10**6, count) + np.cumsum(rng.choice([0, 0, 0, 0, 10**9], count))
    return stamps.astype(np.int64), logs.astype(np.int64), (stamps - 17).astype(np.int64)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 400), cuts=st.lists(st.integers(0, 400), max_size=5))
def test_portions_do_not_matter_to_a_monitor(seed: int, count: int, cuts: list[int]) -> None:
    stamps, logs, headers = stream(seed, count)
    whole, parts, single = (TopicMonitor("lidar", TOPIC) for _ in range(3))
    kept = whole.take(stamps, logs, headers_ns=headers)
    borders = [0, *sorted(min(cut, count) for cut in cuts), count]
    pieces = [slice(a, b) for a, b in pairwise(borders)]
    in_parts = [parts.take(stamps[p], logs[p], headers_ns=headers[p]) for p in pieces]
    one_by_one = [single.take_one(*map(int, row)) for row in zip(stamps, logs, headers, strict=True)]
    np.testing.assert_array_equal(kept, np.concatenate(in_parts))
    np.testing.assert_array_equal(kept, one_by_one)
    # the law itself: exactly the messages that are later than all before them
    assert list(stamps[kept]) == list(dict.fromkeys(np.maximum.accumulate(stamps)))
    results = [monitor.result(gap_factor=1.8) for monitor in (whole, parts, single)]
    assert results[0] == results[1] == results[2]
    assert results[0].used + results[0].backwards + results[0].duplicates == count
    assert whole.findings(gap_factor=1.8) == parts.findings(gap_factor=1.8) == single.findings(gap_factor=1.8)


def test_a_topic_without_messages_has_no_numbers() -> None:
    health = TopicMonitor("imu", TOPIC).result(gap_factor=1.8)
    assert (health.messages, health.rate_hz, health.log_delay_median_s) == (0, None, None)
    assert TopicMonitor("imu", TOPIC).findings(gap_factor=1.8) == []


# --- units ---------------------------------------------------------------------------------------------------------


def felt(accel: float, gyro: float, *, count: int = 150) -> dict[str, HealthFinding]:
    rng = np.random.default_rng(1)
    monitor = ImuMonitor()
    turns = rng.normal(0, 1, (count, 3)) * gyro / 1.5
    monitor.take(turns, rng.normal([0, 0, accel], 0.02 * max(accel, 0), (count, 3)))
    return {finding.name: finding for finding in monitor.findings("/imu")}


@pytest.mark.parametrize(
    ("accel", "gyro", "name"),
    [
        (1.0, 0.2, "imu_accel_in_g"),
        (0.0, 0.2, "imu_accel_dead"),
        (40.0, 0.2, "imu_accel_implausible"),
        (9.81, 0.0, "imu_gyro_dead"),
        (9.81, 6.0, "imu_gyro_in_degps"),
    ],
)
def test_units_that_cannot_be_are_named(accel: float, gyro: float, name: str) -> None:
    found = felt(accel, gyro)
    assert set(found) == {name}
    assert found[name].severity == "error"


def test_usual_inertial_samples_and_too_few_to_tell_are_not_named() -> None:
    assert felt(9.81, 0.4) == {}
    assert felt(8.2, 1.5) == {}
    assert felt(1.0, 30.0, count=10) == {}


# --- motion --------------------------------------------------------------------------------------------------------


def test_motion_is_seen_by_sweeps_or_by_the_reference() -> None:
    sweep = vlp16_sweep(columns=300)
    still, moved = MotionWatch(), MotionWatch()
    assert still.stood_still is None
    for k in range(5):
        still.take_sweep(k * 10**9, vlp16_sweep(columns=300, seed=k).points_lidar)
        moved.take_sweep(k * 10**9, sweep.points_lidar + np.float32([0.3 * k, 0, 0]))
    assert still.stood_still is True
    assert moved.stood_still is False
    moved.take_positions(np.zeros((4, 3)))
    assert moved.stood_still is True  # whoever knows the truth has the last word


# --- roles ---------------------------------------------------------------------------------------------------------


def topics(**kinds: str) -> dict[str, Topic]:
    made = {"/" + name.replace("__", "/"): kind for name, kind in kinds.items()}
    return {name: Topic(name, kind, 5, "cdr", "ros2msg") for name, kind in made.items()}


def roles_of(told: Topics | None = None, **kinds: str) -> dict[str, str]:
    roles = choose_roles(Path("a.mcap"), topics(**kinds), told or Topics())
    named = {role: getattr(roles, role) for role in ("lidar", "imu", "reference", "odometry")}
    return {role: topic.name for role, topic in named.items() if topic is not None}


def test_roles_follow_types_and_names() -> None:
    assert roles_of(points=CLOUD, imu=IMU) == {"lidar": "/points", "imu": "/imu"}
    assert roles_of(points=CLOUD, odom=ODOMETRY) == {"lidar": "/points", "odometry": "/odom"}
    assert roles_of(points=CLOUD, ground_truth__odom=ODOMETRY, odom=ODOMETRY) == {
        "lidar": "/points",
        "reference": "/ground_truth/odom",
        "odometry": "/odom",
    }
    assert roles_of(vicon__drone=POSE, slam__pose=POSE) == {"reference": "/vicon/drone", "odometry": "/slam/pose"}
    assert roles_of(points=CLOUD, goal_pose=POSE) == {"lidar": "/points"}
    assert roles_of(odom=ODOMETRY) == {"odometry": "/odom"}
    everything = Topics(lidar="/b", imu="none", reference="/tf", odometry="none")
    assert roles_of(everything, a=CLOUD, b=CLOUD, imu=IMU, tf=TF, odom=ODOMETRY) == {"lidar": "/b", "reference": "/tf"}


def test_what_could_be_anything_is_left_out_with_a_remark_or_refused() -> None:
    several = topics(points=CLOUD, a=POSE, b=POSE, c=ODOMETRY, d=ODOMETRY)
    roles = choose_roles(Path("a.mcap"), several, Topics())
    assert (roles.reference, roles.odometry) == (None, None)
    assert ["no reference" in roles.assumed[0], "no odometry" in roles.assumed[1]] == [True, True]
    with pytest.raises(IngestError, match=r'reference = "/a" or reference = "/b"'):
        roles_of(a=POSE, b=POSE)


def test_topics_without_messages_are_no_candidates() -> None:
    both = topics(a=CLOUD) | {"/b": Topic("/b", CLOUD, 0, "cdr", "ros2msg")}
    chosen = choose_roles(Path("a.mcap"), both, Topics()).lidar
    assert chosen is not None
    assert chosen.name == "/a"


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("velodyne_msgs/msg/VelodyneScan", "velodyne packets .*convert with velodyne_pointcloud"),
        ("livox_ros_driver2/msg/CustomMsg", "livox CustomMsg"),
        ("foxglove.PointCloud", "foxglove PointCloud"),
        ("sensor_msgs/msg/Image", r"holds /x \(sensor_msgs/msg/Image\)"),
    ],
)
def test_what_holds_no_clouds_says_what_it_holds(kind: str, says: str) -> None:
    with pytest.raises(IngestError, match=says):
        roles_of(x=kind)


# --- mountings -----------------------------------------------------------------------------------------------------


def frames(*edges: tuple[str, str, tuple[float, ...]]) -> StaticFrames:
    tree = StaticFrames()
    tree.add(files.transforms(0, *edges))
    return tree


def test_mountings_need_a_frame_that_is_known() -> None:
    tree = frames(("base_link", "lidar", (0, 0, 1)), ("lidar", "imu", (0.1, 0, 0)))
    found = tree.calibration("lidar", "imu")
    assert found is not None
    assert found[1] == "base_link"
    np.testing.assert_allclose(found[0].T_body_imu[:3, 3], [0.1, 0, 1])
    # without a drone's frame the LiDAR is the body
    found = frames(("mast", "lidar", (0, 0, 1)), ("mast", "imu", (0.1, 0, 0))).calibration("lidar", "imu")
    assert found is not None
    assert found[1] == "lidar"
    np.testing.assert_allclose(found[0].T_body_imu[:3, 3], [0.1, 0, -1])
    assert frames(("a", "b", (0, 0, 1))).calibration("lidar", "imu") is None


def test_a_transform_without_rotation_is_left_out() -> None:
    message = files.transforms(0, ("base_link", "lidar", (0, 0, 1)))
    message.transforms[0].transform.rotation.w = 0.0
    tree = StaticFrames()
    tree.add(message)
    assert tree.between("base_link", "lidar") is None


# --- losses and the value itself -----------------------------------------------------------------------------------


def test_losses_that_only_the_sum_is_known_of_are_shared_by_their_seconds() -> None:
    damage = [Damage(1, "a", None, 1.0), Damage(2, "b", 5, 1.0), Damage(3, "c", None, 3.0)]
    share_losses(damage, 25)
    assert [d.messages for d in damage] == [5, 5, 15]
    assert [d.estimated for d in damage] == [True, False, True]
    alone = [Damage(1, "a", None, None)]
    share_losses(alone, 7)
    assert (alone[0].messages, alone[0].estimated) == (7, False)
    nothing: list[Damage] = []
    share_losses(nothing, 0)
    assert nothing == []
    share_losses(nothing, 4)
    assert nothing[0].messages == 4


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (Damage(9, "x", 3, 0.25), "at byte 9: x; 3 messages, 0.25 s lost"),
        (Damage(None, "x"), "x; no message lost"),
        (Damage(9, "x", None), "at byte 9: x; an unknown number of messages lost"),
        (
            Damage(9, "x", 3, 0.25, estimated=True, open_ended=True),
            "at byte 9: x; at least 3 messages (estimated), 0.25 s lost; what came after is unknown",
        ),
    ],
)
def test_damage_tells_its_place_and_its_price(damage: Damage, says: str) -> None:
    assert damage.describe() == says


SEVERITIES = (("a", "info"), ("b", "error"), ("c", "warning"))


def health(*damage: Damage, earlier: dict[str, object] | None = None) -> Health:
    monitor = TopicMonitor("lidar", TOPIC)
    monitor.take(np.array([START_NS, START_NS + STEP_NS]), np.array([START_NS, START_NS + STEP_NS]))
    topic = monitor.result(gap_factor=1.8)
    found = [HealthFinding(name, severity, 1, "x") for name, severity in SEVERITIES]
    return Health("a.mcap", "mcap", (topic,), None, damage, sorted_findings(found), earlier)


def test_health_as_json_has_no_numbers_that_json_cannot_hold() -> None:
    text = json.dumps(health(Damage(3, "x", None, None)).to_json_dict(), allow_nan=False)
    assert json.loads(text)["recovered"] is True
    assert [finding["name"] for finding in json.loads(text)["findings"]] == ["b", "c", "a"]
    assert health().worst == "error"


def test_a_flight_keeps_its_first_health_unless_it_was_damaged_since() -> None:
    earlier = {"recovered": True, "source": "first"}
    assert health(earlier=earlier).flight_record() == earlier
    assert health(earlier=earlier).recovered
    again = health(Damage(1, "x", 2, 0.1), earlier=earlier).flight_record()
    assert (again["earlier"], again["lost_messages"]) == (earlier, 2)
    assert "when it was first ingested" in recovered_line(health(earlier=earlier))
    assert "at least 2 messages" in recovered_line(health(Damage(1, "x", 2, 0.1), Damage(2, "y", None)))
