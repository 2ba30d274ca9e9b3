from __future__ import annotations

import numpy as np
import pytest
from driver_clouds import vlp16_sweep
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import Calibration, ImuSamples, Sweep, Trajectory
from mineloc.io import canonical
from mineloc.io.pointcloud2 import read_cloud
from mineloc.io.ros import IMU, ODOMETRY, POINT_CLOUD2, POSE_STAMPED, STORE, TF_MESSAGE, stamp_parts

H = 1_760_000_000_123_456_789


@st.composite
def sweeps(draw):
    n = draw(st.integers(0, 40))
    f4 = st.floats(width=32, allow_nan=False, allow_infinity=False)
    return Sweep(
        draw(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)),
        draw(hnp.arrays(np.float32, (n, 3), elements=f4)),
        draw(st.none() | hnp.arrays(np.int64, n, elements=st.integers(0, 2**53))),
        draw(st.none() | hnp.arrays(np.uint16, n)),
        draw(st.none() | hnp.arrays(np.float32, n)),
        draw(st.integers(1, 10**10)),
    )


@given(sweeps())
def test_every_sweep_round_trips_exactly(sweep):
    data = canonical.encode_sweep(sweep)
    again = canonical.decode_sweep(data, period_ns=sweep.period_ns)
    for name in ("stamp_ns", "period_ns"):
        assert getattr(again, name) == getattr(sweep, name)
    for name in ("points_lidar", "offsets_ns", "ring", "intensity"):
        before, after = getattr(sweep, name), getattr(again, name)
        assert (before is None) == (after is None)
        if before is not None:
            assert before.dtype == after.dtype
            np.testing.assert_array_equal(before, after)


def test_a_sweep_is_a_message_that_others_read():
    sweep = vlp16_sweep()
    message = STORE.deserialize_cdr(canonical.encode_sweep(sweep), POINT_CLOUD2)
    assert (message.point_step, message.width, message.height) == (22, len(sweep), 1)
    assert message.row_step == len(message.data) == 22 * len(sweep)
    assert message.header.frame_id == "lidar"
    assert [f.name for f in message.fields] == ["x", "y", "z", "intensity", "ring", "t"]
    found = read_cloud(message, where="x")
    assert found.header_ns == sweep.stamp_ns
    np.testing.assert_array_equal(found.points, sweep.points_lidar)
    np.testing.assert_array_equal(found.time, sweep.offsets_ns)
    np.testing.assert_array_equal(found.ring, sweep.ring)
    # the serializer makes the same bytes
    assert bytes(STORE.serialize_cdr(message, POINT_CLOUD2)) == bytes(canonical.encode_sweep(sweep))


def test_fields_that_a_sweep_does_not_have_are_left_out():
    sweep = Sweep(H, np.ones((3, 3), np.float32), ring=np.arange(3, dtype=np.uint16))
    message = STORE.deserialize_cdr(canonical.encode_sweep(sweep), POINT_CLOUD2)
    assert [f.name for f in message.fields] == ["x", "y", "z", "ring"]
    assert message.point_step == 14


def test_sweeps_that_cannot_be_written_are_refused():
    points = np.ones((1, 3), np.float32)
    with pytest.raises(ValueError, match="offsets_ns beyond"):
        canonical.encode_sweep(Sweep(0, points, np.array([2**53 + 1])))
    with pytest.raises(ValueError, match="does not fit a ROS time"):
        canonical.encode_sweep(Sweep(2**31 * 10**9, points))


def test_clouds_of_others_are_refused():
    message = STORE.deserialize_cdr(canonical.encode_sweep(vlp16_sweep()), POINT_CLOUD2)
    message.fields[0].name = "a"
    with pytest.raises(ValueError, match="not a canonical cloud"):
        canonical.decode_sweep(STORE.serialize_cdr(message, POINT_CLOUD2), period_ns=1)


def _trajectory(n=7, parent="map"):
    rng = np.random.default_rng(3)
    poses = se3.from_rt(Rotation.random(n, rng=rng).as_matrix(), rng.normal(size=(n, 3)))
    return Trajectory(H + 12_345_678 * np.arange(n), poses, parent)


def _pose_is(message_pose, T):
    t, q = se3.to_xyzw(T)
    p, o = message_pose
    assert (p.x, p.y, p.z) == tuple(t)
    assert (o.x, o.y, o.z, o.w) == tuple(q)


def _stamp_is(header, stamp_ns, frame):
    assert (header.stamp.sec, header.stamp.nanosec) == stamp_parts(stamp_ns)
    assert header.frame_id == frame


def test_inertial_samples_are_what_the_serializer_makes():
    rng = np.random.default_rng(0)
    imu = ImuSamples(H + 5_000_000 * np.arange(9), rng.normal(size=(9, 3)), rng.normal(size=(9, 3)))
    encoded = canonical.encode_imu(imu)
    for i, row in enumerate(encoded):
        message = STORE.deserialize_cdr(row.tobytes(), IMU)
        _stamp_is(message.header, imu.stamps_ns[i], "imu")
        gyro, accel = message.angular_velocity, message.linear_acceleration
        assert (gyro.x, gyro.y, gyro.z) == tuple(imu.gyro_radps[i])
        assert (accel.x, accel.y, accel.z) == tuple(imu.accel_mps2[i])
        assert message.orientation_covariance[0] == -1
        assert message.orientation.w == 1
        assert bytes(STORE.serialize_cdr(message, IMU)) == row.tobytes()
    again = canonical.decode_imu([row.tobytes() for row in encoded])
    for name in ("stamps_ns", "gyro_radps", "accel_mps2"):
        np.testing.assert_array_equal(getattr(again, name), getattr(imu, name))


@pytest.mark.parametrize(
    ("msgtype", "layout", "parent"),
    [
        (POSE_STAMPED, canonical.pose_layout("map"), "map"),
        (ODOMETRY, canonical.odometry_layout("odom", "body"), "odom"),
        (TF_MESSAGE, canonical.transform_layout("map", "body"), "map"),
    ],
)
def test_poses_are_what_the_serializer_makes(msgtype, layout, parent):
    trajectory = _trajectory(parent=parent)
    encoded = canonical.encode_poses(trajectory, layout)
    for i, row in enumerate(encoded):
        message = STORE.deserialize_cdr(row.tobytes(), msgtype)
        assert bytes(STORE.serialize_cdr(message, msgtype)) == row.tobytes()
        if msgtype == TF_MESSAGE:
            (message,) = message.transforms
            _pose_is((message.transform.translation, message.transform.rotation), trajectory.poses[i])
        else:
            pose = message.pose if msgtype == POSE_STAMPED else message.pose.pose
            _pose_is((pose.position, pose.orientation), trajectory.poses[i])
        if msgtype != POSE_STAMPED:
            assert message.child_frame_id == "body"
        _stamp_is(message.header, trajectory.stamps_ns[i], parent)
    again = canonical.decode_poses([row.tobytes() for row in encoded], layout, parent=parent, child="body")
    np.testing.assert_array_equal(again.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(again.poses, trajectory.poses, atol=1e-15)


def test_messages_of_other_sizes_or_frames_are_refused():
    rows = canonical.encode_poses(_trajectory(), canonical.pose_layout("map"))
    with pytest.raises(ValueError, match="no multiple"):
        canonical.decode_poses([rows[0].tobytes()[:-1]], canonical.pose_layout("map"), parent="map", child="body")
    with pytest.raises(ValueError, match="constant field"):
        canonical.decode_poses([rows[0].tobytes()], canonical.pose_layout("mop"), parent="map", child="body")
    with pytest.raises(ValueError, match="constant field"):
        canonical.decode_imu([b"\0" * 316], "imu")


def test_calibration_places_the_sensors_in_body():
    T = _trajectory(2).poses
    data = canonical.encode_calibration(Calibration(T[0], T[1]), H)
    message = STORE.deserialize_cdr(data, TF_MESSAGE)
    assert [t.child_frame_id for t in message.transforms] == ["lidar", "imu"]
    for transform, expected in zip(message.transforms, T, strict=True):
        _stamp_is(transform.header, H, "body")
        _pose_is((transform.transform.translation, transform.transform.rotation), expected)
