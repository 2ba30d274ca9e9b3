"""Intersections as CSV and GeoJSON; names that a person edited."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from mineloc.data import Intersection, IntersectionDatabase, Lineage, Sight, WallContour
from mineloc.errors import FormatError
from mineloc.io.intersection_files import read_names, with_names, write_csv, write_geojson

# float32 would lose 3 cm of the first and 0.2 m of the second
GRID = np.array([512_345.678901234, 4_398_765.4321, 2_300.1])


def one(id: int, neighbours: tuple[tuple[int, float], ...]) -> Intersection:
    none = np.zeros((0, 3), np.float32)
    contour = WallContour(np.zeros(8, np.float32), np.full(8, Sight.OPEN, np.uint8), 8.0, np.array([0.0, 2.0, 4.0]))
    return Intersection(
        id, f'Y "{id}", ü', "Y", np.array([0.1 * id, 7.0, -1 / 3]), np.eye(3), contour,
        np.zeros((2, 8), np.float32), none, none, neighbours, 0.9,
    )  # fmt: skip


@pytest.fixture
def database() -> IntersectionDatabase:
    found = (one(0, ((3, 12.5), (3, 40.0))), one(3, ((0, 12.5), (0, 40.0))))
    return IntersectionDatabase(found, GRID, True, Lineage.first("ab" * 32, (0, 3)), np.eye(2), np.eye(2), 0.5, ())


def test_positions_are_exact_in_the_grid(tmp_path: Path, database: IntersectionDatabase) -> None:
    write_csv(tmp_path / "a.csv", database)
    write_geojson(tmp_path / "a.json", database)
    with (tmp_path / "a.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    features = json.loads((tmp_path / "a.json").read_text())["features"]
    for row, feature, known in zip(rows, features[:2], database.intersections, strict=True):
        expected = (known.point_map + GRID).tolist()
        assert [float(row[name]) for name in ("x_m", "y_m", "z_m")] == expected
        assert feature["geometry"]["coordinates"] == expected
    # both ways between the two, each once
    assert [feature["properties"].get("length_m") for feature in features[2:]] == [12.5, 40.0]


def test_an_edited_name_is_taken_over_and_all_else_stays(tmp_path: Path, database: IntersectionDatabase) -> None:
    path = tmp_path / "a.csv"
    write_csv(path, database)
    assert read_names(path) == {known.id: (known.name, known.kind) for known in database.intersections}
    path.write_text("\ufeffid,name,kind\n3,Main drift,T\n", encoding="utf-8")  # as spreadsheets write it
    renamed = with_names(database, read_names(path), where=path)
    assert [(known.name, known.kind) for known in renamed.intersections] == [('Y "0", ü', "Y"), ("Main drift", "T")]
    assert renamed.intersections[1].contour is database.intersections[1].contour


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("id,name\n0,a\n", "no kind"),
        ("id,name,kind\nx,a,Y\n", "id 'x'"),
        ("id,name,kind\n0,a,Q\n", "kind 'Q'"),
        ("id,name,kind\n0,a,Y\n0,b,Y\n", "repeats id 0"),
        ("id,name,kind\n", "no rows"),
        ("id,name,kind\n7,a,Y\n", "unknown ids 7"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, database: IntersectionDatabase, text: str, said: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=said):
        with_names(database, read_names(path), where=path)
