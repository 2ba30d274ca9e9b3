"""Localization in a prior map: by registration to it or by its intersections; between fixes odometry goes on alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mineloc import se3
from mineloc.config import Config, PriorMapConfig
from mineloc.data import F64, Fix, IntersectionDatabase, OdometryStep
from mineloc.errors import ConfigError
from mineloc.graph.batch import solve
from mineloc.graph.pose_graph import PoseGraph
from mineloc.localize.flown import counts_of, first_origin, front_end_steps
from mineloc.localize.kept import Kept
from mineloc.localize.localization import FlightData, Localization
from mineloc.localize.map_tracker import IntersectionTracker, MapTracker, Tracker
from mineloc.localize.prior_map import PriorMap
from mineloc.localize.recognition import Recognizer
from mineloc.odometry.front_end import FrontEnd
from mineloc.progress import Progress


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
        start: where the flight begins in the map.
        map: of the mine, for `map_tracking`.
        database: of its intersections, for `intersections_map`.
    """

    start: Start
    map: PriorMap | None = None
    database: IntersectionDatabase | None = None

    def tracker(self, config: Config, T_map_lidar: F64, *, by: Literal["map", "intersections"]) -> Tracker:
        """What follows a flight that begins at a pose.

        Raises:
            ConfigError: what it needs is not there.
        """
        covariance = self.start.covariance
        if by == "map":
            if self.map is None:
                raise ConfigError("--method", "the method needs a map", expected="--map MAP/", todo="name a map folder")
            return MapTracker(self.map, config.prior_map, T_map_lidar=T_map_lidar, covariance=covariance)
        if self.database is None:
            raise ConfigError(
                "--method", "the method needs a database", expected="--database DB.mcap", todo="make one of a map"
            )
        recognizer = Recognizer(config, self.database)
        return IntersectionTracker(recognizer, config.prior_map, T_map_lidar=T_map_lidar, covariance=covariance)


class MapTracking:
    """Odometry and a tracker: a filter online, all fixes and relative poses in the graph when the flight is over.

    Args:
        config: of all sections that a method reads.
        front_end: turns sweeps into poses.
        prior: what is known, and where the flight begins in it.
        by: what holds the drone.
    """

    def __init__(
        self, config: Config, front_end: FrontEnd, prior: Prior, *, by: Literal["map", "intersections"]
    ) -> None:
        self._config, self._front_end = config, front_end
        self._by: Literal["map", "intersections"] = by
        self._prior, self._start = prior, prior.start
        self._graph = PoseGraph(config.graph)
        self._kept = Kept()
        self._tracker: Tracker | None = None
        self._fixes: list[Fix] = []
        self._T_map_odom: F64 = np.eye(4)  # as known now

    def run(self, flight: FlightData, progress: Progress) -> Localization:
        """Every sweep through the front end, every keyframe to the map and into the graph, then all at once.

        Raises:
            FlightError: fewer than two sweeps, none with points, or time goes backwards.
        """
        clock = self._kept.clock
        for step in front_end_steps(self._front_end, flight, self._config, clock=clock, progress=progress):
            if not self._kept.steps:
                self._T_map_odom = self._start.T_map_level @ first_origin(step, flight.calibration.T_body_lidar)
            if step.keyframe is not None:
                with clock.of(self._by):
                    self._place(step)
            self._kept.add_step(step, self._T_map_odom)
        with clock.of("graph_batch"):
            solution = solve(self._graph)
        return self._kept.told(solution, counts=counts_of(self._front_end), fixes=self._fixes)

    def _place(self, step: OdometryStep) -> None:
        """Register a keyframe; what it says moves all that comes after it."""
        keyframe = self._kept.add_keyframe(step)
        expected = self._T_map_odom @ keyframe.T_odom_lidar
        if step.relative_pose is None:
            self._graph.add_first(keyframe, T_map_lidar=expected, covariance=self._start.covariance)
        else:
            self._graph.add_next(keyframe, step.relative_pose)
        if self._tracker is None:
            self._tracker = self._prior.tracker(self._config, expected, by=self._by)
        fix = self._tracker.follow(keyframe, step.relative_pose)
        self._fixes.append(fix)
        if fix.trusted:
            self._graph.add_fix(fix)
        self._T_map_odom = self._tracker.filter.T_map_lidar @ se3.inverse(keyframe.T_odom_lidar)
