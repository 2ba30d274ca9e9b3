"""The intersections of a map: found on its free space, described, and joined along its roadways (METHOD 5.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np
from scipy.spatial import KDTree

from mineloc.config import IntersectionsConfig
from mineloc.data import F64, I64, Intersection, IntersectionKind, MapCloud, WallContour
from mineloc.places.branches import Junction, find_junctions
from mineloc.places.contour_matrix import contour_matrix
from mineloc.places.free_grid import FreeGrid
from mineloc.places.sheet_grid import sheet_grid
from mineloc.places.virtual_views import self_recognition
from mineloc.places.wall_contour import wall_contour
from mineloc.roadways.mapped import MappedRoadways
from mineloc.roadways.sheet import Sheet

STATION_M = 3.0
"""Intersections are sought from places on the centre-lines so far apart."""
NODE_M = 4.0
"""An intersection so near a node of the roadway graph is that node; any other is a bay."""
_ROUNDS = 3
_STRAIGHT_DEG, _SQUARE_DEG = 25.0, 35.0


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A junction of the map with the free space around it.

    Attributes:
        place_m: (3,) origin of the grid, on the floor, map frame.
        grid: around it, map axes.
        junction: in the grid's frame.
        point_map: (3,) invariant point on the floor.
    """

    place_m: F64
    grid: FreeGrid
    junction: Junction
    point_map: F64


def intersections_of(
    sheet: Sheet, cloud: MapCloud, roadways: MappedRoadways, config: IntersectionsConfig
) -> list[Intersection]:
    """All intersections of a map, numbered from the first node of the roadway graph on; bays come last.

    Args:
        sheet: free space of the map.
        cloud: its points.
        roadways: its centre-lines, on the floor.
        config: of detection and descriptors.
    """
    seen = _told_once(_segments(_Floor.of(sheet), roadways, config), config)
    is_node = [_is_node(one.segment.point_map, roadways) for one in seen]
    order = sorted(range(len(seen)), key=lambda k: (not is_node[k], k))
    seen = [seen[k] for k in order]
    neighbours = neighbours_along([one.segment.point_map for one in seen], roadways)
    points = cloud.points_map
    tree = KDTree(points[:, :2])
    found: list[Intersection] = []
    for id, (one, at_node) in enumerate(zip(seen, sorted(is_node, reverse=True), strict=True)):
        point = one.segment.point_map
        near = np.array(sorted(tree.query_ball_point(point[:2], config.cloud_radius_m)), dtype=np.int64)
        level = np.abs(points[near, 2] - point[2]) < config.cloud_height_m
        found.append(_described(id, one, cloud, near[level], neighbours[id], config, is_bay=not at_node))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Described:
    """A segment with its contour and how well that is recognised."""

    segment: Segment
    contour: WallContour
    quality: float


def _told_once(segments: Sequence[Segment], config: IntersectionsConfig) -> list[_Described]:
    """Of junctions nearer to each other than `merge_m`, which are one place, the one that is recognised best."""
    contours = [
        wall_contour(segment.grid, segment.junction.point_m, segment.junction.branches_rad, config)
        for segment in segments
    ]
    qualities = [
        self_recognition(segment.grid, segment.junction.point_m, k, contours, config)
        for k, segment in enumerate(segments)
    ]
    kept: list[int] = []
    for k in sorted(range(len(segments)), key=lambda k: (-qualities[k], k)):
        if _is_apart(segments[k], [segments[other] for other in kept], config.merge_m):
            kept.append(k)
    return [_Described(segments[k], contours[k], qualities[k]) for k in sorted(kept)]


def _described(
    id: int,
    seen: _Described,
    cloud: MapCloud,
    near: I64,
    neighbours: tuple[tuple[int, float], ...],
    config: IntersectionsConfig,
    *,
    is_bay: bool,
) -> Intersection:
    segment, contour = seen.segment, seen.contour
    point = segment.point_map
    around = (cloud.points_map[near] - point).astype(np.float32)
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = segment.junction.covariance_m2
    covariance[2, 2] = config.cell_m**2
    kind = "bay" if is_bay else kind_of(contour.branches_rad)
    return Intersection(
        id=id,
        name=f"{kind} {id}",
        kind=kind,
        point_map=point,
        covariance_m2=covariance,
        contour=contour,
        matrix=contour_matrix(around, np.zeros(2), 0.0, config),
        points_m=around,
        normals=cloud.normals[near],
        neighbours=neighbours,
        quality=seen.quality,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Floor:
    """The sheet with an index of its cells."""

    sheet: Sheet
    cells_m: F64
    tree: KDTree

    @staticmethod
    def of(sheet: Sheet) -> _Floor:
        cells = sheet.floor_points_m(np.arange(len(sheet)))
        return _Floor(sheet, cells, KDTree(cells))

    def nearest(self, place_m: F64) -> int | None:
        """The cell at a place on the floor, at most a metre away; None without any."""
        distance, cell = self.tree.query(place_m, distance_upper_bound=1.0)
        return int(cell) if np.isfinite(distance) else None

    def segment(self, place_m: F64, grid: FreeGrid, junction: Junction) -> Segment:
        """A junction on the floor of the level of the place from which it was seen."""
        at = np.array([*(place_m[:2] + junction.point_m), place_m[2]])
        _, near = self.tree.query(at, k=min(40, len(self.cells_m)))
        cells = self.cells_m[np.atleast_1d(near)]
        distance = np.hypot(*(cells[:, :2] - at[:2]).T) + 0.2 * np.abs(cells[:, 2] - at[2])
        at[2] = cells[int(distance.argmin()), 2]
        return Segment(place_m, grid, junction, at)


def _segments(floor: _Floor, roadways: MappedRoadways, config: IntersectionsConfig) -> list[Segment]:
    """Junctions seen from all stations, each place once: as it is seen from nearest by."""
    candidates: list[tuple[float, Segment]] = []
    for station in stations(roadways):
        for segment in _seen_from(floor, station, config):
            candidates.append((float(np.linalg.norm(segment.junction.point_m)), segment))
    kept: list[Segment] = []
    for _, segment in sorted(candidates, key=lambda one: one[0]):
        # most candidates are others' doubles: no need to settle them
        if not _is_apart(segment, kept, 0.5 * config.apart_m):
            continue
        settled = _settled(floor, segment, config)
        if _is_apart(settled, kept, max(config.apart_m, settled.junction.clearance_m)):
            kept.append(settled)
    return sorted(kept, key=lambda one: tuple(np.round(one.point_map, 3)))


def _is_apart(segment: Segment, others: Sequence[Segment], least_m: float) -> bool:
    return all(float(np.linalg.norm(segment.point_map - other.point_map)) > least_m for other in others)


def stations(roadways: MappedRoadways) -> F64:
    """(n, 3) nodes where at least three roadways meet, then places along all lines."""
    degrees = np.array(roadways.degrees)
    places = [roadways.nodes_m[degrees >= 3]] if len(degrees) else [np.zeros((0, 3))]
    for road in roadways.roadways:
        at = np.arange(0.5 * STATION_M, road.length_m, STATION_M)
        places.append(np.column_stack([np.interp(at, road.along_m, column) for column in road.line_m.T]))
    return np.concatenate(places)


def _seen_from(floor: _Floor, place_m: F64, config: IntersectionsConfig) -> list[Segment]:
    cell = floor.nearest(place_m)
    if cell is None:
        return []
    grid = sheet_grid(floor.sheet, cell, place_m, config)
    near = config.model_copy(update={"search_m": STATION_M + 1.0})
    return [floor.segment(place_m, grid, junction) for junction in find_junctions(grid, near)]


def _settled(floor: _Floor, segment: Segment, config: IntersectionsConfig) -> Segment:
    """The same junction as it is found from its own point."""
    for _ in range(_ROUNDS):
        again = [
            other
            for other in _seen_from(floor, segment.point_map, config)
            if np.linalg.norm(other.junction.point_m) < config.apart_m
        ]
        if not again:
            break
        nearest = min(again, key=lambda other: float(np.linalg.norm(other.junction.point_m)))
        moved = float(np.linalg.norm(nearest.point_map - segment.point_map))
        segment = nearest
        if moved < 0.5 * config.cell_m:
            break
    return segment


def kind_of(branches_rad: F64) -> IntersectionKind:
    """Shape by the angles between branches: T has two in line and one square to them, Y three of another kind."""
    count = len(branches_rad)
    if count == 4:
        return "X"
    if count != 3:
        return "other"
    gaps = np.degrees(np.diff(np.append(np.sort(branches_rad), np.sort(branches_rad)[0] + 2 * np.pi)))
    straight = int(np.abs(gaps - 180.0).argmin())
    if abs(gaps[straight] - 180.0) < _STRAIGHT_DEG and np.abs(np.delete(gaps, straight) - 90.0).max() < _SQUARE_DEG:
        return "T"
    return "Y"


def _is_node(point: F64, roadways: MappedRoadways) -> bool:
    nodes = roadways.nodes_m[np.array(roadways.degrees) >= 3] if len(roadways.nodes_m) else np.zeros((0, 3))
    return bool(len(nodes) and np.linalg.norm(nodes - point, axis=1).min() < NODE_M)


def neighbours_along(points: Sequence[F64], roadways: MappedRoadways) -> list[tuple[tuple[int, float], ...]]:
    """For each point the others that are reached along roadways without passing a third, with the way's length.

    Args:
        points: (3,) each, near the centre-lines; one farther than `NODE_M` from all of them has no neighbours.
    """
    names: dict[int, object] = {}
    on_line: dict[int, list[tuple[float, int]]] = {}
    for id, point in enumerate(points):
        to_nodes = np.linalg.norm(roadways.nodes_m - point, axis=1) if len(roadways.nodes_m) else np.full(1, np.inf)
        if to_nodes.min() < NODE_M and int(to_nodes.argmin()) not in names:
            names[int(to_nodes.argmin())] = id
            continue
        away = [float(np.linalg.norm(road.line_m - point, axis=1).min()) for road in roadways.roadways]
        if away and min(away) < NODE_M:
            k = int(np.argmin(away))
            nearest = int(np.linalg.norm(roadways.roadways[k].line_m - point, axis=1).argmin())
            on_line.setdefault(k, []).append((float(roadways.roadways[k].along_m[nearest]), id))
    graph = nx.Graph()
    for k, road in enumerate(roadways.roadways):
        stops: list[tuple[float, object]] = [(0.0, names.get(road.a, ("node", road.a)))]
        stops += [(at, id) for at, id in sorted(on_line.get(k, []))]
        stops.append((road.length_m, names.get(road.b, ("node", road.b))))
        for (at, one), (then, other) in pairwise(stops):
            length = max(then - at, 1e-3)
            if not graph.has_edge(one, other) or graph[one][other]["length"] > length:
                graph.add_edge(one, other, length=length)
    return [_reached_first(graph, id, len(points)) for id in range(len(points))]


def _reached_first(graph: Any, start: int, count: int) -> tuple[tuple[int, float], ...]:
    """Others that a walk from `start` meets first."""
    if start not in graph:
        return ()
    others = {id for id in range(count) if id != start}
    reached: dict[int, float] = {}
    for other in others & set(graph):
        alone = graph.subgraph(set(graph) - (others - {other}))
        try:
            reached[other] = float(nx.dijkstra_path_length(alone, start, other, weight="length"))
        except nx.NetworkXNoPath:
            continue
    return tuple(sorted(reached.items()))
