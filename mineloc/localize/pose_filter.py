"""A Kalman filter on the pose of a drone: odometry carries it on, fixes correct it. Causal by construction."""

from __future__ import annotations

import numpy as np

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import F64, Fix, RelativePose
from mineloc.graph.measurements import PointFix, point_jacobian
from mineloc.graph.noise import edge_noise


class PoseFilter:
    """Where a drone is in a map, and how sure that is.

    Args:
        T_map_lidar: (4, 4) at the first keyframe.
        covariance: (6, 6) of that, `[rotation, translation]`, right perturbation.
        config: limits of what odometry leaves open.

    Attributes:
        T_map_lidar: (4, 4) at the newest keyframe.
        covariance: (6, 6) of that.
    """

    def __init__(self, T_map_lidar: F64, covariance: F64, config: GraphConfig) -> None:
        self.T_map_lidar, self.covariance = T_map_lidar, covariance
        self._config = config

    def carry(self, edge: RelativePose) -> None:
        """Move on to the next keyframe."""
        back = se3.adjoint(se3.inverse(edge.T_i_j))
        self.T_map_lidar = se3.rigid(self.T_map_lidar @ edge.T_i_j)
        self.covariance = back @ self.covariance @ back.T + edge_noise(edge.information, self._config).covariance

    def correct(self, fix: Fix) -> None:
        """Take the pose of a fix of the newest keyframe, which is trusted."""
        assert fix.T_map_lidar is not None
        assert fix.covariance is not None
        error = se3.log(se3.rigid(se3.inverse(self.T_map_lidar) @ fix.T_map_lidar))
        self._update(error, np.eye(6), fix.covariance)

    def correct_by_point(self, fix: PointFix) -> None:
        """Take the place of a known point that the newest keyframe sees: paper A's intersection factor, A(22)."""
        seen = se3.apply(self.T_map_lidar, fix.point_lidar[None])[0]
        self._update(fix.point_map - seen, point_jacobian(self.T_map_lidar, fix.point_lidar), fix.covariance)

    def sigmas_away(self, T_map_lidar: F64, *, floor_m: float, floor_deg: float) -> float:
        """Mahalanobis distance of another pose, a component; the floors are added to the covariance."""
        error = se3.log(se3.rigid(se3.inverse(self.T_map_lidar) @ T_map_lidar))
        floor = np.diag([np.radians(floor_deg) ** 2] * 3 + [floor_m**2] * 3)
        return float(np.sqrt(error @ np.linalg.solve(self.covariance + floor, error) / 6.0))

    def _update(self, error: F64, J: F64, noise: F64) -> None:
        gain = self.covariance @ J.T @ np.linalg.inv(J @ self.covariance @ J.T + noise)
        self.T_map_lidar = se3.rigid(self.T_map_lidar @ se3.exp(gain @ error))
        # Joseph's form stays symmetric and positive
        rest = np.eye(6) - gain @ J
        self.covariance = rest @ self.covariance @ rest.T + gain @ noise @ gain.T
