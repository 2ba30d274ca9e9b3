"""The methods that estimate from the flight alone: a front end, gravity, loop closures, the graph that holds them."""

from __future__ import annotations

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, Keyframe, OdometryStep
from mineloc.graph.batch import solve
from mineloc.graph.causal import CausalEstimate
from mineloc.graph.pose_graph import PoseGraph
from mineloc.localize.flown import counts_of, first_origin, front_end_steps
from mineloc.localize.kept import Kept
from mineloc.localize.localization import FlightData, Localization
from mineloc.localize.loops import LoopCloser
from mineloc.odometry.front_end import FrontEnd
from mineloc.progress import Progress


class GraphMethod:
    """Odometry, keyframes, relative pose factors (paper A, eq. 8-19), gravity, loops; smoothed and causal.

    Args:
        config: of all sections that a method reads.
        front_end: turns sweeps into poses.
        closer: finds loop closures; None for open-loop methods.
    """

    def __init__(self, config: Config, front_end: FrontEnd, *, closer: LoopCloser | None = None) -> None:
        self._config, self._front_end, self._closer = config, front_end, closer
        self._graph = PoseGraph(config.graph)
        self._causal = CausalEstimate(self._graph)
        self._kept = Kept()
        self._T_map_odom: F64 = np.eye(4)  # as known now

    def run(self, flight: FlightData, progress: Progress) -> Localization:
        """Every sweep through the front end, every keyframe into the graph, then all at once.

        Raises:
            FlightError: fewer than two sweeps, none with points, or time goes backwards.
        """
        steps = front_end_steps(self._front_end, flight, self._config, clock=self._kept.clock, progress=progress)
        for step in steps:
            self._follow(step, flight.calibration.T_body_lidar)
        return self._smoothed()

    def _follow(self, step: OdometryStep, T_body_lidar: F64) -> None:
        """Grow the graph by a keyframe, and place the sweep with what is known now."""
        if not self._kept.steps:
            self._T_map_odom = first_origin(step, T_body_lidar)
        if step.keyframe is not None:
            with self._kept.clock.of("graph_online"):
                self._add(step.keyframe, step)
            if self._closer is not None:
                self._close(self._closer, step.keyframe)
        self._kept.add_step(step, self._T_map_odom)

    def _add(self, keyframe: Keyframe, step: OdometryStep) -> None:
        if step.relative_pose is None:
            self._graph.add_first(keyframe, T_map_lidar=self._T_map_odom @ step.T_odom_lidar)
        else:
            self._graph.add_next(keyframe, step.relative_pose)
        self._kept.add_keyframe(step)
        self._T_map_odom = self._causal.update() @ se3.inverse(step.T_odom_lidar)

    def _close(self, closer: LoopCloser, keyframe: Keyframe) -> None:
        """Loops that the newest keyframe brings; the estimate moves at once."""
        with self._kept.clock.of("loops"):
            loops = closer.add(keyframe, self._kept.edges[-1], self._T_map_odom @ keyframe.T_odom_lidar)
        if not loops:
            return
        with self._kept.clock.of("graph_online"):
            for loop in loops:
                self._graph.add_loop(loop)
            self._T_map_odom = self._causal.update() @ se3.inverse(keyframe.T_odom_lidar)
            closer.follow(self._causal.poses())

    def _smoothed(self) -> Localization:
        clock = self._kept.clock
        with clock.of("graph_batch"):
            solution = solve(self._graph)
        counts = counts_of(self._front_end)
        if self._closer is None:
            return self._kept.told(solution, counts=counts)
        with clock.of("loops"):
            self._closer.revisit(solution.poses)
            self._graph.replace_loops(self._closer.keep_consistent())
        with clock.of("graph_batch"):
            solution = solve(self._graph)
        fixes = self._closer.fixes(solution.poses)
        return self._kept.told(solution, counts=counts, loops=tuple(self._closer.loops), fixes=fixes)
