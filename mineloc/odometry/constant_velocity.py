"""The motion model of a drone without an IMU."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import F64
from mineloc.odometry.motion import BodyPath, add_to_pose, pose_deviation

NODES = 21
_START_SIGMAS = np.repeat([1e-4, 1e-4, 0.5, 2.0], 3)


class ConstantVelocity:
    """Constant angular rate (body) and velocity (odom), both driven by white acceleration.

    Errors: [rotation, position, rate, velocity], 12 of them: all that a sweep shows.

    Args:
        stamp_ns: time of the first pose, which is the identity.
        angular_radps2, linear_mps2: root spectral densities of the accelerations (rad/s²/√Hz, m/s²/√Hz).
    """

    measured: F64 = np.eye(12)

    def __init__(self, stamp_ns: int, *, angular_radps2: float, linear_mps2: float) -> None:
        self._densities = (angular_radps2**2, linear_mps2**2)
        self.stamp_ns = stamp_ns
        self.T_odom_body = np.eye(4)
        self.rate_radps, self.velocity_mps = np.zeros(3), np.zeros(3)
        self.covariance: F64 = np.diag(_START_SIGMAS**2)
        self._predicted = (self.T_odom_body, self.rate_radps, self.velocity_mps)

    def predict(self, start_ns: int, end_ns: int) -> BodyPath:
        """Move on; the path is the same motion seen backwards from the end, so it may start before the last state."""
        dt = (end_ns - self.stamp_ns) * 1e-9
        turn = Rotation.from_rotvec(dt * self.rate_radps).as_matrix()
        position = self.T_odom_body[:3, 3] + dt * self.velocity_mps
        self.T_odom_body = se3.rigid(se3.from_rt(self.T_odom_body[:3, :3] @ turn, position))
        self.stamp_ns = end_ns
        F = np.eye(12)
        F[:3, :3] = turn.T
        F[:6, 6:] = dt * np.eye(6)
        self.covariance = F @ self.covariance @ F.T + self._noise(dt)
        self._predicted = (self.T_odom_body, self.rate_radps, self.velocity_mps)
        return self.path(start_ns)

    def path(self, start_ns: int) -> BodyPath:
        """The motion from `start_ns` to the state's time, by the state's present rates."""
        start_ns = min(start_ns, self.stamp_ns - 1)
        stamps = np.linspace(start_ns - self.stamp_ns, 0, NODES).astype(np.int64) + self.stamp_ns
        dt = (stamps - self.stamp_ns) * 1e-9
        turns = Rotation.from_rotvec(dt[:, None] * self.rate_radps).as_matrix()
        positions = self.T_odom_body[:3, 3] + dt[:, None] * self.velocity_mps
        return BodyPath(stamps, se3.from_rt(self.T_odom_body[:3, :3] @ turns, positions))

    def deviation(self) -> F64:
        """(12,) error of the state against the prediction."""
        T, rate, velocity = self._predicted
        return np.concatenate(
            [pose_deviation(self.T_odom_body, T), self.rate_radps - rate, self.velocity_mps - velocity]
        )

    def add(self, error: F64) -> None:
        """Apply a (12,) error."""
        self.T_odom_body = add_to_pose(self.T_odom_body, error)
        self.rate_radps = self.rate_radps + error[6:9]
        self.velocity_mps = self.velocity_mps + error[9:12]

    def _noise(self, dt: float) -> F64:
        Q = np.zeros((12, 12))
        for first, density in zip((0, 3), self._densities, strict=True):
            pose, rate = slice(first, first + 3), slice(first + 6, first + 9)
            Q[pose, pose] = density * dt**3 / 3 * np.eye(3)
            Q[pose, rate] = Q[rate, pose] = density * dt**2 / 2 * np.eye(3)
            Q[rate, rate] = density * dt * np.eye(3)
        return Q
