"""Motions with a formula and what an ideal IMU measures on them. For the odometry's tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import F64, I64, ImuSamples

GRAVITY = np.array([0.0, 0.0, 9.80665])
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Motion:
    """Attitude and place by time in seconds; z of the world is up."""

    position: Callable[[F64], F64]
    rotation: Callable[[F64], Rotation]

    def pose(self, t: F64) -> F64:
        return se3.from_rt(self.rotation(t).as_matrix(), self.position(t))

    def at(self, stamps_ns: I64) -> F64:
        return self.pose((stamps_ns - START_NS) * 1e-9)

    def velocity(self, t: float) -> F64:
        h = 1e-4
        return ((self.position(np.array([t + h])) - self.position(np.array([t - h]))) / (2 * h))[0]

    def imu(self, start_ns: int, end_ns: int, *, rate_hz: float = 200.0, T_body_imu: F64 | None = None) -> ImuSamples:
        """Ideal samples in [start, end), by differences of the pose of an IMU that sits at `T_body_imu`."""
        step = round(1e9 / rate_hz)
        stamps = np.arange(-(-(start_ns - START_NS) // step) * step + START_NS, end_ns, step, dtype=np.int64)
        t, h = (stamps - START_NS) * 1e-9, 1e-3
        T = np.eye(4) if T_body_imu is None else T_body_imu
        before, now, after = (self.pose(t + dt) @ T for dt in (-h, 0.0, h))
        accel = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / h**2
        to_imu = np.swapaxes(now[:, :3, :3], 1, 2)
        gyro = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]).as_rotvec() / (2 * h)
        return ImuSamples(stamps, gyro, np.einsum("nij,nj->ni", to_imu, accel + GRAVITY))


def _level(t: F64) -> Rotation:
    return Rotation.from_rotvec(np.zeros((len(t), 3)))


def at_rest(rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Motion:
    return Motion(lambda t: np.zeros((len(t), 3)), lambda t: Rotation.from_euler("xyz", np.tile(rpy, (len(t), 1))))


def accelerating(a: tuple[float, float, float]) -> Motion:
    return Motion(lambda t: 0.5 * t[:, None] ** 2 * np.array(a), _level)


def cruising(v: tuple[float, float, float], w: tuple[float, float, float]) -> Motion:
    """Straight on with constant velocity, turning about a fixed axis of the body."""
    return Motion(lambda t: t[:, None] * np.array(v), lambda t: Rotation.from_rotvec(t[:, None] * np.array(w)))


def circling(radius_m: float, w: float) -> Motion:
    def position(t: F64) -> F64:
        return radius_m * np.stack([np.sin(w * t), 1 - np.cos(w * t), 0 * t], axis=1)

    return Motion(position, lambda t: Rotation.from_rotvec(t[:, None] * np.array([0, 0, w])))


def tumbling() -> Motion:
    """Everything at once: speeds to 2 m/s, rates to 1 rad/s, from rest."""

    def position(t: F64) -> F64:
        return np.stack([1.5 * t - np.sin(1.5 * t), 0.5 * (1 - np.cos(1.2 * t)), 0.3 * (1 - np.cos(0.9 * t))], axis=1)

    def rotation(t: F64) -> Rotation:
        angles = np.stack([0.8 * (1 - np.cos(t)), 0.2 * (1 - np.cos(2.1 * t)), 0.15 * (1 - np.cos(1.7 * t))], axis=1)
        return Rotation.from_euler("ZYX", angles)

    return Motion(position, rotation)
