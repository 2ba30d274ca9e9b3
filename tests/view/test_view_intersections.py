"""The recording of a database of intersections."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from mineloc.config import Config, IntersectionsConfig
from mineloc.data import Intersection, Sight, WallContour
from mineloc.errors import FormatError
from mineloc.io.intersection_database import is_database, write_database
from mineloc.places.database import database_of
from mineloc.view.show import show


def four() -> list[Intersection]:
    rng = np.random.default_rng(4)
    found: list[Intersection] = []
    for id in range(4):
        branches = np.sort(rng.uniform(0, 6.28, 3))
        bearing = 2 * np.pi * np.arange(180) / 180
        gap = np.abs(np.angle(np.exp(1j * (bearing[:, None] - branches)))).min(axis=1) < 0.25
        distance = np.where(gap, 0, rng.uniform(0.3, 0.5, 180)).astype(np.float32)
        sight = np.where(gap, Sight.OPEN, Sight.WALL).astype(np.uint8)
        points = np.column_stack(
            [3 * np.cos(rng.uniform(0, 6.28, 900)), 3 * np.sin(rng.uniform(0, 6.28, 900)), rng.uniform(0, 3, 900)]
        ).astype(np.float32)
        found.append(
            Intersection(
                id=id,
                name=f"Y {id}",
                kind="Y",
                point_map=np.array([40.0 * (id % 2), 30.0 * (id // 2), 0.0]),
                covariance_m2=np.eye(3) * 0.01,
                contour=WallContour(distance, sight, 8.0, branches),
                matrix=rng.uniform(0, 1, (20, 180)).astype(np.float32),
                points_m=points,
                normals=points / np.float32(3),
                neighbours=(((id + 1) % 4, 40.0),),
                quality=0.9,
            )
        )
    return found


@pytest.fixture
def database(tmp_path: Path) -> Path:
    path = tmp_path / "db.mcap"
    known = database_of(four(), IntersectionsConfig(), grid_origin_m=np.zeros(3), is_grid=False, map_sha256="ab" * 32)
    write_database(path, known)
    return path


def test_a_database_is_shown_with_all_that_it_knows(database: Path, tmp_path: Path) -> None:
    (out,) = show(database, save=tmp_path / "db.rrd", config=Config())
    seen = {chunk.entity_path: chunk for chunk in RrdReader(out).stream()}
    wanted = {f"/map/{name}" for name in ("clouds", "names", "branches", "contours", "neighbours")}
    assert wanted | {"/similarity/contours", "/similarity/matrices", "/about"} <= set(seen)
    names = seen["/map/names"].to_record_batch().column("Points3D:labels").to_pylist()
    assert names == [[f"{id}: Y {id} (Y)" for id in range(4)]]


def test_a_database_of_another_version_is_no_flight(database: Path, tmp_path: Path) -> None:
    assert is_database(database)
    content = database.read_bytes()
    database.write_bytes(content.replace(b"mineloc.intersections/2", b"mineloc.intersections/9"))
    with pytest.raises(FormatError, match=r"holds mineloc\.intersections/9"):
        show(database, save=tmp_path / "db.rrd", config=Config())
    database.write_bytes(content[:100])
    assert not is_database(database)
