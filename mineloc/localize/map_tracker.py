"""Where a drone is in a prior map, keyframe by keyframe: by registration to the map, or by its intersections."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from mineloc.config import Config
from mineloc.data import Fix, Keyframe, RelativePose
from mineloc.graph.measurements import PointFix
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.prior_map import PriorMap
from mineloc.localize.recognition import Recognizer
from mineloc.localize.sequence import RoadwaySequence


class Tracker(Protocol):
    """Follows a flight through a map."""

    @property
    def filter(self) -> PoseFilter | None:
        """Pose and covariance at the newest keyframe; None while the flight is not found in the map."""
        ...

    @property
    def fixes(self) -> list[Fix]:
        """Of all keyframes so far; those of a flight that was lost are judged when it is found."""
        ...

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> None:
        """Carry the pose to the next keyframe and correct it by what is seen there.

        Args:
            keyframe: with points.
            edge: what leads to it; None for the first.
        """
        ...


class MapTracker:
    """Every keyframe registered to the map around where it is expected.

    Args:
        prior_map: of the mine.
        config: section `prior_map`: gates and noise.
        known: where the first keyframe is.
    """

    def __init__(self, prior_map: PriorMap, config: Config, known: PoseFilter) -> None:
        self._map, self._config = prior_map, config.prior_map
        self.filter: PoseFilter = known
        self.fixes: list[Fix] = []

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> None:
        """As `Tracker.follow`."""
        if edge is not None:
            self.filter.carry(edge)
        found = self._map.register(keyframe.points_lidar, self.filter.T_map_lidar, self.filter.covariance)
        c = self._config
        sigmas = self.filter.sigmas_away(found.T_map_lidar, floor_m=c.moved_floor_m, floor_deg=c.moved_floor_deg)
        reason = found.reason
        if not reason and sigmas > c.max_moved_sigmas:
            reason = f"{sigmas:.1f} sigmas from the prediction, at most {c.max_moved_sigmas} allowed"
        fix = Fix(
            stamp_ns=keyframe.stamp_ns,
            keyframe=keyframe.index,
            T_map_lidar=found.T_map_lidar,
            covariance=found.covariance,
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
            self.filter.correct(fix)
        self.fixes.append(fix)


class IntersectionTracker:
    """Odometry alone, but at intersections of the database (paper A, 1.6 and 1.7).

    Args:
        recognizer: of the mine's intersections.
        sequence: which of them can follow which.
        config: sections `prior_map`: gates, `intersections`: which factor.
        known: where the first keyframe is.
    """

    def __init__(self, recognizer: Recognizer, sequence: RoadwaySequence, config: Config, known: PoseFilter) -> None:
        self._recognizer, self._sequence, self._config = recognizer, sequence, config
        self.filter: PoseFilter = known
        self.fixes: list[Fix] = []

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> None:
        """As `Tracker.follow`."""
        if edge is not None:
            self.filter.carry(edge)
            self._sequence.carry(edge)
        fix = self._recognizer.follow(keyframe, self.filter)
        if fix.trusted:
            fix = self._judged(fix)
        if fix.trusted:
            self._sequence.accept(fix)
            correct_by(self.filter, fix, self._config)
        self.fixes.append(fix)

    def _judged(self, fix: Fix) -> Fix:
        """Against what odometry expects and the roadways allow."""
        assert fix.T_map_lidar is not None
        c = self._config.prior_map
        sigmas = self.filter.sigmas_away(fix.T_map_lidar, floor_m=c.moved_floor_m, floor_deg=c.moved_floor_deg)
        fix = replace(fix, scores={**fix.scores, "sigmas": sigmas})
        reason = self._sequence.doubt(fix)
        if sigmas > c.max_moved_sigmas:
            reason = f"{sigmas:.1f} sigmas from the prediction, at most {c.max_moved_sigmas} allowed (step 9)"
        return replace(fix, trusted=False, reason=reason) if reason else fix


def correct_by(known: PoseFilter, fix: Fix, config: Config) -> None:
    """Take a recognised intersection by the factor that the configuration names."""
    if config.intersections.factor == "position":
        known.correct_by_point(PointFix.of(fix))
    else:
        known.correct(fix)


def contradicts_map(fix: Fix) -> bool:
    """Whether a fix of a `MapTracker` speaks against the pose: wherever the drone is, it sees the map."""
    return not fix.trusted


def contradicts_database(fix: Fix) -> bool:
    """Whether a fix of an `IntersectionTracker` does: a junction was seen, and none that is known fits there."""
    return not fix.trusted and "branches" in fix.scores
