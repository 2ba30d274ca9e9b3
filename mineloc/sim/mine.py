"""A mine to fly in: its surface and its roadways, from a mesh, a plan or a name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mineloc.errors import SimulationError
from mineloc.roadways.graph import RoadwayGraph, read_graph
from mineloc.sim.builtin import BUILTIN
from mineloc.sim.from_mesh import roadways_of_mesh
from mineloc.sim.mesh_file import SUFFIXES, read_mesh
from mineloc.sim.plan import MinePlan, plan_graph, read_plan
from mineloc.sim.rock import rock_mesh
from mineloc.sim.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Mine:
    """A mine.

    Attributes:
        name: for people.
        vertices_m: (n, 3) in the map frame.
        triangles: (m, 3).
        graph: its roadways.
        scene: its surface, ready for rays.
    """

    name: str
    vertices_m: F64
    triangles: I64
    graph: RoadwayGraph
    scene: Scene


def load_mine(
    mine: str | Path,
    *,
    graph: Path | None = None,
    roadway_width_m: float = 4.0,
    roadway_height_m: float = 3.2,
    threads: int = 0,
) -> Mine:
    """A mine from a mesh file (.ply .obj .stl .dae), a plan (.toml, .dxf) or a built-in name.

    Args:
        mine: path or name.
        graph: roadway graph of a mesh as JSON; None: found in the mesh itself.
        roadway_width_m, roadway_height_m: for plans that do not tell (.dxf).
        threads: of the ray caster, 0: all cores.

    Raises:
        SimulationError: no such mine, or one that cannot be flown.
        FormatError, ConfigError: a file that is not what it claims.
    """
    path = Path(mine)
    suffix = path.suffix.lower()
    if str(mine) in BUILTIN:
        return planned_mine(BUILTIN[str(mine)](), threads=threads)
    if suffix == ".toml":
        return planned_mine(read_plan(path), threads=threads)
    if suffix == ".dxf":
        # ezdxf takes as long to load as all the rest
        from mineloc.sim.dxf import read_dxf

        return planned_mine(read_dxf(path, width_m=roadway_width_m, height_m=roadway_height_m), threads=threads)
    if suffix not in SUFFIXES:
        raise SimulationError(
            str(mine),
            "no such mine",
            expected=f"{', '.join(SUFFIXES)}, .toml, .dxf, or one of {', '.join(BUILTIN)}",
            todo="check the name",
        )
    vertices, triangles = read_mesh(path)
    scene = Scene(vertices, triangles, threads=threads)
    if graph is not None:
        roads = read_graph(graph)
    else:
        used = vertices[np.unique(triangles)]
        roads = roadways_of_mesh(scene, used.min(axis=0), used.max(axis=0), where=str(path))
    return Mine(path.stem, vertices, triangles, roads, scene)


def planned_mine(plan: MinePlan, *, threads: int = 0) -> Mine:
    """The mine that a plan describes, surface and all."""
    vertices, triangles = rock_mesh(plan)
    return Mine(plan.name, vertices, triangles, plan_graph(plan), Scene(vertices, triangles, threads=threads))
