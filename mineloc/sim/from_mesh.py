"""The roadway graph of a mesh: its floor-following free space and the centre-lines in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mineloc.errors import SimulationError
from mineloc.roadways.centre_lines import centre_lines, largest_part
from mineloc.roadways.graph import RoadwayGraph
from mineloc.sim.scene import Scene
from mineloc.sim.sheet import free_sheet

F64 = NDArray[np.float64]

SHORTEST_MINE_M = 10.0
HIGHEST_ROADWAY_M = 60.0
SAMPLES = 300
MOST_CELLS = 4e8


def roadways_of_mesh(
    scene: Scene, low_m: F64, high_m: F64, *, cell_m: float = 0.2, where: str = "mine"
) -> RoadwayGraph:
    """Find the roadways of a mesh: the largest connected part of its free space, as centre-lines on the floor.

    Args:
        scene: the mesh.
        low_m, high_m: (3,) its bounds.
        cell_m: resolution of the plan.
        where: the mine's file, for messages.

    Raises:
        SimulationError: no roadway in it, or a size that only a wrong unit can give.
    """
    _check_scale(scene, low_m, high_m, cell_m, where)
    graph = centre_lines(largest_part(free_sheet(scene, low_m, high_m, cell_m=cell_m)))
    if graph.length_m < SHORTEST_MINE_M:
        raise SimulationError(
            where,
            f"{graph.length_m:.0f} m of roadway between floors and roofs",
            expected=f"at least {SHORTEST_MINE_M:.0f} m, metres, z up, headroom over 1.5 m",
            todo="check the mesh's unit and that it has both floor and roof",
        )
    return graph


def _check_scale(scene: Scene, low_m: F64, high_m: F64, cell_m: float, where: str) -> None:
    """Refuse before the fine grid: gaps as high as towers mean centimetres; no memory holds the plan of a county."""
    columns, rows = np.meshgrid(*(np.linspace(low_m[k], high_m[k], SAMPLES + 2)[1:-1] for k in range(2)))
    start = np.column_stack([columns.ravel(), rows.ravel(), np.full(columns.size, low_m[2] - 1.0)])
    crossings = scene.verticals(start)
    gaps = np.diff(crossings.height_m)[np.diff(crossings.ray) == 0]
    gaps = gaps[gaps > 0.1]
    if len(gaps) and np.median(gaps) > HIGHEST_ROADWAY_M:
        raise SimulationError(
            where,
            f"half of the roof is over {np.median(gaps):.0f} m above the floor",
            expected=f"less than {HIGHEST_ROADWAY_M:.0f} m",
            todo="is the unit centimetres or millimetres? scale it to metres",
        )
    cells = float(np.prod((high_m - low_m)[:2])) / cell_m**2
    if cells > MOST_CELLS:
        raise SimulationError(
            where,
            f"a plan of {cells * cell_m**2 / 1e6:.1f} km²",
            expected=f"at most {MOST_CELLS * cell_m**2 / 1e6:.0f} km²",
            todo="give the roadways with --graph, or cut the mesh",
        )
