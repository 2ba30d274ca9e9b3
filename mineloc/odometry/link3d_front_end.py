"""Paper B's front end: LOAM whose edges are those that LinK3D's keypoints gather (METHOD part 2, 4.3).

Cui et al., *LinK3D: Linear keypoints representation for 3D LiDAR point cloud*, RA-L 2024; paper B, 2.2-2.3. Scattered
edge points, there in one sweep and gone in the next, are what bends LOAM in a rough roadway. Points that gather to a
keypoint over several rings stay: they take the place of LOAM's edges. Keypoints matched to the last sweep's give the
registration its start and hold it sideways. Where too few match, the sweep is LOAM's alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mineloc import se3
from mineloc.config import KeyframeConfig, Link3dConfig, LoamConfig
from mineloc.data import F64, I64, ImuSamples, OdometryStep, Sweep
from mineloc.odometry.link3d_edges import EdgePoints, edge_points
from mineloc.odometry.link3d_matching import KeypointSweep, match_edges, match_keypoints
from mineloc.odometry.link3d_motion import Motion, motion_of
from mineloc.odometry.link3d_outliers import without_isolated
from mineloc.odometry.loam import Aid, LoamFrontEnd, Track
from mineloc.odometry.loam_features import LoamFeatures, extract_features
from mineloc.odometry.loam_solver import Matches


class Link3dFrontEnd(LoamFrontEnd):
    """LOAM aided by LinK3D, behind the `FrontEnd` protocol.

    Args:
        config: LinK3D's keypoints, descriptors and matching.
        loam, keyframe: as for `LoamFrontEnd`.
    """

    def __init__(self, config: Link3dConfig, loam: LoamConfig, keyframe: KeyframeConfig) -> None:
        super().__init__(loam, keyframe)
        self._link3d = config
        self._rng = np.random.default_rng(config.seed)
        self._edges: EdgePoints | None = None
        self._seen: KeypointSweep | None = None
        self._last_seen: KeypointSweep | None = None
        self._aided = self._fallen_back = 0

    @property
    def counts(self) -> Mapping[str, int]:
        """Sweeps that LinK3D aided, and those that were LOAM's alone for want of matches."""
        return {"link3d_sweeps": self._aided, "fallback_sweeps": self._fallen_back}

    def step(self, sweep: Sweep, imu: ImuSamples) -> OdometryStep:
        """Take the next sweep (see `FrontEnd.step`); the inertial samples are ignored.

        Raises:
            FlightError: time goes backwards, or the sweep has no rings.
        """
        out = super().step(sweep, imu)
        if self._track is not None and self._track.stamp_ns == out.stamp_ns:
            self._last_seen = self._seen  # the next sweep starts from this one
        return out

    def _extract(self, sweep: Sweep) -> LoamFeatures:
        """Outliers out, then LinK3D's edge points, and LOAM's features to fall back on."""
        c = self._link3d
        assert sweep.ring is not None
        by_ring = sweep.keep(np.argsort(sweep.ring, kind="stable"))
        by_ring = without_isolated(by_ring, gap_m=c.isolated_gap_m, gap_ratio=c.isolated_gap_ratio)
        self._edges = edge_points(by_ring, c)
        return extract_features(by_ring, self._config)

    def _begin(self, sweep: Sweep, features: LoamFeatures, end_ns: int) -> OdometryStep:
        assert self._edges is not None
        self._seen = KeypointSweep.of(self._edges.deskewed(np.zeros(6), target_ns=end_ns), self._link3d)
        return super()._begin(sweep, features, end_ns)

    def _aid(self, last: Track, features: LoamFeatures, end_ns: int) -> Aid:
        """Match keypoints to the last sweep's; with enough, their edges, their motion and their constraints."""
        c, aid = self._link3d, super()._aid(last, features, end_ns)
        assert self._edges is not None
        seen = KeypointSweep.of(self._edges.deskewed(last.twist_lidar, target_ns=end_ns), c)
        before, self._seen = self._last_seen, seen
        pairs = np.zeros((0, 2), np.int64)
        if before is not None:
            pairs = match_keypoints(
                seen.descriptors, before.descriptors, tolerance_m=c.tolerance_m, min_score=c.min_score
            )
        if before is None or len(pairs) < c.min_matches:
            self._fallen_back += 1
            return aid
        self._aided += 1
        aid = replace(aid, features=_gathered(features, seen))
        return self._with_motion(aid, seen, before, match_edges(seen, before, pairs))

    def _with_motion(self, aid: Aid, seen: KeypointSweep, before: KeypointSweep, edges: I64) -> Aid:
        """The start moved towards the motion of the matched edges, and lines that hold it; as it was without one."""
        c = self._link3d
        source = seen.edges.sweep.points_lidar[edges[:, 0]].astype(np.float64)
        target = before.edges.sweep.points_lidar[edges[:, 1]].astype(np.float64)
        found = motion_of(
            source, target, inlier_m=c.inlier_m, trials=c.trials, min_inliers=c.min_matches, rng=self._rng
        )
        if found is None:
            return aid
        away = se3.log(se3.inverse(aid.T_last_lidar) @ found.T_target_source)
        agrees = np.linalg.norm(away[3:]) < c.start_gate_m and np.linalg.norm(away[:3]) < np.radians(c.start_gate_deg)
        if agrees:  # a wrong start is worse than none
            aid = replace(aid, T_last_lidar=aid.T_last_lidar @ se3.exp(c.start_weight * away * _SEEN_BY_EDGES))
        return replace(aid, constraints=_lines(found, source, target, aid.T_last_lidar, c.constraint_gate_m))


_SEEN_BY_EDGES = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
"""An edge is met by one ring here and by another there: it tells yaw and place in the plane, not height and tilt."""


def _gathered(features: LoamFeatures, seen: KeypointSweep) -> LoamFeatures:
    """LOAM's planes with LinK3D's edges: the sharpest of every keypoint and ring, and all that gather to a keypoint."""
    sweep, keypoints = seen.edges.sweep, seen.keypoints
    return replace(
        features, sharp=sweep.keep(np.sort(keypoints.sharpest)), less_sharp=sweep.keep(keypoints.of_edge >= 0)
    )


def _lines(found: Motion, source: F64, target: F64, T_target_source: F64, gate_m: float) -> Matches:
    """Matched edge points as upright lines through their partners, where these are near already."""
    off_m = np.linalg.norm((se3.apply(T_target_source, source) - target)[:, :2], axis=1)
    kept = found.inliers & (off_m < gate_m)
    count = int(kept.sum())
    axes = np.tile([0.0, 0.0, 1.0], (count, 1))
    is_line, is_firm = np.ones(count, np.bool_), np.zeros(count, np.bool_)
    return Matches(source[kept], target[kept], axes, is_line, is_firm)
