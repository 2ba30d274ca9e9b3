"""From the tour to a line that a drone can fly: in the middle of the roadway, rounded, clear of the walls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mineloc.errors import SimulationError
from mineloc.roadways.graph import Roadway, RoadwayGraph
from mineloc.sim.scene import Scene
from mineloc.sim.tour import Step

F64 = NDArray[np.float64]

STEP_M = 0.1
ROUNDING_M = 0.8
RELAXATIONS = 12
HIGHEST_FLIGHT_M = 3.0
SHORTEST_BLIND_M = 3.0


def fly_line(graph: RoadwayGraph, tour: list[Step], scene: Scene, *, clearance_m: float) -> list[F64]:
    """The legs of the flight: (n, 3) points every 0.1 m; the drone turns on the spot between two legs.

    Args:
        graph: the roadways; their lines lie on the floor.
        tour: where to go.
        scene: the mine.
        clearance_m: wanted distance to floor, roof and walls.

    Raises:
        SimulationError: a roadway without roof or floor, or too narrow.
    """
    out: list[F64] = []
    for leg in _legs(graph, tour):
        line = clear_line(round_line(mid_height(leg, scene)), scene, clearance_m=clearance_m)
        _check(line, scene, clearance_m / 2)
        out.append(line)
    return out


def _check(line_m: F64, scene: Scene, least_m: float) -> None:
    distance = scene.clearance_m(line_m)
    worst = int(distance.argmin())
    if distance[worst] < least_m:
        x, y, z = line_m[worst]
        raise SimulationError(
            "mine",
            f"only {distance[worst]:.2f} m to the wall at ({x:.1f}, {y:.1f}, {z:.1f})",
            expected=f"{least_m:.2f} m",
            todo="choose another start or lower simulate.clearance_m",
        )


def _legs(graph: RoadwayGraph, tour: list[Step]) -> list[F64]:
    """Floor lines between reversals, every 0.1 m."""
    groups: list[list[F64]] = [[]]
    for before, step in zip([None, *tour[:-1]], tour, strict=True):
        line = graph.roadways[step.roadway].line_m
        if before is not None and before.roadway == step.roadway and before.forward != step.forward:
            groups.append([])
        groups[-1].append(line if step.forward else line[::-1])
    return [resample(np.concatenate(lines)) for lines in groups]


def resample(line_m: F64) -> F64:
    """(n, 3) points at equal distances of about 0.1 m along a polyline."""
    length = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    line = line_m[np.concatenate([[True], length > 1e-6])]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = max(2, round(along[-1] / STEP_M) + 1)
    at = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(at, along, line[:, axis]) for axis in range(3)], axis=1)


def mid_height(floor_m: F64, scene: Scene) -> F64:
    """Lift a line on the floor to half of the free height, 3 m at most.

    Raises:
        SimulationError: no floor or no roof at some point.
    """
    probe = floor_m + np.array([0.0, 0.0, 1.0])
    down = scene.ranges_m(probe, [0.0, 0.0, -1.0])
    up = scene.ranges_m(probe, [0.0, 0.0, 1.0])
    known = np.isfinite(down) & np.isfinite(up)
    if known.mean() < 0.5:
        raise SimulationError(
            "mine",
            f"no floor or roof on {1 - known.mean():.0%} of a roadway",
            expected="roadways closed below and above",
            todo="check the mesh",
        )
    height = probe[:, 2] - down + np.minimum((down + up) / 2, HIGHEST_FLIGHT_M)
    index = np.arange(len(height))
    filled = np.interp(index, index[known], height[known])
    smooth = gaussian_filter1d(filled, 1.5 / STEP_M, mode="nearest")
    return np.column_stack([floor_m[:, :2], smooth])


def round_line(line_m: F64) -> F64:
    """Round the corners (a Gaussian over the length); the end points stay."""
    # odd reflection at the ends keeps end points and end directions
    pad = min(len(line_m) - 1, int(4 * ROUNDING_M / STEP_M))
    head = 2 * line_m[0] - line_m[pad:0:-1]
    tail = 2 * line_m[-1] - line_m[-2 : -pad - 2 : -1]
    smooth = gaussian_filter1d(np.concatenate([head, line_m, tail]), ROUNDING_M / STEP_M, axis=0)
    return smooth[pad : pad + len(line_m)]


def clear_line(line_m: F64, scene: Scene, *, clearance_m: float) -> F64:
    """Push the line away from walls that are nearer than `clearance_m`, keeping it smooth; the best of some tries."""
    line, best, least = line_m.copy(), line_m, np.inf
    for _ in range(RELAXATIONS):
        away = line - scene.nearest_m(line)
        distance = np.linalg.norm(away, axis=1)
        lack = np.maximum(clearance_m * 1.1 - distance, 0.0)
        if (cost := float((lack**2).sum())) < least:
            best, least = line.copy(), cost
        if not lack.any():
            break
        push = away / np.maximum(distance, 1e-6)[:, None] * lack[:, None]
        line = line + gaussian_filter1d(push, 0.5 / STEP_M, axis=0, mode="nearest")
    return resample(best)


def passable(graph: RoadwayGraph, scene: Scene, *, clearance_m: float) -> RoadwayGraph:
    """The roadways that a drone fits through; blind ones end before they get too narrow or low.

    Args:
        graph: the roadways.
        scene: the mine.
        clearance_m: wanted distance to floor, roof and walls; 3/4 of it counts as passable.

    Raises:
        SimulationError: none is left.
    """
    degree = [len(roads) for roads in graph.at_node()]
    nodes = graph.nodes_m.copy()
    kept: list[Roadway] = []
    for road in graph.roadways:
        floor = resample(road.line_m)
        room = scene.clearance_m(clear_line(mid_height(floor, scene), scene, clearance_m=clearance_m))
        # relaxing changes the number of points a little; what matters is where it is tight
        narrow = np.flatnonzero(room < 0.75 * clearance_m) / max(len(room) - 1, 1) * (len(floor) - 1)
        first, last = _open_part(narrow, len(floor), blind_a=degree[road.a] == 1, blind_b=degree[road.b] == 1)
        if last - first >= SHORTEST_BLIND_M / STEP_M or (not len(narrow) and degree[road.a] + degree[road.b] > 2):
            kept.append(Roadway(road.a, road.b, floor[first : last + 1]))
            nodes[road.a], nodes[road.b] = kept[-1].line_m[0], kept[-1].line_m[-1]
    if not kept:
        raise SimulationError(
            "mine",
            f"no roadway with {0.75 * clearance_m:.2f} m around its middle",
            expected="room for a drone",
            todo="check the mesh's unit, or lower simulate.clearance_m",
        )
    return RoadwayGraph(nodes, tuple(kept))


def _open_part(narrow: F64, count: int, *, blind_a: bool, blind_b: bool) -> tuple[int, int]:
    """First and last index of a roadway that can be flown; last < first if it is shut between two intersections."""
    margin = round(0.5 / STEP_M)
    if not len(narrow):
        return 0, count - 1
    if blind_b and not blind_a:
        return 0, int(narrow[0]) - margin
    if blind_a and not blind_b:
        return int(narrow[-1]) + 1 + margin, count - 1
    if blind_a and blind_b:
        # a mine of one roadway: the longest stretch between narrow places
        edges = np.concatenate([[-1.0], narrow, [float(count)]])
        widest = int(np.diff(edges).argmax())
        return int(edges[widest]) + 1 + margin, int(edges[widest + 1]) - margin
    return 0, -1
