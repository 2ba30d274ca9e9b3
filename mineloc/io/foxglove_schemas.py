"""The two of Foxglove's message schemas that a database carries, as JSON Schema; a viewer decodes messages by them."""

from __future__ import annotations

from typing import Any

_NUMBER: dict[str, Any] = {"type": "number"}
_INTEGER: dict[str, Any] = {"type": "integer"}
_TEXT: dict[str, Any] = {"type": "string"}
_FLAG: dict[str, Any] = {"type": "boolean"}
_BYTES: dict[str, Any] = {"type": "string", "contentEncoding": "base64"}


def _object(title: str, **properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_TIME = _object("time", sec=_INTEGER, nsec=_INTEGER)
_DURATION = _object("duration", sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT = _object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOR = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_KEY_VALUE = _object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)
_MESH = {"pose": _POSE, "points": _list(_POINT), "color": _COLOR, "colors": _list(_COLOR), "indices": _list(_INTEGER)}
_BODY = {"pose": _POSE, "size": _VECTOR, "color": _COLOR}

_PRIMITIVES: dict[str, dict[str, Any]] = {
    "arrows": _object(
        "foxglove.ArrowPrimitive", pose=_POSE, shaft_length=_NUMBER, shaft_diameter=_NUMBER, head_length=_NUMBER,
        head_diameter=_NUMBER, color=_COLOR,
    ),
    "cubes": _object("foxglove.CubePrimitive", **_BODY),
    "spheres": _object("foxglove.SpherePrimitive", **_BODY),
    "cylinders": _object("foxglove.CylinderPrimitive", **_BODY, bottom_scale=_NUMBER, top_scale=_NUMBER),
    "lines": _object("foxglove.LinePrimitive", type=_INTEGER, thickness=_NUMBER, scale_invariant=_FLAG, **_MESH),
    "triangles": _object("foxglove.TriangleListPrimitive", **_MESH),
    "texts": _object(
        "foxglove.TextPrimitive", pose=_POSE, billboard=_FLAG, font_size=_NUMBER, scale_invariant=_FLAG, color=_COLOR,
        text=_TEXT,
    ),
    "models": _object(
        "foxglove.ModelPrimitive", pose=_POSE, scale=_VECTOR, color=_COLOR, override_color=_FLAG, url=_TEXT,
        media_type=_TEXT, data=_BYTES,
    ),
}  # fmt: skip

POINT_CLOUD = _object(
    "foxglove.PointCloud",
    timestamp=_TIME,
    frame_id=_TEXT,
    pose=_POSE,
    point_stride=_INTEGER,
    fields=_list(_object("foxglove.PackedElementField", name=_TEXT, offset=_INTEGER, type=_INTEGER)),
    data=_BYTES,
)
SCENE_UPDATE = _object(
    "foxglove.SceneUpdate",
    deletions=_list(_object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_INTEGER, id=_TEXT)),
    entities=_list(
        _object(
            "foxglove.SceneEntity",
            timestamp=_TIME,
            frame_id=_TEXT,
            id=_TEXT,
            lifetime=_DURATION,
            frame_locked=_FLAG,
            metadata=_list(_KEY_VALUE),
            **{name: _list(primitive) for name, primitive in _PRIMITIVES.items()},
        )
    ),
)
PRIMITIVES = tuple(_PRIMITIVES)
"""Every kind that a scene entity lists, if only as an empty list."""
