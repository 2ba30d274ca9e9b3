"""The motion model of a drone with an IMU: strapdown integration between sweeps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mineloc import se3
from mineloc.compiled import njit
from mineloc.data import F64, I64, ImuSamples
from mineloc.odometry.motion import BodyPath, add_to_pose, exp_so3, pose_deviation

GRAVITY_MPS2 = 9.80665
GAP_S = 0.05
"""A longer pause between samples is a hole: what happens in it is guessed, not measured."""
_GAP_RADPS2, _GAP_MPS2 = 2.0, 3.0
_START_SIGMAS = np.repeat([0.02, 1e-4, 1.0, 0.003, 0.05], 3)


class ImuNoise(NamedTuple):
    """Densities: gyro rad/s/√Hz, accelerometer m/s²/√Hz (vibration included), and the walks of their biases."""

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float


class ImuMotion:
    """Body = IMU. Errors: [rotation, position, velocity, gyro bias, accelerometer bias], 15 of them; z of odom is up.

    The accelerometer keeps roll and pitch right for the whole flight, which is what stops the z drift of 16-beam
    LiDARs (METHOD 4.1, 7.3).

    Args:
        first: samples of the first moments; their mean says where up is and, if the drone is at rest, the gyro bias.
        T_odom_body: (4, 4) start pose; its heading and position are kept, its roll and pitch are levelled.

    Raises:
        ValueError: no samples.
    """

    def __init__(self, stamp_ns: int, first: ImuSamples, *, noise: ImuNoise, T_odom_body: F64 | None = None) -> None:
        if not len(first):
            raise ValueError("an IMU model needs samples to find up")
        self._noise = noise
        self._samples = ImuSamples.empty()
        self.stamp_ns = stamp_ns
        start = np.eye(4) if T_odom_body is None else T_odom_body
        up_odom = start[:3, :3] @ first.accel_mps2.mean(axis=0)
        self.T_odom_body = se3.from_rt(se3.rotation_between(up_odom, [0, 0, 1]) @ start[:3, :3], start[:3, 3])
        self.velocity_mps = np.zeros(3)
        rate = first.gyro_radps.mean(axis=0)
        self.gyro_bias_radps = rate if float(np.linalg.norm(rate)) < 0.02 else np.zeros(3)
        self.accel_bias_mps2 = np.zeros(3)
        self.covariance: F64 = np.diag(_START_SIGMAS**2)
        self._predicted = self._state()

    def feed(self, samples: ImuSamples) -> None:
        """Take new samples; older ones than the state needs are dropped, repeated ones ignored."""
        known = int(self._samples.stamps_ns[-1]) if len(self._samples) else -1
        fresh = samples.stamps_ns > known
        stamps = np.concatenate([self._samples.stamps_ns, samples.stamps_ns[fresh]])
        first = max(0, int(np.searchsorted(stamps, self.stamp_ns, side="right")) - 1)
        gyro = np.concatenate([self._samples.gyro_radps, samples.gyro_radps[fresh]])[first:]
        accel = np.concatenate([self._samples.accel_mps2, samples.accel_mps2[fresh]])[first:]
        self._samples = ImuSamples(stamps[first:], gyro, accel)

    def predict(self, start_ns: int, end_ns: int) -> BodyPath:
        """Integrate to `end_ns`. Beyond the samples the last ones are held, and the covariance says so."""
        if end_ns <= self.stamp_ns:
            self._predicted = self._state()
            stamps = np.array([min(start_ns, end_ns) - 1, end_ns], dtype=np.int64)
            return BodyPath(stamps, np.stack([self.T_odom_body] * 2))
        stamps, gyro, accel = self._nodes(end_ns)
        rotations, positions, self.velocity_mps, self.covariance = _integrate(
            (stamps - self.stamp_ns) * 1e-9,
            gyro - self.gyro_bias_radps,
            accel - self.accel_bias_mps2,
            np.ascontiguousarray(self.T_odom_body[:3, :3]),
            self.T_odom_body[:3, 3].copy(),
            self.velocity_mps,
            self.covariance,
            self._noise,
        )
        poses = se3.from_rt(rotations, positions)
        if start_ns < self.stamp_ns:
            # the sweep began a little before the last one ended
            back = -1e-9 * (self.stamp_ns - start_ns)
            turn = exp_so3(back * (gyro[0] - self.gyro_bias_radps))
            first = se3.from_rt(poses[0, :3, :3] @ turn, poses[0, :3, 3] + back * self.velocity_mps)
            stamps = np.concatenate([np.array([start_ns]), stamps])
            poses = np.concatenate([first[None], poses])
        self.T_odom_body, self.stamp_ns = poses[-1], end_ns
        self._predicted = self._state()
        return BodyPath(stamps, poses)

    def deviation(self) -> F64:
        """(15,) error of the state against the prediction."""
        T, *vectors = self._predicted
        _, *now = self._state()
        return np.concatenate(
            [pose_deviation(self.T_odom_body, T), *(a - b for a, b in zip(now, vectors, strict=True))]
        )

    def add(self, error: F64) -> None:
        """Apply a (15,) error."""
        self.T_odom_body = add_to_pose(self.T_odom_body, error)
        self.velocity_mps = self.velocity_mps + error[6:9]
        self.gyro_bias_radps = self.gyro_bias_radps + error[9:12]
        self.accel_bias_mps2 = self.accel_bias_mps2 + error[12:15]

    def _state(self) -> tuple[F64, F64, F64, F64]:
        return self.T_odom_body, self.velocity_mps, self.gyro_bias_radps, self.accel_bias_mps2

    def _nodes(self, end_ns: int) -> tuple[I64, F64, F64]:
        s = self._samples
        inside = (s.stamps_ns > self.stamp_ns) & (s.stamps_ns < end_ns)
        stamps = np.concatenate([np.array([self.stamp_ns]), s.stamps_ns[inside], np.array([end_ns])])
        if not len(s):
            rest = se3.inverse(self.T_odom_body)[:3, 2] * GRAVITY_MPS2 + self.accel_bias_mps2
            return stamps, np.tile(self.gyro_bias_radps, (2, 1)), np.tile(rest, (2, 1))
        x, at = stamps - self.stamp_ns, s.stamps_ns - self.stamp_ns
        gyro = np.stack([np.interp(x, at, column) for column in s.gyro_radps.T], axis=1)
        accel = np.stack([np.interp(x, at, column) for column in s.accel_mps2.T], axis=1)
        return stamps, gyro, accel


@njit(cache=True, nogil=True)
def _integrate(
    times_s: F64, gyro: F64, accel: F64, R: F64, p: F64, v: F64, P: F64, noise: ImuNoise
) -> tuple[F64, F64, F64, F64]:
    """Trapezoid in the rates, midpoint in the attitude; the covariance by first-order transition a step."""
    m = len(times_s)
    Rs, ps = np.empty((m, 3, 3)), np.empty((m, 3))
    Rs[0], ps[0] = R, p
    v, P = v.copy(), P.copy()
    for k in range(m - 1):
        dt = times_s[k + 1] - times_s[k]
        w = 0.5 * (gyro[k] + gyro[k + 1])
        f = 0.5 * (accel[k] + accel[k + 1])
        dR = exp_so3(w * dt)
        a = Rs[k] @ (exp_so3(0.5 * dt * w) @ f)
        a[2] -= GRAVITY_MPS2
        ps[k + 1] = ps[k] + v * dt + 0.5 * a * dt * dt
        v = v + a * dt
        Rs[k + 1] = Rs[k] @ dR
        F = _transition(Rs[k], dR, f, dt)
        P = F @ P @ F.T
        gap = dt > GAP_S
        gyro2 = noise.gyro**2 + (_GAP_RADPS2**2 * dt * dt if gap else 0.0)
        accel2 = noise.accel**2 + (_GAP_MPS2**2 if gap else 0.0)
        for i in range(3):
            P[i, i] += gyro2 * dt
            P[3 + i, 3 + i] += accel2 * dt**3 / 3.0
            P[6 + i, 6 + i] += accel2 * dt
            P[9 + i, 9 + i] += noise.gyro_walk**2 * dt
            P[12 + i, 12 + i] += noise.accel_walk**2 * dt
    return Rs, ps, v, P


@njit(cache=True, nogil=True)
def _transition(R: F64, dR: F64, f: F64, dt: float) -> F64:
    """(15, 15) error transition of one step."""
    F = np.eye(15)
    f_hat = np.array([[0.0, -f[2], f[1]], [f[2], 0.0, -f[0]], [-f[1], f[0], 0.0]])
    Rf = R @ f_hat
    F[0:3, 0:3] = dR.T
    F[6:9, 0:3] = -Rf * dt
    F[6:9, 12:15] = -R * dt
    F[3:6, 0:3] = -0.5 * Rf * dt * dt
    F[3:6, 12:15] = -0.5 * R * dt * dt
    for i in range(3):
        F[i, 9 + i] = -dt
        F[3 + i, 6 + i] = dt
    return F
