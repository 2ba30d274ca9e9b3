"""Triangles of a COLLADA (.dae) file, which open3d does not read: scene graph, unit and up axis applied."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mineloc.errors import FormatError

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

DEEPEST = 64


def read_collada(path: Path) -> tuple[F64, I64]:
    """Vertices (n, 3) in metres, z up, and triangles (m, 3) of all geometry in the file's scene.

    Raises:
        FormatError: not COLLADA, or its references lead nowhere.
    """
    try:
        root = ElementTree.parse(path).getroot()
        return _Document(root).triangles()
    except (ElementTree.ParseError, UnicodeDecodeError, KeyError, IndexError, ValueError, RecursionError) as error:
        raise FormatError(
            path,
            f"not a COLLADA mesh ({type(error).__name__}: {error})",
            expected="COLLADA 1.4",
            todo="export it again",
        ) from None


class _Document:
    """A parsed file, tags without their namespace."""

    def __init__(self, root: ElementTree.Element) -> None:
        for element in root.iter():
            element.tag = element.tag.rpartition("}")[2]
        if root.tag != "COLLADA":
            raise ValueError(f"root element {root.tag}")
        self.root = root
        self.by_id = {name: element for element in root.iter() if (name := element.get("id"))}
        self.vertices: list[F64] = []
        self.triangles_found: list[I64] = []
        self.count = 0

    def triangles(self) -> tuple[F64, I64]:
        for node in self.root.iterfind("library_visual_scenes/visual_scene/node"):
            self._visit(node, self._to_metres_z_up(), 0)
        if not self.triangles_found:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        return np.concatenate(self.vertices), np.concatenate(self.triangles_found)

    def _to_metres_z_up(self) -> F64:
        unit = self.root.find("asset/unit")
        metre = 1.0 if unit is None else float(unit.get("meter", "1"))
        axis = (self.root.findtext("asset/up_axis") or "Y_UP").strip()
        turn = {
            "X_UP": [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
            "Y_UP": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
            "Z_UP": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        }[axis]
        out = np.eye(4)
        out[:3, :3] = metre * np.array(turn, dtype=np.float64)
        return out

    def _visit(self, node: ElementTree.Element, parent: F64, depth: int) -> None:
        if depth > DEEPEST:
            raise ValueError("nodes refer to one another in a circle")
        here = parent @ _transform(node)
        for instance in node.iterfind("instance_geometry"):
            self._add(self._target(instance.get("url")), here)
        for instance in node.iterfind("instance_node"):
            self._visit(self._target(instance.get("url")), here, depth + 1)
        for child in node.iterfind("node"):
            self._visit(child, here, depth + 1)

    def _target(self, url: str | None) -> ElementTree.Element:
        return self.by_id[(url or "").removeprefix("#")]

    def _add(self, geometry: ElementTree.Element, T: F64) -> None:
        for mesh in geometry.iterfind("mesh"):
            for kind in ("triangles", "polylist", "polygons"):
                for group in mesh.iterfind(kind):
                    positions, faces = self._faces(group)
                    self.vertices.append(positions @ T[:3, :3].T + T[:3, 3])
                    # a mirrored node turns its triangles inside out
                    faces = faces[:, ::-1] if np.linalg.det(T[:3, :3]) < 0 else faces
                    self.triangles_found.append(faces + self.count)
                    self.count += len(positions)

    def _faces(self, group: ElementTree.Element) -> tuple[F64, I64]:
        inputs = list(group.iterfind("input"))
        stride = 1 + max(int(entry.get("offset", "0")) for entry in inputs)
        vertex = next(entry for entry in inputs if entry.get("semantic") == "VERTEX")
        offset = int(vertex.get("offset", "0"))
        positions = self._positions(self._target(vertex.get("source")))
        lists = [_integers(p.text).reshape(-1, stride)[:, offset] for p in group.iterfind("p")]
        if group.tag == "triangles":
            corners = np.full(sum(len(values) for values in lists) // 3, 3, np.int64)
        elif group.tag == "polylist":
            corners = _integers(group.findtext("vcount"))
        else:
            corners = np.array([len(values) for values in lists], np.int64)
        faces = _fans(np.concatenate([*lists, np.zeros(0, np.int64)]), corners)
        if faces.size and (faces.min() < 0 or faces.max() >= len(positions)):
            raise ValueError("a triangle names a vertex that is not there")
        return positions, faces

    def _positions(self, vertices: ElementTree.Element) -> F64:
        entry = next(e for e in vertices.iterfind("input") if e.get("semantic") == "POSITION")
        source = self._target(entry.get("source"))
        values = np.array((source.findtext("float_array") or "").split(), dtype=np.float64)
        accessor = source.find("technique_common/accessor")
        stride = 3 if accessor is None else int(accessor.get("stride", "3"))
        return values.reshape(-1, stride)[:, :3]


def _integers(text: str | None) -> I64:
    return np.array((text or "").split(), dtype=np.int64)


def _fans(corners: I64, counts: I64) -> I64:
    """Triangles (m, 3) of polygons given one after the other, each as a fan from its first corner."""
    start = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else np.zeros(0, np.int64)
    extra = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), extra)
    within = np.arange(len(polygon)) - np.repeat(np.cumsum(extra) - extra, extra)
    first = start[polygon]
    return np.stack([corners[first], corners[first + within + 1], corners[first + within + 2]], axis=1)


def _transform(node: ElementTree.Element) -> F64:
    """(4, 4) of all transform elements of a node, in their order."""
    out = np.eye(4)
    for element in node:
        step = np.eye(4)
        if element.tag not in ("matrix", "translate", "scale", "rotate"):
            continue
        values = np.array((element.text or "").split(), dtype=np.float64)
        if element.tag == "matrix":
            step = values.reshape(4, 4)
        elif element.tag == "translate":
            step[:3, 3] = values
        elif element.tag == "scale":
            step[:3, :3] = np.diag(values)
        else:
            step[:3, :3] = Rotation.from_rotvec(np.deg2rad(values[3]) * values[:3]).as_matrix()
        out = out @ step
    return out
