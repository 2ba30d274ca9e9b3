"""Targets along a flight: on walls, in sight where they are picked, and true to their survey."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mineloc import se3
from mineloc.config import ControlConfig, SimulateConfig
from mineloc.data import Calibration, CameraModel
from mineloc.mapping.tags import observe_tags
from mineloc.sim.flight import START_NS, SimulatedFlight
from mineloc.sim.mine import Mine
from mineloc.sim.tag_camera import TagCamera
from mineloc.sim.targets import TargetSurvey, grid_json, in_sight, survey_of

CONFIG = SimulateConfig(
    length_m=300,
    seed=5,
    target_every_m=20,
    grid_e_m=500_000,
    grid_n_m=7_100_000,
    grid_z_m=-350,
    grid_yaw_deg=30,
    sweep_loss=0.05,
)


@pytest.fixture(scope="module")
def flown(demo: Mine) -> SimulatedFlight:
    return SimulatedFlight(demo, CONFIG)


@pytest.fixture(scope="module")
def survey(flown: SimulatedFlight) -> TargetSurvey:
    found = survey_of(flown)
    assert found is not None
    return found


def test_targets_are_on_walls_beside_the_flight_and_never_far_apart(
    flown: SimulatedFlight, survey: TargetSurvey
) -> None:
    places = np.array([target.position_map for target in survey.targets])
    assert 6 <= len(places) <= 16
    scene = flown.mine.scene
    off = scene.clearance_m(places)
    assert off.min() > 0.005
    assert off.max() < 0.03
    # walls, not floor or roof: the nearest rock is to the side
    to_rock = (scene.nearest_m(places) - places) / off[:, None]
    assert np.abs(to_rock[:, 2]).max() < 0.8
    path = flown.motion.pose(np.arange(0.0, flown.motion.end_s, 0.1))[:, :3, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    near = np.linalg.norm(path[:, None] - places, axis=2).min(axis=1) < 8.0
    assert np.diff(way[near]).max() < CONFIG.target_every_m + 3.0
    # boards face the drone that saw the wall
    nearest = path[np.linalg.norm(path[:, None] - places, axis=2).argmin(axis=0)]
    facing = np.array([-target.T_map_board[:3, 2] for target in survey.targets])
    assert (np.einsum("ni,ni->n", nearest - places, facing) > 0).all()
    for target in survey.targets:
        assert np.linalg.det(target.T_map_board[:3, :3]) == pytest.approx(1.0)
        np.testing.assert_allclose(target.T_map_board[:3, 1], [0, 0, -1])


def test_survey_is_the_truth_in_the_mine_grid_but_for_its_sigma(survey: TargetSurvey) -> None:
    truth = se3.apply(survey.T_grid_map, np.array([target.position_map for target in survey.targets]))
    off = np.array([point.position_grid for point in survey.points]) - truth
    assert 0.003 < off.std() < 0.007
    assert truth[:, 1].mean() == pytest.approx(7_100_000, abs=500)
    east = survey.T_grid_map[:3, 0]
    np.testing.assert_allclose(east, [np.cos(np.pi / 6), np.sin(np.pi / 6), 0])
    np.testing.assert_array_equal(json.loads(grid_json(CONFIG) or b"{}")["T_grid_map"], survey.T_grid_map)
    assert grid_json(SimulateConfig()) is None
    assert [point.role for point in survey.points[:6]] == ["control", "control", "check"] * 2
    assert len({point.name for point in survey.points}) == len(survey.points)
    assert {point.tag_id for point in survey.points} == {None}


def test_picks_are_where_the_lidar_saw_the_target(flown: SimulatedFlight, survey: TargetSurvey) -> None:
    by_name = {target.name: target for target in survey.targets}
    scene, off = flown.mine.scene, []
    for observation in survey.observations:
        T = flown.pose(np.array([observation.stamp_ns]))[0] @ flown.calibration.T_body_lidar
        target = by_name[observation.target].position_map
        off.append(se3.apply(T, observation.point_lidar[None])[0] - target)
        distance = np.linalg.norm(target - T[:3, 3])
        assert 0.8 < distance < 8.0
        assert scene.ranges_m(T[None, :3, 3], (target - T[:3, 3]) / distance)[0] > distance - 0.02
        # within the field of the VLP-16, and in a sweep that is there
        assert abs(np.degrees(np.arcsin(observation.point_lidar[2] / np.linalg.norm(observation.point_lidar)))) < 16
        assert not flown.lost[(observation.stamp_ns - START_NS) // 100_000_000]
    assert 0.008 < np.std(off) < 0.012
    counts = [sum(o.target == name for o in survey.observations) for name in by_name]
    assert min(counts) >= 2
    assert max(counts) <= 9
    assert len(survey.observations) > 3 * len(by_name)
    assert {o.flight for o in survey.observations} == {"demo-5"}


def test_rock_hides_targets(flown: SimulatedFlight, survey: TargetSurvey) -> None:
    target = survey.targets[0]
    facing = -target.T_map_board[:3, 2]
    near = np.tile(np.eye(4), (3, 1, 1))
    near[0, :3, 3] = target.position_map + 1.5 * facing
    near[1, :3, 3] = target.position_map - 1.5 * facing  # in the rock, behind it
    near[2, :3, 3] = target.position_map + 1.5 * facing + [0, 0, 1.2]  # above the LiDAR's field
    assert in_sight(target.position_map, facing, near, flown).tolist() == [True, False, False]
    far = np.tile(np.eye(4), (1, 1, 1))
    far[0, :3, 3] = target.position_map + 9.0 * facing
    assert not in_sight(target.position_map, facing, far, flown).any()


def test_tags_lean_towards_those_who_come_and_have_numbers(demo: Mine) -> None:
    config = CONFIG.model_copy(update={"length_m": 120, "tags": True, "tag_size_m": 0.25})
    flight = SimulatedFlight(demo, config)
    survey = survey_of(flight)
    assert survey is not None
    assert [point.tag_id for point in survey.points] == list(range(185, 185 + len(survey.points)))
    assert {point.tag_size_m for point in survey.points} == {0.25}
    first = survey.targets[1]
    seen = flight.pose(np.array([o.stamp_ns for o in survey.observations if o.target == first.name]))
    # the drone flies against the board's face
    assert (seen[:, :3, 0] @ first.T_map_board[:3, 2]).max() > 0.3
    # all of the board is before the rock
    half = 0.5 * 10 / 8 * 0.25
    corners = se3.apply(first.T_map_board, np.array([[x, y, 0.0] for x in (-half, half) for y in (-half, half)]))
    eye = first.position_map - 1.5 * first.T_map_board[:3, 2]
    ways = corners - eye
    length = np.linalg.norm(ways, axis=1)
    assert (demo.scene.ranges_m(np.tile(eye, (4, 1)), ways / length[:, None]) > length).all()


def test_the_same_flight_has_the_same_targets_and_without_the_wish_none(demo: Mine, survey: TargetSurvey) -> None:
    again = survey_of(SimulatedFlight(demo, CONFIG))
    assert again is not None
    for a, b in zip(survey.points, again.points, strict=True):
        np.testing.assert_array_equal(a.position_grid, b.position_grid)
    for a, b in zip(survey.observations, again.observations, strict=True):
        np.testing.assert_array_equal(a.point_lidar, b.point_lidar)
    assert survey_of(SimulatedFlight(demo, SimulateConfig(length_m=20))) is None


def test_the_camera_sees_the_tags_that_the_drone_passes(demo: Mine) -> None:
    """From pictures to observations: nearly every tag is found, where it is."""
    config = CONFIG.model_copy(update={"length_m": 60, "tags": True})
    flight = SimulatedFlight(demo, config)
    survey = survey_of(flight)
    assert survey is not None
    T_body_camera = se3.from_rt(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), [0.1, 0.0, 0.0])
    camera = TagCamera(flight, survey, CameraModel(848, 480, 424.0, 424.0, 423.5, 239.5), T_body_camera, rate_hz=1.0)
    calibration = Calibration(flight.calibration.T_body_lidar, flight.calibration.T_body_imu, T_body_camera)
    whole = (START_NS, START_NS + 10**12)
    seen = observe_tags(camera.between(*whole), survey.points, calibration, ControlConfig(), flight="demo-5")
    # pictures are taken where a tag is in them alone
    assert seen.images == len(camera.stamps_ns) < flight.motion.end_s / 2
    assert seen.used >= seen.images / 3
    found = {o.target for o in seen.observations}
    assert found == {target.name for target in survey.targets}
    assert len(found) >= 2
    truth = {target.name: target.position_map for target in survey.targets}
    for observation in seen.observations:
        T = flight.pose(np.array([observation.stamp_ns]))[0] @ flight.calibration.T_body_lidar
        off = se3.apply(T, observation.point_lidar[None])[0] - truth[observation.target]
        assert np.linalg.norm(off) < 0.03
    middle = int(camera.stamps_ns[len(camera.stamps_ns) // 2])
    (again,) = camera.between(middle, middle + 1)
    parts = [*camera.between(START_NS, middle), *camera.between(middle, whole[1])]
    assert [image.stamp_ns for image in parts] == camera.stamps_ns.tolist()
    np.testing.assert_array_equal(again.pixels, parts[len(camera.stamps_ns) // 2].pixels)
