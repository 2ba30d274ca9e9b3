"""Mine plans from DXF: every line, polyline, arc or spline of the model space is a centre-line on the floor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from ezdxf import path as dxf_path
from ezdxf import units
from ezdxf.enums import InsertUnits
from ezdxf.filemanagement import readfile
from ezdxf.lldxf.const import DXFError

from mineloc.errors import FormatError
from mineloc.sim.plan import MinePlan, RoadwayPlan

KINDS = ("LINE", "LWPOLYLINE", "POLYLINE", "ARC", "SPLINE")
SAG_M = 0.1


def read_dxf(path: Path, *, width_m: float, height_m: float) -> MinePlan:
    """A plan from the centre-lines of a DXF file (a layer per level, heights in the file's z).

    Layers that are off or frozen are left out. The drawing's unit is honoured; without one it is metres.

    Args:
        path: the file.
        width_m, height_m: of all roadways, which centre-lines do not tell.

    Raises:
        FormatError: not a DXF file, or no line in it.
    """
    try:
        drawing = readfile(path)
    except (OSError, DXFError, UnicodeDecodeError, ValueError) as error:
        raise FormatError(
            path, f"not a DXF file ({' '.join(str(error).split())})", expected="DXF", todo="export it again"
        ) from None
    scale = units.conversion_factor(InsertUnits(drawing.units), InsertUnits.Meters) if drawing.units else 1.0
    hidden = {layer.dxf.name.lower() for layer in drawing.layers if layer.is_off() or layer.is_frozen()}
    roads: list[RoadwayPlan] = []
    for entity in drawing.modelspace():
        if entity.dxftype() in KINDS and entity.dxf.layer.lower() not in hidden:
            points = _points(entity, scale)
            if len(points) >= 2:
                roads.append(RoadwayPlan(points_m=points, width_m=width_m, height_m=height_m))
    if not roads:
        raise FormatError(
            path,
            "no line on a visible layer of the model space",
            expected="centre-lines (LINE, POLYLINE, LWPOLYLINE, ARC, SPLINE)",
            todo="check the layers",
        )
    return MinePlan(name=path.stem, roadway=tuple(roads))


def _points(entity: Any, scale: float) -> tuple[tuple[float, float, float], ...]:
    """Vertices in metres, curves as chords with 0.1 m of sag, repeated points dropped."""
    try:
        line = dxf_path.make_path(entity)
    except (TypeError, ValueError):
        # meshes hide among POLYLINEs; they are no centre-lines
        return ()
    points = (
        np.array([vertex.xyz for vertex in line.flattening(SAG_M / scale)], dtype=np.float64).reshape(-1, 3) * scale
    )
    moved = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6]) if len(points) else []
    return tuple((float(x), float(y), float(z)) for x, y, z in points[np.asarray(moved, dtype=bool)])
