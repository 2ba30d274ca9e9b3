"""From the tour to a line that a drone can fly: in the middle of the roadway, rounded, clear of the walls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mineloc.errors import SimulationError
from mineloc.sim.roadways import RoadwayGraph
from mineloc.sim.scene import Scene
from mineloc.sim.tour import Step

F64 = NDArray[np.float64]

STEP_M = 0.1
ROUNDING_M = 0.8
RELAXATIONS = 12
HIGHEST_FLIGHT_M = 3.0


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
    return [clear_line(round_line(mid_height(leg, scene)), scene, clearance_m=clearance_m) for leg in _legs(graph, tour)]


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
    probe = floor_m + [0.0, 0.0, 1.0]
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
    """Push the line away from walls that are nearer than `clearance_m`, keeping it smooth.

    Raises:
        SimulationError: there is less than half of the clearance even so.
    """
    line = line_m.copy()
    for _ in range(RELAXATIONS):
        away = line - scene.nearest_m(line)
        distance = np.linalg.norm(away, axis=1)
        lack = np.maximum(clearance_m * 1.1 - distance, 0.0)
        if not lack.any():
            break
        push = away / np.maximum(distance, 1e-6)[:, None] * lack[:, None]
        line += gaussian_filter1d(push, 0.5 / STEP_M, axis=0, mode="nearest") * 1.5
    distance = scene.clearance_m(line)
    worst = int(distance.argmin())
    if distance[worst] < clearance_m / 2:
        x, y, z = line[worst]
        raise SimulationError(
            "mine",
            f"only {distance[worst]:.2f} m to the wall at ({x:.1f}, {y:.1f}, {z:.1f})",
            expected=f"{clearance_m / 2:.2f} m",
            todo="choose another start or lower simulate.clearance_m",
        )
    return resample(line)
