"""Where a drone is in a prior map, keyframe by keyframe: by registration to the map, or by its intersections."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from mineloc.config import PriorMapConfig
from mineloc.data import F64, Fix, Keyframe, RelativePose
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.prior_map import PriorMap
from mineloc.localize.recognition import Recognizer


class Tracker(Protocol):
    """Follows a flight through a map.

    Attributes:
        filter: pose and covariance at the newest keyframe.
    """

    filter: PoseFilter

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> Fix:
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
        config: gates and noise.
        T_map_lidar: (4, 4) of the first keyframe.
        covariance: (6, 6) of that, `[rotation, translation]`, right perturbation.
    """

    def __init__(self, prior_map: PriorMap, config: PriorMapConfig, *, T_map_lidar: F64, covariance: F64) -> None:
        self._map, self._config = prior_map, config
        self.filter = PoseFilter(T_map_lidar, covariance)

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> Fix:
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
        return fix


class IntersectionTracker:
    """Odometry alone, but at intersections of the database (paper A, 1.6 and 1.7).

    Args:
        recognizer: of the mine's intersections.
        config: gates.
        T_map_lidar, covariance: as for `MapTracker`.
    """

    def __init__(self, recognizer: Recognizer, config: PriorMapConfig, *, T_map_lidar: F64, covariance: F64) -> None:
        self._recognizer, self._config = recognizer, config
        self.filter = PoseFilter(T_map_lidar, covariance)

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> Fix:
        """As `Tracker.follow`."""
        if edge is not None:
            self.filter.carry(edge)
        fix = self._recognizer.follow(keyframe, self._is_possible)
        if not fix.trusted or fix.T_map_lidar is None:
            return fix
        c = self._config
        sigmas = self.filter.sigmas_away(fix.T_map_lidar, floor_m=c.moved_floor_m, floor_deg=c.moved_floor_deg)
        fix = replace(fix, scores={**fix.scores, "sigmas": sigmas})
        if sigmas > c.max_moved_sigmas:
            reason = f"{sigmas:.1f} sigmas from the prediction, at most {c.max_moved_sigmas} allowed"
            return replace(fix, trusted=False, reason=reason)
        self.filter.correct(fix)
        return fix

    def _is_possible(self, T_map_lidar: F64) -> bool:
        """Before registration: an invariant point is known to some decimetres, its turn to some degrees."""
        c = self._config
        sigmas = self.filter.sigmas_away(T_map_lidar, floor_m=c.seen_floor_m, floor_deg=c.seen_floor_deg)
        return sigmas <= c.max_moved_sigmas
