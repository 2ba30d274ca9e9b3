"""What a method keeps of a flight while it runs, and the answer made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mineloc.data import F64, Fix, Keyframe, OdometryStep, RelativePose, Trajectory
from mineloc.graph.batch import Solution
from mineloc.graph.spread import spread
from mineloc.localize.flown import without_points
from mineloc.localize.localization import Clock, Localization

POINTS_A_KEYFRAME = 250
"""Enough to draw the mine; the map of a survey comes from `reconstruct`."""


@dataclass(slots=True, eq=False)
class Kept:
    """Steps, keyframes and online poses so far.

    Attributes:
        clock: seconds by module.
        steps: one a sweep, without points.
        keyframes, edges: nodes and what leads to each, None for the first.
        online: (4, 4) `T_map_lidar` of each sweep as known at the time, from the `online_from`-th on.
    """

    clock: Clock = field(default_factory=Clock)
    steps: list[OdometryStep] = field(default_factory=list[OdometryStep])
    keyframes: list[Keyframe] = field(default_factory=list[Keyframe])
    edges: list[RelativePose | None] = field(default_factory=list[RelativePose | None])
    online: list[F64] = field(default_factory=list[F64])
    online_from: int = 0

    def add_keyframe(self, step: OdometryStep) -> Keyframe:
        """Keep the keyframe of a step, which has one, with the points that will be drawn; it itself."""
        assert step.keyframe is not None
        self.keyframes.append(drawn(step.keyframe))
        self.edges.append(step.relative_pose)
        return step.keyframe

    def add_step(self, step: OdometryStep, T_map_odom: F64) -> None:
        """Keep a step and where it puts the drone with what is known now."""
        self.online.append(T_map_odom @ step.T_odom_lidar)
        self.steps.append(without_points(step))

    def forget_online(self) -> None:
        """Where the drone was told to be so far was not in the map."""
        self.online.clear()
        self.online_from = len(self.steps)

    def told(
        self,
        solution: Solution,
        *,
        counts: Mapping[str, int],
        loops: Sequence[RelativePose] = (),
        fixes: Sequence[Fix] = (),
        in_map: bool = True,
        start_off_m: float | None = None,
    ) -> Localization:
        """The answer: the smoothed keyframes spread over all sweeps."""
        stamps = np.array([step.stamp_ns for step in self.steps])
        odometry = Trajectory(stamps, np.stack([s.T_odom_lidar for s in self.steps]), parent="odom", child="lidar")
        return Localization(
            smoothed=spread(odometry, np.array([k.stamp_ns for k in self.keyframes]), solution.poses),
            online=Trajectory(stamps[self.online_from :], np.stack(self.online), child="lidar"),
            steps=self.steps,
            keyframes=self.keyframes,
            edges=self.edges,
            keyframe_poses=solution.poses,
            covariances=solution.covariances,
            loops=loops,
            fixes=fixes,
            counts=counts,
            seconds=dict(self.clock.seconds),
            in_map=in_map,
            start_off_m=start_off_m,
        )


def drawn(keyframe: Keyframe) -> Keyframe:
    """With `POINTS_A_KEYFRAME` of its points, evenly through the cloud: the same ones on every run."""
    n = len(keyframe.points_lidar)
    pick = np.unique(np.linspace(0, n - 1, min(n, POINTS_A_KEYFRAME)).astype(np.int64))
    return replace(keyframe, points_lidar=keyframe.points_lidar[pick])
