"""The free space of a map around a place, as a drone would lay it out: one level, no roadway that crosses over."""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.ndimage import binary_dilation

from mineloc.config import IntersectionsConfig
from mineloc.data import F64, Sight
from mineloc.places.free_grid import FreeGrid
from mineloc.roadways.sheet import Sheet


def sheet_grid(sheet: Sheet, start: int, place_m: F64, config: IntersectionsConfig) -> FreeGrid:
    """The cells that hang together with a place, within the grid's square.

    Args:
        sheet: free space of a map; its cells have the size of the grid's.
        start: the cell at the place.
        place_m: (3,) on the floor, map frame; the grid's frame has its origin there and the map's axes.
        config: `cell_m`, `half_m`.

    Raises:
        ValueError: the sheet's cells are of another size.
    """
    if abs(sheet.cell_m - config.cell_m) > 1e-9:
        raise ValueError(f"a sheet of {sheet.cell_m} m cells for a grid of {config.cell_m} m")
    half = round(config.half_m / config.cell_m)
    column, row = sheet.column - sheet.column[start], sheet.row - sheet.row[start]
    open_cells = np.zeros((2 * half + 1, 2 * half + 1), np.bool_)
    seen = {start}
    waiting = deque([start])
    while waiting:
        cell = waiting.popleft()
        y, x = int(row[cell]) + half, int(column[cell]) + half
        # where a level comes around and lies over another, the nearer one counts
        if open_cells[y, x]:
            continue
        open_cells[y, x] = True
        for other in sheet.links[cell]:
            if other >= 0 and other not in seen and abs(row[other]) <= half and abs(column[other]) <= half:
                seen.add(int(other))
                waiting.append(int(other))
    sight = np.full(open_cells.shape, Sight.UNKNOWN, np.uint8)
    sight[np.asarray(binary_dilation(open_cells, np.ones((3, 3), np.bool_)), dtype=np.bool_)] = Sight.WALL
    sight[open_cells] = Sight.OPEN
    middle = sheet.floor_points_m(np.array([start]))[0, :2]
    return FreeGrid(config.cell_m, middle - place_m[:2] - half * config.cell_m, sight)
