"""The recording of a map: what lies where, the roof apart, closures between the right keyframes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from map_clouds import cloud_of
from rrd_columns import Recording

from mineloc.config import ViewConfig
from mineloc.data import F64, MapCloud, SurfaceKind, Trajectory
from mineloc.errors import FormatError, OutputError
from mineloc.mapping.map_coverage import Coverage
from mineloc.mapping.survey_map import SurveyMap
from mineloc.roadways.mapped import MappedRoadway, MappedRoadways
from mineloc.stages.map_folder import write_map_folder
from mineloc.stages.map_tables import MAP_FIXES, MAP_KEYFRAMES, coverage_table
from mineloc.stages.run_tables import pose_columns
from mineloc.view.placed import local_origin
from mineloc.view.survey_map import record_map

ORIGIN = np.array([512_400.0, 4_398_200.0, 2_300.0])
STEP_NS = 100_000_000


def flown(y_m: float) -> F64:
    """(21, 4, 4) along x, a metre apart."""
    poses = np.tile(np.eye(4), (21, 1, 1))
    poses[:, :3, 3] = ORIGIN + np.array([0.0, y_m, 1.5]) + np.arange(21)[:, None] * [1.0, 0.0, 0.0]
    return poses


def cloud() -> MapCloud:
    """Floor, two walls and roof of a roadway of 20 x 4 x 3 m."""
    rng = np.random.default_rng(0)
    n = 500
    points = rng.uniform([0, -2, 0], [20, 2, 3], (4 * n, 3))
    points[:n, 2], points[n : 2 * n, 2] = 0.0, 3.0
    points[2 * n : 3 * n, 1], points[3 * n :, 1] = -2.0, 2.0
    surface = np.repeat(np.array([SurfaceKind.FLOOR, SurfaceKind.ROOF, SurfaceKind.WALL, SurfaceKind.WALL]), n)
    return cloud_of(points, origin_m=ORIGIN, surface=surface)


def keyframes(name: str, poses: F64) -> pl.DataFrame:
    k = np.arange(len(poses))
    sigmas = {f"sigma_{what}": np.full(len(k), 0.01) for what in ("xy_m", "z_m", "yaw_deg")}
    columns = {"flight": [name] * len(k), "index": k, "stamp_ns": k * STEP_NS, "path_m": k * 1.0}
    return pl.DataFrame({**columns, **pose_columns(poses), **sigmas}, schema=MAP_KEYFRAMES)


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    """Two flights side by side in one roadway; keyframe 3 of the second closes with keyframe 5 of the first."""
    line = ORIGIN + np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]])
    two = np.full(2, 2.0)
    roadways = MappedRoadways(line, (MappedRoadway(0, 1, line, two, two, two + 1.0),), 1.0)
    one, none = np.ones(1), np.zeros(0, np.int64)
    seen = Coverage(none, none * 1.0, none * 1.0, np.zeros((0, 4)), *(none * 1.0,) * 4)
    flights = {"a": flown(-0.5), "b": flown(0.5)}
    fix = {
        "flight": ["b", "b"],
        "stamp_ns": [3 * STEP_NS, 4 * STEP_NS],
        "keyframe": [3, 4],
        "trusted": [True, False],
        "reason": ["", "overlap 0.1"],
        "target": ["keyframe 5", "keyframe 6"],
        **pose_columns(flights["b"][3:5]),
        **{f"sigma_{what}": np.repeat(one, 2) for what in ("xy_m", "z_m", "yaw_deg")},
        "scores": ["{}", "{}"],
    }
    folder = tmp_path / "map"
    folder.mkdir()
    write_map_folder(
        folder,
        product=SurveyMap(cloud(), roadways, seen),
        grid_origin_m=np.zeros(3),
        trajectories={name: Trajectory(np.arange(21) * STEP_NS, poses) for name, poses in flights.items()},
        keyframes=pl.concat([keyframes(name, poses) for name, poses in flights.items()]),
        fixes=pl.DataFrame(fix, schema=MAP_FIXES),
        coverage=coverage_table(seen),
        flown=None,
        timing={},
        manifest={
            "mineloc_version": "0",
            "front_end": "mineloc",
            "flights": [{"name": name, "path_m": 20.0, "degenerate_m": 0.0} for name in flights],
            "frame": {"grid_origin_m": [0.0, 0.0, 0.0], "is_grid": False},
            "map": {"points": 2000, "roadways_m": 20.0, "intersections": 0, "complete_share": 1.0},
            "loops": {"accepted": 1, "refused": 1},
            "control": None,
        },
    )
    return folder


def test_every_kind_of_surface_lies_where_it_was_seen(survey: Path, tmp_path: Path) -> None:
    recording = Recording(record_map(survey, tmp_path / "map.rrd", config=ViewConfig()))
    origin = local_origin(np.concatenate([flown(-0.5), flown(0.5)])[:, :3, 3])
    assert np.linalg.norm(origin - ORIGIN) < 1000
    assert "/map/other" not in recording.entities
    for name, count in (("floor", 500), ("walls", 1000), ("roof", 500)):
        points = recording.array(f"/map/{name}", "Points3D:positions").reshape(-1, 3)
        assert len(points) == count
        placed = points + origin - ORIGIN
        assert placed.min(axis=0) == pytest.approx([0, -2, 3 if name == "roof" else 0], abs=0.2), name
        assert placed.max(axis=0) == pytest.approx([20, 2, 0 if name == "floor" else 3], abs=0.2), name
    roadway = recording.array("/map/roadways", "LineStrips3D:strips")[0]
    assert roadway + origin - ORIGIN == pytest.approx(np.array([[0, 0, 0], [20, 0, 0]]), abs=1e-3)
    (blueprint,) = recording.reader.blueprints()
    assert blueprint.application_id == "mineloc"


def test_a_closure_between_two_flights_joins_its_own_keyframes(survey: Path, tmp_path: Path) -> None:
    recording = Recording(record_map(survey, tmp_path / "map.rrd", config=ViewConfig()))
    (strip,) = recording.values["/map/loops", "LineStrips3D:strips"][0]
    ends = np.asarray(strip)
    off = ends - np.stack([flown(-0.5)[5, :3, 3], flown(0.5)[3, :3, 3]])
    # both ends are off by the local origin, the same one
    assert np.ptp(off, axis=0) == pytest.approx(0.0, abs=1e-4)


def test_a_limit_on_points_thins_all_kinds_alike(survey: Path, tmp_path: Path) -> None:
    recording = Recording(record_map(survey, tmp_path / "map.rrd", config=ViewConfig(map_points=1000)))
    counts = [
        len(recording.array(f"/map/{name}", "Points3D:positions").reshape(-1, 3)) for name in ("floor", "walls", "roof")
    ]
    assert sum(counts) <= 1000
    assert counts == [250, 500, 250]


def test_equal_maps_give_equal_recordings_of_one_identity(survey: Path, tmp_path: Path) -> None:
    first = Recording(record_map(survey, tmp_path / "1.rrd", config=ViewConfig()))
    again = Recording(record_map(survey, tmp_path / "2.rrd", config=ViewConfig()))
    assert first.reader.recordings()[0].recording_id == again.reader.recordings()[0].recording_id
    assert first.entities == again.entities


def test_what_is_no_map_or_is_there_already_is_refused(survey: Path, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="not a map folder"):
        record_map(tmp_path, tmp_path / "map.rrd", config=ViewConfig())
    record_map(survey, tmp_path / "map.rrd", config=ViewConfig())
    with pytest.raises(OutputError, match="exists"):
        record_map(survey, tmp_path / "map.rrd", config=ViewConfig())


def test_the_page_beside_the_map_tells_its_facts(survey: Path, tmp_path: Path) -> None:
    recording = Recording(record_map(survey, tmp_path / "map.rrd", config=ViewConfig()))
    (text,) = recording.values["/about", "TextDocument:text"][0]
    assert "1 accepted, 1 refused" in text
    assert "20 m, 0 intersections" in text
