"""The LOAM front end: the baseline of both papers, as published in A-LOAM (METHOD 4.1).

Zhang and Singh, *LOAM: Lidar Odometry and Mapping in Real-time*, RSS 2014. Where it differs from A-LOAM: rings come
from the sweep, not from elevation angles; points are motion-compensated; occluded points and surfaces along the beam
are rejected, as in LOAM; every sweep is mapped. The IMU is not used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mineloc import se3
from mineloc.config import KeyframeConfig, LoamConfig
from mineloc.data import F32, F64, ImuSamples, Keyframe, OdometryStep, RelativePose, Sweep
from mineloc.errors import FlightError
from mineloc.odometry.information import degeneracy_of, edge_information
from mineloc.odometry.keyframes import KeyframeSelector
from mineloc.odometry.loam_features import LoamFeatures, extract_features
from mineloc.odometry.loam_map import FeatureMap
from mineloc.odometry.loam_matching import match_lines, match_planes
from mineloc.odometry.loam_solver import Matches, firm_hessian, solve
from mineloc.sweep import deskew_constant_twist, first_in_voxels, voxel_centroids

_REACH_M = (525.0, 525.0, 275.0)
"""Half of A-LOAM's grid of 21 × 21 × 11 cubes of 50 m: what the map remembers around the drone."""

_SHORTEST_STEP_S = 1e-3
"""Sweeps that end closer together say nothing about the velocity."""

_WEAK_RATIO = 0.01
"""LOAM's own: in a tunnel with waves of 5 cm, where it slips by half, the score is 0.008; the Edgar mine has 0.02 and
more."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The last sweep that features were taken from: where the next one starts."""

    stamp_ns: int
    T_odom_lidar: F64
    twist_lidar: F64
    features: LoamFeatures


@dataclass(frozen=True, slots=True, eq=False)
class Aid:
    """What is known of a sweep before it is registered.

    Attributes:
        features: deskewed to the end of the sweep.
        T_last_lidar: (4, 4) assumed motion since the last sweep.
        constraints: points that belong to lines or planes of the last sweep, in its lidar frame; None without. They
            join the registrations to the last sweep and to the map.
    """

    features: LoamFeatures
    T_last_lidar: F64
    constraints: Matches | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Registration:
    """A pose, the matches behind it and their residual, and how many points asked for a match."""

    T_odom_lidar: F64
    matches: Matches
    residual_m: float
    points: int


class LoamFrontEnd:
    """LOAM behind the `FrontEnd` protocol. Poses are those of A-LOAM's mapping, each at the end of its sweep.

    A-LOAM's `T_map_odom`, the correction kept from one map registration to the next, is part of the pose: the motion
    from sweep to sweep is appended to the last mapped pose.

    A front end that knows more of a sweep than LOAM overrides `_extract` and `_aid`.
    """

    def __init__(self, config: LoamConfig, keyframe: KeyframeConfig) -> None:
        self._config = config
        self._keyframe = keyframe
        self._selector = KeyframeSelector(keyframe)
        search_m = config.neighbour_distance_m
        self._corners = FeatureMap(leaf_m=config.corner_leaf_m, search_m=search_m, reach_m=_REACH_M)
        self._surfaces = FeatureMap(leaf_m=config.surface_leaf_m, search_m=search_m, reach_m=_REACH_M)
        self._track: Track | None = None
        self._start_ns: int | None = None
        self._end_ns = 0
        self._coasted_s = 0.0

    def step(self, sweep: Sweep, imu: ImuSamples) -> OdometryStep:  # noqa: ARG002 - LOAM uses no IMU
        """Take the next sweep (see `FrontEnd.step`); the inertial samples are ignored.

        Raises:
            FlightError: time goes backwards, or the sweep has no rings.
        """
        end_ns = self._end_of(sweep)
        features = self._extract(sweep)
        last = self._track
        if last is None:
            return self._begin(sweep, features, end_ns)
        aid = self._aid(last, features.deskewed(last.twist_lidar, target_ns=end_ns), end_ns)
        odometry = self._sweep_to_sweep(last, aid)
        guess = se3.rigid(last.T_odom_lidar @ aid.T_last_lidar) if odometry is None else odometry.T_odom_lidar
        registration = self._sweep_to_map(last, aid, guess) or odometry
        if registration is None:
            return self._coast(last, aid.features, guess, end_ns)
        self._extend_map(aid.features, registration.T_odom_lidar)
        self._track = _follow(last, registration.T_odom_lidar, aid.features, end_ns)
        return self._report(sweep, registration, self._track, last.twist_lidar)

    def _extract(self, sweep: Sweep) -> LoamFeatures:
        """The features of a sweep, not deskewed."""
        return extract_features(sweep, self._config)

    def _aid(self, last: Track, features: LoamFeatures, end_ns: int) -> Aid:
        """What is known of the sweep just extracted, deskewed by the motion before: here constant velocity."""
        return Aid(features, self._predict(last, end_ns))

    def _end_of(self, sweep: Sweep) -> int:
        """The time for which this sweep's pose will be true: its last point, later than all before."""
        where = f"sweep at {sweep.stamp_ns} ns"
        if self._start_ns is not None and sweep.stamp_ns <= self._start_ns:
            raise FlightError(
                where,
                f"not later than the sweep before ({self._start_ns} ns)",
                expected="rising times",
                todo="ingest the recording again: it sorts sweeps and reports clock jumps",
            )
        if sweep.ring is None:
            raise FlightError(
                where,
                "no ring numbers",
                expected="a ring for every point: LOAM picks its features ring by ring",
                todo="name the ring field in the sequence file and ingest again, or use --method odometry",
            )
        self._end_ns = sweep.end_ns if self._start_ns is None else max(sweep.end_ns, self._end_ns + 1)
        self._start_ns = sweep.stamp_ns
        return self._end_ns

    def _begin(self, sweep: Sweep, features: LoamFeatures, end_ns: int) -> OdometryStep:
        """The first sweep with features is the origin; its motion is unknown, so it is taken as at rest."""
        lack = _lack(features, self._config)
        if lack:
            return OdometryStep(end_ns, np.eye(4), trusted=False, reason=f"{lack}; the flight has not begun")
        features = features.deskewed(np.zeros(6), target_ns=end_ns)
        self._track = Track(end_ns, np.eye(4), np.zeros(6), features)
        self._extend_map(features, np.eye(4))
        return self._report(sweep, None, self._track, np.zeros(6))

    def _predict(self, last: Track, end_ns: int) -> F64:
        """Constant velocity; a drone unseen for longer than `max_prediction_s` counts as hovering from then on."""
        elapsed_s = min((end_ns - last.stamp_ns) * 1e-9, self._config.max_prediction_s)
        return se3.exp(elapsed_s * last.twist_lidar)

    def _sweep_to_sweep(self, last: Track, aid: Aid) -> _Registration | None:
        """Sharp to less sharp, flat to less flat points of the last sweep; None with too few matches."""
        config, features = self._config, aid.features
        within = {"distance_m": config.odometry_distance_m, "rings": config.odometry_rings}
        if _lack(features, config):
            return None
        found = _register(
            lambda T: Matches.join(
                match_lines(features.sharp, last.features.less_sharp, T, **within),
                match_planes(features.flat, last.features.less_flat, T, **within),
            ),
            aid.T_last_lidar,
            constraints=aid.constraints,
            points=len(features.sharp) + len(features.flat),
            at_least=config.odometry_min_matches,
            rounds=config.odometry_rounds,
            iterations=config.odometry_iterations,
            huber_m=config.huber_m,
            min_eigenvalue=config.odometry_min_eigenvalue,
        )
        return None if found is None else replace(found, T_odom_lidar=se3.rigid(last.T_odom_lidar @ found.T_odom_lidar))

    def _sweep_to_map(self, last: Track, aid: Aid, guess: F64) -> _Registration | None:
        """Thinned less sharp and less flat points to the lines and planes of the map; None with too few matches."""
        config, features = self._config, aid.features
        corners = voxel_centroids(features.less_sharp.points_lidar, config.corner_leaf_m)
        surfaces = voxel_centroids(features.less_flat.points_lidar, config.surface_leaf_m)
        return _register(
            lambda T: Matches.join(
                self._corners.match_lines(corners, T, ratio=config.line_eigenvalue_ratio),
                self._surfaces.match_planes(surfaces, T, tolerance_m=config.plane_tolerance_m),
            ),
            guess,
            constraints=None if aid.constraints is None else aid.constraints.placed(last.T_odom_lidar),
            points=len(corners) + len(surfaces),
            at_least=config.mapping_min_matches,
            rounds=config.mapping_rounds,
            iterations=config.mapping_iterations,
            huber_m=config.huber_m,
            min_eigenvalue=config.mapping_min_eigenvalue,
        )

    def _extend_map(self, features: LoamFeatures, T_odom_lidar: F64) -> None:
        for target, points, leaf_m in (
            (self._corners, features.less_sharp.points_lidar, self._config.corner_leaf_m),
            (self._surfaces, features.less_flat.points_lidar, self._config.surface_leaf_m),
        ):
            thinned = se3.apply(T_odom_lidar, voxel_centroids(points, leaf_m))
            target.add(thinned.astype(np.float32), T_odom_lidar[:3, 3])

    def _coast(self, last: Track, features: LoamFeatures, T_odom_lidar: F64, end_ns: int) -> OdometryStep:
        """The prior carries on. A sweep with features becomes the one to match next, unconnected to those before."""
        lack = _lack(features, self._config)
        if not lack:
            self._coasted_s += (end_ns - last.stamp_ns) * 1e-9
            self._track = Track(end_ns, T_odom_lidar, last.twist_lidar, features)
        reason = lack or "too few points match the last sweep or the map"
        return OdometryStep(end_ns, T_odom_lidar, trusted=False, reason=f"{reason}; constant velocity")

    def _report(self, sweep: Sweep, registration: _Registration | None, track: Track, twist_lidar: F64) -> OdometryStep:
        """What the step says of itself, with a keyframe and its relative pose when one is due."""
        keyframe, relative, degeneracy = None, None, None
        hessian = np.zeros((6, 6))
        if registration is not None:
            # matches between two sweeps are never firm: where the map gave none, nothing is claimed
            hessian, firm = firm_hessian(registration.matches, registration.T_odom_lidar, huber_m=self._config.huber_m)
            degeneracy = degeneracy_of(hessian, firm, weak_ratio=_WEAK_RATIO)
        if self._selector.consider(track.stamp_ns, track.T_odom_lidar):
            index = self._selector.index
            points_lidar = self._thin(sweep, twist_lidar, track.stamp_ns)
            keyframe = Keyframe(index, track.stamp_ns, track.T_odom_lidar, points_lidar)
            if self._selector.T_before_last is not None and degeneracy is not None:
                information = edge_information(hessian, degeneracy, coasted_s=self._coasted_s)
                relative = RelativePose(index - 1, index, self._selector.T_before_last, information)
            self._coasted_s = 0.0
        return OdometryStep(
            track.stamp_ns,
            track.T_odom_lidar,
            trusted=True,
            keyframe=keyframe,
            relative_pose=relative,
            degeneracy=degeneracy,
            inlier_ratio=len(registration.matches) / registration.points if registration else float("nan"),
            residual_m=registration.residual_m if registration else float("nan"),
            points_used=registration.points if registration else 0,
        )

    def _thin(self, sweep: Sweep, twist_lidar: F64, end_ns: int) -> F32:
        points = deskew_constant_twist(sweep, twist_lidar, target_ns=end_ns).points_lidar
        return points[first_in_voxels(points, self._keyframe.voxel_m)]


def _register(
    match: Callable[[F64], Matches],
    T: F64,
    *,
    constraints: Matches | None,
    points: int,
    at_least: int,
    rounds: int,
    iterations: int,
    huber_m: float,
    min_eigenvalue: float,
) -> _Registration | None:
    """Match and solve in turn, always with the constraints; None with fewer matches than `at_least` without them."""
    found: _Registration | None = None
    for _ in range(rounds):
        matches = match(T)
        if len(matches) < at_least:
            return None
        if constraints is not None:
            matches = Matches.join(matches, constraints)
        T, residual_m = solve(matches, T, iterations=iterations, huber_m=huber_m, min_eigenvalue=min_eigenvalue)
        asked = points if constraints is None else points + len(constraints)
        found = _Registration(T, matches, residual_m, asked)
    return found


def _follow(last: Track, T_odom_lidar: F64, features: LoamFeatures, end_ns: int) -> Track:
    """The track after a registered sweep, with the velocity that led from the last pose to this one."""
    elapsed_s = (end_ns - last.stamp_ns) * 1e-9
    moved = se3.log(se3.inverse(last.T_odom_lidar) @ T_odom_lidar)
    twist = last.twist_lidar if elapsed_s < _SHORTEST_STEP_S else moved / elapsed_s
    return Track(end_ns, T_odom_lidar, twist, features)


def _lack(features: LoamFeatures, config: LoamConfig) -> str:
    """What a sweep lacks to be matched; empty when it has enough."""
    count = len(features.sharp) + len(features.flat)
    if count < config.odometry_min_matches:
        return f"{count} feature points, fewer than {config.odometry_min_matches}"
    assert features.less_flat.ring is not None
    assert features.less_sharp.ring is not None
    rings = np.unique(np.concatenate([features.less_flat.ring, features.less_sharp.ring]))
    return "features on one ring only" if len(rings) < 2 else ""
