"""The database command on files: names taken over, tables written, wrong input refused with nothing left behind."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from plan_scenes import drawn, mapped, walls_of
from typer.testing import CliRunner

from mineloc.cli import app
from mineloc.config import IntersectionsConfig
from mineloc.io.intersection_database import read_database, write_database
from mineloc.places.database import database_of
from mineloc.places.segmentation import intersections_of


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    sheet, config = drawn(), IntersectionsConfig()
    found = intersections_of(sheet, walls_of(sheet), mapped(sheet), config)
    path = tmp_path_factory.mktemp("db") / "db.mcap"
    origin = np.array([512_000.25, 4_398_000.5, 2_300.0])
    write_database(path, database_of(found, config, grid_origin_m=origin, is_grid=True, map_sha256="ab"))
    return path


def edited(path: Path, **rows: dict[str, str]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["id", "name", "kind"])
        writer.writeheader()
        writer.writerows(rows.values())
    return path


def test_a_person_names_an_intersection(made: Path, tmp_path: Path) -> None:
    names = edited(tmp_path / "names.csv", one={"id": "1", "name": "Main cross, «north»", "kind": "X"})
    arguments = ["database", str(made), "--names", str(names), "--out", str(tmp_path / "named.mcap")]
    tables = ["--csv", str(tmp_path / "t.csv"), "--geojson", str(tmp_path / "t.json")]
    result = CliRunner().invoke(app, [*arguments, *tables])
    assert result.exit_code == 0, result.output
    before, after = read_database(made), read_database(tmp_path / "named.mcap")
    assert [one.name for one in after.intersections] == ["T 0", "Main cross, «north»"]
    assert np.array_equal(before.intersections[1].point_map, after.intersections[1].point_map)
    with (tmp_path / "t.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert rows[1]["name"] == "Main cross, «north»"
    at = before.intersections[1].point_map + before.grid_origin_m
    assert [float(rows[1][key]) for key in ("x_m", "y_m", "z_m")] == at.tolist()
    features = json.loads((tmp_path / "t.json").read_text())["features"]
    assert [one["geometry"]["type"] for one in features].count("LineString") == 1


def test_names_that_do_not_fit_leave_nothing_behind(made: Path, tmp_path: Path) -> None:
    names = edited(tmp_path / "names.csv", one={"id": "99", "name": "x", "kind": "T"})
    out = tmp_path / "named.mcap"
    result = CliRunner().invoke(app, ["database", str(made), "--names", str(names), "--out", str(out)])
    assert result.exit_code == 1
    assert not out.exists()
    result = CliRunner().invoke(app, ["database", str(tmp_path), "--out", str(out)])
    assert result.exit_code == 1
    assert not out.exists()
