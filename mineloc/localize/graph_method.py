"""The methods that estimate from the flight alone: a front end, gravity, loop closures, the graph that holds them."""

from __future__ import annotations

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, Keyframe, OdometryStep, RelativePose, Trajectory
from mineloc.graph.batch import solve
from mineloc.graph.causal import CausalEstimate
from mineloc.graph.pose_graph import PoseGraph
from mineloc.graph.spread import spread
from mineloc.localize.flown import counts_of, first_origin, front_end_steps, without_points
from mineloc.localize.localization import Clock, FlightData, Localization
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
        self._clock = Clock()
        self._steps: list[OdometryStep] = []
        self._keyframes: list[Keyframe] = []
        self._edges: list[RelativePose | None] = []
        self._online: list[F64] = []
        self._T_map_odom: F64 = np.eye(4)  # as known now

    def run(self, flight: FlightData, progress: Progress) -> Localization:
        """Every sweep through the front end, every keyframe into the graph, then all at once.

        Raises:
            FlightError: fewer than two sweeps, none with points, or time goes backwards.
        """
        steps = front_end_steps(self._front_end, flight, self._config, clock=self._clock, progress=progress)
        for step in steps:
            self._follow(step, flight.calibration.T_body_lidar)
        return self._smoothed()

    def _follow(self, step: OdometryStep, T_body_lidar: F64) -> None:
        """Grow the graph by a keyframe, and place the sweep with what is known now."""
        if not self._steps:
            self._T_map_odom = first_origin(step, T_body_lidar)
        if step.keyframe is not None:
            with self._clock.of("graph_online"):
                self._add(step.keyframe, step)
            if self._closer is not None:
                self._close(self._closer, step.keyframe)
        self._online.append(self._T_map_odom @ step.T_odom_lidar)
        self._steps.append(without_points(step))

    def _add(self, keyframe: Keyframe, step: OdometryStep) -> None:
        if step.relative_pose is None:
            self._graph.add_first(keyframe, T_map_lidar=self._T_map_odom @ step.T_odom_lidar)
        else:
            self._graph.add_next(keyframe, step.relative_pose)
        self._keyframes.append(keyframe)
        self._edges.append(step.relative_pose)
        self._T_map_odom = self._causal.update() @ se3.inverse(step.T_odom_lidar)

    def _close(self, closer: LoopCloser, keyframe: Keyframe) -> None:
        """Loops that the newest keyframe brings; the estimate moves at once."""
        with self._clock.of("loops"):
            loops = closer.add(keyframe, self._edges[-1], self._T_map_odom @ keyframe.T_odom_lidar)
        if not loops:
            return
        with self._clock.of("graph_online"):
            for loop in loops:
                self._graph.add_loop(loop)
            self._T_map_odom = self._causal.update() @ se3.inverse(keyframe.T_odom_lidar)
            closer.follow(self._causal.poses())

    def _smoothed(self) -> Localization:
        with self._clock.of("graph_batch"):
            solution = solve(self._graph)
        if self._closer is not None:
            with self._clock.of("loops"):
                self._closer.revisit(solution.poses)
                self._graph.replace_loops(self._closer.keep_consistent())
            with self._clock.of("graph_batch"):
                solution = solve(self._graph)
        stamps = np.array([step.stamp_ns for step in self._steps])
        odometry = Trajectory(stamps, np.stack([s.T_odom_lidar for s in self._steps]), parent="odom", child="lidar")
        smoothed = spread(odometry, np.array([k.stamp_ns for k in self._keyframes]), solution.poses)
        return Localization(
            smoothed=smoothed,
            online=Trajectory(stamps, np.stack(self._online), child="lidar"),
            steps=self._steps,
            keyframes=self._keyframes,
            edges=self._edges,
            keyframe_poses=solution.poses,
            covariances=solution.covariances,
            loops=() if self._closer is None else tuple(self._closer.loops),
            fixes=() if self._closer is None else self._closer.fixes(solution.poses),
            counts=counts_of(self._front_end),
            seconds=dict(self._clock.seconds),
        )
