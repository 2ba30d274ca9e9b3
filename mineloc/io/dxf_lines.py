"""Centre-lines as DXF: 3-D polylines in full coordinates of the frame, metres, a layer a level."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from ezdxf import units
from ezdxf._options import options
from ezdxf.filemanagement import new

from mineloc.data import F64
from mineloc.output import new_file
from mineloc.roadways.mapped import MappedRoadways

RAMPS, INTERSECTIONS, ENDS = "RAMPS", "INTERSECTIONS", "ENDS"
_COLOURS = (3, 5, 30, 6, 4, 2)


def write_dxf(
    path: Path,
    roadways: MappedRoadways,
    *,
    origin_m: F64 | None = None,
    frame: str = "map",
    overwrite: bool = False,
) -> None:
    """Write the centre-lines as a DXF drawing (R2010), whole or not at all.

    Layers: `LEVEL_1`, `LEVEL_2` … from below, `RAMPS` between them, `INTERSECTIONS` and `ENDS` as points. Coordinates
    are double and stand for themselves: east, north, up.

    Args:
        path: the file.
        roadways: centre-lines.
        origin_m: (3,) where the origin of the roadways' frame lies in `frame`; None: it is the same frame.
        frame: name of the file's frame, one word.
        overwrite: replace an existing file.

    Raises:
        OutputError: `path` exists (unless `overwrite`) or cannot be written.
    """
    shift = np.zeros(3) if origin_m is None else np.asarray(origin_m, dtype=np.float64)
    with _without_the_time():
        drawing = new("R2010", units=units.M)
        drawing.header["$INSUNITS"], drawing.header["$MEASUREMENT"] = units.M, 1
        drawing.header.custom_vars.append("mineloc", "centre-lines of roadways, on the floor")
        drawing.header.custom_vars.append("unit", "metre")
        drawing.header.custom_vars.append("frame", frame)
        space = drawing.modelspace()
        levels = roadways.levels()
        layers = [RAMPS if level is None else f"LEVEL_{level + 1}" for level in levels]
        for number, layer in enumerate([*sorted(set(layers)), INTERSECTIONS, ENDS]):
            drawing.layers.add(layer, color=_COLOURS[number % len(_COLOURS)])
        for road, layer in zip(roadways.roadways, layers, strict=True):
            points = [tuple(point) for point in (road.line_m + shift).tolist()]
            space.add_polyline3d(points, dxfattribs={"layer": layer})
        for place, degree in zip((roadways.nodes_m + shift).tolist(), roadways.degrees, strict=True):
            if degree != 2:
                layer = ENDS if degree == 1 else INTERSECTIONS
                space.add_point(tuple(place), dxfattribs={"layer": layer})
        with new_file(path, overwrite=overwrite) as temp:
            drawing.saveas(temp)


@contextmanager
def _without_the_time() -> Generator[None]:
    """Within: drawings carry no time of writing and no random ids, so that a drawing is the same when written again."""
    before = options.write_fixed_meta_data_for_testing
    options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        options.write_fixed_meta_data_for_testing = before
