"""The drone's true motion: derivatives, attitude, limits; and the IMU on it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.config import SimulateConfig
from mineloc.data import ImuSamples
from mineloc.sim.flight import START_NS, SimulatedFlight
from mineloc.sim.imu import Imu, ImuNoise, ideal_imu, mounting
from mineloc.sim.motion import GRAVITY_MPS2, Motion, Vibration
from mineloc.sim.path import resample
from mineloc.sim.schedule import Limits, schedule

SILENT = ImuNoise(0, 0, 0, 0, 0, 0)


def _random_motion(seed: int, *, shaking: bool) -> Motion:
    rng = np.random.default_rng(seed)
    control = np.cumsum(rng.normal(0, [0.2, 0.2, 0.05, 0.1, 0.03, 0.03], (60, 6)), axis=0)
    return Motion(control, 0.1, Vibration.of_rotors(0.5, 0.03, rng) if shaking else Vibration.none())


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_derivatives_are_those_of_the_pose(seed: int, shaking: bool) -> None:
    motion = _random_motion(seed, shaking=shaking)
    t, h = np.linspace(0.3, 5.5, 40), 2e-5
    state, before, after = motion.at(t), motion.at(t - h), motion.at(t + h)
    velocity = (after.T_map_body[:, :3, 3] - before.T_map_body[:, :3, 3]) / (2 * h)
    np.testing.assert_allclose(state.velocity_mps, velocity, atol=2e-4)
    np.testing.assert_allclose(state.accel_mps2, (after.velocity_mps - before.velocity_mps) / (2 * h), atol=5e-3)
    turned = se3.log(se3.inverse(before.T_map_body) @ after.T_map_body)[:, :3] / (2 * h)
    np.testing.assert_allclose(state.rate_radps, turned, atol=2e-4)
    np.testing.assert_allclose(state.rate_change_radps2, (after.rate_radps - before.rate_radps) / (2 * h), atol=5e-3)
    np.testing.assert_allclose(motion.pose(t), state.T_map_body)


def test_pose_rotates_as_yaw_pitch_roll() -> None:
    euler = np.array([0.7, -0.2, 0.1])
    motion = Motion(np.tile(np.concatenate([[1, 2, 3], euler]), (10, 1)), 0.1, Vibration.none())
    T = motion.pose(np.array([0.5]))[0]
    np.testing.assert_allclose(T[:3, :3], Rotation.from_euler("ZYX", euler).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])


def test_vibration_has_the_strength_asked_for() -> None:
    shake = Vibration.of_rotors(0.5, 0.03, np.random.default_rng(0))
    t = np.arange(0, 60, 1e-3)
    np.testing.assert_allclose(shake.value(t, 2)[:, :3].std(axis=0), 0.5, rtol=0.05)
    np.testing.assert_allclose(shake.value(t, 1)[:, 3:].std(axis=0), 0.03, rtol=0.05)
    assert np.abs(shake.value(t, 0)[:, :3]).max() < 1e-3


def test_flight_keeps_its_limits(calm: SimulatedFlight) -> None:
    config = calm.config
    state = calm.motion.at(np.arange(0, calm.motion.end_s, 0.01))
    speed = np.linalg.norm(state.velocity_mps, axis=1)
    assert speed.max() < config.speed_mps * 1.04
    assert np.median(speed) > 0.9 * config.speed_mps
    assert np.linalg.norm(state.accel_mps2, axis=1).max() < config.accel_mps2 * 1.1
    assert np.rad2deg(np.abs(state.rate_radps[:, 2]).max()) < config.yaw_rate_degps * 1.05
    assert np.rad2deg(np.abs(state.rate_radps[:, :2]).max()) < 40
    path = np.linalg.norm(np.diff(state.T_map_body[:, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx(config.length_m, rel=0.02)


def test_flight_keeps_clear_of_the_walls_and_never_goes_through(calm: SimulatedFlight) -> None:
    scene = calm.mine.scene
    positions = calm.pose(START_NS + np.arange(0, int(calm.motion.end_s * 1e9), 10_000_000))[:, :3, 3]
    assert scene.clearance_m(positions).min() > calm.config.clearance_m / 2
    step = np.diff(positions, axis=0)
    length = np.linalg.norm(step, axis=1)
    assert (scene.ranges_m(positions[:-1], step / np.maximum(length, 1e-9)[:, None]) > length).all()


def test_flight_rests_hovers_and_sways(calm: SimulatedFlight) -> None:
    t = np.arange(0, 2.5, 0.01)
    rest = calm.motion.at(t)
    assert np.abs(rest.velocity_mps).max() < 0.02
    assert np.abs(calm.motion.at(calm.motion.end_s - t).velocity_mps).max() < 0.02
    # with and without wander: it is there, and of the size asked for
    still = SimulatedFlight(calm.mine, calm.config.model_copy(update={"sway_m": 0.0})).motion.pose(
        np.arange(10, calm.motion.end_s, 0.1)
    )
    off = np.linalg.norm(calm.motion.pose(np.arange(10, calm.motion.end_s, 0.1))[:, :3, 3] - still[:, :3, 3], axis=1)
    assert 0.05 < np.sqrt((off**2).mean()) < 0.25


def test_drone_tilts_with_its_thrust(calm: SimulatedFlight) -> None:
    """In still air only thrust acts, and it points out of the top; drag makes the rest."""
    state = calm.motion.at(np.arange(5, calm.motion.end_s - 5, 0.05))
    force = state.accel_mps2 + [0, 0, GRAVITY_MPS2] + 0.2 * state.velocity_mps
    top = state.T_map_body[:, :3, 2]
    angle = np.arccos(np.clip((force * top).sum(axis=1) / np.linalg.norm(force, axis=1), -1, 1))
    assert np.rad2deg(np.percentile(angle, 99)) < 1.5
    tilt = np.rad2deg(np.arccos(top[:, 2]))
    assert 4 < tilt.max() < 20
    nose = state.T_map_body[:, :2, 0]
    fast = np.linalg.norm(state.velocity_mps, axis=1) > 1
    ahead = (nose * state.velocity_mps[:, :2]).sum(axis=1)[fast] / np.linalg.norm(state.velocity_mps[fast, :2], axis=1)
    assert np.percentile(ahead, 5) > 0.9


def test_bends_are_slow_and_straights_fast() -> None:
    line = resample(np.array([[0, 0, 0], [30, 0, 0], [30, 0.0, 0], [30, 30, 0]], float))
    angle = np.linspace(-np.pi / 2, 0, 50)
    bend = np.stack([28 + 2 * np.cos(angle), 2 + 2 * np.sin(angle), 0 * angle], axis=1)
    line = resample(np.concatenate([[[0, 0, 0]], bend, [[30, 30, 0]]]))
    plan = schedule([line], Limits(4.0, 1.5, np.deg2rad(60), 2.0))
    speed = np.linalg.norm(np.diff(plan.positions_m, axis=0), axis=1) / plan.step_s
    assert speed.max() == pytest.approx(4.0, rel=0.02)
    corner = np.linalg.norm(plan.positions_m[:-1] - [29.4, 0.6, 0], axis=1).argmin()
    # lateral acceleration on a radius of 2 m: v² / 2 <= 1.5 / sqrt 2
    assert speed[corner] == pytest.approx(np.sqrt(2 * 1.5 / np.sqrt(2)), rel=0.15)
    assert plan.yaw_rad[-1] - plan.yaw_rad[0] == pytest.approx(np.pi / 2, abs=0.02)


def test_turns_on_the_spot_between_legs() -> None:
    line = resample(np.array([[0, 0, 0], [20, 0, 0]], float))
    plan = schedule([line, line[::-1]], Limits(2.0, 1.5, np.deg2rad(45), 2.0))
    rate = np.rad2deg(np.abs(np.diff(plan.yaw_rad)) / plan.step_s)
    assert 40 < rate.max() <= 45.1
    assert abs(plan.yaw_rad[-1] - plan.yaw_rad[0]) == pytest.approx(np.pi, abs=0.02)
    turning = rate > 10
    speed = np.linalg.norm(np.diff(plan.positions_m, axis=0), axis=1) / plan.step_s
    assert speed[turning].max() < 0.3


# --- the IMU


def _imu(motion: Motion, noise: ImuNoise = SILENT, T: np.ndarray | None = None, seed: int = 0) -> Imu:
    return Imu(
        motion, np.eye(4) if T is None else T, noise, rate_hz=200.0, start_ns=START_NS, rng=np.random.default_rng(seed)
    )


def test_imu_at_rest_feels_gravity_upwards() -> None:
    motion = Motion(np.tile([1.0, 2, 3, 0.8, 0, 0], (30, 1)), 0.1, Vibration.none())
    samples = _imu(motion).until(START_NS + 1_000_000_000)
    assert len(samples) == 200
    np.testing.assert_allclose(samples.accel_mps2, np.tile([0, 0, 9.80665], (200, 1)), atol=1e-9)
    np.testing.assert_allclose(samples.gyro_radps, 0, atol=1e-12)


def test_imu_integrates_to_the_true_motion(calm: SimulatedFlight) -> None:
    """Gyroscope and accelerometer without errors, mounted askew and off centre, give back attitude and position."""
    T_body_imu = mounting(3.0, -5.0, 20.0, (0.1, -0.2, 0.05))
    imu = Imu(calm.motion, T_body_imu, SILENT, rate_hz=1000.0, start_ns=START_NS, rng=np.random.default_rng(0))
    imu.until(START_NS + 10_000_000_000)
    samples = imu.until(START_NS + 22_000_000_000)
    times = (samples.stamps_ns - START_NS) * 1e-9
    T = calm.motion.pose(times) @ T_body_imu
    R, p = Rotation.from_matrix(T[0, :3, :3]), T[0, :3, 3]
    v = (calm.motion.pose(times[:1] + 1e-4) @ T_body_imu)[0, :3, 3] - (calm.motion.pose(times[:1] - 1e-4) @ T_body_imu)[
        0, :3, 3
    ]
    v /= 2e-4
    dt, gravity = 1e-3, np.array([0, 0, -GRAVITY_MPS2])
    gyro = (samples.gyro_radps[1:] + samples.gyro_radps[:-1]) / 2
    accel = samples.accel_mps2.copy()
    for k in range(len(gyro)):
        R_next = R * Rotation.from_rotvec(gyro[k] * dt)
        a = (R.apply(accel[k]) + R_next.apply(accel[k + 1])) / 2 + gravity
        p, v, R = p + v * dt + a * dt**2 / 2, v + a * dt, R_next
    assert np.rad2deg((R.inv() * Rotation.from_matrix(T[-1, :3, :3])).magnitude()) < 0.01
    np.testing.assert_allclose(p, T[-1, :3, 3], atol=0.02)
    # lower bound: without the lever arm it would not come out
    rate = (
        ideal_imu(calm.motion.at(times), np.eye(4))[1]
        - ideal_imu(calm.motion.at(times), T_body_imu)[1] @ T_body_imu[:3, :3].T
    )
    assert np.abs(rate).max() > 0.05


@given(st.lists(st.integers(1, 400_000_000), min_size=1, max_size=6))
@settings(max_examples=15, deadline=None)
def test_imu_read_in_pieces_equals_read_at_once_without_noise(pieces: list[int]) -> None:
    motion = _random_motion(3, shaking=False)
    one, many = _imu(motion), _imu(motion)
    parts: list[ImuSamples] = []
    end = START_NS
    for piece in pieces:
        end += piece
        parts.append(many.until(end))
    whole = one.until(end)
    np.testing.assert_array_equal(np.concatenate([part.stamps_ns for part in parts]), whole.stamps_ns)
    np.testing.assert_allclose(np.concatenate([part.gyro_radps for part in parts]), whole.gyro_radps, atol=1e-12)
    assert (np.diff(whole.stamps_ns) == 5_000_000).all()
    assert whole.stamps_ns[-1] < end <= whole.stamps_ns[-1] + 5_000_000


def test_imu_noise_has_its_densities() -> None:
    motion = Motion(np.tile([0.0, 0, 0, 0, 0, 0], (12_000, 1)), 0.1, Vibration.none())
    noise = ImuNoise(1e-4, 3e-3, 0.0, 2e-3, 3e-2, 0.0)
    samples = _imu(motion, noise).until(START_NS + 200_000_000_000)
    np.testing.assert_allclose(samples.gyro_radps.std(axis=0), 1e-4 * np.sqrt(200), rtol=0.03)
    np.testing.assert_allclose(samples.accel_mps2.std(axis=0), 2e-3 * np.sqrt(200), rtol=0.03)
    biases = np.array([_imu(motion, noise, seed=k).until(START_NS + 10**9).gyro_radps.mean(axis=0) for k in range(60)])
    assert biases.std() == pytest.approx(3e-3, rel=0.25)
    walking = ImuNoise(0, 0, 1e-3, 0, 0, 1e-2)
    ends = np.array([_imu(motion, walking, seed=k).until(START_NS + 4 * 10**9).accel_mps2[-1] for k in range(60)])
    assert (ends - [0, 0, GRAVITY_MPS2]).std() == pytest.approx(1e-2 * 2, rel=0.25)


def test_mounting_is_a_rotation_about_the_named_axes() -> None:
    T = mounting(0.0, 0.0, 90.0, (1.0, 2.0, 3.0))
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])


def test_simulated_imu_is_the_flight_s(flight: SimulatedFlight) -> None:
    assert isinstance(flight.config, SimulateConfig)
    packets = [packet for _, packet in zip(range(15), flight.packets(), strict=False)]
    samples = [packet.imu for packet in packets]
    stamps = np.concatenate([one.stamps_ns for one in samples])
    assert stamps[0] == START_NS
    assert (np.diff(stamps) == 5_000_000).all()
    accel = np.concatenate([one.accel_mps2 for one in samples]).mean(axis=0)
    assert np.linalg.norm(accel) == pytest.approx(GRAVITY_MPS2, abs=0.15)
    # the imu is mounted half a degree askew
    assert np.rad2deg(np.arccos(accel[2] / np.linalg.norm(accel))) < 2.0
