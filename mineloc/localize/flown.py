"""A flight through a front end: its steps, one after the other, and what is kept of them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, I64, Keyframe, OdometryStep, RelativePose, Trajectory
from mineloc.errors import FlightError
from mineloc.localize.localization import Clock, FlightData, levelled_origin, settled
from mineloc.odometry.front_end import FrontEnd
from mineloc.progress import Progress
from mineloc.sweep.range_filter import within_range

Watch = Callable[[OdometryStep], None]
"""Is shown every step of the front end, with its points."""


def front_end_steps(
    front_end: FrontEnd,
    flight: FlightData,
    config: Config,
    *,
    clock: Clock,
    progress: Progress,
    watch: Watch | None = None,
) -> Generator[OdometryStep]:
    """Every sweep of a flight through a front end.

    Raises:
        FlightError: fewer than two sweeps, none with points, or time going backwards.
    """
    count, keyframes = 0, 0
    for sweep, imu in clock.waiting(settled(flight.steps, first_s=config.odometry.settle_s)):
        with clock.of("odometry"):
            step = front_end.step(within_range(sweep, config.sweep), imu)
        if watch is not None:
            with clock.of("watch"):
                watch(step)
        yield step
        count, keyframes = count + 1, keyframes + (step.keyframe is not None)
        progress(count, None, "sweeps")
    if count < 2:
        raise FlightError("localize", f"{count} sweeps", expected="at least two", todo="check that the LiDAR was on")
    if not keyframes:
        raise FlightError(
            "localize", "no sweep has points", expected="LiDAR returns", todo="check the ranges and the sensor"
        )


def first_origin(step: OdometryStep, T_body_lidar: F64) -> F64:
    """`T_map_odom` from a flight's first step: the levelled body there is the map's origin."""
    up_is_known = step.keyframe is not None and step.keyframe.up_lidar is not None
    return levelled_origin(step.T_odom_lidar @ se3.inverse(T_body_lidar), up_is_known=up_is_known)


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """A flight by its front end alone.

    Attributes:
        steps: one a sweep, without points.
        keyframes, edges: nodes and what leads to each, None for the first.
        T_map_odom: (4, 4) the levelled start.
        counts: what the front end counted, by name.
        clock: seconds by module.
    """

    steps: Sequence[OdometryStep]
    keyframes: Sequence[Keyframe]
    edges: Sequence[RelativePose | None]
    T_map_odom: F64
    counts: Mapping[str, int]
    clock: Clock

    @property
    def odometry(self) -> Trajectory:
        """`T_odom_lidar`, one pose a sweep."""
        stamps = np.array([step.stamp_ns for step in self.steps])
        return Trajectory(stamps, np.stack([s.T_odom_lidar for s in self.steps]), parent="odom", child="lidar")

    @property
    def keyframe_stamps_ns(self) -> I64:
        """(k,) int64."""
        return np.array([keyframe.stamp_ns for keyframe in self.keyframes])

    @property
    def keyframe_poses(self) -> F64:
        """(k, 4, 4) `T_map_lidar` by odometry alone."""
        return se3.rigid(self.T_map_odom @ np.array([keyframe.T_odom_lidar for keyframe in self.keyframes]))


def fly(
    front_end: FrontEnd, flight: FlightData, config: Config, *, progress: Progress, watch: Watch | None = None
) -> Flown:
    """Run a front end over a whole flight.

    Raises:
        FlightError: as `front_end_steps`.
    """
    clock = Clock()
    steps: list[OdometryStep] = []
    keyframes: list[Keyframe] = []
    edges: list[RelativePose | None] = []
    T_map_odom = np.eye(4)
    for step in front_end_steps(front_end, flight, config, clock=clock, progress=progress, watch=watch):
        if not steps:
            T_map_odom = first_origin(step, flight.calibration.T_body_lidar)
        if step.keyframe is not None:
            keyframes.append(step.keyframe)
            edges.append(step.relative_pose)
        steps.append(without_points(step))
    return Flown(steps, keyframes, edges, T_map_odom, counts_of(front_end), clock)


def counts_of(front_end: FrontEnd) -> Mapping[str, int]:
    """What a front end counted, if it counts."""
    return dict(getattr(front_end, "counts", {}))


def without_points(step: OdometryStep) -> OdometryStep:
    """The step alone: the graph keeps the keyframes' points, and a flight has many more sweeps than keyframes."""
    return replace(step, keyframe=None, points_lidar=None)
