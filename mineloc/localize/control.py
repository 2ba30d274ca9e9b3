"""Survey control in the graph: sightings carried to keyframes, flights placed in the mine grid, factors made of both.

The graph works in `local`, the mine grid less a recorded origin in whole kilometres, so that nothing loses its
millimetres in float32 or in a solver. Only control points become factors; check points are carried too, for the
residual table alone. It takes two rounds: `place_in_grid` before the graph is solved, when odometry has drifted and
only what no drift explains is left out; `judge` after it, when a gross error stands out by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mineloc import se3
from mineloc.config import ControlConfig, GraphConfig
from mineloc.data import F64, I64, Bool, ControlPoint, Observation, Trajectory
from mineloc.data.checks import freeze, need
from mineloc.graph.measurements import PointFix
from mineloc.graph.noise import anchor_covariance
from mineloc.localize.sightings import FlownPoses, Sighting, Unused, carry_to_keyframes
from mineloc.mapping.control import MEDIAN_NORM, ControlTable, control_table
from mineloc.mapping.grid_placement import GridPlacement, Sightings, find_grid


@dataclass(frozen=True, slots=True, eq=False)
class FlightPlacement:
    """Where one flight lies.

    Attributes:
        T_local_map: (4, 4) from the map frame of its poses, None when control does not tell.
        reason: why not; empty otherwise.
        anchor_covariance: (6, 6) of its first keyframe, loose: the control points decide. None without a placement.
        found: how the targets agreed, of all flights that share its map frame.
    """

    T_local_map: F64 | None
    reason: str
    anchor_covariance: F64 | None
    found: GridPlacement


@dataclass(frozen=True, slots=True, eq=False)
class GridReference:
    """All that control says.

    Attributes:
        points: the survey.
        origin_grid: (3,) origin of `local` in the mine grid.
        sightings: observations at keyframes, of control and check points.
        left_out: (n,) sightings of control points that are gross errors; they make no factor.
        unused: observations that no keyframe could take, and why.
        placements: one a flight.
        config: what it was made with.
    """

    points: tuple[ControlPoint, ...]
    origin_grid: F64
    sightings: tuple[Sighting, ...]
    left_out: Bool
    unused: tuple[Unused, ...]
    placements: tuple[FlightPlacement, ...]
    config: ControlConfig = field(default_factory=ControlConfig)

    def __post_init__(self) -> None:
        need(self.left_out.shape == (len(self.sightings),), "left_out must have one value a sighting")
        freeze(self)

    @property
    def surveyed_local(self) -> F64:
        """(m, 3) the survey in the local frame."""
        return np.array([point.position_grid - self.origin_grid for point in self.points])

    @property
    def misfits(self) -> tuple[str, ...]:
        """Names of the control points most of whose sightings are left out."""
        target = self._targets()
        gone = np.bincount(target[self.left_out], minlength=len(self.points))
        return tuple(p.name for k, p in enumerate(self.points) if gone[k] and 2 * gone[k] > int((target == k).sum()))

    def point_fixes(self) -> list[PointFix]:
        """The factors: control points alone, without what is left out.

        Every factor takes its share of the survey's error: that of a target is the same in all its sightings, and n
        factors with n times its variance know no more together than it allows.
        """
        used = np.array([self.points[s.point].role == "control" for s in self.sightings], np.bool_) & ~self.left_out
        counts = np.bincount(self._targets()[used], minlength=len(self.points))
        local = self.surveyed_local
        fixes: list[PointFix] = []
        for sighting in (s for s, is_used in zip(self.sightings, used, strict=True) if is_used):
            survey = self.points[sighting.point].covariance_grid * counts[sighting.point]
            seen = _turned(sighting, self.placements[sighting.flight].T_local_map)
            fixes.append(PointFix(sighting.keyframe, local[sighting.point], sighting.point_lidar, seen + survey))
        return fixes

    def seen_local(self, poses: F64) -> F64:
        """(n, 3) where the sightings lie when the keyframes of the graph are at `poses` (k, 4, 4) `T_local_lidar`."""
        rows = np.array([s.keyframe for s in self.sightings], np.int64)
        points = np.array([s.point_lidar for s in self.sightings]).reshape(-1, 3)
        return np.einsum("nij,nj->ni", poses[rows, :3, :3], points) + poses[rows, :3, 3]

    def _targets(self) -> I64:
        return np.array([s.point for s in self.sightings], np.int64)


def place_in_grid(
    points: Sequence[ControlPoint],
    observations: Sequence[Observation],
    flights: Sequence[FlownPoses],
    *,
    config: ControlConfig,
    graph: GraphConfig,
) -> GridReference:
    """Carry the observations to keyframes and place every flight that sees enough of them.

    Flights that share a map frame are placed together. What is farther from its target than odometry can have drifted
    is left out from the beginning.

    Args:
        points: the survey, at least one target.
        observations: of its targets.
        flights: with the best poses that there are, levelled; odometry will do.
        config: gates.
        graph: noise of anchors.

    Raises:
        ValueError: no targets, or an observation of one that is not surveyed.
    """
    need(bool(points), "a survey has targets")
    sightings, unused = carry_to_keyframes(points, observations, flights, config)
    origin = local_origin(points, step_m=config.origin_step_m)
    left_out = np.zeros(len(sightings), np.bool_)
    placements: dict[int, FlightPlacement] = {}
    for members in _frames(flights):
        rows = [k for k, s in enumerate(sightings) if s.flight in members and points[s.point].role == "control"]
        seen = _seen_in_map(points, origin, [sightings[k] for k in rows], flights)
        most_m = config.gate_m + config.drift * sum(_flown_m(flights[m].odometry) for m in members)
        found = find_grid(seen, gate_m=config.gate_m, most_m=most_m, min_separation_m=config.min_separation_m)
        if found.T_grid_map is not None:
            left_out[rows] = _away_m(seen, found.T_grid_map) > most_m
        for member in members:
            placements[member] = _placement(found, flights[member], config, graph)
    return GridReference(
        points=tuple(points),
        origin_grid=origin,
        sightings=sightings,
        left_out=left_out,
        unused=unused,
        placements=tuple(placements[k] for k in range(len(flights))),
        config=config,
    )


def judge(reference: GridReference, poses: F64) -> GridReference:
    """Leave out what a solved graph contradicts, take back what it confirms.

    A sighting is left out when it is farther from its target than `outlier_sigmas` of what its own error and the
    survey's allow, and than so many of what the others show.

    Args:
        reference: whose point fixes were in the graph.
        poses: (k, 4, 4) `T_local_lidar` of its keyframes.
    """
    target = np.array([s.point for s in reference.sightings], np.int64)
    is_control = np.array([point.role == "control" for point in reference.points], np.bool_)[target]
    if not is_control.any():
        return reference
    away_m = np.linalg.norm(reference.seen_local(poses) - reference.surveyed_local[target], axis=1)
    survey = np.array([np.trace(point.covariance_grid) / 3.0 for point in reference.points])
    expected_m = np.sqrt(np.array([s.sigma_m for s in reference.sightings]) ** 2 + survey[target])
    usual_m = float(np.median(away_m[is_control])) / MEDIAN_NORM
    limit_m = reference.config.outlier_sigmas * np.maximum(expected_m, usual_m)
    return replace(reference, left_out=is_control & (away_m > limit_m))


def residuals(reference: GridReference, poses: F64) -> ControlTable:
    """The residual table of a finished map.

    Args:
        reference: after `judge`.
        poses: (k, 4, 4) `T_local_lidar` of the keyframes of the graph.
    """
    return control_table(
        reference.points,
        np.array([s.point for s in reference.sightings], np.int64),
        reference.seen_local(poses) + reference.origin_grid,
        np.array([s.sigma_m for s in reference.sightings]),
        outlier_sigmas=reference.config.outlier_sigmas,
        gross_m=reference.config.gate_m,
        outliers=reference.misfits,
    )


def graph_with_control(graph: GraphConfig, config: ControlConfig) -> GraphConfig:
    """How a graph with control points is configured: gravity is believed much less.

    An accelerometer's bias tilts "up" by the same tenths of a degree in all keyframes. A thousand factors that each
    claim an error of their own hold that tilt against the targets, and the map sags between them.
    """
    sigma_deg = max(graph.gravity_sigma_deg, config.gravity_sigma_deg)
    return graph.model_copy(update={"gravity_sigma_deg": sigma_deg})


def local_origin(points: Sequence[ControlPoint], *, step_m: float) -> F64:
    """(3,) multiples of `step_m` below the middle of the survey: it depends on no flight."""
    middle = np.mean([point.position_grid for point in points], axis=0)
    return np.floor(middle / step_m) * step_m


def _frames(flights: Sequence[FlownPoses]) -> list[list[int]]:
    """Flights by map frame; without a name for it each has its own."""
    groups: dict[str | int, list[int]] = {}
    for k, flight in enumerate(flights):
        groups.setdefault(flight.frame or k, []).append(k)
    return list(groups.values())


def _seen_in_map(
    points: Sequence[ControlPoint], origin: F64, sightings: Sequence[Sighting], flights: Sequence[FlownPoses]
) -> Sightings:
    """Sightings of control points where the poses put them, the survey in `local`."""
    placed = [se3.apply(flights[s.flight].pose_of(s.keyframe), s.point_lidar[None])[0] for s in sightings]
    return Sightings(
        names=[point.name for point in points],
        surveyed_grid=np.array([point.position_grid - origin for point in points]),
        target=np.array([s.point for s in sightings], np.int64),
        points_map=np.array(placed).reshape(-1, 3),
    )


def _away_m(seen: Sightings, T_local_map: F64) -> F64:
    return np.linalg.norm(se3.apply(T_local_map, seen.points_map) - seen.surveyed_grid[seen.target], axis=1)


def _flown_m(odometry: Trajectory) -> float:
    return float(odometry.path_m[-1])


def _placement(found: GridPlacement, flight: FlownPoses, config: ControlConfig, graph: GraphConfig) -> FlightPlacement:
    if found.T_grid_map is None:
        return FlightPlacement(None, found.reason, None, found)
    loose = graph.model_copy(update={"anchor_m": config.anchor_m, "anchor_yaw_deg": config.anchor_yaw_deg})
    return FlightPlacement(found.T_grid_map, "", anchor_covariance(found.T_grid_map @ flight.poses[0], loose), found)


def _turned(sighting: Sighting, T_local_map: F64 | None) -> F64:
    """(3, 3) covariance of a sighting in the local frame; as bad as its worst direction where the heading is open."""
    if T_local_map is None:
        return np.eye(3) * float(np.linalg.eigvalsh(sighting.covariance_lidar)[-1])
    r = (T_local_map @ sighting.T_map_lidar)[:3, :3]
    return r @ sighting.covariance_lidar @ r.T
