"""What an IMU says on the true motion: specific force and angular rate with bias, random walk and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc import se3
from mineloc.data import ImuSamples
from mineloc.sim.motion import GRAVITY_MPS2, Kinematics, Motion

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of one IMU, the same for the three axes.

    Attributes:
        gyro_density: white noise, rad/s/√Hz.
        gyro_bias_radps: standard deviation of the constant part of the bias.
        gyro_walk: random walk of the bias, rad/s²/√Hz.
        accel_density: m/s²/√Hz.
        accel_bias_mps2: standard deviation of the constant part.
        accel_walk: m/s³/√Hz.
    """

    gyro_density: float
    gyro_bias_radps: float
    gyro_walk: float
    accel_density: float
    accel_bias_mps2: float
    accel_walk: float


def ideal_imu(state: Kinematics, T_body_imu: F64) -> tuple[F64, F64]:
    """Angular rate and specific force (+g upwards at rest) in the imu frame, (n, 3) each, without any error.

    The lever arm l from the body's origin adds `α × l + ω × (ω × l)`.
    """
    lever = T_body_imu[:3, 3]
    omega, alpha = state.rate_radps, state.rate_change_radps2
    force_map = state.accel_mps2 + np.array([0.0, 0.0, GRAVITY_MPS2])
    force = np.einsum("nji,nj->ni", state.T_map_body[:, :3, :3], force_map)
    force += np.cross(alpha, lever) + np.cross(omega, np.cross(omega, lever))
    R = T_body_imu[:3, :3]
    return omega @ R, force @ R


class Imu:
    """An IMU that is read piece by piece, in the order of time.

    Args:
        motion: the truth.
        T_body_imu: its place.
        noise: its errors.
        rate_hz: of the samples.
        start_ns: stamp of the motion's time zero.
        rng: the errors.
    """

    def __init__(
        self,
        motion: Motion,
        T_body_imu: F64,
        noise: ImuNoise,
        *,
        rate_hz: float,
        start_ns: int,
        rng: np.random.Generator,
    ) -> None:
        self._motion = motion
        self._T_body_imu = T_body_imu
        self._noise = noise
        self._period_ns = round(1e9 / rate_hz)
        self._start_ns = start_ns
        self._rng = rng
        self._next = 0
        self._bias = rng.standard_normal(6) * np.repeat([noise.gyro_bias_radps, noise.accel_bias_mps2], 3)

    def until(self, end_ns: int) -> ImuSamples:
        """The samples after the previous call's up to `end_ns` (without)."""
        stop = max(self._next, -((self._start_ns - end_ns) // self._period_ns))
        index = np.arange(self._next, stop, dtype=np.int64)
        self._next = stop
        if not len(index):
            return ImuSamples.empty()
        since_ns = index * self._period_ns
        gyro, accel = ideal_imu(self._motion.at(np.asarray(since_ns * 1e-9, np.float64)), self._T_body_imu)
        errors = self._errors(len(index))
        return ImuSamples(self._start_ns + since_ns, gyro + errors[:, :3], accel + errors[:, 3:])

    def _errors(self, count: int) -> F64:
        """(n, 6) bias and noise; the bias walks on from where it was."""
        step_s = self._period_ns * 1e-9
        noise = self._noise
        walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3) * np.sqrt(step_s)
        bias = self._bias + np.cumsum(self._rng.standard_normal((count, 6)) * walk, axis=0)
        self._bias = bias[-1]
        density = np.repeat([noise.gyro_density, noise.accel_density], 3) / np.sqrt(step_s)
        return bias + self._rng.standard_normal((count, 6)) * density


def mounting(roll_deg: float, pitch_deg: float, yaw_deg: float, offset_m: tuple[float, float, float]) -> F64:
    """(4, 4) place of a sensor on the body from its offset and its small mounting angles."""
    rotvec = np.deg2rad([roll_deg, pitch_deg, yaw_deg])
    T = se3.exp(np.concatenate([rotvec, np.zeros(3)]))
    T[:3, 3] = offset_m
    return T
