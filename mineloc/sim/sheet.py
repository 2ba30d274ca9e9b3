"""The free-space sheet of a mesh: a ray up through every cell of the plan."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from mineloc.roadways.sheet import Sheet, fill_pinholes, link
from mineloc.sim.scene import Crossings, Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

FILLINGS = 2


def free_sheet(
    scene: Scene, low_m: F64, high_m: F64, *, cell_m: float = 0.2, headroom_m: float = 1.5, opening_m: float = 1.2
) -> Sheet:
    """Cast a ray up through every cell of the plan and keep the gaps that are free.

    Which gaps are free and which are rock is read from the winding of the triangles: a free gap has a floor and a
    roof that face each other. Meshes wound the other way round (facing the rock) are recognised by their majority:
    there is always at least as much free gap as rock between levels. Meshes wound at random are taken to be closed.

    Args:
        scene: the mine.
        low_m, high_m: (3,) bounds of the mesh.
        cell_m: size of the grid.
        headroom_m: least height of a gap.
        opening_m: least height over which two neighbouring gaps must overlap to be linked.
    """
    # off the round numbers on which modelled meshes have their edges
    origin = low_m[:2] + cell_m * np.array([0.37, 0.61])
    columns, rows = (int(np.ceil((high_m[k] - origin[k]) / cell_m)) for k in range(2))
    found: list[_Gaps] = []
    band = max(1, 2_000_000 // max(columns, 1))
    for first in range(0, rows, band):
        row, column = np.divmod(np.arange(columns * min(band, rows - first)), columns)
        start = np.column_stack([origin[0] + column * cell_m, origin[1] + (row + first) * cell_m])
        crossings = scene.verticals(np.column_stack([start, np.full(len(start), low_m[2] - 1.0)]))
        found.append(_gaps(crossings, first * columns, headroom_m))
    gaps = _Gaps(*(np.concatenate([getattr(part, f.name) for part in found]) for f in fields(_Gaps)))
    free = gaps.free()
    row, column = np.divmod(gaps.cell[free], columns)
    floor, roof = gaps.bottom_m[free] + low_m[2] - 1.0, gaps.top_m[free] + low_m[2] - 1.0
    sheet = Sheet(cell_m, origin, column, row, floor, roof, link(column, row, floor, roof, opening_m))
    for _ in range(FILLINGS):
        sheet = fill_pinholes(sheet, opening_m)
    return sheet


@dataclass(frozen=True, slots=True, eq=False)
class _Gaps:
    """Tall gaps between neighbouring crossings of vertical rays: cell, heights, winding (±2: walls face), parity."""

    cell: I64
    bottom_m: F64
    top_m: F64
    facing: F64
    odd: Bool

    def free(self) -> Bool:
        """Which gaps are free space. Where half of the triangles are wound at random, every second gap of a ray is."""
        facing = np.abs(self.facing) == 2
        if facing.sum() < 0.6 * len(facing):
            return ~self.odd
        return self.facing == (2.0 if (self.facing > 0).sum() >= (self.facing < 0).sum() else -2.0)


def _gaps(crossings: Crossings, first_cell: int, headroom_m: float) -> _Gaps:
    ray, height, side = crossings.ray, crossings.height_m, np.sign(crossings.upward)
    tall = np.flatnonzero((ray[1:] == ray[:-1]) & (np.diff(height) >= headroom_m))
    odd = (tall - np.searchsorted(ray, ray[tall], "left")) % 2 == 1
    return _Gaps(ray[tall] + first_cell, height[tall], height[tall + 1], side[tall] - side[tall + 1], odd)
