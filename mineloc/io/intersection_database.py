"""The intersection database as an MCAP file: exact records of our own beside messages that Foxglove draws as they are.

Clouds are `foxglove.PointCloud`, names and branches a `foxglove.SceneUpdate`, both as JSON; what they cannot hold
(descriptors, covariance, neighbours) is in the records, positions there as decimal doubles. Equal databases give equal
bytes.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

from mineloc.data import F32, F64, Intersection, IntersectionDatabase, Lineage, WallContour
from mineloc.errors import FormatError
from mineloc.io.foxglove_schemas import POINT_CLOUD, SCENE_UPDATE
from mineloc.io.intersection_messages import cloud_message, points_and_normals, scene_message
from mineloc.output import new_file

SCHEMA_VERSION = 2
_FAMILY = "mineloc.intersections/"
SCHEMA = f"{_FAMILY}{SCHEMA_VERSION}"
_FACTS, _RECORDS = "/intersections/facts", "/intersections/records"
_CLOUDS, _SCENE = "/intersections/clouds", "/intersections/scene"
_ORIGINS = {
    f"{_FAMILY}1": frozenset({"map_sha256"}),
    SCHEMA: frozenset({"version", "parents", "next_id", "maps"}),
}
"""Facts that are told in one version of the schema alone: version 1 knew neither parents nor several maps."""
_FACT_NAMES = frozenset(
    {"count", "grid_origin_m", "is_grid", "contour_similarity", "matrix_similarity", "contour_threshold", "twins"}
)
_RECORD_NAMES = frozenset(
    {"id", "name", "kind", "point_map", "covariance_m2", "branches_rad", "contour_radius_m", "contour_distance"}
    | {"contour_sight", "matrix", "neighbours", "quality"}
)
_DAMAGE = (
    *(OSError, McapError, ValueError, LookupError, TypeError, EOFError, struct.error, ZstdError),
    *(MemoryError, OverflowError),  # of lengths that are not what they were
)
"""What the readers of MCAP, zstd and JSON raise over bytes that are not what they were."""


def write_database(path: Path, database: IntersectionDatabase, *, overwrite: bool = False) -> None:
    """Write a database; nothing appears at `path` before it is whole.

    Raises:
        OutputError: `path` exists or cannot be written.
    """
    with new_file(path, overwrite=overwrite) as temp, temp.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, use_statistics=True)
        writer.start(profile="", library="mineloc")
        own = {"title": SCHEMA, "type": "object"}
        channels = {
            topic: writer.register_channel(
                topic=topic,
                message_encoding="json",
                schema_id=writer.register_schema(
                    name=schema["title"], encoding="jsonschema", data=json.dumps(schema, sort_keys=True).encode()
                ),
            )
            for topic, schema in (
                (_FACTS, own),
                (_RECORDS, own),
                (_CLOUDS, POINT_CLOUD),
                (_SCENE, SCENE_UPDATE),
            )
        }
        writer.add_metadata(SCHEMA, {})
        # no checksum covers metadata: the facts are a message
        facts = json.dumps(_facts(database), sort_keys=True, allow_nan=False).encode()
        writer.add_message(channels[_FACTS], log_time=0, publish_time=0, data=facts)
        for k, one in enumerate(database.intersections):
            for topic, message in ((_RECORDS, _record(one)), (_CLOUDS, cloud_message(one))):
                data = json.dumps(message, sort_keys=True, allow_nan=False).encode()
                writer.add_message(channels[topic], log_time=k, publish_time=k, sequence=k, data=data)
        scene = json.dumps(scene_message(database), sort_keys=True, allow_nan=False).encode()
        writer.add_message(channels[_SCENE], log_time=0, publish_time=0, data=scene)
        writer.finish()


def read_database(path: Path) -> IntersectionDatabase:
    """Read a database, every byte of it checked.

    Version 1 of the schema is read too: it tells all that a first version of a database needs.

    Raises:
        FormatError: missing, damaged, another kind of file, or of a version of the schema that is not known.
    """
    if path.is_dir():
        raise FormatError(path, "is a folder", expected="a database of intersections", todo="check the path")
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            schema = _known_schema(path, [one.name for one in reader.iter_metadata()])
            messages: dict[str, list[Any]] = {_FACTS: [], _RECORDS: [], _CLOUDS: []}
            for _, channel, message in reader.iter_messages(topics=list(messages)):
                messages[channel.topic].append(json.loads(message.data))
        (facts,) = messages[_FACTS]
        return _database(schema, facts, messages[_RECORDS], messages[_CLOUDS])
    except FormatError:
        raise
    except FileNotFoundError as error:
        raise FormatError(
            path, "no such file", expected="a database of intersections", todo="check the path"
        ) from error
    except _DAMAGE as error:
        reason = str(error) or type(error).__name__
        raise FormatError(
            path,
            f"is damaged ({reason})",
            expected="a whole database of intersections",
            todo="take a copy of it, or make it again",
        ) from error


def _known_schema(path: Path, names: list[str]) -> str:
    """The schema that a file says it has.

    Raises:
        FormatError: none, or one that this version of mineloc cannot read in full.
    """
    found = [name for name in names if name.startswith(_FAMILY)]
    if len(found) == 1 and found[0] in _ORIGINS:
        return found[0]
    if not found:
        raise FormatError(
            path, "holds no database of intersections", expected=SCHEMA, todo="name a file of `mineloc database`"
        )
    number = found[0].removeprefix(_FAMILY)
    is_newer = number.isdecimal() and int(number) > SCHEMA_VERSION
    raise FormatError(
        path,
        f"holds {' and '.join(found)}",
        expected=" or ".join(_ORIGINS),
        todo="update mineloc, which is older than the file" if is_newer else "make it again with this mineloc",
    )


def is_database(path: Path) -> bool:
    """Whether a file says that it is a database of intersections, of any version; False where it cannot be read."""
    try:
        with path.open("rb") as stream:
            names = [one.name for one in make_reader(stream).iter_metadata()]
    except _DAMAGE:
        return False
    return any(name.startswith(_FAMILY) for name in names)


def _facts(database: IntersectionDatabase) -> dict[str, Any]:
    return {
        "count": len(database),
        "grid_origin_m": database.grid_origin_m.tolist(),
        "is_grid": database.is_grid,
        "version": database.lineage.version,
        "parents": list(database.lineage.parents),
        "next_id": database.lineage.next_id,
        "maps": list(database.lineage.maps),
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


def _database(
    schema: str, facts: dict[str, Any], records: list[dict[str, Any]], clouds: list[dict[str, Any]]
) -> IntersectionDatabase:
    # metadata, which names the schema, has no checksum: facts of another one tell that it is wrong
    if frozenset(facts) != _FACT_NAMES | _ORIGINS[schema] or any(
        frozenset(record) != _RECORD_NAMES for record in records
    ):
        raise ValueError(f"not the fields of {schema}")
    if len(records) != facts["count"] or len(clouds) != facts["count"]:
        raise ValueError(f"{len(records)} records and {len(clouds)} clouds of {facts['count']}")
    count = int(facts["count"])
    return IntersectionDatabase(
        intersections=tuple(_intersection(record, cloud) for record, cloud in zip(records, clouds, strict=True)),
        grid_origin_m=_doubles(facts["grid_origin_m"]),
        is_grid=bool(facts["is_grid"]),
        lineage=_lineage(facts, records),
        contour_similarity=_doubles(facts["contour_similarity"]).reshape(count, count),
        matrix_similarity=_doubles(facts["matrix_similarity"]).reshape(count, count),
        contour_threshold=float(facts["contour_threshold"]),
        twins=tuple((int(a), int(b)) for a, b in facts["twins"]),
    )


def _lineage(facts: dict[str, Any], records: list[dict[str, Any]]) -> Lineage:
    if "map_sha256" in facts:
        # nothing of version 1 follows another: its ids are all that were ever given
        return Lineage.first(str(facts["map_sha256"]), (int(record["id"]) for record in records))
    return Lineage(
        version=int(facts["version"]),
        parents=tuple(str(one) for one in facts["parents"]),
        next_id=int(facts["next_id"]),
        maps=tuple(str(one) for one in facts["maps"]),
    )


def _intersection(record: dict[str, Any], cloud: dict[str, Any]) -> Intersection:
    points, normals = points_and_normals(cloud)
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
        points_m=points,
        normals=normals,
        neighbours=tuple((int(id), float(length_m)) for id, length_m in record["neighbours"]),
        quality=float(record["quality"]),
    )


def _doubles(values: Any) -> F64:
    return np.array(values, dtype=np.float64)


def _singles(values: Any) -> F32:
    return np.array(values, dtype=np.float32)
