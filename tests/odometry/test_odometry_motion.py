from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from inertial_motions import GRAVITY, START_NS, Motion, accelerating, at_rest, circling, cruising, tumbling
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import F64, ImuSamples
from mineloc.odometry.constant_velocity import ConstantVelocity
from mineloc.odometry.imu_motion import ImuMotion
from mineloc.odometry.motion import MotionModel, add_to_pose, exp_so3, pose_deviation
from mineloc.odometry.strapdown import ImuNoise, Known, integrate, integrate_plainly

NOISE = ImuNoise(gyro=1e-3, accel=0.02, gyro_walk=1e-4, accel_walk=1e-3)
SWEEP_NS = 100_000_000


def sigmas_of(samples: F64, covariance: F64) -> F64:
    """Variances of samples (n, d) along the axes in which the covariance is the unit matrix: all about one."""
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), samples.T)
    return np.linalg.eigvalsh(whitened @ whitened.T / samples.shape[0])


# What both models share


@settings(deadline=None)  # the first call compiles
@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3))
def test_exp_so3_is_scipys(vector: list[float]) -> None:
    for scale in (1.0, 1e-6, 1e-10, 0.0):
        w = scale * np.array(vector)
        assert np.allclose(exp_so3(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-14)


@settings(deadline=None)
@given(seed=st.integers(0, 10_000))
def test_what_is_added_to_a_pose_is_its_deviation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, error = se3.exp(rng.normal(size=6)), rng.normal(0, 0.5, 6)
    assert pose_deviation(add_to_pose(T, error), T) == pytest.approx(error, abs=1e-12)


def moving_models() -> list[MotionModel]:
    velocity = ConstantVelocity(START_NS, angular_radps2=1.0, linear_mps2=1.0)
    velocity.add(np.concatenate([np.zeros(6), [0.1, 0.2, -0.3], [1.0, 2.0, 3.0]]))
    imu = ImuMotion(START_NS, np.eye(4), noise=NOISE)
    imu.feed(tumbling().imu(START_NS, START_NS + SWEEP_NS))
    return [velocity, imu]


@pytest.mark.parametrize("which", [0, 1])
def test_after_a_prediction_the_deviation_is_what_was_added(which: int) -> None:
    model = moving_models()[which]
    model.predict(START_NS, START_NS + SWEEP_NS)
    assert not model.deviation().any()
    errors = np.random.default_rng(0).normal(0, 0.01, (2, len(model.covariance)))
    model.add(errors[0])
    assert model.deviation() == pytest.approx(errors[0], abs=1e-14)
    model.add(errors[1])
    assert model.deviation() == pytest.approx(errors.sum(axis=0), abs=2e-4)  # rotations add to first order


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("early_ns", [-1000, 0, 1, 3_000_000])
def test_the_path_covers_the_sweep_and_ends_at_the_state(which: int, early_ns: int) -> None:
    model = moving_models()[which]
    path = model.predict(START_NS - early_ns, START_NS + SWEEP_NS)
    assert (np.diff(path.stamps_ns) > 0).all()
    assert path.stamps_ns[0] <= START_NS - early_ns
    assert path.stamps_ns[-1] == model.stamp_ns == START_NS + SWEEP_NS
    assert np.array_equal(path.poses[-1], model.T_odom_body)
    # no jump where the path goes back before the state
    steps = np.linalg.norm(np.diff(path.poses[:, :3, 3], axis=0), axis=1) / (np.diff(path.stamps_ns) * 1e-9)
    assert steps.max() < 4.0


# Constant velocity


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), steps=st.lists(st.integers(1, 10**9), min_size=1, max_size=5))
def test_constant_velocity_follows_a_constant_twist(seed: int, steps: list[int]) -> None:
    v, w = np.random.default_rng(seed).normal(0, 1, (2, 3))
    truth = cruising(tuple(v), tuple(w))
    model = ConstantVelocity(START_NS, angular_radps2=1.0, linear_mps2=1.0)
    model.add(np.concatenate([np.zeros(6), w, v]))
    now = START_NS
    for step in steps:
        path = model.predict(now, now + step)
        now += step
        assert np.allclose(path.poses, truth.at(path.stamps_ns), atol=1e-6)
        assert np.allclose(model.T_odom_body, truth.at(np.array([now]))[0], atol=1e-6)


def test_constant_velocity_knows_its_own_error() -> None:
    rng = np.random.default_rng(3)
    angular, linear, dt, parts, n = 0.6, 2.0, 0.4, 40, 500
    model = ConstantVelocity(START_NS, angular_radps2=angular, linear_mps2=linear)
    model.covariance = np.diag(np.repeat([0.01, 0.02, 0.05, 0.3], 3) ** 2)
    w, v = np.array([0.1, 0.2, 0.6]), np.array([1.0, 0.0, 0.5])
    model.add(np.concatenate([np.zeros(6), w, v]))
    start = rng.multivariate_normal(np.zeros(12), model.covariance, n)
    model.predict(START_NS, START_NS + round(dt * 1e9))
    h = dt / parts
    R, p = Rotation.from_rotvec(start[:, :3]), start[:, 3:6].copy()
    rate, velocity = w + start[:, 6:9], v + start[:, 9:12]
    for _ in range(parts):
        R, p = R * Rotation.from_rotvec(h * rate), p + h * velocity
        rate = rate + rng.normal(0, angular * np.sqrt(h), (n, 3))
        velocity = velocity + rng.normal(0, linear * np.sqrt(h), (n, 3))
    truth = model.T_odom_body
    rotation = (Rotation.from_matrix(truth[:3, :3]).inv() * R).as_rotvec()
    errors = np.concatenate([rotation, p - truth[:3, 3], rate - w, velocity - v], axis=1)
    # the spread of the eigenvalues of a sample covariance in 12 dimensions
    spread = np.sqrt(12 / n)
    found = sigmas_of(errors, model.covariance)
    assert (1 - spread) ** 2 * 0.9 < found.min()
    assert found.max() < (1 + spread) ** 2 * 1.1


@settings(deadline=None, max_examples=20)
@given(parts=st.integers(2, 20))
def test_constant_velocity_is_as_unsure_in_parts_as_in_one(parts: int) -> None:
    whole, split = (ConstantVelocity(0, angular_radps2=1.0, linear_mps2=2.0) for _ in range(2))
    whole.predict(0, 10**9)
    for k in range(parts):
        split.predict(0, (k + 1) * 10**9 // parts)
    assert np.allclose(split.covariance, whole.covariance, rtol=1e-6)


# Inertial


def started(truth: Motion, *, end_ns: int, rate_hz: float = 200.0) -> ImuMotion:
    """A model that knows how the motion begins, with ideal samples."""
    model = ImuMotion(START_NS, truth.at(np.array([START_NS]))[0], noise=NOISE)
    model.velocity_mps = truth.velocity(0.0)
    model.feed(truth.imu(START_NS, end_ns, rate_hz=rate_hz))
    return model


@pytest.mark.parametrize(
    ("truth", "limit_m"),
    [
        (at_rest((0.1, -0.2, 1.0)), 1e-6),
        (accelerating((1.0, -0.5, 0.3)), 1e-5),
        (cruising((2.0, 0.5, 0.1), (0.1, 0.2, 0.5)), 2e-4),
        (circling(3.0, 0.7), 2e-4),
        (tumbling(), 1e-3),
    ],
    ids=["rest", "acceleration", "twist", "circle", "tumble"],
)
def test_the_imu_model_follows_the_motion(truth: Motion, limit_m: float) -> None:
    model = started(truth, end_ns=START_NS + 22 * SWEEP_NS)
    for k in range(20):
        now = START_NS + k * SWEEP_NS
        path = model.predict(now, now + SWEEP_NS)
        off = se3.inverse(truth.at(path.stamps_ns)) @ path.poses
        assert np.linalg.norm(off[:, :3, 3], axis=1).max() < limit_m
        assert se3.angle_rad(off).max() < 1e-4
    assert model.velocity_mps == pytest.approx(truth.velocity(2.0), abs=2 * limit_m)


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10_000), m=st.integers(2, 40))
def test_the_strapdown_kernel_agrees_with_plain_numpy(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.001, 0.02, m))
    root = rng.normal(0, 0.1, (15, 15))
    state = se3.exp(rng.normal(size=6)), rng.normal(size=3), root @ root.T
    measured = rng.normal(0, 1, (m - 1, 3)), rng.normal(0, 3, (m - 1, 3)) + GRAVITY
    known = Known(*(rng.uniform(size=(2, m - 1)) < 0.3))
    fast, plain = (way(times, *measured, known, *state, NOISE) for way in (integrate, integrate_plainly))
    assert np.allclose(fast.poses, plain.poses, rtol=1e-9, atol=1e-12)
    assert fast.velocity_mps == pytest.approx(plain.velocity_mps, rel=1e-9)
    assert np.allclose(fast.covariance, plain.covariance, rtol=1e-9, atol=1e-9 * plain.covariance.max())


def test_the_imu_model_knows_its_own_error() -> None:
    rng = np.random.default_rng(4)
    n, seconds, rate_hz = 400, 1.0, 200.0
    truth = tumbling()
    samples = truth.imu(START_NS, START_NS + round(seconds * 1e9) + 1, rate_hz=rate_hz)
    times = (samples.stamps_ns - START_NS) * 1e-9
    start = truth.at(np.array([START_NS]))[0], truth.velocity(0.0)
    P = np.diag(np.repeat([0.01, 0.02, 0.1, 0.005, 0.05], 3) ** 2)
    known = Known(*np.zeros((2, len(times) - 1), np.bool_))
    ideal_gyro, ideal_accel = (0.5 * (c[:-1] + c[1:]) for c in (samples.gyro_radps, samples.accel_mps2))
    exact = integrate(times, ideal_gyro, ideal_accel, known, *start, P, NOISE)
    errors = np.empty((n, 9))
    for k in range(n):
        wrong = rng.multivariate_normal(np.zeros(15), P)
        noise = rng.normal(size=(4, len(times) - 1, 3)) * np.sqrt(rate_hz)
        # the biases walk on while the samples are taken
        gyro_bias = wrong[9:12] + np.cumsum(noise[2], axis=0) * NOISE.gyro_walk / rate_hz
        accel_bias = wrong[12:15] + np.cumsum(noise[3], axis=0) * NOISE.accel_walk / rate_hz
        gyro = ideal_gyro - gyro_bias + NOISE.gyro * noise[0]
        accel = ideal_accel - accel_bias + NOISE.accel * noise[1]
        T, v = add_to_pose(start[0], wrong[:6]), start[1] + wrong[6:9]
        found = integrate(times, gyro, accel, known, T, v, P, NOISE)
        errors[k, :6] = pose_deviation(found.poses[-1], exact.poses[-1])
        errors[k, 6:] = found.velocity_mps - exact.velocity_mps
    spread = np.sqrt(9 / n)
    ratio = sigmas_of(errors, exact.covariance[:9, :9])
    assert (1 - spread) ** 2 * 0.85 < ratio.min()
    assert ratio.max() < (1 + spread) ** 2 * 1.15


@settings(deadline=None, max_examples=20)
@given(cuts=st.lists(st.integers(0, 440), max_size=6), overlap=st.integers(0, 5))
def test_portions_and_repetitions_of_samples_change_nothing(cuts: list[int], overlap: int) -> None:
    truth = tumbling()
    imu = truth.imu(START_NS, START_NS + 22 * SWEEP_NS)
    whole, split = (started(at_rest(), end_ns=START_NS) for _ in range(2))
    whole.feed(imu)
    borders = [0, *sorted(cuts), len(imu)]
    for a, b in pairwise(borders):
        part = slice(max(0, a - overlap), b)
        split.feed(ImuSamples(imu.stamps_ns[part], imu.gyro_radps[part], imu.accel_mps2[part]))
    for k in range(20):
        for model in (whole, split):
            model.predict(START_NS + k * SWEEP_NS, START_NS + (k + 1) * SWEEP_NS)
        assert np.array_equal(whole.T_odom_body, split.T_odom_body)
        assert np.array_equal(whole.covariance, split.covariance)


@pytest.mark.parametrize("period_ns", [50_000_000, 100_000_000])
def test_a_hole_of_the_imu_widens_the_covariance(period_ns: int) -> None:
    # also when the sweeps come faster than what counts as a hole
    truth = cruising((1.0, 0, 0), (0, 0, 0))
    imu = truth.imu(START_NS, START_NS + 20 * SWEEP_NS)
    hole = (imu.stamps_ns > START_NS + 3 * SWEEP_NS) & (imu.stamps_ns < START_NS + 8 * SWEEP_NS)
    holed = ImuSamples(imu.stamps_ns[~hole], imu.gyro_radps[~hole], imu.accel_mps2[~hole])
    complete, missing = (started(truth, end_ns=START_NS) for _ in range(2))
    complete.feed(imu)
    missing.feed(holed)
    for k in range(20 * SWEEP_NS // period_ns):
        start_ns, end_ns = START_NS + k * period_ns, START_NS + (k + 1) * period_ns
        variances = []
        for model in (complete, missing):
            model.covariance = np.diag(np.repeat([1e-3, 1e-3, 1e-2, 1e-4, 1e-2], 3) ** 2)
            model.predict(start_ns, end_ns)
            variances.append(np.diag(model.covariance)[[0, 6]])
        in_hole = start_ns >= START_NS + 3 * SWEEP_NS and end_ns <= START_NS + 8 * SWEEP_NS
        dt = period_ns * 1e-9
        assert variances[1] - variances[0] == pytest.approx(in_hole * np.array([4.0 * dt**3, 9.0 * dt]), rel=1e-4)


def velocity_sigma(model: ImuMotion) -> float:
    return float(np.sqrt(model.covariance[6, 6]))


def test_after_the_last_sample_the_drone_goes_on_and_trust_goes() -> None:
    # the last samples are of a hard brake: held on, they would throw the drone back
    truth = cruising((1.0, 0, 0), (0, 0, 0.5))
    ideal = truth.imu(START_NS, START_NS + 2 * SWEEP_NS)
    braking = ideal.accel_mps2.copy()
    braking[-3:, 0] -= 5.0
    model = started(truth, end_ns=START_NS)
    model.feed(replace(ideal, accel_mps2=braking))
    for k in range(2):
        model.predict(START_NS + k * SWEEP_NS, START_NS + (k + 1) * SWEEP_NS)
    sure, velocity = velocity_sigma(model), model.velocity_mps
    for k in range(2, 5):
        path = model.predict(START_NS + k * SWEEP_NS, START_NS + (k + 1) * SWEEP_NS)
        assert se3.angle_rad(se3.inverse(truth.at(path.stamps_ns)) @ path.poses).max() < 1e-3
        assert np.array_equal(model.velocity_mps, velocity)
    assert velocity_sigma(model) ** 2 > sure**2 + 0.9 * 3.0**2 * 0.3


def test_in_a_long_hole_the_drone_stops_turning() -> None:
    model = started(cruising((1.0, 0, 0), (0, 0, 0.5)), end_ns=START_NS + 2 * SWEEP_NS)
    model.predict(START_NS, START_NS + 2 * SWEEP_NS)
    before = model.T_odom_body
    model.predict(START_NS + 2 * SWEEP_NS, START_NS + 30 * SWEEP_NS)
    assert np.array_equal(model.T_odom_body[:3, :3], before[:3, :3])
    assert model.T_odom_body[:3, 3] - before[:3, 3] == pytest.approx([2.8, 0, 0], abs=0.01)


def test_an_imu_that_never_came_leaves_the_drone_where_it_goes() -> None:
    model = ImuMotion(START_NS, at_rest((0.2, 0.1, 0.0)).at(np.array([START_NS]))[0], noise=NOISE)
    model.velocity_mps = np.array([1.0, 0.0, 0.0])
    model.predict(START_NS, START_NS + 10 * SWEEP_NS)
    assert model.T_odom_body[:3, 3] == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert velocity_sigma(model) > 1.0
