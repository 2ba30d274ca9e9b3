"""Reconstruction from flight files to a map folder, on a mine of wall points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rough_mine import START_NS, WIDTH_M, ring, roadway_along, write_flight

from mineloc import se3
from mineloc.config import Config, layered_config
from mineloc.data import F64, ControlPoint, Observation, SurfaceKind
from mineloc.errors import ConfigError, FlightError, IngestError, OutputError
from mineloc.io.clouds import read_cloud
from mineloc.io.control_points import control_points_csv, observations_csv
from mineloc.metrics.alignment import umeyama
from mineloc.stages.localize import localize
from mineloc.stages.map_folder import MapFolder
from mineloc.stages.reconstruct import ReconstructResult, reconstruct
from mineloc.stages.run_folder import RunFolder

SMALL = layered_config(
    [{"loops": {"submap_keyframes": 3, "submap_reach_m": 12.0}, "map": {"max_range_m": 8.0}}], where="test"
)
QUICK = SMALL.model_copy(update={"loops": SMALL.loops.model_copy(update={"max_candidates": 1, "every_m": 8.0})})
"""Where two flights are joined: every candidate is a search from features."""
GRID = np.array([512_000.0, 4_398_000.0, 2_300.0])


@pytest.fixture(scope="module")
def mine():
    return roadway_along(ring(13.0), rough_m=0.12, rng=np.random.default_rng(1))


@pytest.fixture(scope="module")
def flight(mine, tmp_path_factory) -> tuple[Path, F64]:
    """One and a half rounds."""
    line = ring(13.0)
    path = tmp_path_factory.mktemp("rough") / "a.mcap"
    return path, write_flight(path, np.concatenate([line, line[: len(line) // 2]]), mine, seed=2, name="a")


@pytest.fixture(scope="module")
def made(flight, tmp_path_factory) -> tuple[ReconstructResult, MapFolder]:
    out = tmp_path_factory.mktemp("maps") / "map"
    result = reconstruct([flight[0]], out, config=SMALL)
    return result, MapFolder.open(out)


def test_the_map_has_what_a_survey_asks_for(made):
    result, survey = made
    assert result.loops >= 3
    assert result.degenerate_m < 5
    assert result.roadways_m == pytest.approx(82, abs=6)
    cloud = survey.cloud()
    kinds = {kind: len(cloud.of_kind(kind)) for kind in SurfaceKind}
    assert min(kinds[SurfaceKind.FLOOR], kinds[SurfaceKind.WALL], kinds[SurfaceKind.ROOF]) > 0.1 * len(cloud)
    width = np.concatenate([road.width_m for road in survey.roadways.roadways])
    assert np.nanmedian(width) == pytest.approx(WIDTH_M, abs=0.5)
    for suffix in (".ply", ".pcd", ".laz"):
        assert len(read_cloud(survey.path / f"map{suffix}")) == len(cloud)
    for name in ("roadways.dxf", "intersections.csv", "coverage.parquet", "timing.json"):
        assert (survey.path / name).stat().st_size


def test_the_trajectory_is_that_of_the_flight(made, flight):
    _, survey = made
    truth = flight[1]
    estimate = survey.trajectories["a"]
    assert len(estimate) == len(truth)
    T = umeyama(truth[:, :3, 3], estimate.positions_m)
    error = np.linalg.norm(se3.apply(T, estimate.positions_m) - truth[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.05


def in_the_map(start_m: list[float] | None) -> Config:
    start = {} if start_m is None else {"prior_map": {"start_m": start_m}}
    return layered_config([{"loops": {"submap_keyframes": 3}}, start], where="test")


def test_a_flight_is_tracked_in_the_map_that_was_made(made, flight, tmp_path):
    _, survey = made
    arguments = {"method": "map_tracking", "prior_map": survey.path}
    result = localize(flight[0], tmp_path / "run", **arguments, config=in_the_map([0.0, 0.0, 0.0]))
    assert result.fixes > 0.95 * result.keyframes
    assert "fixes accepted" in result.summary()
    run = RunFolder.open(tmp_path / "run")
    mapped = survey.trajectories["a"]
    for trajectory in (run.smoothed, run.online):
        assert np.linalg.norm(trajectory.positions_m - mapped.positions_m, axis=1)[20:].max() < 0.1


def test_a_flight_that_begins_elsewhere_than_told_has_no_fix(made, flight, tmp_path):
    _, survey = made
    arguments = {"method": "map_tracking", "prior_map": survey.path}
    result = localize(flight[0], tmp_path / "run", **arguments, config=in_the_map([300.0, 0.0, 0.0]))
    assert result.fixes == 0
    assert result.fixes_refused == result.keyframes


def test_tracking_without_map_or_start_is_refused_before_any_work(made, flight, tmp_path):
    _, survey = made
    cases = (
        ("needs a map", lambda: localize(flight[0], tmp_path / "run", method="map_tracking", config=SMALL)),
        (
            "start_m: is not set",
            lambda: localize(
                flight[0], tmp_path / "run", method="map_tracking", prior_map=survey.path, config=in_the_map(None)
            ),
        ),
        (
            "uses no map",
            lambda: localize(flight[0], tmp_path / "run", method="odometry", prior_map=survey.path, config=SMALL),
        ),
        ("needs a map", lambda: reconstruct([flight[0]], tmp_path / "run", method="map_tracking", config=SMALL)),
    )
    for match, attempt in cases:
        with pytest.raises(ConfigError, match=match):
            attempt()
        assert not (tmp_path / "run").exists()


def test_walls_lie_where_they_are(made, flight, mine):
    _, survey = made
    T = umeyama(flight[1][:, :3, 3], survey.trajectories["a"].positions_m)
    walls = se3.apply(T, survey.cloud().of_kind(SurfaceKind.WALL).points_map)
    # the nearest of points a quarter of a metre apart is some 7 cm away along the wall
    assert np.median(mine.tree.query(walls)[0]) < 0.12


def test_every_candidate_is_in_the_table(made):
    result, survey = made
    assert survey.fixes["trusted"].sum() == result.loops
    assert (~survey.fixes["trusted"]).sum() == result.refused
    assert survey.fixes.filter(~survey.fixes["trusted"])["reason"].str.len_chars().min() > 0
    assert set(survey.keyframes["flight"]) == {"a"}


def test_again_is_the_same(made, flight, tmp_path):
    _, survey = made
    reconstruct([flight[0]], tmp_path / "again", config=SMALL)
    for file in sorted(survey.path.rglob("*")):
        if file.is_file() and file.name != "timing.json":
            assert (tmp_path / "again" / file.relative_to(survey.path)).read_bytes() == file.read_bytes(), file.name


def test_control_points_put_the_map_in_the_grid(flight, tmp_path):
    path, truth = flight
    targets, seen = survey_along(truth)
    (tmp_path / "targets.csv").write_bytes(control_points_csv(targets))
    (tmp_path / "seen.csv").write_bytes(observations_csv(seen))
    result = reconstruct(
        [path],
        tmp_path / "map",
        control=tmp_path / "targets.csv",
        observations=tmp_path / "seen.csv",
        config=SMALL,
    )
    assert result.control is not None
    assert result.control["check_m"] is not None
    assert result.control["check_m"] < 0.06
    survey = MapFolder.open(tmp_path / "map")
    in_grid = survey.trajectories["a"].positions_m + survey.grid_origin_m
    assert np.sqrt(np.mean(np.sum((in_grid - in_the_grid(truth[:, :3, 3])) ** 2, axis=1))) < 0.06
    assert read_cloud(tmp_path / "map" / "map.laz").points_map.mean(axis=0) == pytest.approx(
        in_the_grid(truth[:, :3, 3]).mean(axis=0), abs=5
    )


def test_two_flights_of_one_mine_become_one_map(flight, mine, tmp_path):
    """The second begins on the other side, flies the other way, and tells its reference in a frame of its own."""
    line = np.roll(ring(13.0), -len(ring(13.0)) // 3, axis=0)[::-1]
    truth = write_flight(tmp_path / "b.mcap", line[: len(line) * 2 // 3], mine, seed=3, name="b")
    reconstruct([flight[0], tmp_path / "b.mcap"], tmp_path / "map", config=QUICK)
    survey = MapFolder.open(tmp_path / "map")
    both = np.concatenate([survey.trajectories[name].positions_m for name in ("a", "b")])
    true = np.concatenate([flight[1], truth])[:, :3, 3]
    error = np.linalg.norm(se3.apply(umeyama(true, both), both) - true, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.08


def test_flights_of_two_mines_do_not_become_one_map(flight, tmp_path):
    line = ring(11.0)
    other = roadway_along(line, rough_m=0.12, rng=np.random.default_rng(9))
    write_flight(tmp_path / "b.mcap", line[: len(line) // 2], other, seed=3, name="b")
    with pytest.raises(FlightError, match="places in common"):
        reconstruct([flight[0], tmp_path / "b.mcap"], tmp_path / "map", config=QUICK)
    assert not (tmp_path / "map").exists()


def test_wrong_input_is_told_before_any_work(flight, tmp_path):
    path, out = flight[0], tmp_path / "map"
    (tmp_path / "seen.csv").write_text("target,flight,stamp_ns,x_m,y_m,z_m,sigma_m\n")
    cases = (
        (ConfigError, "no flight", {"flights": []}),
        (ConfigError, "is there already", {"flights": [path, path]}),
        (ConfigError, "unknown method", {"method": "magic"}),
        (ConfigError, "observations without targets", {"observations": tmp_path / "seen.csv"}),
        (IngestError, "no such file|No such file", {"flights": [tmp_path / "none.mcap"]}),
    )
    for error, match, what in cases:
        arguments = {"flights": [path], **what}
        with pytest.raises(error, match=match):
            reconstruct(arguments.pop("flights"), out, config=SMALL, **arguments)
        assert not out.exists()
    out.mkdir()
    (out / "mine").touch()
    with pytest.raises(OutputError, match="exists"):
        reconstruct([path], out, config=SMALL)


def test_one_target_alone_places_nothing(flight, tmp_path):
    path, truth = flight
    targets, seen = survey_along(truth)
    (tmp_path / "targets.csv").write_bytes(control_points_csv(targets[:1]))
    (tmp_path / "seen.csv").write_bytes(observations_csv([one for one in seen if one.target == targets[0].name]))
    with pytest.raises(FlightError, match="control points do not place it"):
        reconstruct(
            [path], tmp_path / "map", control=tmp_path / "targets.csv", observations=tmp_path / "seen.csv", config=SMALL
        )


def in_the_grid(points: F64) -> F64:
    turn = np.radians(30)
    r = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return points @ r.T + GRID


def survey_along(truth: F64) -> tuple[list[ControlPoint], list[Observation]]:
    """A target on the wall beside every 25th sweep, every third a check point, each picked once."""
    rng = np.random.default_rng(5)
    targets: list[ControlPoint] = []
    seen: list[Observation] = []
    for k in range(5, len(truth), 25):
        name = f"T{k}"
        here = np.array([0.5, 2.0, 0.3])
        place = in_the_grid(se3.apply(truth[k], here[None]))[0]
        role = "check" if len(targets) % 3 == 2 else "control"
        targets.append(ControlPoint(name, place, 0.005, 0.005, role))
        seen.append(
            Observation.picked(name, "a", START_NS + k * 100_000_000, here + rng.normal(0, 0.01, 3), sigma_m=0.01)
        )
    return targets, seen
