"""A Kalman filter on the pose of a drone: odometry carries it on, fixes correct it. Causal by construction."""

from __future__ import annotations

import numpy as np

from mineloc import se3
from mineloc.data import F64, Fix, RelativePose


class PoseFilter:
    """Where a drone is in a map, and how sure that is.

    Args:
        T_map_lidar: (4, 4) at the first keyframe.
        covariance: (6, 6) of that, `[rotation, translation]`, right perturbation.

    Attributes:
        T_map_lidar: (4, 4) at the newest keyframe.
        covariance: (6, 6) of that.
    """

    def __init__(self, T_map_lidar: F64, covariance: F64) -> None:
        self.T_map_lidar, self.covariance = T_map_lidar, covariance

    def carry(self, edge: RelativePose) -> None:
        """Move on to the next keyframe."""
        back = se3.adjoint(se3.inverse(edge.T_i_j))
        self.T_map_lidar = se3.rigid(self.T_map_lidar @ edge.T_i_j)
        self.covariance = back @ self.covariance @ back.T + np.linalg.inv(edge.information)

    def correct(self, fix: Fix) -> None:
        """Take a fix of the newest keyframe, which is trusted."""
        assert fix.T_map_lidar is not None
        assert fix.covariance is not None
        error = se3.log(se3.rigid(se3.inverse(self.T_map_lidar) @ fix.T_map_lidar))
        gain = self.covariance @ np.linalg.inv(self.covariance + fix.covariance)
        self.T_map_lidar = se3.rigid(self.T_map_lidar @ se3.exp(gain @ error))
        # Joseph's form stays symmetric and positive
        rest = np.eye(6) - gain
        self.covariance = rest @ self.covariance @ rest.T + gain @ fix.covariance @ gain.T

    def sigmas_away(self, T_map_lidar: F64, *, floor_m: float, floor_deg: float) -> float:
        """Mahalanobis distance of another pose, a component; the floors are added to the covariance."""
        error = se3.log(se3.rigid(se3.inverse(self.T_map_lidar) @ T_map_lidar))
        floor = np.diag([np.radians(floor_deg) ** 2] * 3 + [floor_m**2] * 3)
        return float(np.sqrt(error @ np.linalg.solve(self.covariance + floor, error) / 6.0))
