"""Observations of surveyed targets, carried from the time of the observation to a keyframe of the graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import ControlConfig
from mineloc.data import F64, I64, ControlPoint, Observation, Trajectory
from mineloc.data.checks import freeze, need

_LONGEST_GAP_NS = 500_000_000  # odometry is not interpolated over longer ones


@dataclass(frozen=True, slots=True, eq=False)
class FlownPoses:
    """A flight as far as control is concerned.

    Attributes:
        flight: its name.
        odometry: `T_odom_lidar`, one pose a sweep.
        stamps_ns: (k,) of its keyframes, each of them a sweep.
        poses: (k, 4, 4) `T_map_lidar` of the keyframes, as well as they are known; the map is levelled.
        first: index of its first keyframe in the graph.
        frame: flights whose poses are in one map frame have the same name for it; empty: its own.
    """

    flight: str
    odometry: Trajectory
    stamps_ns: I64
    poses: F64
    first: int = 0
    frame: str = ""

    def __post_init__(self) -> None:
        need(len(self.stamps_ns) > 0, "a flight has keyframes")
        need(self.poses.shape == (len(self.stamps_ns), 4, 4), "one pose a keyframe")
        need(bool(np.isin(self.stamps_ns, self.odometry.stamps_ns).all()), "every keyframe must be a sweep")
        need(bool((np.diff(self.stamps_ns) > 0).all()), "keyframes in rising order")
        freeze(self)

    def pose_of(self, keyframe: int) -> F64:
        """(4, 4) `T_map_lidar` of a keyframe by its index in the graph."""
        return self.poses[keyframe - self.first]


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """An observation as if it had been made at a keyframe.

    Attributes:
        observation: as it was made.
        point: index of its target in the survey.
        flight: index of its flight.
        keyframe: index in the graph.
        point_lidar: (3,) the target in the lidar frame of the keyframe.
        covariance_lidar: (3, 3) of that: the observation's own and what the way adds, metres².
        T_map_lidar: (4, 4) of the keyframe when it was carried.
    """

    observation: Observation
    point: int
    flight: int
    keyframe: int
    point_lidar: F64
    covariance_lidar: F64
    T_map_lidar: F64

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of one coordinate, the mean of all directions."""
        return float(np.sqrt(np.trace(self.covariance_lidar) / 3.0))


@dataclass(frozen=True, slots=True, eq=False)
class Unused:
    """An observation that no keyframe could take.

    Attributes:
        observation: it.
        reason: why.
    """

    observation: Observation
    reason: str


def carry_to_keyframes(
    points: Sequence[ControlPoint],
    observations: Sequence[Observation],
    flights: Sequence[FlownPoses],
    config: ControlConfig,
) -> tuple[tuple[Sighting, ...], tuple[Unused, ...]]:
    """Each observation at the keyframe from which it is the shortest way, by the odometry between.

    Raises:
        ValueError: an observation of a target that is not surveyed.
    """
    index = {point.name: k for k, point in enumerate(points)}
    strange = [o.target for o in observations if o.target not in index]
    need(not strange, f"observations of targets that are not surveyed: {', '.join(strange[:3])}")
    of_flight: dict[int, list[Observation]] = {}
    unused: list[Unused] = []
    for observation in observations:
        flight, reason = _flight_of(observation, flights)
        if flight is None:
            unused.append(Unused(observation, reason))
        else:
            of_flight.setdefault(flight, []).append(observation)
    out: list[Sighting] = []
    for flight, ones in sorted(of_flight.items()):
        out += _carried(ones, [index[o.target] for o in ones], flight, flights[flight], config)
    return tuple(out), tuple(unused)


def _flight_of(observation: Observation, flights: Sequence[FlownPoses]) -> tuple[int | None, str]:
    named = [k for k, f in enumerate(flights) if not observation.flight or f.flight == observation.flight]
    if not named:
        return None, f"flight {observation.flight!r} is not among them"
    t = observation.stamp_ns
    spans = [k for k in named if flights[k].odometry.stamps_ns[0] <= t <= flights[k].odometry.stamps_ns[-1]]
    if not spans:
        return None, f"no sweeps at {t} ns: {_how_far(t, [flights[k].odometry for k in named])}"
    if len(spans) > 1:
        return None, f"{len(spans)} flights were in the air at {t} ns: name one"
    stamps = flights[spans[0]].odometry.stamps_ns
    after = int(np.searchsorted(stamps, t, side="left"))
    gap_ns = int(stamps[after] - stamps[max(after - 1, 0)]) if stamps[after] != t else 0
    if gap_ns > _LONGEST_GAP_NS:
        return None, f"odometry has a gap of {gap_ns * 1e-9:.1f} s at {t} ns"
    return spans[0], ""


def _how_far(stamp_ns: int, trajectories: Sequence[Trajectory]) -> str:
    first, last = min(int(t.stamps_ns[0]) for t in trajectories), max(int(t.stamps_ns[-1]) for t in trajectories)
    if stamp_ns < first:
        return f"{(first - stamp_ns) * 1e-9:.3f} s before the first"
    return f"{(stamp_ns - last) * 1e-9:.3f} s after the last" if stamp_ns > last else "between two flights"


def _carried(
    observations: Sequence[Observation], targets: Sequence[int], flight: int, flown: FlownPoses, config: ControlConfig
) -> list[Sighting]:
    stamps = np.array([o.stamp_ns for o in observations], np.int64)
    T_odom_seen = flown.odometry.at(stamps)
    keys = flown.odometry.poses[np.searchsorted(flown.odometry.stamps_ns, flown.stamps_ns)]
    after = np.clip(np.searchsorted(flown.stamps_ns, stamps), 0, len(keys) - 1)
    before = np.maximum(after - 1, 0)
    out: list[Sighting] = []
    for k, observation in enumerate(observations):
        ways = [(row, se3.inverse(keys[row]) @ T_odom_seen[k]) for row in (int(before[k]), int(after[k]))]
        row, T_key_seen = min(ways, key=lambda way: _way_variance(way[1], observation, config))
        r = T_key_seen[:3, :3]
        way = np.eye(3) * _way_variance(T_key_seen, observation, config)
        out.append(
            Sighting(
                observation=observation,
                point=targets[k],
                flight=flight,
                keyframe=flown.first + row,
                point_lidar=se3.apply(T_key_seen, observation.point_lidar[None])[0],
                covariance_lidar=r @ observation.covariance_lidar @ r.T + way,
                T_map_lidar=flown.poses[row],
            )
        )
    return out


def _way_variance(T_key_seen: F64, observation: Observation, config: ControlConfig) -> float:
    """What the odometry between adds to one axis, metres². None where the observation was made at the keyframe."""
    moved_m, turned = float(np.linalg.norm(T_key_seen[:3, 3])), float(se3.angle_rad(T_key_seen))
    if moved_m < 1e-9 and turned < 1e-9:
        return 0.0
    swing_m = np.radians(config.between_deg) * float(np.linalg.norm(observation.point_lidar))
    return (config.between * moved_m) ** 2 + swing_m**2
