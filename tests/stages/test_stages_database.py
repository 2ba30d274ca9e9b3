"""The database command on files: names taken over, tables written, wrong input refused with nothing left behind."""

from __future__ import annotations

import csv
import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from map_clouds import cloud_of
from plan_scenes import drawn, mapped, walls_of
from typer.testing import CliRunner

from mineloc.cli import app
from mineloc.config import IntersectionsConfig, layered_config
from mineloc.data import F64, IntersectionDatabase, Lineage, Trajectory
from mineloc.errors import ConfigError, FormatError, MapError
from mineloc.io.clouds import write_ply, write_roadways
from mineloc.io.intersection_database import read_database, write_database
from mineloc.io.trajectories import write_tum
from mineloc.places.database import database_of
from mineloc.places.segmentation import intersections_of
from mineloc.stages.known_map import KnownMap
from mineloc.stages.map_tables import MAP_FIXES, MAP_KEYFRAMES

ORIGIN = np.array([512_000.25, 4_398_000.5, 2_300.0])
# drawn points lie in the middle of cells there
ELSEWHERE = ORIGIN + np.array([40.1, -25.1, 3.0])


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    sheet, config = drawn(), IntersectionsConfig()
    found = intersections_of(sheet, walls_of(sheet), mapped(sheet), config)
    path = tmp_path_factory.mktemp("db") / "db.mcap"
    write_database(path, database_of(found, config, grid_origin_m=ORIGIN, is_grid=True, map_sha256="ab"))
    return path


def map_folder(folder: Path, *, grid_origin_m: F64 = ELSEWHERE, is_grid: bool = True) -> Path:
    """A T and a crossing as a flight would map them, in a frame at `ELSEWHERE`."""
    sheet = drawn()
    shift = ORIGIN - ELSEWHERE
    floor = sheet.floor_points_m(np.arange(len(sheet)))
    walls = walls_of(sheet).points_map
    cloud = cloud_of(np.concatenate([walls, floor, floor + np.array([0, 0, 3.0])]) + shift)
    up = np.repeat([0.0, 1.0, -1.0], [len(walls), len(floor), len(floor)])
    cloud = replace(cloud, normals=np.column_stack([1 - np.abs(up), 0 * up, up]).astype(np.float32))
    roads = mapped(sheet)
    moved = tuple(replace(road, line_m=road.line_m + shift) for road in roads.roadways)
    (folder / "trajectories").mkdir(parents=True)
    write_ply(folder / "map.ply", cloud)
    write_roadways(folder / "roadways.json", replace(roads, nodes_m=roads.nodes_m + shift, roadways=moved))
    pl.DataFrame(schema=MAP_KEYFRAMES).write_parquet(folder / "keyframes.parquet")
    pl.DataFrame(schema=MAP_FIXES).write_parquet(folder / "fixes.parquet")
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, 3] = np.column_stack([np.arange(40.0), np.zeros(40), np.full(40, 1.5)]) + shift
    write_tum(folder / "trajectories" / "a.tum", Trajectory(np.arange(40) * 10**9, poses, "map", "body"))
    frame = {"grid_origin_m": grid_origin_m.tolist(), "is_grid": is_grid}
    manifest = {"schema": "mineloc.map/1", "flights": [{"name": "a"}], "frame": frame}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def changed(path: Path, out: Path, **facts: object) -> Path:
    write_database(out, replace(read_database(path), **facts))
    return out


def run(*arguments: object) -> dict[str, object]:
    result = CliRunner().invoke(app, ["database", *map(str, arguments), "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def grown(tmp_path_factory) -> Path:
    return map_folder(tmp_path_factory.mktemp("grown") / "map")


@pytest.fixture(scope="module")
def old(made: Path, tmp_path_factory) -> Path:
    """Of the mine before: the crossing under a name of its own, and a place that is gone; no T yet."""
    known = read_database(made)
    gone = replace(known.intersections[0], id=4, name="Old shaft", point_map=np.array([0.0, 90.0, 0.0]))
    found = [gone, replace(known.intersections[1], id=7, name="Main cross")]
    path = tmp_path_factory.mktemp("old") / "old.mcap"
    write_database(path, database_of(found, IntersectionsConfig(), grid_origin_m=ORIGIN, is_grid=True, map_sha256="ab"))
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


def test_a_map_that_grew_follows_the_database_before(grown: Path, old: Path, tmp_path: Path) -> None:
    out = tmp_path / "new.mcap"
    told = run(grown, "--out", out, "--since", old, "--csv", tmp_path / "t.csv")
    assert (told["version"], told["kinds"]) == (2, {"T": 1, "X": 1})
    assert told["changes"] == {"kept": [7], "new": [8], "retired": [[4, "Old shaft"]], "renumbered": []}
    known = read_database(out)
    assert {one.id: one.name for one in known.intersections} == {7: "Main cross", 8: "T 8"}
    assert [id for id, _ in known.by_id(8).neighbours] == [7]
    assert known.lineage == Lineage(2, (sha256(old),), 9, (sha256(grown / "manifest.json"),))
    assert (tmp_path / "t.csv").read_text().count("Main cross") == 1
    # a name given later stays with its version
    names = edited(tmp_path / "names.csv", one={"id": "8", "name": "Pump", "kind": "T"})
    run(out, "--out", tmp_path / "named.mcap", "--names", names)
    assert read_database(tmp_path / "named.mcap").lineage == known.lineage


def test_a_person_is_told_what_stays_and_what_is_gone(made: Path, old: Path, tmp_path: Path) -> None:
    arguments = ["database", str(old), "--merge", str(made), "--out", str(tmp_path / "all.mcap")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "version 2: 2 kept, 1 new (8), 0 retired" in result.output
    assert "renumbered: 0 is 8, 1 is 7" in result.output
    known = read_database(tmp_path / "all.mcap")
    assert {one.id: one.name for one in known.intersections} == {4: "Old shaft", 7: "Main cross", 8: "T 8"}
    assert known.lineage == Lineage(2, (sha256(old), sha256(made)), 9, ("ab",))
    assert (4, 8) in known.twins


def test_frames_that_cannot_be_compared_are_refused_at_once(grown: Path, old: Path, made: Path, tmp_path: Path) -> None:
    loose = map_folder(tmp_path / "loose", grid_origin_m=np.zeros(3), is_grid=False)
    no_grid = changed(made, tmp_path / "no_grid.mcap", is_grid=False, grid_origin_m=np.zeros(3))
    other = changed(made, tmp_path / "other.mcap", intersections=_with_fewer_rows(read_database(made)))
    out = tmp_path / "out.mcap"
    for arguments, where, found in (
        ([grown, "--since", no_grid], no_grid, "not in the mine grid"),
        ([loose, "--since", old], loose, "not in the mine grid"),
        ([old, "--merge", no_grid], no_grid, "not in the mine grid"),
        ([no_grid, "--merge", old], no_grid, "not in the mine grid"),
        ([made, "--merge", other], other, "descriptors of other sizes"),
    ):
        with pytest.raises(MapError, match=found) as caught:
            run(*arguments, "--out", out)
        assert caught.value.where == str(where)
    with pytest.raises(FormatError, match="no such file"):
        run(grown, "--since", tmp_path / "none.mcap", "--out", out)
    both = ["database", str(made), "--merge", str(old), "--since", str(old), "--out", str(out)]
    assert CliRunner().invoke(app, both).exit_code == 2
    assert not out.exists()


def _with_fewer_rows(known: IntersectionDatabase):
    return tuple(replace(one, matrix=np.ascontiguousarray(one.matrix[:-1])) for one in known.intersections)


def test_a_merged_database_serves_each_of_its_maps_and_no_other(grown: Path, made: Path, tmp_path: Path) -> None:
    digest = sha256(grown / "manifest.json")
    maps = {"mine": tuple(sorted(("ab", digest))), "other": ("ab", "cd")}
    line = {name: Lineage(2, ("x", "y"), 2, of) for name, of in maps.items()}
    merged, other = (changed(made, tmp_path / f"{name}.mcap", lineage=one) for name, one in line.items())
    config = layered_config([{"prior_map": {"start_m": [0.0, 0.0, 0.0]}}], where="test")
    known = KnownMap.open(grown, merged, config)
    assert known is not None
    assert known.map_sha256 == digest
    assert known.prior.database is not None
    # its places are told in the frame of that map
    expected = read_database(made).intersections[1].point_map + ORIGIN - ELSEWHERE
    assert known.prior.database.intersections[1].point_map == pytest.approx(expected, abs=1e-6)
    with pytest.raises(ConfigError, match="is of another map"):
        KnownMap.open(grown, other, config)
