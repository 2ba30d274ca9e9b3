from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mineloc import se3
from mineloc.data import ImuSamples
from mineloc.errors import IngestError
from mineloc.io.messages import STANDARD_GRAVITY_MPS2, ImuDecoder, PoseDecoder, increasing, poses_of
from mineloc.io.ros import IMU, ODOMETRY, POSE_COVARIANCE, POSE_STAMPED, STORE, TF_MESSAGE, TRANSFORM_STAMPED
from mineloc.io.sequence import ImuRules, Mounting, ReferenceRules, Sequence

H = 1_760_000_000_123_456_789
T = STORE.types


def _header(stamp_ns, frame):
    return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9), frame)


@dataclass
class _Raw:
    data: bytes
    message: Any


def _imu(stamp_ns, gyro, accel, *, frame="imu_link", ros1=False):
    vector = T["geometry_msgs/msg/Vector3"]
    message = T[IMU](
        _header(stamp_ns, frame),
        T["geometry_msgs/msg/Quaternion"](0, 0, 0, 1),
        np.zeros(9),
        vector(*gyro),
        np.zeros(9),
        vector(*accel),
        np.zeros(9),
    )
    # bytes that are no CDR must be left to the decoder of the recording
    return _Raw(b"\x07" * 320 if ros1 else bytes(STORE.serialize_cdr(message, IMU)), message)


def _samples(n, *, frame="imu_link", ros1=False, scale=(1.0, 1.0), seed=0):
    rng = np.random.default_rng(seed)
    gyro = 0.1 * rng.normal(size=(n, 3))
    accel = np.array([0, 0, 9.8]) + 0.1 * rng.normal(size=(n, 3))
    stamps = H + 5_000_000 * np.arange(n)
    raw = [
        _imu(int(t), g / scale[0], a / scale[1], frame=frame, ros1=ros1)
        for t, g, a in zip(stamps, gyro, accel, strict=True)
    ]
    return raw, ImuSamples(stamps, gyro, accel)


def _same(a, b, rtol=1e-12):
    np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
    np.testing.assert_allclose(a.gyro_radps, b.gyro_radps, rtol=rtol)
    np.testing.assert_allclose(a.accel_mps2, b.accel_mps2, rtol=rtol)


@pytest.mark.parametrize("frame", ["", "imu", "a/long/frame_id", "längs"])
@pytest.mark.parametrize("ros1", [False, True])
def test_imu_messages_of_any_frame_and_encoding(frame, ros1):
    raw, truth = _samples(20, frame=frame, ros1=ros1)
    decoder = ImuDecoder(ImuRules(), where="x")
    first, second, nothing = decoder.decode(raw[:13]), decoder.decode(raw[13:]), decoder.decode([])
    _same(first, truth.between(0, int(truth.stamps_ns[13])))
    _same(second, truth.between(int(truth.stamps_ns[13]), 2**62))
    assert len(nothing) == 0
    assert decoder.findings == ()


def test_frames_that_change_are_decoded_one_by_one():
    raw, truth = _samples(10)
    other, _ = _samples(10, frame="other_link_x")
    _same(ImuDecoder(ImuRules(), where="x").decode(raw[:5] + other[5:]), truth)


def test_imu_units_are_converted():
    raw, truth = _samples(300, scale=(np.pi / 180, STANDARD_GRAVITY_MPS2))
    decoder = ImuDecoder(ImuRules(accel_unit="g", gyro_unit="degps"), where="x")
    _same(decoder.decode(raw), truth)


@pytest.mark.parametrize(
    ("scale", "rules", "match"),
    [
        ((1.0, STANDARD_GRAVITY_MPS2), ImuRules(), r"acceleration 0\.999 m/s².*about 9\.8.*accel_unit"),
        ((1.0, 1.0), ImuRules(accel_unit="g"), r"acceleration 96\.1 m/s².*accel_unit"),
        ((0.001, 1.0), ImuRules(), r"angular rate \d+ rad/s.*gyro_unit"),
    ],
)
def test_wrong_units_are_refused_once_enough_is_seen(scale, rules, match):
    raw, _ = _samples(300, scale=scale)
    decoder = ImuDecoder(rules, where="x.bag: /imu")
    assert len(decoder.decode(raw[:199])) == 199
    with pytest.raises(IngestError, match=match):
        decoder.decode(raw[199:])


def test_a_dead_sensor_is_no_unit_mistake():
    raw = [_imu(H + i, (0, 0, 0), (0, 0, 0)) for i in range(300)]
    assert len(ImuDecoder(ImuRules(), where="x").decode(raw)) == 300


@given(st.lists(st.integers(0, 12), max_size=30), st.integers(0, 29), st.integers(1, 9))
def test_only_later_finite_samples_pass(stamps, bad, portion):
    """In any portions: each kept sample is later than all kept before; what is dropped is counted."""
    raw = [_imu(t, (np.nan if i == bad else 0.0, 0, 0), (0, 0, 9.8)) for i, t in enumerate(stamps)]
    decoder = ImuDecoder(ImuRules(), where="x")
    parts = [decoder.decode(raw[i : i + portion]) for i in range(0, len(raw), portion)]
    found = [int(t) for part in parts for t in part.stamps_ns]
    expected, high = [], -1
    for i, t in enumerate(stamps):
        if i != bad and t > high:
            expected.append(t)
            high = t
    assert found == expected
    counts = {f.name: f.count for f in decoder.findings}
    assert counts.get("imu_not_finite", 0) == (bad < len(stamps))
    assert sum(counts.values()) == len(stamps) - len(expected)


@given(st.lists(st.tuples(st.integers(-5, 9), st.booleans()), min_size=1, max_size=30), st.none() | st.integers(-3, 5))
def test_increasing_is_the_loop(rows, last):
    high = -(10**9) if last is None else last
    expected = []
    for stamp, good in rows:
        expected.append(good and stamp > high)
        high = max(high, stamp) if good else high
    stamps, good = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    assert increasing(stamps, good, last).tolist() == expected


def _pose_message(kind, stamp_ns, pose, *, frame="world", child="drone"):
    t, q = se3.to_xyzw(pose)
    vector, quaternion = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/Quaternion"](*q)
    header = _header(stamp_ns, frame)
    if kind in (TRANSFORM_STAMPED, TF_MESSAGE):
        one = T[TRANSFORM_STAMPED](header, child, T["geometry_msgs/msg/Transform"](vector(*t), quaternion))
        return T[TF_MESSAGE]([one]) if kind == TF_MESSAGE else one
    made = T["geometry_msgs/msg/Pose"](T["geometry_msgs/msg/Point"](*t), quaternion)
    if kind == POSE_STAMPED:
        return T[kind](header, made)
    covariance = T["geometry_msgs/msg/PoseWithCovariance"](made, np.zeros(36))
    if kind == POSE_COVARIANCE:
        return T[kind](header, covariance)
    twist = T["geometry_msgs/msg/Twist"](vector(0, 0, 0), vector(0, 0, 0))
    return T[kind](header, child, covariance, T["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)))


POSES = se3.exp(np.random.default_rng(0).normal(size=(6, 6)))
KINDS = [ODOMETRY, POSE_STAMPED, POSE_COVARIANCE, TRANSFORM_STAMPED, TF_MESSAGE]


def _decoder(kind, rules=None, T_places_body=None):
    where = "x.bag: /gt"
    return PoseDecoder(
        kind,
        rules or ReferenceRules(),
        np.eye(4) if T_places_body is None else T_places_body,
        parent="map",
        where=where,
    )


@pytest.mark.parametrize("kind", KINDS)
def test_poses_of_every_type(kind):
    decoder = _decoder(kind)
    assert decoder.take() is None
    for i, pose in enumerate(POSES):
        decoder.add(_pose_message(kind, H + i, pose))
        if i == 3:
            early = decoder.take()
    late = decoder.take()
    assert (early.parent, early.child, len(early), len(late)) == ("map", "body", 4, 2)
    np.testing.assert_allclose(np.concatenate([early.poses, late.poses]), POSES, atol=1e-12)
    assert np.concatenate([early.stamps_ns, late.stamps_ns]).tolist() == [H + i for i in range(6)]
    assert decoder.frames[0] == "world"


def test_a_reference_of_a_sensor_is_moved_to_the_body():
    mounting = Mounting(translation_m=(0.1, 0.2, -0.3), quaternion_xyzw=(0, 0, np.sqrt(0.5), np.sqrt(0.5)))
    sequence = Sequence(reference=ReferenceRules(places="lidar", shift_s=0.25), T_body={"lidar": mounting})
    decoder = _decoder(POSE_STAMPED, sequence.reference, sequence.T_places_body)
    truth = POSES[0] @ se3.inverse(mounting.transform())
    decoder.add(_pose_message(POSE_STAMPED, H, POSES[0]))
    taken = decoder.take()
    np.testing.assert_allclose(taken.poses[0], truth, atol=1e-12)
    # the lidar's own pose comes back from the body's
    np.testing.assert_allclose(taken.poses[0] @ mounting.transform(), POSES[0], atol=1e-12)
    assert taken.stamps_ns[0] == H + 250_000_000


def test_tf_of_several_pairs_must_be_told_apart():
    decoder = _decoder(TF_MESSAGE)
    decoder.add(_pose_message(TF_MESSAGE, H, POSES[0], frame="map", child="odom"))
    with pytest.raises(IngestError, match=r"map → odom and odom → drone.*parent_frame"):
        decoder.add(_pose_message(TF_MESSAGE, H + 1, POSES[1], frame="odom", child="drone"))
    told = _decoder(TF_MESSAGE, ReferenceRules(parent_frame="odom", child_frame="drone"))
    told.add(_pose_message(TF_MESSAGE, H, POSES[0], frame="map", child="odom"))
    told.add(_pose_message(TF_MESSAGE, H + 1, POSES[1], frame="odom", child="drone"))
    assert told.take().stamps_ns.tolist() == [H + 1]


def test_poses_that_are_none_are_dropped_and_counted():
    decoder = _decoder(ODOMETRY)
    bad = _pose_message(ODOMETRY, H + 1, POSES[1])
    bad.pose.pose.orientation.w = bad.pose.pose.orientation.x = 0.0
    bad.pose.pose.orientation.y = bad.pose.pose.orientation.z = 0.0
    nan = _pose_message(ODOMETRY, H + 2, POSES[1])
    nan.pose.pose.position.y = np.nan
    again = _pose_message(ODOMETRY, H, POSES[2])
    other = _pose_message(ODOMETRY, H + 4, POSES[2], child="wheel")
    for message in (_pose_message(ODOMETRY, H, POSES[0]), bad, nan, again, other):
        decoder.add(message)
    assert decoder.take().stamps_ns.tolist() == [H]
    counts = {f.name: f.count for f in decoder.findings}
    assert counts == {"pose_frames_differ": 1, "poses_not_rigid": 2, "pose_time_not_increasing": 1}
    decoder.add(again)
    assert decoder.take() is None


def test_other_types_are_a_mistake_of_the_caller():
    with pytest.raises(ValueError, match="holds no pose"):
        poses_of(_imu(0, (0, 0, 0), (0, 0, 0)).message, IMU)
