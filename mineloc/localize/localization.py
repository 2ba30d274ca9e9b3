"""What a method works on and what it gives."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from mineloc.data import F64, Calibration, Fix, ImuSamples, Keyframe, OdometryStep, Sweep, Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class FlightData:
    """A flight as a method sees it: one pass over the sweeps.

    Attributes:
        steps: each sweep with its inertial samples, as `io.flight_reader.FlightReader.steps` gives them.
        calibration: where the sensors sit.
    """

    steps: Iterable[tuple[Sweep, ImuSamples]]
    calibration: Calibration


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """The answer of a method.

    Attributes:
        smoothed, online: `T_map_lidar`, one pose a sweep; `online` as known at that time.
        steps: what the front end said, one a sweep, without keyframe points.
        keyframes: nodes of the graph; `keyframe_poses` (k, 4, 4) their smoothed `T_map_lidar`, `covariances`
            (k, 6, 6) `[rotation, translation]`, right perturbation.
        fixes: recognitions, accepted or refused.
        seconds: by module, one entry a call.
    """

    smoothed: Trajectory
    online: Trajectory
    steps: Sequence[OdometryStep]
    keyframes: Sequence[Keyframe]
    keyframe_poses: F64
    covariances: F64
    fixes: Sequence[Fix]
    seconds: dict[str, list[float]]


@dataclass(slots=True)
class Clock:
    """Adds up the time of named modules."""

    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list[float]))

    @contextmanager
    def of(self, module: str) -> Generator[None]:
        """Time a block."""
        start = perf_counter()
        yield
        self.seconds[module].append(perf_counter() - start)

    def waiting(self, steps: Iterable[tuple[Sweep, ImuSamples]]) -> Generator[tuple[Sweep, ImuSamples]]:
        """The same steps; the time until each one comes counts as `read`."""
        source = iter(steps)
        while True:
            start = perf_counter()
            item = next(source, None)
            if item is None:
                return
            self.seconds["read"].append(perf_counter() - start)
            yield item


def levelled_origin(T_odom_body: F64, *, up_is_known: bool) -> F64:
    """`T_map_odom` that puts the first body pose at the origin with heading zero.

    Args:
        T_odom_body: (4, 4) of the first sweep.
        up_is_known: z of odom is up, so roll and pitch stay; otherwise the drone counts as level at its start.
    """
    T = np.eye(4)
    if up_is_known:
        x, y = T_odom_body[0, 0], T_odom_body[1, 0]
        yaw = np.arctan2(y, x)
        T[:2, :2] = [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
    else:
        T[:3, :3] = T_odom_body[:3, :3].T
    T[:3, 3] = -T[:3, :3] @ T_odom_body[:3, 3]
    return T
