"""A mine that has changed since it was mapped: roadways walled up, places widened.

Both act on the triangles, whatever the mine came from. Walls change the roadway graph too: tours end before them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from mineloc.config import SimulateConfig
from mineloc.errors import SimulationError
from mineloc.roadways.graph import Roadway, RoadwayGraph
from mineloc.sim.mine import Mine
from mineloc.sim.path import SHORTEST_BLIND_M, STEP_M, resample
from mineloc.sim.scene import Scene
from mineloc.sim.wall import REACH_M, Wall, fit_wall, wall_mesh
from mineloc.sim.widening import widen

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

CHANGES_FILE = "changes.json"
FARTHEST_M = 3.0
GAP_M = 2.0
STEEPEST_RAD = np.deg2rad(45.0)
_WALLS = 30  # random stream


def changed_mine(
    mine: Mine,
    *,
    closed: Sequence[tuple[float, float, float, float]] = (),
    widened: Sequence[tuple[float, float, float, float, float]] = (),
    threads: int = 0,
) -> Mine:
    """The mine as it is now; walls are fitted to the widened roadways.

    Args:
        mine: as it was mapped.
        closed: `x_m y_m z_m` in its frame and the bearing of the roadway there in degrees, for each wall.
        widened: `x_m y_m z_m radius_m by_m` for each place.
        threads: of the ray caster, 0: all cores.

    Raises:
        SimulationError: a place in no roadway, a bearing across it, no rock for a wall to join, nothing to widen within
            the radius, no roadway left.
    """
    for index, (x, y, z, radius_m, by_m) in enumerate(widened):
        mine = _widened(mine, np.array([x, y, z]), radius_m, by_m, f"simulate.widened[{index}]", threads)
    for index, (x, y, z, bearing_deg) in enumerate(closed):
        place = np.array([x, y, z])
        mine = _closed(mine, place, np.deg2rad(bearing_deg), f"simulate.closed[{index}]", threads)
    return mine


def changes_json(config: SimulateConfig) -> bytes | None:
    """What was changed, as a file: {"closed": [[x_m, y_m, z_m, bearing_deg]], "widened": [[..., radius_m, by_m]]}.

    None when nothing was.
    """
    if not config.closed and not config.widened:
        return None
    return json.dumps({"closed": config.closed, "widened": config.widened}).encode()


def cut_graph(graph: RoadwayGraph, wall: Wall) -> RoadwayGraph:
    """The roadways without the way through a wall: they end 2 m before it, in nodes that come behind the old ones.

    Roadways that pass beside the wall stay; what is left shorter than 3 m is no roadway.

    Args:
        graph: centre-lines on the floor, map frame.
        wall: in the same frame.
    """
    nodes = list(graph.nodes_m)
    roads: list[Roadway] = []
    for road in graph.roadways:
        line = resample(road.line_m)
        inside = _inside(line, wall)
        if not inside.any():
            roads.append(road)
            continue
        shut = np.flatnonzero(binary_dilation(inside, iterations=round(GAP_M / STEP_M)))
        # the open stretches lie between the shut points; only the first and last one may reach an old node
        edges = np.concatenate([[-1], shut, [len(line)]])
        for first, last in zip(edges[:-1] + 1, edges[1:] - 1, strict=True):
            if (last - first) * STEP_M < SHORTEST_BLIND_M:
                continue
            piece = line[first : last + 1]
            ends = road.a, road.b
            if first > 0:
                ends = len(nodes), ends[1]
                nodes.append(piece[0])
            if last < len(line) - 1:
                ends = ends[0], len(nodes)
                nodes.append(piece[-1])
            roads.append(Roadway(*ends, piece))
    return RoadwayGraph(np.array(nodes), tuple(roads))


def _inside(line_m: F64, wall: Wall) -> Bool:
    """(n,) points of a floor line that lie in the wall, or under it where the line is lower than the floor."""
    along, left, up = ((line_m - wall.centre_m) @ wall.axes.T).T
    beside = (np.abs(along) <= REACH_M) & (left >= wall.right_m) & (left <= wall.left_m)
    return beside & (up >= wall.low_m - 1.0) & (up <= wall.high_m)


def _closed(mine: Mine, place_m: F64, bearing_rad: float, where: str, threads: int) -> Mine:
    foot = _centre_line(mine.graph, place_m, where, bearing_rad)
    wall = fit_wall(mine.scene, place_m, foot, bearing_rad, where=where)
    # the same wall in every flight, and whatever else is changed: its place alone decides how it looks
    millimetres = [round(value * 1000) & 0xFFFFFFFF for value in place_m.tolist()]
    vertices, triangles = wall_mesh(wall, np.random.default_rng(np.random.SeedSequence((_WALLS, *millimetres))))
    graph = cut_graph(mine.graph, wall)
    if not graph.roadways:
        raise SimulationError(where, "no roadway is left", expected="one to fly in", todo="choose another place")
    both = np.concatenate([mine.vertices_m, vertices])
    joined = np.concatenate([mine.triangles, triangles + len(mine.vertices_m)])
    return replace(mine, vertices_m=both, triangles=joined, graph=graph, scene=Scene(both, joined, threads=threads))


def _widened(mine: Mine, place_m: F64, radius_m: float, by_m: float, where: str, threads: int) -> Mine:
    foot = _centre_line(mine.graph, place_m, where)
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    eye = np.tile(np.array([*place_m[:2], foot[2] + 1.0]), (len(angle), 1))
    nearest = float(mine.scene.ranges_m(eye, around).min())
    if nearest >= radius_m:
        raise SimulationError(
            where,
            f"the nearest wall is {nearest:.1f} m away",
            expected=f"one within radius_m = {radius_m:g}",
            todo="choose a larger radius or another place",
        )
    vertices, triangles = widen(mine.vertices_m, mine.triangles, place_m, radius_m, by_m, where=where)
    return replace(mine, vertices_m=vertices, triangles=triangles, scene=Scene(vertices, triangles, threads=threads))


def _centre_line(graph: RoadwayGraph, place_m: F64, where: str, bearing_rad: float | None = None) -> F64:
    """(3,) the point of the centre-lines that is nearest to a place, of those that go along a bearing if one is given.

    Raises:
        SimulationError: it is farther than 3 m away, or the roadways there go elsewhere.
    """
    lines = [resample(road.line_m) for road in graph.roadways]
    points, ways = np.concatenate(lines), np.concatenate([_ways(line) for line in lines])
    distance = np.linalg.norm(points - place_m, axis=1)
    nearest = int(distance.argmin())
    if distance[nearest] > FARTHEST_M:
        x, y, z = points[nearest]
        raise SimulationError(
            where,
            f"in no roadway: the nearest centre-line is {distance[nearest]:.1f} m away at ({x:.1f}, {y:.1f}, {z:.1f})",
            expected=f"a place within {FARTHEST_M:.0f} m of one, in the mine's frame",
            todo="correct the place",
        )
    if bearing_rad is None:
        return points[nearest]
    # at an intersection another roadway may be nearer than the one that is meant
    fits = np.abs(np.cos(ways - bearing_rad)) >= np.cos(STEEPEST_RAD)
    own = int(np.where(fits, distance, np.inf).argmin())
    if not fits[own] or distance[own] > FARTHEST_M:
        raise SimulationError(
            where,
            f"the bearing {np.rad2deg(bearing_rad):g}°, where the roadway goes along {np.rad2deg(ways[nearest]):.0f}°",
            expected=f"within {np.rad2deg(STEEPEST_RAD):.0f}° of it, one way or the other",
            todo="correct the bearing or the place",
        )
    return points[own]


def _ways(line_m: F64) -> F64:
    """(n,) bearing of a line at its points, over a metre on both sides."""
    index, reach = np.arange(len(line_m)), round(1.0 / STEP_M)
    step = line_m[np.minimum(index + reach, len(line_m) - 1)] - line_m[np.maximum(index - reach, 0)]
    return np.arctan2(step[:, 1], step[:, 0])
