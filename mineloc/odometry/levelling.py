"""Where up is: from a drone that stands still, or from one that flies and knows its motion by LiDAR."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import F64, ImuSamples
from mineloc.errors import FlightError
from mineloc.odometry.constant_velocity import ConstantVelocity
from mineloc.odometry.strapdown import GRAVITY_MPS2

FEWEST = 5
"""Samples without which there is no IMU."""
_CALM_RADPS, _CALM_MPS2, _CALM_SAMPLES = 0.02, 0.1, 20
_BIAS_MPS2 = 0.5
_IN_FLIGHT_S, _FIRST_STEPS = 1.0, 3


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """What an IMU at rest says.

    Attributes:
        up_imu: (3,) specific force.
        gyro_bias_radps: (3,).
    """

    up_imu: F64
    gyro_bias_radps: F64


def check_force(imu: ImuSamples) -> None:
    """Refuse an accelerometer whose unit is not m/s².

    Raises:
        FlightError: the mean force is far from gravity.
    """
    force = float(np.linalg.norm(imu.accel_mps2.mean(axis=0)))
    if not 0.7 * GRAVITY_MPS2 < force < 1.3 * GRAVITY_MPS2:
        raise FlightError(
            "odometry",
            f"the IMU's mean specific force is {force:.2f}",
            expected="about 9.81 m/s² (gravity)",
            todo="check its unit (g instead of m/s²?) in the sequence file, or --set odometry.use_imu=false",
        )


def standing(first: ImuSamples) -> Standing | None:
    """The longest beginning in which the drone rests, halving while it does not; None if it never does."""
    n = len(first)
    while n >= min(_CALM_SAMPLES, len(first)) and n >= FEWEST:
        gyro, accel = first.gyro_radps[:n], first.accel_mps2[:n]
        rate, force = gyro.mean(axis=0), accel.mean(axis=0)
        change = float(np.linalg.norm(accel[n // 2 :].mean(axis=0) - accel[: n // 2].mean(axis=0)))
        # what vibration alone leaves of the difference of two means
        noise = float(np.linalg.norm(accel.std(axis=0))) * np.sqrt(4.0 / n)
        if (
            float(np.linalg.norm(rate)) < _CALM_RADPS
            and change < _CALM_MPS2 + noise
            and abs(float(np.linalg.norm(force)) - GRAVITY_MPS2) < _BIAS_MPS2
        ):
            return Standing(force, rate)
        n //= 2
    return None


def levelled(T_odom_imu: F64, up_imu: F64) -> F64:
    """The pose with its roll and pitch set right, heading and place kept: z of odom becomes up."""
    turn = se3.rotation_between(T_odom_imu[:3, :3] @ up_imu, [0, 0, 1])
    return se3.from_rt(turn @ T_odom_imu[:3, :3], T_odom_imu[:3, 3])


class UpFinder:
    """Finds up while the drone flies by LiDAR alone: what the accelerometer felt, less what the velocity became.

    ∫ R f dt = v₁ - v₀ + g T: a second of it levels to half a degree, however the drone moves.
    """

    def __init__(self) -> None:
        self._impulse: F64 = np.zeros(3)
        self._velocity: F64 = np.zeros(3)
        self._begin_ns, self._end_ns, self._steps = 0, 0, 0

    def follow(self, motion: ConstantVelocity, imu: ImuSamples, T_body_imu: F64) -> None:
        """Take the samples up to the state of `motion`, which has been registered."""
        self._steps += 1
        part = imu.between(self._end_ns + 1, motion.stamp_ns + 1)
        if self._steps <= _FIRST_STEPS or len(part) < FEWEST:
            # the first velocities are poor; after a hole it begins again
            self._impulse, self._velocity = np.zeros(3), motion.velocity_mps
            self._begin_ns = motion.stamp_ns
        else:
            tau = 1e-9 * (part.stamps_ns - motion.stamp_ns)
            turned = Rotation.from_rotvec(tau[:, None] * motion.rate_radps).apply(
                part.accel_mps2 @ T_body_imu[:3, :3].T
            )
            force_odom = motion.T_odom_body[:3, :3] @ turned.mean(axis=0)
            self._impulse = self._impulse + force_odom * (motion.stamp_ns - self._end_ns) * 1e-9
        self._end_ns = motion.stamp_ns

    def up_odom(self, motion: ConstantVelocity) -> F64 | None:
        """(3,) up in the odom frame of `motion`, None while too little has been seen."""
        if (self._end_ns - self._begin_ns) * 1e-9 < _IN_FLIGHT_S:
            return None
        return self._impulse - (motion.velocity_mps - self._velocity)
