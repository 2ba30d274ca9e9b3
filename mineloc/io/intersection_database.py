"""The intersection database as an MCAP file: exact records of our own beside messages that Foxglove draws as they are.

Clouds are `foxglove.PointCloud`, names and branches a `foxglove.SceneUpdate`, both as JSON; what they cannot hold
(descriptors, covariance, neighbours) is in the records, positions there as decimal doubles. Equal databases give equal
bytes.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

from mineloc.data import F32, F64, Intersection, IntersectionDatabase, WallContour
from mineloc.errors import FormatError
from mineloc.output import new_file

SCHEMA = "mineloc.intersections/1"
_FACTS, _RECORDS = "/intersections/facts", "/intersections/records"
_CLOUDS, _SCENE = "/intersections/clouds", "/intersections/scene"
_POINT_BYTES = 24
_FLOAT32 = 7  # of foxglove.PackedElementField
_BRANCH_M = 3.0


def write_database(path: Path, database: IntersectionDatabase, *, overwrite: bool = False) -> None:
    """Write a database; nothing appears at `path` before it is whole.

    Raises:
        OutputError: `path` exists or cannot be written.
    """
    with new_file(path, overwrite=overwrite) as temp, temp.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, use_statistics=True)
        writer.start(profile="", library="mineloc")
        channels = {
            topic: writer.register_channel(
                topic=topic,
                message_encoding="json",
                schema_id=writer.register_schema(
                    name=schema, encoding="jsonschema", data=json.dumps({"title": schema, "type": "object"}).encode()
                ),
            )
            for topic, schema in (
                (_FACTS, SCHEMA),
                (_RECORDS, SCHEMA),
                (_CLOUDS, "foxglove.PointCloud"),
                (_SCENE, "foxglove.SceneUpdate"),
            )
        }
        writer.add_metadata(SCHEMA, {})
        # no checksum covers metadata: the facts are a message
        facts = json.dumps(_facts(database), sort_keys=True, allow_nan=False).encode()
        writer.add_message(channels[_FACTS], log_time=0, publish_time=0, data=facts)
        for k, one in enumerate(database.intersections):
            for topic, message in ((_RECORDS, _record(one)), (_CLOUDS, _cloud(one))):
                data = json.dumps(message, sort_keys=True, allow_nan=False).encode()
                writer.add_message(channels[topic], log_time=k, publish_time=k, sequence=k, data=data)
        scene = json.dumps(_scene(database), sort_keys=True, allow_nan=False).encode()
        writer.add_message(channels[_SCENE], log_time=0, publish_time=0, data=scene)
        writer.finish()


def read_database(path: Path) -> IntersectionDatabase:
    """Read a database, every byte of it checked.

    Raises:
        FormatError: missing, damaged, another kind of file, or of another version.
    """
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            kinds = [one.name for one in reader.iter_metadata() if one.name.startswith("mineloc.intersections/")]
            if kinds != [SCHEMA]:
                found = kinds[0] if kinds else "no database of intersections"
                raise FormatError(path, f"holds {found}", expected=SCHEMA, todo="make it again with this version")
            messages: dict[str, list[Any]] = {_FACTS: [], _RECORDS: [], _CLOUDS: []}
            for _, channel, message in reader.iter_messages(topics=list(messages)):
                messages[channel.topic].append(json.loads(message.data))
        (facts,) = messages[_FACTS]
        return _database(facts, messages[_RECORDS], messages[_CLOUDS])
    except FormatError:
        raise
    except FileNotFoundError as error:
        raise FormatError(
            path, "no such file", expected="a database of intersections", todo="check the path"
        ) from error
    except (OSError, McapError, ValueError, LookupError, TypeError, EOFError, struct.error, ZstdError) as error:
        raise FormatError(
            path, f"is damaged ({error})", expected="a whole database of intersections", todo="make it again"
        ) from error


def is_database(path: Path) -> bool:
    """Whether a file says that it is a database of intersections, of any version; False where it cannot be read."""
    try:
        with path.open("rb") as stream:
            names = [one.name for one in make_reader(stream).iter_metadata()]
    except (OSError, McapError, ValueError, EOFError, struct.error):
        return False
    return any(name.startswith("mineloc.intersections/") for name in names)


def _facts(database: IntersectionDatabase) -> dict[str, Any]:
    return {
        "count": len(database),
        "grid_origin_m": database.grid_origin_m.tolist(),
        "is_grid": database.is_grid,
        "map_sha256": database.map_sha256,
        "contour_similarity": database.contour_similarity.tolist(),
        "matrix_similarity": database.matrix_similarity.tolist(),
        "contour_threshold": database.contour_threshold,
        "twins": [list(pair) for pair in database.twins],
    }


def _record(one: Intersection) -> dict[str, Any]:
    contour = one.contour
    return {
        "id": one.id,
        "name": one.name,
        "kind": one.kind,
        "point_map": one.point_map.tolist(),
        "covariance_m2": one.covariance_m2.tolist(),
        "branches_rad": contour.branches_rad.tolist(),
        "contour_radius_m": contour.radius_m,
        "contour_distance": contour.distance.astype(float).tolist(),
        "contour_sight": contour.sight.tolist(),
        "matrix": one.matrix.astype(float).tolist(),
        "neighbours": [[id, length_m] for id, length_m in one.neighbours],
        "quality": one.quality,
    }


def _cloud(one: Intersection) -> dict[str, Any]:
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    data = np.column_stack([one.points_m, one.normals]).astype("<f4").tobytes()
    return {
        "timestamp": {"sec": 0, "nsec": one.id},
        "frame_id": "map",
        "pose": {
            "position": dict(zip("xyz", one.point_map.tolist(), strict=True)),
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
        "point_stride": _POINT_BYTES,
        "fields": [{"name": name, "offset": 4 * k, "type": _FLOAT32} for k, name in enumerate(names)],
        "data": base64.b64encode(data).decode(),
    }


def _scene(database: IntersectionDatabase) -> dict[str, Any]:
    """Names over the points, and a line a branch."""
    entities = []
    for one in database.intersections:
        x, y, z = one.point_map.tolist()
        ends = [
            {"x": x + _BRANCH_M * float(np.cos(b)), "y": y + _BRANCH_M * float(np.sin(b)), "z": z}
            for b in one.contour.branches_rad
        ]
        centre = {"x": x, "y": y, "z": z}
        orange, white = {"r": 0.9, "g": 0.6, "b": 0.0, "a": 1.0}, {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0}
        level = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        entities.append(
            {
                "timestamp": {"sec": 0, "nsec": 0},
                "frame_id": "map",
                "id": str(one.id),
                "lifetime": {"sec": 0, "nsec": 0},
                "frame_locked": False,
                "metadata": [],
                "lines": [
                    {
                        "type": 2,
                        "pose": {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": level},
                        "thickness": 0.2,
                        "scale_invariant": False,
                        "points": [point for end in ends for point in (centre, end)],
                        "color": orange,
                        "colors": [],
                        "indices": [],
                    }
                ],
                "texts": [
                    {
                        "pose": {"position": {"x": x, "y": y, "z": z + 2.0}, "orientation": level},
                        "billboard": True,
                        "font_size": 1.5,
                        "scale_invariant": False,
                        "color": white,
                        "text": one.name,
                    }
                ],
            }
        )
    return {"deletions": [], "entities": entities}


def _database(
    facts: dict[str, Any], records: list[dict[str, Any]], clouds: list[dict[str, Any]]
) -> IntersectionDatabase:
    if len(records) != facts["count"] or len(clouds) != facts["count"]:
        raise ValueError(f"{len(records)} records and {len(clouds)} clouds of {facts['count']}")
    count = int(facts["count"])
    return IntersectionDatabase(
        intersections=tuple(_intersection(record, cloud) for record, cloud in zip(records, clouds, strict=True)),
        grid_origin_m=_doubles(facts["grid_origin_m"]),
        is_grid=bool(facts["is_grid"]),
        map_sha256=str(facts["map_sha256"]),
        contour_similarity=_doubles(facts["contour_similarity"]).reshape(count, count),
        matrix_similarity=_doubles(facts["matrix_similarity"]).reshape(count, count),
        contour_threshold=float(facts["contour_threshold"]),
        twins=tuple((int(a), int(b)) for a, b in facts["twins"]),
    )


def _intersection(record: dict[str, Any], cloud: dict[str, Any]) -> Intersection:
    points = np.frombuffer(base64.b64decode(cloud["data"], validate=True), "<f4").reshape(-1, _POINT_BYTES // 4)
    return Intersection(
        id=int(record["id"]),
        name=str(record["name"]),
        kind=record["kind"],
        point_map=_doubles(record["point_map"]),
        covariance_m2=_doubles(record["covariance_m2"]),
        contour=WallContour(
            distance=_singles(record["contour_distance"]),
            sight=np.array(record["contour_sight"], dtype=np.uint8),
            radius_m=float(record["contour_radius_m"]),
            branches_rad=_doubles(record["branches_rad"]),
        ),
        matrix=_singles(record["matrix"]),
        points_m=np.ascontiguousarray(points[:, :3], dtype=np.float32),
        normals=np.ascontiguousarray(points[:, 3:], dtype=np.float32),
        neighbours=tuple((int(id), float(length_m)) for id, length_m in record["neighbours"]),
        quality=float(record["quality"]),
    )


def _doubles(values: Any) -> F64:
    return np.array(values, dtype=np.float64)


def _singles(values: Any) -> F32:
    return np.array(values, dtype=np.float32)
