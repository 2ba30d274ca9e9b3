"""What a method works on and what it gives."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from mineloc.data import F64, Calibration, Fix, ImuSamples, Keyframe, OdometryStep, RelativePose, Sweep, Trajectory


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
        smoothed, online: `T_map_lidar`, one pose a sweep; `online` as known at that time, from where the flight was
            found in the map on.
        steps: what the front end said, one a sweep, without keyframe points.
        keyframes: nodes of the graph; `keyframe_poses` (k, 4, 4) their smoothed `T_map_lidar`, `covariances`
            (k, 6, 6) `[rotation, translation]`, right perturbation.
        edges: what leads to each keyframe, None for the first.
        loops: closures that the smoothed estimate rests on.
        fixes: recognitions, accepted or refused.
        counts: what the front end counted, by name.
        seconds: by module, one entry a call.
        in_map: False where a flight never found itself in the map: then all poses are in a frame of its own.
        start_off_m: how far from the start that was told it began, where the map refuted that start; else None.
    """

    smoothed: Trajectory
    online: Trajectory
    steps: Sequence[OdometryStep]
    keyframes: Sequence[Keyframe]
    edges: Sequence[RelativePose | None]
    keyframe_poses: F64
    covariances: F64
    loops: Sequence[RelativePose]
    fixes: Sequence[Fix]
    counts: Mapping[str, int]
    seconds: dict[str, list[float]]
    in_map: bool = True
    start_off_m: float | None = None


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


def settled(steps: Iterable[tuple[Sweep, ImuSamples]], *, first_s: float) -> Generator[tuple[Sweep, ImuSamples]]:
    """The same steps, but the first one has the inertial samples of the first `first_s` seconds.

    A drone stands for a moment before it takes off, and a second of gravity levels it five times better than the tenth
    of a second of one sweep. So the first poses of a flight are known a second later than the others.
    """
    source = iter(steps)
    held: list[tuple[Sweep, ImuSamples]] = []
    for item in source:
        held.append(item)
        if item[0].end_ns - held[0][0].stamp_ns >= first_s * 1e9:
            break
    if held:
        parts = [imu for _, imu in held]
        held[0] = (held[0][0], _joined(parts))
    yield from held
    yield from source


def _joined(parts: Sequence[ImuSamples]) -> ImuSamples:
    stamps = np.concatenate([part.stamps_ns for part in parts])
    rows = np.concatenate([[True], np.diff(stamps) > 0]) if len(stamps) else np.zeros(0, np.bool_)
    gyro, accel = (np.concatenate([getattr(part, name) for part in parts]) for name in ("gyro_radps", "accel_mps2"))
    return ImuSamples(stamps[rows], gyro[rows], accel[rows])


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
