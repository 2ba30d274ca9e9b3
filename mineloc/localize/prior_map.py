"""A prior map that keyframes are registered to (METHOD 7.3, registration to the prior map between intersections)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import OdometryConfig, PriorMapConfig
from mineloc.data import F32, F64, MapCloud
from mineloc.odometry.information import EdgeNoise, degeneracy_of, edge_information
from mineloc.odometry.registration import Thinned, Weighting, linearise
from mineloc.odometry.voxel_map import VoxelMap, insert_into_both
from mineloc.sweep.voxel_grid import voxel_centroids

_STILL = np.zeros(6)
_CONVERGED_RAD, _CONVERGED_M = 2e-5, 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class MapRegistration:
    """What registering a keyframe to the map gave.

    Attributes:
        T_map_lidar: (4, 4) where it fits best; along directions that the map leaves open, where it was expected.
        information: (6, 6) of that by the map alone, `[rotation, translation]`, right perturbation.
        inlier_ratio: share of the points that lie on the map.
        residual_m: root mean square distance from its planes.
        moved_m, moved_rad: away from where it was expected.
        reason: why it is not to be believed; empty when it is.
    """

    T_map_lidar: F64
    information: F64
    inlier_ratio: float
    residual_m: float
    moved_m: float
    moved_rad: float
    reason: str

    @property
    def covariance(self) -> F64:
        """(6, 6) inverse of the information."""
        covariance = np.asarray(np.linalg.inv(self.information), dtype=np.float64)
        return 0.5 * (covariance + covariance.T)


class PriorMap:
    """The map of a mine as patches at two sizes.

    Args:
        cloud: of a reconstruction.
        config: thresholds and noise.
        odometry: sizes of the patches, weights of residuals: those of the front end.
    """

    def __init__(self, cloud: MapCloud, config: PriorMapConfig, odometry: OdometryConfig) -> None:
        self._config, self._odometry = config, odometry
        self._weighting = Weighting.of(odometry)
        # single coordinates near zero: a mine grid does not fit into float32 patches
        self.origin_m: F64 = np.asarray(cloud.origin_m, dtype=np.float64)
        make = {"min_weight": config.patch_min_points, "growth": 0.0, "cap": 1e9}
        self._maps = VoxelMap(odometry.fine_voxel_m, **make), VoxelMap(odometry.coarse_voxel_m, **make)
        insert_into_both(self._maps, cloud.points_m.astype(np.float64), now=0.0)

    def register(self, points_lidar: F32, expected: F64, covariance: F64) -> MapRegistration:
        """Where a keyframe is, near where it is expected.

        Args:
            points_lidar: (n, 3) deskewed.
            expected: (4, 4) `T_map_lidar`.
            covariance: (6, 6) of that, `[rotation, translation]`, right perturbation.
        """
        c = self._config
        few = voxel_centroids(points_lidar, self._odometry.sweep_voxel_m).astype(np.float64)
        thinned = Thinned(few, np.zeros(len(few)), np.ones(len(few)))
        T = expected.copy()
        T[:3, 3] -= self.origin_m
        start = T
        prior = np.linalg.inv(self._prior(covariance, expected))
        share = self._odometry.information_share
        for _ in range(c.rounds):
            last = linearise(thinned, T, _STILL, self._maps, self._weighting)
            H, b = share * last.H[:6, :6], share * last.b[:6]
            error = -np.asarray(np.linalg.solve(prior + H, prior @ _deviation(T, start) + b), dtype=np.float64)
            T = _moved(T, error)
            if np.abs(error[:3]).max() < _CONVERGED_RAD and np.abs(error[3:]).max() < _CONVERGED_M:
                break
        last = linearise(thinned, T, _STILL, self._maps, self._weighting)
        matches = last.planar + last.other
        ratio = matches / max(len(few), 1)
        away = _deviation(T, start)
        moved_m, moved_rad = float(np.linalg.norm(away[3:])), float(np.linalg.norm(away[:3]))
        out = T.copy()
        out[:3, 3] += self.origin_m
        return MapRegistration(
            T_map_lidar=out,
            information=self._information(last.H[:6, :6], T, matches),
            inlier_ratio=ratio,
            residual_m=last.residual_m,
            moved_m=moved_m,
            moved_rad=moved_rad,
            reason=self._refusal(ratio, last.planar, last.residual_m),
        )

    def _prior(self, covariance: F64, expected: F64) -> F64:
        """(6, 6) of [rotation (lidar), position (map)], so wide that the map alone decides where it can."""
        c = self._config
        turn = np.eye(6)
        turn[3:, 3:] = expected[:3, :3]
        floor = np.diag([np.radians(c.expected_deg) ** 2] * 3 + [c.expected_m**2] * 3)
        return c.expected_inflation * turn @ covariance @ turn.T + floor

    def _information(self, H: F64, T: F64, matches: int) -> F64:
        """Of the lidar's pose, right perturbation, as `edge_information` judges it."""
        turn = np.eye(6)
        turn[3:, 3:] = T[:3, :3]
        hessian = turn.T @ H @ turn
        c = self._config
        # rows are weighted by their variances already: σ enters as 1/√2, that 2σ² is 1
        noise = EdgeNoise(
            sigma_m=float(np.sqrt(0.5)),
            correlation=c.correlation,
            floor_rad=np.radians(c.sigma_deg),
            floor_m=c.sigma_m,
        )
        judged = degeneracy_of(hessian, matches, weak_ratio=self._odometry.weak_ratio)
        return edge_information(hessian, judged, noise=noise)

    def _refusal(self, ratio: float, planar: int, residual_m: float) -> str:
        c = self._config
        if planar < c.min_matches:
            return f"{planar} matches with the map, at least {c.min_matches} needed"
        if ratio < c.min_inlier_ratio:
            return f"inlier ratio {ratio:.2f} on the map, at least {c.min_inlier_ratio} needed"
        if residual_m > c.max_residual_m:
            return f"residual {residual_m:.3f} m on the map, at most {c.max_residual_m} m allowed"
        return ""


def _deviation(T: F64, before: F64) -> F64:
    """(6,) [rotation (right), position (map)] that takes one pose to another."""
    turn = se3.log(se3.from_rt(before[:3, :3].T @ T[:3, :3], np.zeros(3)))[:3]
    return np.concatenate([turn, T[:3, 3] - before[:3, 3]])


def _moved(T: F64, error: F64) -> F64:
    turn = se3.exp(np.concatenate([error[:3], np.zeros(3)]))
    return se3.rigid(se3.from_rt(T[:3, :3] @ turn[:3, :3], T[:3, 3] + error[3:]))
