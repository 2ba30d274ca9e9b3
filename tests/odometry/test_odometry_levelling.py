from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from inertial_motions import START_NS, Motion, accelerating, at_rest, circling, cruising, tumbling
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import F64, ImuSamples
from mineloc.errors import FlightError
from mineloc.odometry.constant_velocity import ConstantVelocity
from mineloc.odometry.levelling import UpFinder, check_force, levelled, standing

SWEEP_NS = 100_000_000
SECOND_NS = 1_000_000_000
angles = st.floats(-0.6, 0.6)


def vibrating(imu: ImuSamples, sigma_mps2: float, *, seed: int = 0) -> ImuSamples:
    noise = np.random.default_rng(seed).normal(0, sigma_mps2, imu.accel_mps2.shape)
    return replace(imu, accel_mps2=imu.accel_mps2 + noise)


def angle_deg(a: F64, b: F64) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@settings(deadline=None)
@given(roll=angles, pitch=angles, bias=st.floats(-0.01, 0.01))
def test_a_drone_at_rest_says_where_up_is_and_what_its_gyro_reads_at_rest(
    roll: float, pitch: float, bias: float
) -> None:
    motion = at_rest((roll, pitch, 0.3))
    imu = motion.imu(START_NS, START_NS + SECOND_NS)
    found = standing(replace(imu, gyro_radps=imu.gyro_radps + bias))
    assert found is not None
    up = motion.at(np.array([START_NS]))[0, 2, :3]
    assert angle_deg(found.up_imu, up) < 1e-4
    assert found.gyro_bias_radps == pytest.approx([bias] * 3, abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_vibration_is_no_motion(seed: int) -> None:
    found = standing(vibrating(at_rest().imu(START_NS, START_NS + SECOND_NS), 0.6, seed=seed))
    assert found is not None
    assert angle_deg(found.up_imu, np.array([0, 0, 1.0])) < 0.5


@pytest.mark.parametrize(
    "motion",
    [cruising((1.0, 0, 0), (0, 0, 0.3)), circling(3.0, 0.7), tumbling(), accelerating((4.0, 0.0, 0.0))],
    ids=["turn", "circle", "tumble", "acceleration"],
)
def test_a_drone_that_moves_is_not_taken_for_standing(motion: Motion) -> None:
    assert standing(motion.imu(START_NS, START_NS + SECOND_NS)) is None


def test_of_a_start_only_the_rest_before_it_counts() -> None:
    moving = tumbling()
    motion = Motion(
        lambda t: moving.position(np.maximum(t - 0.3, 0)), lambda t: moving.rotation(np.maximum(t - 0.3, 0))
    )
    found = standing(motion.imu(START_NS, START_NS + SECOND_NS))
    assert found is not None
    assert angle_deg(found.up_imu, np.array([0, 0, 1.0])) < 0.1


def test_too_few_samples_say_nothing() -> None:
    assert standing(ImuSamples.empty()) is None
    assert standing(at_rest().imu(START_NS, START_NS + 20_000_000)) is None


@pytest.mark.parametrize("factor", [1 / 9.80665, 1000.0, 0.0])
def test_an_accelerometer_in_another_unit_is_refused(factor: float) -> None:
    imu = at_rest().imu(START_NS, START_NS + SWEEP_NS)
    with pytest.raises(FlightError, match=r"specific force.*unit"):
        check_force(replace(imu, accel_mps2=factor * imu.accel_mps2))
    check_force(imu)


@given(roll=angles, pitch=angles, yaw=st.floats(-3, 3))
def test_levelling_keeps_place_and_heading(roll: float, pitch: float, yaw: float) -> None:
    R = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    right = se3.from_rt(R, [1.0, 2.0, 3.0])
    up = 9.8 * R[2]
    # what is level stays
    assert np.allclose(levelled(right, up), right, atol=1e-9)
    # a start that takes the drone for level becomes level, by the smallest turn
    start = levelled(np.eye(4), up)
    assert start[2, :3] @ up == pytest.approx(9.8)
    assert not start[:3, 3].any()
    assert se3.angle_rad(start) == pytest.approx(np.deg2rad(angle_deg(up, np.array([0, 0, 1.0]))), abs=1e-9)


def followed(
    motion: Motion, *, sweeps: int, T_body_imu: F64 | None = None, missing: range = range(0)
) -> list[F64 | None]:
    """Up as found after each sweep, in the frame of the body's start, from a model that is always right."""
    T_body_imu = np.eye(4) if T_body_imu is None else T_body_imu
    finder, found = UpFinder(), []
    T_start = motion.at(np.array([START_NS]))[0]
    model = ConstantVelocity(START_NS, angular_radps2=1.0, linear_mps2=1.0)
    for k in range(sweeps):
        before, model.stamp_ns = model.stamp_ns, START_NS + (k + 1) * SWEEP_NS
        t = (k + 1) * 0.1
        model.T_odom_body = se3.inverse(T_start) @ motion.at(np.array([model.stamp_ns]))[0]
        model.velocity_mps = T_start[:3, :3].T @ motion.velocity(t)
        model.rate_radps = motion.imu(model.stamp_ns, model.stamp_ns + 1).gyro_radps[0]
        imu = motion.imu(before + 1, model.stamp_ns + 1, T_body_imu=T_body_imu)
        finder.follow(model, ImuSamples.empty() if k in missing else imu, T_body_imu)
        found.append(finder.up_odom(model))
    return found


@pytest.mark.parametrize("motion", [circling(3.0, 0.7), tumbling(), accelerating((1.5, 0.5, 0.2))])
def test_up_is_found_in_flight(motion: Motion) -> None:
    T_body_imu = se3.from_rt(Rotation.from_euler("xyz", [1.0, 0.3, -2.0]).as_matrix(), [0.0, 0.0, 0.0])
    found = followed(motion, sweeps=16, T_body_imu=T_body_imu)
    first = next(k for k, up in enumerate(found) if up is not None)
    assert first == 12  # a second after the first three sweeps
    up = motion.at(np.array([START_NS]))[0, 2, :3]
    for one in found[first:]:
        assert one is not None
        assert angle_deg(one, up) < 0.5
    # the accelerometer alone is far off
    alone = motion.imu(START_NS, START_NS + SECOND_NS)
    felt = np.einsum("nij,nj->ni", motion.at(alone.stamps_ns)[:, :3, :3], alone.accel_mps2).mean(axis=0)
    assert angle_deg(felt, np.array([0, 0, 1.0])) > 3.0


def test_a_hole_begins_the_search_anew() -> None:
    found = followed(tumbling(), sweeps=22, missing=range(8, 10))
    assert next(k for k, up in enumerate(found) if up is not None) == 19
