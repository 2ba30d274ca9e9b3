"""Methods without absolute information: a front end, gravity, and the graph that holds both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, Keyframe, OdometryStep, Trajectory
from mineloc.errors import FlightError
from mineloc.graph.batch import solve
from mineloc.graph.causal import CausalEstimate
from mineloc.graph.pose_graph import PoseGraph
from mineloc.graph.spread import spread
from mineloc.localize.localization import Clock, FlightData, Localization, levelled_origin, settled
from mineloc.odometry.front_end import FrontEnd
from mineloc.progress import Progress
from mineloc.sweep.range_filter import within_range


class RelativeMethod:
    """Odometry, keyframes, relative pose factors (paper A, eq. 8-19), gravity; smoothed and causal.

    Args:
        config: of all sections that a method reads.
        front_end: turns sweeps into poses.
    """

    def __init__(self, config: Config, front_end: FrontEnd) -> None:
        self._config, self._front_end = config, front_end
        self._graph = PoseGraph(config.graph)
        self._causal = CausalEstimate(self._graph)
        self._clock = Clock()
        self._steps: list[OdometryStep] = []
        self._keyframes: list[Keyframe] = []
        self._online: list[F64] = []
        self._T_map_odom: F64 = np.eye(4)  # as known now

    def run(self, flight: FlightData, progress: Progress) -> Localization:
        """Every sweep through the front end, every keyframe into the graph, then all at once.

        Raises:
            FlightError: fewer than two sweeps, or time goes backwards.
        """
        steps = settled(flight.steps, first_s=self._config.odometry.settle_s)
        for sweep, imu in self._clock.waiting(steps):
            with self._clock.of("odometry"):
                step = self._front_end.step(within_range(sweep, self._config.sweep), imu)
            with self._clock.of("graph_online"):
                self._follow(step, flight.calibration.T_body_lidar)
            progress(len(self._steps), None, "sweeps")
        if len(self._steps) < 2:
            raise FlightError(
                "localize", f"{len(self._steps)} sweeps", expected="at least two", todo="check that the LiDAR was on"
            )
        return self._smoothed()

    def _follow(self, step: OdometryStep, T_body_lidar: F64) -> None:
        """Grow the graph by a keyframe, and place the sweep with what is known now."""
        if not self._steps:
            up_is_known = step.keyframe is not None and step.keyframe.up_lidar is not None
            T_odom_body = step.T_odom_lidar @ se3.inverse(T_body_lidar)
            self._T_map_odom = levelled_origin(T_odom_body, up_is_known=up_is_known)
        if step.keyframe is not None:
            self._add(step)
            self._T_map_odom = self._causal.update() @ se3.inverse(step.T_odom_lidar)
            self._keyframes.append(step.keyframe)
            # the graph keeps the points; a flight has many more sweeps than keyframes
            step = replace(step, keyframe=None)
        self._online.append(self._T_map_odom @ step.T_odom_lidar)
        self._steps.append(step)

    def _add(self, step: OdometryStep) -> None:
        assert step.keyframe is not None
        if step.relative_pose is None:
            self._graph.add_first(step.keyframe, T_map_lidar=self._T_map_odom @ step.T_odom_lidar)
        else:
            self._graph.add_next(step.keyframe, step.relative_pose)

    def _smoothed(self) -> Localization:
        if not self._keyframes:
            raise FlightError(
                "localize", "no sweep has points", expected="LiDAR returns", todo="check the ranges and the sensor"
            )
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
            keyframe_poses=solution.poses,
            covariances=solution.covariances,
            fixes=(),
            seconds=dict(self._clock.seconds),
        )
