"""From flown flights to one map frame: joined, closed, tied to survey control, smoothed (paper A, 1.9; paper B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, ControlPoint, Fix, Keyframe, Observation, RelativePose, Trajectory
from mineloc.errors import FlightError
from mineloc.graph.batch import Solution, solve
from mineloc.graph.pose_graph import PoseGraph
from mineloc.graph.spread import spread
from mineloc.localize.control import GridReference, graph_with_control, judge, place_in_grid, residuals
from mineloc.localize.flown import Flown
from mineloc.localize.loops import LoopCloser
from mineloc.localize.merging import join_flights
from mineloc.localize.sightings import FlownPoses
from mineloc.mapping.control import ControlTable


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """What a surveyor measured: targets, and where flights saw them."""

    points: Sequence[ControlPoint]
    observations: Sequence[Observation]


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """All flights in one frame.

    Attributes:
        origin_m: (3,) of the map frame in the mine grid; zero without control points.
        trajectories: `T_map_lidar` of each flight, one pose a sweep.
        keyframes: of each flight, with the index within it.
        poses: (k, 4, 4) `T_map_lidar` of each flight's keyframes.
        covariances: (k, 6, 6) of those, `[rotation, translation]`, right perturbation.
        loops: closures in the graph, keyframes counted through all flights.
        fixes: of each flight: every candidate for a closure, accepted or refused.
        control: residuals at the targets; None without survey.
        solution: of the graph.
    """

    origin_m: F64
    trajectories: Sequence[Trajectory]
    keyframes: Sequence[Sequence[Keyframe]]
    poses: Sequence[F64]
    covariances: Sequence[F64]
    loops: Sequence[RelativePose]
    fixes: Sequence[Sequence[Fix]]
    control: ControlTable | None
    solution: Solution


def reconstruct_flights(
    flights: Mapping[str, Flown],
    config: Config,
    *,
    closer: LoopCloser | None,
    survey: Survey | None = None,
) -> Reconstruction:
    """Join the flights in one frame, close loops within and between them, tie them to the survey, smooth all at once.

    Args:
        flights: by name, in the order of joining.
        config: sections `loops`, `graph`, `control`.
        closer: finds loop closures, new; None: odometry and control alone.
        survey: control points and observations.

    Raises:
        FlightError: flights that nothing joins, or control points that place none of them.
    """
    reference = None if survey is None else _placed_in_grid(flights, survey, config)
    places = join_flights(flights, config) if reference is None else _places(flights, reference)
    nodes = _nodes(list(flights.values()), places)
    loops = _closed(nodes, closer)
    graph = _graph(nodes, reference, config)
    graph.replace_loops(loops)
    if reference is not None:
        graph.replace_point_fixes(reference.point_fixes())
    solution = solve(graph)
    if closer is not None:
        closer.revisit(solution.poses)
        graph.replace_loops(closer.keep_consistent())
    if reference is not None:
        reference = judge(reference, solution.poses)
        graph.replace_point_fixes(reference.point_fixes())
    if closer is not None or reference is not None:
        solution = solve(graph)
    return _told(flights, solution, closer, reference)


@dataclass(frozen=True, slots=True, eq=False)
class _Node:
    """A keyframe counted through all flights, placed by odometry; `edge` is None where a flight begins."""

    keyframe: Keyframe
    edge: RelativePose | None


def _placed_in_grid(flights: Mapping[str, Flown], survey: Survey, config: Config) -> GridReference:
    flown: list[FlownPoses] = []
    first = 0
    for name, flight in flights.items():
        poses, stamps = flight.keyframe_poses, flight.keyframe_stamps_ns
        flown.append(FlownPoses(name, flight.odometry, stamps, poses, first=first))
        first += len(poses)
    reference = place_in_grid(survey.points, survey.observations, flown, config=config.control, graph=config.graph)
    for name, placement in zip(flights, reference.placements, strict=True):
        if placement.T_local_map is None:
            raise FlightError(
                name,
                f"control points do not place it: {placement.reason}",
                expected="at least two control points, seen well apart",
                todo="give more observations, or reconstruct without --control",
            )
    return reference


def _places(flights: Mapping[str, Flown], reference: GridReference) -> list[F64]:
    places = [placement.T_local_map for placement in reference.placements]
    return [
        place @ flight.T_map_odom for place, flight in zip(places, flights.values(), strict=True) if place is not None
    ]


def _nodes(flights: Sequence[Flown], places: Sequence[F64]) -> list[_Node]:
    """All keyframes in a row; `T_odom_lidar` of each is then in the common frame."""
    nodes: list[_Node] = []
    for flight, T_map_odom in zip(flights, places, strict=True):
        first = len(nodes)
        for keyframe, edge in zip(flight.keyframes, flight.edges, strict=True):
            placed = replace(
                keyframe,
                index=first + keyframe.index,
                T_odom_lidar=se3.rigid(T_map_odom @ keyframe.T_odom_lidar),
            )
            nodes.append(_Node(placed, None if edge is None else replace(edge, i=first + edge.i, j=first + edge.j)))
    return nodes


def _closed(nodes: Sequence[_Node], closer: LoopCloser | None) -> list[RelativePose]:
    """All loop closures of one pass; the estimate moves at each, so that the next search starts near."""
    if closer is None:
        return []
    moved = np.eye(4)
    for node in nodes:
        moved = np.eye(4) if node.edge is None else moved
        for loop in closer.add(node.keyframe, node.edge, moved @ node.keyframe.T_odom_lidar):
            T_odom_j = nodes[loop.j].keyframe.T_odom_lidar
            moved = se3.rigid(closer.pose(loop.i) @ loop.T_i_j @ se3.inverse(T_odom_j))
    return closer.loops


def _graph(nodes: Sequence[_Node], reference: GridReference | None, config: Config) -> PoseGraph:
    graph = PoseGraph(config.graph if reference is None else graph_with_control(config.graph, config.control))
    flight = 0
    for node in nodes:
        if node.edge is not None:
            graph.add_next(node.keyframe, node.edge)
            continue
        anchor = None if reference is None else reference.placements[flight].anchor_covariance
        if flight == 0:
            graph.add_first(node.keyframe, T_map_lidar=node.keyframe.T_odom_lidar, covariance=anchor)
        else:
            graph.add_another(node.keyframe, T_map_lidar=node.keyframe.T_odom_lidar, covariance=anchor)
        flight += 1
    return graph


def _told(
    flights: Mapping[str, Flown], solution: Solution, closer: LoopCloser | None, reference: GridReference | None
) -> Reconstruction:
    ends = np.cumsum([len(flight.keyframes) for flight in flights.values()])[:-1]
    poses, covariances = np.split(solution.poses, ends), np.split(solution.covariances, ends)
    trajectories = [
        spread(flight.odometry, flight.keyframe_stamps_ns, own)
        for flight, own in zip(flights.values(), poses, strict=True)
    ]
    fixes: list[list[Fix]] = [[] for _ in flights]
    for fix in () if closer is None else closer.fixes(solution.poses):
        flight = int(np.searchsorted(ends, fix.keyframe, side="right"))
        first = int(ends[flight - 1]) if flight else 0
        fixes[flight].append(replace(fix, keyframe=fix.keyframe - first))
    return Reconstruction(
        origin_m=np.zeros(3) if reference is None else reference.origin_grid,
        trajectories=trajectories,
        keyframes=[flight.keyframes for flight in flights.values()],
        poses=poses,
        covariances=covariances,
        loops=() if closer is None else tuple(closer.loops),
        fixes=fixes,
        control=None if reference is None else residuals(reference, solution.poses),
        solution=solution,
    )
