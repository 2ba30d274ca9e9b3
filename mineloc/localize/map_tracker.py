"""Where a drone is in a prior map, keyframe by keyframe: odometry carries it on, registration to the map corrects it.

A Kalman filter on the pose alone. It is causal: what it says of a keyframe rests on that keyframe and those before.
"""

from __future__ import annotations

import numpy as np

from mineloc import se3
from mineloc.config import PriorMapConfig
from mineloc.data import F64, Fix, Keyframe, RelativePose
from mineloc.localize.prior_map import MapRegistration, PriorMap


class MapTracker:
    """Follows a flight through a prior map.

    Args:
        prior_map: of the mine.
        config: gates and noise.
        T_map_lidar: (4, 4) of the first keyframe.
        covariance: (6, 6) of that, `[rotation, translation]`, right perturbation.

    Attributes:
        T_map_lidar: (4, 4) of the newest keyframe.
        covariance: (6, 6) of that.
    """

    def __init__(self, prior_map: PriorMap, config: PriorMapConfig, *, T_map_lidar: F64, covariance: F64) -> None:
        self._map, self._config = prior_map, config
        self.T_map_lidar, self.covariance = T_map_lidar, covariance

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> Fix:
        """Carry the pose to the next keyframe and register that to the map.

        Args:
            keyframe: with points.
            edge: what leads to it; None for the first.
        """
        if edge is not None:
            self._carry(edge)
        found = self._map.register(keyframe.points_lidar, self.T_map_lidar, self.covariance)
        sigmas = self._sigmas_away(found)
        reason = found.reason
        if not reason and sigmas > self._config.max_moved_sigmas:
            reason = (
                f"{sigmas:.1f} sigmas from where odometry expects it, at most {self._config.max_moved_sigmas} allowed"
            )
        covariance = np.asarray(np.linalg.inv(found.information), dtype=np.float64)
        fix = Fix(
            stamp_ns=keyframe.stamp_ns,
            keyframe=keyframe.index,
            T_map_lidar=found.T_map_lidar,
            covariance=0.5 * (covariance + covariance.T),
            trusted=not reason,
            reason=reason,
            target="map",
            scores={
                "inlier_ratio": found.inlier_ratio,
                "residual_m": found.residual_m,
                "moved_m": found.moved_m,
                "moved_deg": float(np.degrees(found.moved_rad)),
                "sigmas": sigmas,
            },
        )
        if fix.trusted:
            self._correct(fix)
        return fix

    def _carry(self, edge: RelativePose) -> None:
        back = se3.adjoint(se3.inverse(edge.T_i_j))
        self.T_map_lidar = se3.rigid(self.T_map_lidar @ edge.T_i_j)
        self.covariance = back @ self.covariance @ back.T + np.linalg.inv(edge.information)

    def _correct(self, fix: Fix) -> None:
        assert fix.T_map_lidar is not None
        assert fix.covariance is not None
        error = se3.log(se3.rigid(se3.inverse(self.T_map_lidar) @ fix.T_map_lidar))
        gain = self.covariance @ np.linalg.inv(self.covariance + fix.covariance)
        self.T_map_lidar = se3.rigid(self.T_map_lidar @ se3.exp(gain @ error))
        # Joseph's form stays symmetric and positive
        rest = np.eye(6) - gain
        self.covariance = rest @ self.covariance @ rest.T + gain @ fix.covariance @ gain.T

    def _sigmas_away(self, found: MapRegistration) -> float:
        """Mahalanobis distance of the correction, a component."""
        c = self._config
        error = se3.log(se3.rigid(se3.inverse(self.T_map_lidar) @ found.T_map_lidar))
        floor = np.diag([np.radians(c.moved_floor_deg) ** 2] * 3 + [c.moved_floor_m**2] * 3)
        return float(np.sqrt(error @ np.linalg.solve(self.covariance + floor, error) / 6.0))
