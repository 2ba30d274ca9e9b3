"""Mines from mesh files: read, and refused if they cannot be a mine in metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from mineloc.errors import FormatError, SimulationError
from mineloc.sim.collada import read_collada

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

SUFFIXES = (".ply", ".obj", ".stl", ".dae")
LARGEST_MINE_M = 20_000.0
SMALLEST_MINE_M = 10.0
SMALLEST_HEIGHT_M = 1.5


def read_mesh(path: Path) -> tuple[F64, I64]:
    """Vertices (n, 3) and triangles (m, 3) of a mesh file, degenerate triangles left out.

    Raises:
        FormatError: no such file, or not a mesh.
        SimulationError: no surface, positions that are not finite, or a size that no mine in metres has.
    """
    if not path.is_file():
        raise FormatError(path, "no such file", expected="a mesh file", todo="check the path")
    vertices, triangles = read_collada(path) if path.suffix.lower() == ".dae" else _read_open3d(path)
    if not len(triangles):
        raise SimulationError(
            path, "no triangles", expected="a surface", todo="export the mine as triangles, not points"
        )
    if not np.isfinite(vertices).all():
        raise SimulationError(path, "vertices that are not finite", expected="numbers", todo="repair the mesh")
    corners = vertices[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    _check_size(path, vertices[np.unique(triangles)], float(area.sum()))
    return vertices, triangles[area > 0]


def _read_open3d(path: Path) -> tuple[F64, I64]:
    # open3d says what is wrong on stdout and returns an empty mesh; its PLY reader even ignores the level
    if path.suffix.lower() == ".ply":
        with path.open("rb") as file:
            if file.read(3) != b"ply":
                raise FormatError(path, "not a PLY file", expected="a mesh", todo="check the file")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(path)
    if mesh.is_empty():
        raise FormatError(
            path,
            "cannot be read as a mesh",
            expected=f"a whole {path.suffix} file",
            todo="check the file or export it again",
        )
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.triangles, dtype=np.int64)


def _check_size(path: Path, vertices_m: F64, area_m2: float) -> None:
    size = vertices_m.max(axis=0) - vertices_m.min(axis=0)
    plan, height = float(size[:2].max()), float(size[2])
    found = f"{size[0]:.4g} x {size[1]:.4g} x {size[2]:.4g} m"
    if area_m2 <= 0 or min(plan, height) <= 0:
        raise SimulationError(path, f"no surface ({found})", expected="a hollow mine", todo="check the mesh")
    if plan > LARGEST_MINE_M:
        raise SimulationError(
            path,
            found,
            expected=f"at most {LARGEST_MINE_M / 1000:.0f} km",
            todo="is the unit millimetres or centimetres? scale it to metres",
        )
    if plan < SMALLEST_MINE_M or height < SMALLEST_HEIGHT_M:
        raise SimulationError(
            path,
            found,
            expected=f"at least {SMALLEST_MINE_M:.0f} m long and {SMALLEST_HEIGHT_M} m high",
            todo="is the unit kilometres or feet, or is y up? scale it to metres, z up",
        )
