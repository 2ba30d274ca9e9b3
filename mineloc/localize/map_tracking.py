"""Localization in a prior map: by registration to it or by its intersections; between fixes odometry goes on alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mineloc import se3
from mineloc.config import Config, PriorMapConfig
from mineloc.data import F64, Fix, IntersectionDatabase, OdometryStep
from mineloc.errors import ConfigError
from mineloc.graph.batch import Solution, solve
from mineloc.graph.condensed import outvoted_fixes
from mineloc.graph.measurements import PointFix
from mineloc.graph.pose_graph import PoseGraph
from mineloc.localize.flown import counts_of, first_origin, front_end_steps
from mineloc.localize.kept import Kept
from mineloc.localize.localization import FlightData, Localization
from mineloc.localize.map_tracker import (
    IntersectionTracker,
    MapTracker,
    Tracker,
    contradicts_database,
    contradicts_map,
)
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.prior_map import PriorMap
from mineloc.localize.recognition import Recognizer
from mineloc.localize.relocalization import RecoveringTracker, Relocalizer
from mineloc.localize.sequence import RoadwaySequence
from mineloc.odometry.front_end import FrontEnd
from mineloc.progress import Progress

By = Literal["map", "intersections"]
_ANYWHERE_RAD, _ANYWHERE_M = np.radians(30.0), 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a flight begins.

    Attributes:
        T_map_level: (4, 4) of the drone's level frame, heading ahead.
        covariance: (6, 6) of that, `[rotation, translation]`, right perturbation.
    """

    T_map_level: F64
    covariance: F64

    @staticmethod
    def of(config: PriorMapConfig, grid_origin_m: F64) -> Start | None:
        """What the configuration says; None when it says nothing.

        Args:
            grid_origin_m: (3,) of the map frame.
        """
        if config.start_m is None:
            return None
        T = se3.exp(np.array([0.0, 0.0, np.radians(config.start_yaw_deg), 0.0, 0.0, 0.0]))
        T[:3, 3] = np.array(config.start_m) - grid_origin_m
        turn, shift = np.radians(config.start_sigma_deg), config.start_sigma_m
        return Start(T, np.diag([np.radians(0.5) ** 2] * 2 + [turn**2] + [shift**2] * 3))


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known before a flight.

    Attributes:
        start: where the flight begins in the map; None: anywhere, and intersections find it.
        map: of the mine, for `map_tracking`.
        database: of its intersections, for `intersections_map` and for flights that begin anywhere.
    """

    start: Start | None
    map: PriorMap | None = None
    database: IntersectionDatabase | None = None

    def check(self, by: By) -> None:
        """Whether there is what a method needs.

        Raises:
            ConfigError: there is not.
        """
        if by == "map" and self.map is None:
            raise ConfigError("--method", "the method needs a map", expected="--map MAP/", todo="name a map folder")
        if by == "intersections" and self.database is None:
            raise ConfigError(
                "--method", "the method needs a database", expected="--database DB.mcap", todo="make one of a map"
            )
        if self.start is None and self.database is None:
            raise ConfigError(
                "prior_map.start_m",
                "is not set",
                expected="where the drone begins, in the frame of the map, or a database to find it by",
                todo="set it and prior_map.start_yaw_deg, or give --database",
            )

    def tracker(self, config: Config, T_map_lidar: F64, *, by: By) -> Tracker:
        """What follows a flight.

        Args:
            T_map_lidar: (4, 4) of its first keyframe, where the start is known.
        """
        if self.start is not None:
            return self._track(config, PoseFilter(T_map_lidar, self.start.covariance, config.graph), by)
        assert self.database is not None
        return Relocalizer(Recognizer(config, self.database), config, lambda known: self._track(config, known, by))

    def _track(self, config: Config, known: PoseFilter, by: By) -> Tracker:
        """Once its pose is known; a flight that the map contradicts for long is searched for anew."""
        tracker, database = self._by(config, known, by), self.database
        if database is None:
            return tracker

        def search() -> Relocalizer:
            # a bare tracker: the one around it goes on watching, two would search side by side
            return Relocalizer(Recognizer(config, database), config, lambda found: self._by(config, found, by))

        return RecoveringTracker(
            tracker, search, contradicts_map if by == "map" else contradicts_database, config.prior_map
        )

    def _by(self, config: Config, known: PoseFilter, by: By) -> Tracker:
        if by == "map":
            assert self.map is not None
            return MapTracker(self.map, config, known)
        assert self.database is not None
        sequence = RoadwaySequence(self.database, config.intersections)
        return IntersectionTracker(Recognizer(config, self.database), sequence, config, known)


class MapTracking:
    """Odometry and a tracker: a filter online, all fixes and relative poses in the graph when the flight is over.

    Args:
        config: of all sections that a method reads.
        front_end: turns sweeps into poses.
        prior: what is known, and where the flight begins in it.
        by: what holds the drone.

    Raises:
        ConfigError: the prior lacks what it needs.
    """

    def __init__(self, config: Config, front_end: FrontEnd, prior: Prior, *, by: By) -> None:
        self._config, self._front_end = config, front_end
        self._by: By = by
        prior.check(by)
        self._prior = prior
        self._kept = Kept()
        self._tracker: Tracker | None = None
        self._T_map_odom: F64 = np.eye(4)  # as known now; of a frame of its own while the flight is not found
        self._origin: F64 = np.eye(4)  # the same at the start
        self._found = prior.start is not None

    def run(self, flight: FlightData, progress: Progress) -> Localization:
        """Every sweep through the front end, every keyframe to the map, then all at once.

        Raises:
            FlightError: fewer than two sweeps, none with points, or time goes backwards.
        """
        clock = self._kept.clock
        for step in front_end_steps(self._front_end, flight, self._config, clock=clock, progress=progress):
            if not self._kept.steps:
                start = np.eye(4) if self._prior.start is None else self._prior.start.T_map_level
                self._origin = self._T_map_odom = start @ first_origin(step, flight.calibration.T_body_lidar)
            if step.keyframe is not None:
                with clock.of(self._by):
                    self._place(step)
            self._kept.add_step(step, self._T_map_odom)
        return self._smoothed()

    def _place(self, step: OdometryStep) -> None:
        """Show a keyframe to the tracker; what it says moves all that comes after it."""
        keyframe = self._kept.add_keyframe(step)
        if self._tracker is None:
            expected = self._T_map_odom @ keyframe.T_odom_lidar
            self._tracker = self._prior.tracker(self._config, expected, by=self._by)
        self._tracker.follow(keyframe, step.relative_pose)
        known = self._tracker.filter
        if known is None:
            return
        if not self._found:
            # what was told of the drone before was not in the map
            self._found = True
            self._kept.forget_online()
        self._T_map_odom = known.T_map_lidar @ se3.inverse(keyframe.T_odom_lidar)

    def _smoothed(self) -> Localization:
        assert self._tracker is not None
        with self._kept.clock.of("graph_batch"):
            fixes = self._agreed(self._tracker.fixes)
            solution = self._solved(fixes)
        counts = counts_of(self._front_end)
        off_m = self._start_off_m(solution) if self._was_lost else None
        return self._kept.told(solution, counts=counts, fixes=fixes, in_map=self._found, start_off_m=off_m)

    @property
    def _was_lost(self) -> bool:
        return isinstance(self._tracker, RecoveringTracker) and self._tracker.was_lost

    def _start_off_m(self, solution: Solution) -> float:
        told = self._origin @ self._kept.keyframes[0].T_odom_lidar
        return float(np.linalg.norm(solution.poses[0][:3, 3] - told[:3, 3]))

    def _agreed(self, fixes: list[Fix]) -> list[Fix]:
        """Recognitions that the others outvote are refused; one wrong id must not bend the trajectory."""
        if self._by == "map" or not self._found:
            return fixes
        return outvoted_fixes(self._kept.keyframes, self._kept.edges, fixes, self._config.graph)

    def _solved(self, fixes: list[Fix]) -> Solution:
        graph = PoseGraph(self._config.graph)
        for keyframe, edge in zip(self._kept.keyframes, self._kept.edges, strict=True):
            if edge is not None:
                graph.add_next(keyframe, edge)
                continue
            T_map_odom, covariance = self._first()
            graph.add_first(keyframe, T_map_lidar=T_map_odom @ keyframe.T_odom_lidar, covariance=covariance)
        by_point = self._by == "intersections" and self._config.intersections.factor == "position"
        for fix in fixes:
            if fix.trusted and by_point:
                graph.add_point_fix(PointFix.of(fix))
            elif fix.trusted:
                graph.add_fix(fix)
        return solve(graph)

    def _first(self) -> tuple[F64, F64 | None]:
        """`T_map_odom` of the start and the covariance there: as given, as found later, or of a frame of its own."""
        if self._prior.start is not None and not self._was_lost:
            return self._origin, self._prior.start.covariance
        if not self._found:
            return self._origin, None
        return self._T_map_odom, np.diag([_ANYWHERE_RAD**2] * 3 + [_ANYWHERE_M**2] * 3)
