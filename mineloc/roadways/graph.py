"""The roadway graph of a mine: where roadways meet, and the centre-lines between."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mineloc.errors import FormatError

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Roadway:
    """One roadway between two nodes.

    Attributes:
        a, b: indices of its end nodes.
        line_m: (n, 3) centre-line on the floor from a to b, map frame.
    """

    a: int
    b: int
    line_m: F64

    @property
    def length_m(self) -> float:
        """Length of the centre-line."""
        return float(np.linalg.norm(np.diff(self.line_m, axis=0), axis=1).sum())


@dataclass(frozen=True, slots=True, eq=False)
class RoadwayGraph:
    """Nodes (intersections, ends, bends) and the roadways between them.

    Attributes:
        nodes_m: (n, 3) positions on the floor, map frame.
        roadways: the edges.
    """

    nodes_m: F64
    roadways: tuple[Roadway, ...]

    def at_node(self) -> list[list[int]]:
        """For each node the roadways that end there; a roadway that returns to its own node counts twice."""
        out: list[list[int]] = [[] for _ in range(len(self.nodes_m))]
        for index, road in enumerate(self.roadways):
            out[road.a].append(index)
            out[road.b].append(index)
        return out

    @property
    def intersections(self) -> list[int]:
        """Nodes where at least three roadways meet."""
        return [node for node, roads in enumerate(self.at_node()) if len(roads) >= 3]

    @property
    def length_m(self) -> float:
        """Total length of all roadways."""
        return sum(road.length_m for road in self.roadways)


def read_graph(path: Path, *, floor_z_m: float = 0.0) -> RoadwayGraph:
    """A roadway graph from JSON: `nodes` [{id, xy or xyz}], `edges` [{a, b, path}] with (n, 2) or (n, 3) paths.

    Raises:
        FormatError: not such a file.
    """
    try:
        raw: Any = json.loads(path.read_text(encoding="utf-8"))
        floor = float(raw.get("z_floor", floor_z_m))
        index = {node["id"]: k for k, node in enumerate(raw["nodes"])}
        nodes = np.array([_xyz(node.get("xyz", node.get("xy")), floor) for node in raw["nodes"]])
        roads = tuple(_roadway(edge, index, nodes, floor) for edge in raw["edges"])
    except (
        OSError,
        UnicodeDecodeError,
        json.JSONDecodeError,
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
    ) as error:
        raise FormatError(
            path, f"not a roadway graph ({error})", expected="JSON with nodes and edges", todo="correct the file"
        ) from None
    if not roads:
        raise FormatError(path, "no edges", expected="at least one roadway", todo="correct the file")
    return RoadwayGraph(nodes, roads)


def _xyz(values: list[float], floor_z_m: float) -> F64:
    return np.array([*values[:2], values[2] if len(values) > 2 else floor_z_m], dtype=np.float64)


def _roadway(edge: dict[str, Any], index: dict[int, int], nodes: F64, floor_z_m: float) -> Roadway:
    a, b = index[edge["a"]], index[edge["b"]]
    inner = [_xyz(point, floor_z_m) for point in edge["path"]]
    return Roadway(a, b, np.array([nodes[a], *inner, nodes[b]]))
