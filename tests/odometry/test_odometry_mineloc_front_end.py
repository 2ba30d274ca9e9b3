"""The mineloc front end on flights with a formula: how near it stays, what it admits, what it refuses."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numba
import numpy as np
import pytest
from analytic_scenes import room, rough_tunnel, smooth_tunnel
from inertial_flights import Flight, Step, errors_of
from inertial_motions import at_rest, cruising, tumbling

from mineloc import se3
from mineloc.config import KeyframeConfig, OdometryConfig
from mineloc.data import Calibration, ImuSamples, OdometryStep, Sweep
from mineloc.errors import FlightError
from mineloc.odometry.mineloc_front_end import MinelocFrontEnd

AIRFRAME = Calibration(se3.exp([0.0, 0.1, 0.0, 0.1, 0.0, 0.2]), se3.exp([0.0, 0.0, 1.5, -0.05, 0.02, 0.0]))
NO_IMU = OdometryConfig(use_imu=False)


def front_end(config: OdometryConfig | None = None, calibration: Calibration | None = None) -> MinelocFrontEnd:
    return MinelocFrontEnd(config or OdometryConfig(), KeyframeConfig(), calibration or Calibration())


def told(steps: list[Step], config: OdometryConfig | None = None) -> list[OdometryStep]:
    system = front_end(config)
    return [system.step(step.sweep, step.imu) for step in steps]


@pytest.fixture(scope="module")
def through_rock() -> list[Step]:
    """12 m along a rough roadway at 2 m/s, after 0 s of rest."""
    return list(Flight(rough_tunnel(0.15), cruising((2.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 60).steps())


def test_all_motions_at_once_in_a_room_with_an_airframe() -> None:
    flight = Flight(room(8, 6, 1.2), tumbling(), 60, AIRFRAME, gyro_bias_radps=(0.01, -0.02, 0.005))
    metres, radians = errors_of(front_end(calibration=AIRFRAME), flight.steps())
    assert metres.max() < 0.09
    assert np.degrees(radians.max()) < 0.8


@pytest.mark.parametrize(("config", "limit_m"), [(None, 0.10), (NO_IMU, 0.10)], ids=["imu", "no imu"])
def test_a_rough_roadway_is_followed(through_rock: list[Step], config: OdometryConfig | None, limit_m: float) -> None:
    metres, radians = errors_of(front_end(config), through_rock)
    assert metres.max() < limit_m
    assert np.degrees(radians.max()) < 1.0


def test_a_drone_that_hovers_does_not_swing_itself_up() -> None:
    metres, radians = errors_of(front_end(NO_IMU), Flight(room(8, 6, 1.2), at_rest(), 60, sigma_m=0.02).steps())
    assert metres.max() < 0.04
    assert np.degrees(radians.max()) < 0.3


def test_a_smooth_roadway_is_weak_along_its_axis_and_says_so() -> None:
    flight = Flight(smooth_tunnel(), cruising((2.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 30)
    steps = told(list(flight.steps()), NO_IMU)
    late = [step.degeneracy for step in steps[10:] if step.degeneracy is not None]
    assert np.mean([one.is_degenerate for one in late]) > 0.9
    for one in late:
        if one.is_degenerate:
            assert abs(np.concatenate([one.weak_directions, one.blurred_directions])[0][0]) > 0.95


def test_a_rough_roadway_has_no_weak_direction_but_its_length_is_doubted(through_rock: list[Step]) -> None:
    """Gentle waves hold the way along the axis, but to half a per cent only (the test above: 6 cm in 12 m)."""
    steps = told(through_rock)
    late = [step.degeneracy for step in steps[5:] if step.degeneracy is not None]
    assert np.mean([len(one.weak_directions) > 0 for one in late]) < 0.1
    assert np.mean([len(one.blurred_directions) > 0 for one in late]) > 0.5
    assert all(abs(one.blurred_directions[0][0]) > 0.95 for one in late if len(one.blurred_directions))
    assert all(step.trusted for step in steps)


def test_a_drone_between_walls_on_all_sides_doubts_nothing() -> None:
    flight = Flight(room(8, 6, 1.2), cruising((0.5, 0.2, 0.0), (0.0, 0.0, 0.2)), 40)
    steps = told(list(flight.steps()))
    assert not any(step.degeneracy is not None and step.degeneracy.is_degenerate for step in steps[5:])


def test_equal_flights_give_equal_bits_whatever_the_threads(through_rock: list[Step]) -> None:
    before = numba.get_num_threads()
    try:
        poses = []
        for threads in (1, before):
            numba.set_num_threads(threads)
            poses.append([step.T_odom_lidar for step in told(through_rock[:25])])
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(*poses)


def test_keyframes_are_a_metre_apart_and_joined_by_what_was_flown(through_rock: list[Step]) -> None:
    keyframes = [step for step in told(through_rock) if step.keyframe is not None]
    assert [step.keyframe.index for step in keyframes] == list(range(len(keyframes)))
    assert 10 <= len(keyframes) <= 13
    assert keyframes[0].relative_pose is None
    for one, two in pairwise(keyframes):
        assert 1.0 <= np.linalg.norm((se3.inverse(one.T_odom_lidar) @ two.T_odom_lidar)[:3, 3]) < 1.3
        assert np.allclose(two.relative_pose.T_i_j, se3.inverse(one.T_odom_lidar) @ two.T_odom_lidar, atol=1e-9)
        assert len(two.keyframe.points_lidar) > 200


def test_up_is_known_at_once_where_the_drone_stands_and_never_without_imu() -> None:
    steps = list(Flight(room(4, 3, 2), at_rest((0.1, -0.05, 0.0)), 3).steps())
    first = told(steps)[0]
    assert first.keyframe.up_lidar == pytest.approx(steps[0].T_map_lidar[2, :3], abs=2e-3)
    assert first.T_odom_lidar[2, :3] == pytest.approx(steps[0].T_map_lidar[2, :3], abs=2e-3)
    assert told(steps, NO_IMU)[0].keyframe.up_lidar is None


def test_the_imu_may_fall_silent(through_rock: list[Step]) -> None:
    steps = [step if k < 20 else replace(step, imu=ImuSamples.empty()) for k, step in enumerate(through_rock)]
    metres, _ = errors_of(front_end(), steps)
    assert metres.max() < 0.15


def test_a_sweep_without_points_is_not_trusted_and_the_next_one_is(through_rock: list[Step]) -> None:
    blind = [replace(step, sweep=step.sweep.keep(np.zeros(len(step.sweep), bool))) for step in through_rock]
    steps = [blind[k] if k in (15, 16) else through_rock[k] for k in range(25)]
    found = told(steps)
    assert [k for k, step in enumerate(found) if not step.trusted] == [15, 16]
    assert "no points" in found[15].reason
    assert np.linalg.norm((se3.inverse(found[0].T_odom_lidar) @ found[-1].T_odom_lidar)[:3, 3]) == pytest.approx(
        np.linalg.norm((se3.inverse(steps[0].T_map_lidar) @ steps[-1].T_map_lidar)[:3, 3]), abs=0.1
    )


def test_another_place_is_told_and_nothing_is_invented() -> None:
    here = Flight(rough_tunnel(0.15), at_rest(), 12)
    there = Flight(room(12.0, 10.0, 1.9), at_rest(), 40)
    found = told(list(here.steps()) + list(there.steps())[12:], NO_IMU)
    assert all(step.trusted for step in found[:12])
    assert not found[12].trusted
    assert "inlier ratio" in found[12].reason or "matches" in found[12].reason
    assert found[-1].trusted
    assert np.linalg.norm(found[-1].T_odom_lidar[:3, 3]) < 0.5


def test_time_that_goes_backwards_is_refused(through_rock: list[Step]) -> None:
    system = front_end()
    system.step(through_rock[1].sweep, through_rock[1].imu)
    with pytest.raises(FlightError, match="time going forwards"):
        system.step(through_rock[0].sweep, through_rock[0].imu)


def test_an_imu_in_units_of_gravity_is_refused(through_rock: list[Step]) -> None:
    first = through_rock[0]
    wrong = replace(first.imu, accel_mps2=first.imu.accel_mps2 / 9.81)
    with pytest.raises(FlightError):
        front_end().step(first.sweep, wrong)


def test_a_flight_of_instant_sweeps() -> None:
    flight = list(Flight(room(8, 6, 1.2), at_rest(), 10).steps())
    instant = [replace(s, sweep=Sweep(s.sweep.stamp_ns, s.sweep.points_lidar)) for s in flight]
    metres, _ = errors_of(front_end(NO_IMU), instant)
    assert metres.max() < 0.04
