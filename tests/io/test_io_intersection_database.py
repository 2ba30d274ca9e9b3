"""The database file: exact, equal for equal content, whole or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from mineloc.config import IntersectionsConfig
from mineloc.data import Intersection, IntersectionDatabase, Lineage, Sight, WallContour
from mineloc.errors import FormatError, OutputError
from mineloc.io.intersection_database import SCHEMA, is_database, read_database, write_database
from mineloc.places.database import database_of

GRID = np.array([512_345.678901234, 4_398_765.4321, 2_300.1])


def intersection(id: int, seed: int, *, name: str = "") -> Intersection:
    rng = np.random.default_rng(seed)
    sight = rng.choice([Sight.WALL, Sight.OPEN, Sight.UNKNOWN], 180).astype(np.uint8)
    distance = np.where(sight == Sight.WALL, rng.uniform(0.1, 1, 180), 0).astype(np.float32)
    n = int(rng.integers(0, 50))
    return Intersection(
        id=id,
        name=name or f"Y {id}",
        kind="Y",
        point_map=rng.normal(0, 500, 3),
        covariance_m2=np.diag(rng.uniform(0.01, 1, 3)),
        contour=WallContour(distance, sight, 8.0, np.sort(rng.uniform(0, 6.28, 3))),
        matrix=rng.uniform(0, 1, (20, 180)).astype(np.float32),
        points_m=rng.normal(0, 5, (n, 3)).astype(np.float32),
        normals=rng.normal(0, 1, (n, 3)).astype(np.float32),
        neighbours=((id + 1, float(rng.uniform(5, 100))),),
        quality=float(rng.uniform(0, 1)),
    )


def some(count: int, seed: int, **names: str) -> IntersectionDatabase:
    found = [intersection(3 * k, seed + k, **names) for k in range(count)]
    return database_of(found, IntersectionsConfig(), grid_origin_m=GRID, is_grid=True, map_sha256="ab" * 32)


def assert_equal(a: IntersectionDatabase, b: IntersectionDatabase) -> None:
    assert (a.is_grid, a.lineage, a.contour_threshold, a.twins) == (
        b.is_grid, b.lineage, b.contour_threshold, b.twins,
    )  # fmt: skip
    for name in ("grid_origin_m", "contour_similarity", "matrix_similarity"):
        assert np.array_equal(getattr(a, name), getattr(b, name))
    assert len(a) == len(b)
    for one, other in zip(a.intersections, b.intersections, strict=True):
        facts = [(x.id, x.name, x.kind, x.neighbours, x.quality, x.contour.radius_m) for x in (one, other)]
        assert facts[0] == facts[1]
        for name in ("point_map", "covariance_m2", "matrix", "points_m", "normals"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
        for name in ("distance", "sight", "branches_rad"):
            assert np.array_equal(getattr(one.contour, name), getattr(other.contour, name)), name


@settings(deadline=None, max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(count=st.integers(0, 4), seed=st.integers(0, 1000), name=st.text(max_size=20))
def test_what_is_written_is_read(tmp_path: Path, count: int, seed: int, name: str) -> None:
    database = some(count, seed, name=name)
    if seed % 2:
        line = Lineage(1 + seed, ("cd" * 32, "ef" * 32)[: 1 + seed % 3], 20 + seed, ("ab" * 32, "bc" * 32))
        database = replace(database, lineage=line)
    write_database(tmp_path / "db.mcap", database, overwrite=True)
    assert_equal(read_database(tmp_path / "db.mcap"), database)
    write_database(tmp_path / "again.mcap", database, overwrite=True)
    assert (tmp_path / "db.mcap").read_bytes() == (tmp_path / "again.mcap").read_bytes()


def test_others_find_messages_that_they_draw(tmp_path: Path) -> None:
    write_database(tmp_path / "db.mcap", some(3, 1))
    with (tmp_path / "db.mcap").open("rb") as stream:
        schemas = [schema.name for schema, _, _ in make_reader(stream).iter_messages()]
    assert schemas.count("foxglove.PointCloud") == 3
    assert schemas.count("foxglove.SceneUpdate") == 1


def fits(value: Any, schema: dict[str, Any]) -> bool:
    """Whether a message is what a JSON Schema of the kind that Foxglove publishes says."""
    kind = schema["type"]
    if kind == "object":
        own = schema["properties"]
        return set(value) == set(own) and all(fits(value[name], part) for name, part in own.items())
    if kind == "array":
        return isinstance(value, list) and all(fits(item, schema["items"]) for item in value)
    types = {"number": (int, float), "integer": int, "string": str, "boolean": bool}
    return isinstance(value, types[kind])


def test_messages_are_what_their_schemas_in_the_file_say(tmp_path: Path) -> None:
    write_database(tmp_path / "a.mcap", some(3, 1))
    checked: set[str] = set()
    with (tmp_path / "a.mcap").open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages():
            assert schema is not None
            if schema.name.startswith("foxglove."):
                assert fits(json.loads(message.data), json.loads(schema.data))
                assert not fits({}, json.loads(schema.data))
                checked.add(schema.name)
    assert checked == {"foxglove.PointCloud", "foxglove.SceneUpdate"}


def test_a_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "db.mcap"
    write_database(path, some(2, 5))
    content = path.read_bytes()
    whole = read_database(path)
    rng = np.random.default_rng(0)
    for at in rng.integers(9, len(content) - 9, 60):
        damaged = bytearray(content)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(damaged))
        # the file's index repeats what is elsewhere, and names the writer: there a bit changes nothing that is read
        try:
            found = read_database(path)
        except FormatError:
            continue
        assert_equal(found, whole)


@pytest.mark.parametrize("length", [1 << 46, 1 << 63])
def test_a_length_without_sense_is_damage(tmp_path: Path, length: int) -> None:
    path = tmp_path / "db.mcap"
    write_database(path, some(2, 5))
    content, refused = path.read_bytes(), 0
    whole = read_database(path)
    for at in range(80, 140):  # the first chunk's record and its sizes
        path.write_bytes(content[:at] + length.to_bytes(8, "little") + content[at + 8 :])
        try:
            assert_equal(read_database(path), whole)
        except FormatError:
            refused += 1
        is_database(path)
    assert refused > 30


def rewritten(path: Path, to: Path, *, schema: str, change: Callable[[str, dict[str, Any]], dict[str, Any]]) -> Path:
    """The messages of a database under another schema, each changed by topic."""
    with path.open("rb") as source, to.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata(schema, {})
        for old, channel, message in make_reader(source).iter_messages(log_time_order=False):
            id = writer.register_channel(
                channel.topic, "json", writer.register_schema(old.name, old.encoding, old.data)
            )
            data = json.dumps(change(channel.topic, json.loads(message.data))).encode()
            writer.add_message(id, message.log_time, data, message.publish_time, message.sequence)
        writer.finish()
    return to


def as_version_1(topic: str, message: dict[str, Any]) -> dict[str, Any]:
    if topic != "/intersections/facts":
        return message
    kept = {name: message[name] for name in message if name not in ("version", "parents", "next_id", "maps")}
    return {**kept, "map_sha256": message["maps"][0]}


def test_version_1_is_read_as_the_first_of_its_mine(tmp_path: Path) -> None:
    whole = some(3, 8)
    write_database(tmp_path / "db.mcap", whole)
    old = rewritten(tmp_path / "db.mcap", tmp_path / "old.mcap", schema="mineloc.intersections/1", change=as_version_1)
    assert_equal(read_database(old), whole)
    assert read_database(old).lineage == Lineage(1, (), 7, ("ab" * 32,))


@pytest.mark.parametrize(
    ("topic", "changed"),
    [
        ("facts", {"map_sha256": "ab"}),
        ("facts", {"later": 1}),
        ("records", {"later": 1}),
        ("facts", {"next_id": 3}),
        ("facts", {"version": 0}),
        ("facts", {"version": 2}),
        ("facts", {"maps": []}),
        ("facts", {"count": 1}),
        ("records", {"id": 0}),
    ],
)
def test_what_cannot_be_read_in_full_is_refused(tmp_path: Path, topic: str, changed: dict[str, Any]) -> None:
    write_database(tmp_path / "db.mcap", some(2, 8))
    odd = rewritten(
        tmp_path / "db.mcap",
        tmp_path / "odd.mcap",
        schema=SCHEMA,
        change=lambda on, message: {**message, **changed} if on.endswith(topic) else message,
    )
    with pytest.raises(FormatError, match="is damaged"):
        read_database(odd)


def test_a_file_of_one_version_that_says_another_is_refused(tmp_path: Path) -> None:
    write_database(tmp_path / "db.mcap", some(2, 8))
    for schema, change in (("mineloc.intersections/1", lambda _, message: message), (SCHEMA, as_version_1)):
        odd = rewritten(tmp_path / "db.mcap", tmp_path / "odd.mcap", schema=schema, change=change)
        with pytest.raises(FormatError, match="is damaged"):
            read_database(odd)


def test_a_file_that_ends_early_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "db.mcap"
    write_database(path, some(2, 5))
    content = path.read_bytes()
    for end in np.linspace(0, len(content) - 1, 40).astype(int):
        path.write_bytes(content[:end])
        with pytest.raises(FormatError, match="is damaged") as caught:
            read_database(path)
        assert "()" not in str(caught.value)


def test_what_is_no_database_is_refused_with_a_reason(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_database(tmp_path / "none.mcap")
    with pytest.raises(FormatError, match="is a folder"):
        read_database(tmp_path)
    (tmp_path / "text.mcap").write_text("hello")
    with pytest.raises(FormatError, match="damaged"):
        read_database(tmp_path / "text.mcap")
    for name, expected in (
        ("mineloc.intersections/0", r"holds mineloc\.intersections/0; expected .*/1 or .*/2; make it again"),
        ("mineloc.intersections/9", r"holds mineloc\.intersections/9; expected .*/1 or .*/2; update mineloc"),
        ("mineloc.intersections/x", r"holds mineloc\.intersections/x; expected .*/1 or .*/2; make it again"),
        ("other", "holds no database"),
    ):
        with (tmp_path / "old.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            writer.add_metadata(name, {})
            writer.finish()
        with pytest.raises(FormatError, match=expected):
            read_database(tmp_path / "old.mcap")
    write_database(tmp_path / "db.mcap", some(1, 1))
    with pytest.raises(OutputError, match="exists"):
        write_database(tmp_path / "db.mcap", some(1, 1))
