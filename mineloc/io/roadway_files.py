"""Roadways as JSON with widths and heights (`read_graph` takes the lines alone), intersections as CSV."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mineloc.data import F64
from mineloc.errors import FormatError
from mineloc.output import new_file
from mineloc.roadways.graph import read_graph
from mineloc.roadways.mapped import MappedRoadway, MappedRoadways

_DIGITS = 4


def write_roadways(
    path: Path, roadways: MappedRoadways, *, origin_m: F64 | None = None, frame: str = "map", overwrite: bool = False
) -> None:
    """Write the roadways as JSON, whole or not at all; what is not known is null.

    Args:
        path: the file.
        roadways: what to write.
        origin_m: (3,) where the origin of the roadways' frame lies in `frame`; None: it is the same frame.
        frame: name of the file's frame.
        overwrite: replace an existing file.

    Raises:
        OutputError: `path` exists (unless `overwrite`) or cannot be written.
    """
    shift = np.zeros(3) if origin_m is None else np.asarray(origin_m, dtype=np.float64)
    nodes = [
        {"id": k, "xyz": _rounded(place), "degree": degree}
        for k, (place, degree) in enumerate(zip(roadways.nodes_m + shift, roadways.degrees, strict=True))
    ]
    edges = [
        {
            "a": road.a,
            "b": road.b,
            "length_m": round(road.length_m, _DIGITS),
            "level": level,
            "path": [_rounded(point) for point in road.line_m[1:-1] + shift],
            "left_m": _rounded(road.left_m),
            "right_m": _rounded(road.right_m),
            "height_m": _rounded(road.height_m),
        }
        for road, level in zip(roadways.roadways, roadways.levels(), strict=True)
    ]
    raw = {"unit": "metre", "frame": frame, "width_height_m": roadways.width_height_m, "nodes": nodes, "edges": edges}
    with new_file(path, overwrite=overwrite) as temp:
        temp.write_text(json.dumps(raw, allow_nan=False, separators=(",", ":")) + "\n", encoding="utf-8")


def _rounded(values: F64) -> list[float | None]:
    return [round(value, _DIGITS) if np.isfinite(value) else None for value in values.tolist()]


def read_roadways(path: Path) -> MappedRoadways:
    """Roadways that `write_roadways` wrote, in the file's frame.

    Raises:
        FormatError: not such a file.
    """
    graph = read_graph(path)
    try:
        raw: Any = json.loads(path.read_text(encoding="utf-8"))
        if raw["unit"] != "metre":
            raise ValueError(f"unit {raw['unit']}")
        roads = tuple(
            MappedRoadway(road.a, road.b, road.line_m, *(_values(edge[key]) for key in _PROFILES))
            for road, edge in zip(graph.roadways, raw["edges"], strict=True)
        )
        return MappedRoadways(graph.nodes_m, roads, float(raw["width_height_m"]))
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            path,
            f"roadways without their widths ({error})",
            expected="a file of mineloc reconstruct",
            todo="make it anew",
        ) from None


_PROFILES = ("left_m", "right_m", "height_m")


def _values(values: list[float | None]) -> F64:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def write_intersections_csv(
    path: Path, roadways: MappedRoadways, *, origin_m: F64 | None = None, frame: str = "map", overwrite: bool = False
) -> None:
    """Write the intersections as CSV: number, coordinates in metres, how many roadways meet.

    Args:
        path: the file.
        roadways: what to write.
        origin_m: (3,) where the origin of the roadways' frame lies in `frame`; None: it is the same frame.
        frame: name of the file's frame.
        overwrite: replace an existing file.

    Raises:
        OutputError: `path` exists (unless `overwrite`) or cannot be written.
    """
    shift = np.zeros(3) if origin_m is None else np.asarray(origin_m, dtype=np.float64)
    lines = [f"# unit metre, frame {frame}", "node,east_m,north_m,up_m,roadways"]
    for node, (place, degree) in enumerate(zip((roadways.nodes_m + shift).tolist(), roadways.degrees, strict=True)):
        if degree >= 3:
            lines.append(f"{node},{place[0]:.3f},{place[1]:.3f},{place[2]:.3f},{degree}")
    with new_file(path, overwrite=overwrite) as temp:
        temp.write_text("\n".join(lines) + "\n", encoding="ascii")
