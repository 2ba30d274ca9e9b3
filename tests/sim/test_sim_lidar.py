"""The sensors: who fires when and where, against the numbers of their manuals and plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mineloc import se3
from mineloc.errors import ConfigError
from mineloc.sim.lidar import LidarModel, lidar_model
from mineloc.sim.motion import Motion, Vibration
from mineloc.sim.shots import aim, firings_of

NAMES = ["vlp16", "rs16", "hdl32e", "os0"]


@pytest.mark.parametrize(
    ("name", "lasers", "low_deg", "high_deg", "shots"),
    [
        ("vlp16", 16, -15.0, 15.0, 28_930),
        ("rs16", 16, -15.0, 15.0, 28_830),
        ("hdl32e", 32, -30.67, 10.67, 69_450),
        ("os0", 64, -45.0, 45.0, 65_536),
    ],
)
def test_fan_and_rate(name: str, lasers: int, low_deg: float, high_deg: float, shots: int) -> None:
    lidar = lidar_model(name)
    assert lidar.lasers == lasers
    assert np.rad2deg(lidar.elevation_rad.min()) == pytest.approx(low_deg, abs=0.01)
    assert np.rad2deg(lidar.elevation_rad.max()) == pytest.approx(high_deg, abs=0.01)
    assert len(firings_of(lidar, 7, 10.0).time_s) * lasers == pytest.approx(shots, abs=40)


def test_vlp16_fires_interleaved_and_its_heights_fall_with_the_elevation() -> None:
    lidar = lidar_model("vlp16")
    assert np.rad2deg(lidar.elevation_rad[:4]).round().tolist() == [-15, 1, -13, 3]
    by_elevation = np.argsort(lidar.elevation_rad)
    assert (np.diff(lidar.height_m[by_elevation]) < 0).all()
    assert lidar.height_m[by_elevation[0]] == pytest.approx(0.0112)
    np.testing.assert_allclose(lidar.height_m[by_elevation], -lidar.height_m[by_elevation][::-1])
    assert lidar.fire_s[-1] + 2 * 2.304e-6 < lidar.firing_period_s(10.0) == 55.296e-6


@pytest.mark.parametrize("name", NAMES)
def test_ring_is_the_rank_of_the_elevation(name: str) -> None:
    lidar = lidar_model(name)
    assert sorted(lidar.ring) == list(range(lidar.lasers))
    assert (np.diff(lidar.elevation_rad[np.argsort(lidar.ring)]) > 0).all()


@given(st.sampled_from(NAMES), st.integers(0, 100_000), st.sampled_from([5.0, 10.0, 20.0]))
def test_revolutions_follow_one_another_without_gap_or_overlap(name: str, revolution: int, rate_hz: float) -> None:
    lidar = lidar_model(name)
    one, other = (firings_of(lidar, revolution + k, rate_hz) for k in range(2))
    period = lidar.firing_period_s(rate_hz)
    assert other.time_s[0] - one.time_s[-1] == pytest.approx(period, rel=1e-6)
    assert one.time_s[0] >= revolution / rate_hz - 1e-9
    assert one.time_s[-1] < (revolution + 1) / rate_hz
    # clockwise seen from above, cut behind the drone
    assert (np.diff(one.azimuth_rad) < 0).all()
    assert np.pi - one.azimuth_rad[0] < 2 * np.pi * rate_hz * period * 1.001
    assert one.azimuth_rad[-1] + np.pi < 2 * np.pi * rate_hz * period * 1.001


def _moving() -> Motion:
    t = np.arange(40)
    control = np.stack([0.25 * t, 0.02 * t**2, 0.1 * t, 0.12 * t, 0.02 * t, -0.03 * t], axis=1)
    return Motion(control, 0.1, Vibration.none())


@pytest.mark.parametrize("name", NAMES)
def test_rays_leave_the_moving_sensor_at_the_time_of_each_shot(name: str) -> None:
    lidar, motion, rate = lidar_model(name), _moving(), 10.0
    firings = firings_of(lidar, 12, rate)
    period = lidar.firing_period_s(rate)
    poses = motion.pose(np.append(firings.time_s, firings.time_s[-1] + period))
    shots = aim(lidar, firings, poses, rate)
    pick = np.random.default_rng(0).integers(0, len(shots.ring), 400)
    column, laser = np.divmod(pick, lidar.lasers)
    t = firings.time_s[column] + lidar.fire_s[laser]
    origin, direction = _by_hand(lidar, t, laser, rate)
    T = motion.pose(t)
    np.testing.assert_allclose(shots.origins_lidar[pick], origin, atol=1e-9)
    np.testing.assert_allclose(shots.directions_lidar[pick], direction, atol=1e-9)
    np.testing.assert_allclose(
        shots.rays[pick, :3], np.einsum("nij,nj->ni", T[:, :3, :3], origin) + T[:, :3, 3], atol=1e-5
    )
    np.testing.assert_allclose(shots.rays[pick, 3:], np.einsum("nij,nj->ni", T[:, :3, :3], direction), atol=1e-6)
    np.testing.assert_array_equal(shots.ring[pick], lidar.ring[laser])
    np.testing.assert_allclose(shots.offsets_ns[pick] * 1e-9, t - firings.time_s[0], atol=1e-9)
    assert shots.offsets_ns.min() == 0
    # the motion is fast enough to tell: one pose for the whole sweep would be decimetres off
    far = se3.apply(poses[0], origin + 10 * direction) - (shots.rays[pick, :3] + 10 * shots.rays[pick, 3:])
    assert np.linalg.norm(far, axis=1).max() > 0.3


def _by_hand(lidar: LidarModel, t: np.ndarray, laser: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    turn = np.pi - 2 * np.pi * rate * t
    look, up = turn + lidar.azimuth_rad[laser], lidar.elevation_rad[laser]
    origin = np.stack([lidar.radius_m * np.cos(turn), lidar.radius_m * np.sin(turn), lidar.height_m[laser]], axis=1)
    return origin, np.stack([np.cos(up) * np.cos(look), np.cos(up) * np.sin(look), np.sin(up)], axis=1)


def test_unknown_sensor_is_refused() -> None:
    with pytest.raises(ConfigError, match="vlp16, rs16, hdl32e, os0"):
        lidar_model("vlp32")
