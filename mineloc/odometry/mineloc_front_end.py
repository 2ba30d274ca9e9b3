"""The mineloc front end: LiDAR odometry, inertial where there is an IMU, for roadways that look alike along their axis.

What METHOD part 7 knows, in one filter: patches at fine voxels, planar and non-planar residuals blended, the motion
prior inside the solve, gravity through the accelerometer, a robust kernel, and information that tells weak directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mineloc import se3
from mineloc.config import KeyframeConfig, OdometryConfig
from mineloc.data import F64, Calibration, Degeneracy, ImuSamples, Keyframe, OdometryStep, RelativePose, Sweep
from mineloc.errors import FlightError
from mineloc.odometry.contrast import contrast
from mineloc.odometry.information import EdgeNoise, degeneracy_of, edge_information, weakest_direction
from mineloc.odometry.keyframes import KeyframeSelector
from mineloc.odometry.model_choice import ModelChoice
from mineloc.odometry.motion import BodyPath, MotionModel
from mineloc.odometry.registration import Linearised, Thinned, Weighting, linearise
from mineloc.odometry.voxel_map import VoxelMap, insert_into_both
from mineloc.sweep.deskew import moved_by_twist, transform_between_knots
from mineloc.sweep.voxel_grid import VoxelMeans, voxel_means

FORGET_EVERY = 100
_CONVERGED_RAD, _CONVERGED_M = 2e-5, 2e-4
PROBE_EVERY = 5
"""Sweeps; what a shift of one of them says goes for the next ones too."""
LOST_SWEEPS = 10
"""After so many sweeps that the map does not hold, the motion model begins anew."""


@dataclass(frozen=True, slots=True, eq=False)
class _Registered:
    last: Linearised | None
    hessian_lidar: F64
    cloud: Thinned

    @property
    def points(self) -> int:
        return len(self.cloud.ranges)

    @property
    def matches(self) -> int:
        return 0 if self.last is None else self.last.planar + self.last.other

    @property
    def inlier_ratio(self) -> float:
        return self.matches / self.points if self.points else float("nan")


def _twist(motion: MotionModel) -> F64:
    """(6,) [rate (body), velocity (odom)] of the state that the prediction did not have."""
    return (motion.measured @ motion.deviation())[6:]


class MinelocFrontEnd:
    """`FrontEnd` for every method but the baselines.

    The odom frame's origin is the body at the first sweep; with an IMU from the start its z axis is up. Poses are true
    for the time of a sweep's last point.

    Args:
        config, keyframes: thresholds and noise.
        calibration: where the IMU sits against the LiDAR.
    """

    def __init__(self, config: OdometryConfig, keyframes: KeyframeConfig, calibration: Calibration) -> None:
        self._config, self._keyframe_config = config, keyframes
        self._selector = KeyframeSelector(keyframes)
        self._weighting = Weighting.of(config)
        self._choice = ModelChoice(config, calibration.T_lidar_imu)
        self._maps = self._new_maps()
        self._sweeps = 0
        self._flown_m = 0.0
        self._coasted_s = 0.0
        self._lost_sweeps = 0
        self._is_blurred, self._until_probe = False, 0

    def step(self, sweep: Sweep, imu: ImuSamples) -> OdometryStep:
        """Deskew by the predicted motion, register to the patches inside the motion prior, grow the map.

        Raises:
            FlightError: the sweep is not later than the one before; an IMU that does not measure gravity.
        """
        motion = self._model(sweep, imu)
        before = motion.stamp_ns, motion.T_odom_body
        path = motion.predict(sweep.stamp_ns, sweep.end_ns)
        cloud = self._thinned(sweep, path)
        registered = self._register(motion, cloud)
        cloud = self._deskewed_further(cloud, motion)
        reason = self._doubt(registered)
        self._coasted_s += (motion.stamp_ns - before[0]) * 1e-9 if reason else 0.0
        self._lost_sweeps = self._lost_sweeps + 1 if reason and registered.points else 0
        self._flown_m += float(np.linalg.norm(motion.T_odom_body[:3, 3] - before[1][:3, 3]))
        degeneracy = self._judged(registered, motion)
        if self._choice.follow(imu):
            self._maps = self._new_maps()
        self._grow_map(cloud)
        return self._told(motion.stamp_ns, cloud, registered, degeneracy, reason)

    def _model(self, sweep: Sweep, imu: ImuSamples) -> MotionModel:
        """The motion model for a sweep; with a new one the map begins anew too."""
        before = self._choice.motion
        if before is not None and sweep.end_ns <= before.stamp_ns:
            raise FlightError(
                "odometry",
                f"a sweep ends at {sweep.end_ns} ns, not after the one before ({before.stamp_ns} ns)",
                expected="time going forwards",
                todo="ingest the recording again: it names and drops such sweeps",
            )
        if self._lost_sweeps > LOST_SWEEPS:
            self._choice.give_up()
            self._maps, self._lost_sweeps = self._new_maps(), 0
        return self._choice.begin(sweep, imu)

    def _thinned(self, sweep: Sweep, path: BodyPath) -> VoxelMeans:
        """Points in lidar axes as if all were measured at the sweep's end by that path, one a voxel of the map."""
        n = len(sweep)
        T_end_lidar = se3.inverse(path.poses[-1] @ self._choice.T_body_lidar) @ path.poses @ self._choice.T_body_lidar
        offsets_ns = np.zeros(n, np.int64) if sweep.offsets_ns is None else sweep.offsets_ns
        knots_ns, rows = path.stamps_ns - sweep.stamp_ns, np.ascontiguousarray(T_end_lidar[:, :3])
        points = transform_between_knots(sweep.points_lidar, offsets_ns, knots_ns, rows)
        times_s = 1e-9 * (offsets_ns - offsets_ns.max(initial=0))
        return voxel_means(points, times_s, np.ones(n), self._config.insert_voxel_m, ring=sweep.ring)

    def _deskewed_further(self, cloud: VoxelMeans, motion: MotionModel) -> VoxelMeans:
        """The points once more, by the motion that registration added to the prediction; to first order."""
        twist, T_body_lidar = _twist(motion), self._choice.T_body_lidar
        rate, velocity = twist[:3], motion.T_odom_body[:3, :3].T @ twist[3:]
        turn = T_body_lidar[:3, :3].T
        velocity_lidar = turn @ (velocity + np.cross(rate, T_body_lidar[:3, 3]))
        return cloud._replace(points=moved_by_twist(cloud.points, cloud.times_s, turn @ rate, velocity_lidar))

    def _register(self, motion: MotionModel, cloud: VoxelMeans) -> _Registered:
        """Gauss-Newton on prior and residuals together; without a map or points the prediction stands."""
        few = voxel_means(*cloud, self._config.sweep_voxel_m)
        thinned = Thinned(se3.apply(self._choice.T_body_lidar, few.points), few.times_s, few.weights)
        if not len(self._maps[0]) or not len(thinned.ranges):
            return _Registered(None, np.zeros((6, 6)), thinned)
        predicted, A = motion.covariance, motion.measured
        prior = np.asarray(np.linalg.inv(predicted), dtype=np.float64)
        share, rounds = self._config.information_share, self._config.rounds
        left_open: F64 | None = None  # where planes stand changes little from round to round
        while True:
            last = linearise(thinned, motion.T_odom_body, _twist(motion), self._maps, self._weighting)
            if left_open is None:
                left_open = last.left_open(self._config.weak_ratio)
            H, b = last.held(left_open)
            information = prior + share * A.T @ H @ A
            gradient = prior @ motion.deviation() + share * A.T @ b
            error = -np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
            motion.add(error)
            rounds -= 1
            if rounds == 0 or (np.abs(error[:3]).max() < _CONVERGED_RAD and np.abs(error[3:6]).max() < _CONVERGED_M):
                break
        motion.covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        twist_prior = np.linalg.inv(A[6:] @ predicted @ A[6:].T) / share
        still = H[:6, :6] - H[:6, 6:] @ np.linalg.solve(H[6:, 6:] + twist_prior, H[6:, :6])
        return _Registered(last, self._in_lidar(still, motion.T_odom_body), thinned)

    def _in_lidar(self, H: F64, T_odom_body: F64) -> F64:
        """The Hessian of [rotation (body), position (odom)] as one of a right perturbation of the lidar pose."""
        to_body = np.eye(6)
        to_body[3:, 3:] = T_odom_body[:3, :3]
        A = to_body @ se3.adjoint(self._choice.T_body_lidar)
        return A.T @ H @ A

    def _judged(self, registered: _Registered, motion: MotionModel) -> Degeneracy | None:
        """What the information says of the pose, and every few sweeps a shift along its weakest direction."""
        if registered.last is None:
            return None
        c, hessian = self._config, registered.hessian_lidar
        found = degeneracy_of(hessian, registered.matches, weak_ratio=c.weak_ratio)
        if found.score >= c.probe_below or len(found.weak_directions):
            self._is_blurred, self._until_probe = False, 0
            return found
        direction_lidar = weakest_direction(hessian)
        if self._until_probe == 0:
            shift = motion.T_odom_body[:3, :3] @ self._choice.T_body_lidar[:3, :3] @ direction_lidar * c.probe_m
            pose, twist = motion.T_odom_body, _twist(motion)
            here_m = registered.last.residual_m
            growth = contrast(registered.cloud, pose, twist, self._maps, self._weighting, shift, here_m=here_m)
            self._is_blurred, self._until_probe = growth < c.min_contrast, PROBE_EVERY
        self._until_probe -= 1
        return replace(found, blurred_directions=direction_lidar[None]) if self._is_blurred else found

    def _doubt(self, registered: _Registered) -> str:
        """Why a pose rests on the motion prior alone; empty if it does not."""
        c = self._config
        if not registered.points:
            return "the sweep has no points"
        if registered.last is None:
            return "" if self._selector.index < 0 else "the map begins anew"
        if registered.matches < c.min_matches:
            return f"{registered.matches} matches, at least {c.min_matches} needed"
        if registered.inlier_ratio < c.min_inlier_ratio:
            return f"inlier ratio {registered.inlier_ratio:.2f}, at least {c.min_inlier_ratio} needed"
        return ""

    def _grow_map(self, cloud: VoxelMeans) -> None:
        if len(cloud.points):
            points = se3.apply(self._choice.T_odom_lidar, cloud.points)
            insert_into_both(self._maps, points, now=self._flown_m)
        self._sweeps += 1
        if self._sweeps % FORGET_EVERY == 0:
            for patches in self._maps:
                patches.forget(self._flown_m - self._config.forget_after_m)

    def _told(
        self, stamp_ns: int, cloud: VoxelMeans, registered: _Registered, degeneracy: Degeneracy | None, reason: str
    ) -> OdometryStep:
        T_odom_lidar = self._choice.T_told_lidar
        last = registered.last
        keyframe, edge = None, None
        if len(cloud.points) and self._selector.consider(stamp_ns, T_odom_lidar):
            points = voxel_means(*cloud, self._keyframe_config.voxel_m).points.astype(np.float32)
            keyframe = Keyframe(self._selector.index, stamp_ns, T_odom_lidar, points, self._choice.up_lidar)
            edge = self._edge(registered, degeneracy)
            self._coasted_s = 0.0
        return OdometryStep(
            stamp_ns=stamp_ns,
            T_odom_lidar=T_odom_lidar,
            trusted=not reason,
            reason=reason,
            keyframe=keyframe,
            relative_pose=edge,
            degeneracy=degeneracy,
            inlier_ratio=registered.inlier_ratio,
            residual_m=float("nan") if last is None else last.residual_m,
            points_used=registered.points,
            points_lidar=cloud.points.astype(np.float32),
        )

    def _edge(self, registered: _Registered, degeneracy: Degeneracy | None) -> RelativePose | None:
        T_i_j, j = self._selector.T_before_last, self._selector.index
        if T_i_j is None:
            return None
        # the registration's rows are weighted by their own variances already: σ enters as 1/√2, that 2σ² is 1
        c = self._config
        noise = EdgeNoise(
            sigma_m=float(np.sqrt(0.5)),
            correlation=c.edge_correlation,
            floor_rad=c.edge_floor_rad,
            floor_m=c.edge_floor_m,
        )
        judged = degeneracy or degeneracy_of(registered.hessian_lidar, 0)
        information = edge_information(registered.hessian_lidar, judged, noise=noise, coasted_s=self._coasted_s)
        return RelativePose(j - 1, j, T_i_j, information)

    def _new_maps(self) -> tuple[VoxelMap, VoxelMap]:
        c = self._config
        fine = VoxelMap(c.fine_voxel_m, cap=c.patch_points, min_weight=c.patch_min_points, growth=c.patch_growth)
        # the share of a patch that is new falls with its area: the coarse ones keep more
        cap = c.patch_points * max(1.0, (c.coarse_voxel_m / c.fine_voxel_m) ** 2)
        coarse = VoxelMap(c.coarse_voxel_m, cap=cap, min_weight=c.patch_min_points, growth=c.patch_growth)
        return fine, coarse
