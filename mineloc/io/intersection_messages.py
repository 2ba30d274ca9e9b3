"""What Foxglove draws of an intersection database: `foxglove.PointCloud` and `foxglove.SceneUpdate`, as JSON."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from mineloc.data import F32, Intersection, IntersectionDatabase
from mineloc.io.foxglove_schemas import PRIMITIVES

_POINT_BYTES = 24
_FLOAT32 = 7  # of foxglove.PackedElementField
_LINE_LIST = 2  # of foxglove.LinePrimitive
_BRANCH_M = 3.0
_NAME_ABOVE_M = 2.0
_LEVEL = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_ORANGE, _WHITE = {"r": 0.9, "g": 0.6, "b": 0.0, "a": 1.0}, {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}


def cloud_message(one: Intersection) -> dict[str, Any]:
    """`foxglove.PointCloud` of the dense cloud of an intersection, posed at its point."""
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    data = np.column_stack([one.points_m, one.normals]).astype("<f4").tobytes()
    return {
        "timestamp": {"sec": 0, "nsec": one.id},
        "frame_id": "map",
        "pose": {"position": _xyz(*one.point_map.tolist()), "orientation": _LEVEL},
        "point_stride": _POINT_BYTES,
        "fields": [{"name": name, "offset": 4 * k, "type": _FLOAT32} for k, name in enumerate(names)],
        "data": base64.b64encode(data).decode(),
    }


def points_and_normals(message: dict[str, Any]) -> tuple[F32, F32]:
    """(n, 3) points and (n, 3) normals of a `cloud_message`.

    Raises:
        ValueError, LookupError, TypeError: the message is not such a one.
    """
    rows = np.frombuffer(base64.b64decode(message["data"], validate=True), "<f4").reshape(-1, _POINT_BYTES // 4)
    return (
        np.ascontiguousarray(rows[:, :3], dtype=np.float32),
        np.ascontiguousarray(rows[:, 3:], dtype=np.float32),
    )


def scene_message(database: IntersectionDatabase) -> dict[str, Any]:
    """`foxglove.SceneUpdate`: names over the points, and a line a branch."""
    return {"deletions": [], "entities": [_entity(one) for one in database.intersections]}


def _entity(one: Intersection) -> dict[str, Any]:
    x, y, z = one.point_map.tolist()
    bearings = one.contour.branches_rad
    ends = [_xyz(x + _BRANCH_M * float(np.cos(b)), y + _BRANCH_M * float(np.sin(b)), z) for b in bearings]
    branches = {
        "type": _LINE_LIST,
        "pose": {"position": _xyz(0.0, 0.0, 0.0), "orientation": _LEVEL},
        "thickness": 0.2,
        "scale_invariant": False,
        "points": [point for end in ends for point in (_xyz(x, y, z), end)],
        "color": _ORANGE,
        "colors": [],
        "indices": [],
    }
    name = {
        "pose": {"position": _xyz(x, y, z + _NAME_ABOVE_M), "orientation": _LEVEL},
        "billboard": True,
        "font_size": 1.5,
        "scale_invariant": False,
        "color": _WHITE,
        "text": one.name,
    }
    return {
        "timestamp": {"sec": 0, "nsec": 0},
        "frame_id": "map",
        "id": str(one.id),
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [],
        # a viewer that decodes by the schema wants every kind
        **{kind: [] for kind in PRIMITIVES},
        "lines": [branches],
        "texts": [name],
    }


def _xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}
