"""Whole flights: points on the mesh, truth, repeatability, and the flights that are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mineloc import se3
from mineloc.config import SimulateConfig
from mineloc.data import Sweep
from mineloc.errors import SimulationError
from mineloc.sim.flight import START_NS, SimulatedFlight, check_enclosed, missing
from mineloc.sim.mine import Mine, load_mine
from mineloc.sim.scene import Scene


def _in_map(flight: SimulatedFlight, sweep: Sweep) -> np.ndarray:
    """Deskewed by the truth: every point at its own time."""
    assert sweep.offsets_ns is not None
    T = flight.pose(sweep.stamp_ns + sweep.offsets_ns) @ flight.calibration.T_body_lidar
    return np.einsum("nij,nj->ni", T[:, :3, :3], sweep.points_lidar.astype(np.float64)) + T[:, :3, 3]


@pytest.mark.parametrize("sensor", ["vlp16", "rs16", "hdl32e", "os0"])
def test_points_deskewed_by_the_truth_lie_on_the_walls(demo: Mine, sensor: str) -> None:
    flight = SimulatedFlight(demo, SimulateConfig(length_m=40, seed=1, sensor=sensor))  # type: ignore[arg-type]
    sweep = flight.sweep(120)
    off = demo.scene.clearance_m(_in_map(flight, sweep))
    # ranges are 2 cm off (more at grazing incidence), seen under an angle
    assert 0.008 < np.sqrt((off**2).mean()) < 0.025
    assert np.percentile(off, 99.5) < 0.08
    # lower bound: as one instant, the same sweep is decimetres off
    T = flight.pose(np.array([sweep.stamp_ns]))[0] @ flight.calibration.T_body_lidar
    instant = demo.scene.clearance_m(se3.apply(T, sweep.points_lidar))
    assert np.sqrt((instant**2).mean()) > 0.04
    speed = np.linalg.norm(flight.motion.at(np.array([12.0])).velocity_mps)
    assert speed > 1.0


def test_sweep_fields_are_in_the_house_s_order(flight: SimulatedFlight) -> None:
    sweep = flight.sweep(100)
    assert sweep.offsets_ns is not None
    assert sweep.ring is not None
    assert sweep.offsets_ns[0] == 0
    assert (np.diff(sweep.offsets_ns) >= 0).all()
    assert sweep.offsets_ns[-1] < 100_035_000  # the last firing begins in time
    assert 0 <= sweep.stamp_ns - START_NS - 100 * 100_000_000 < 200_000
    assert 25_000 < len(sweep) <= 28_944
    # ring and elevation agree
    z = sweep.points_lidar[:, 2] / np.linalg.norm(sweep.points_lidar, axis=1)
    mean = [np.rad2deg(np.arcsin(z[sweep.ring == ring])).mean() for ring in range(16)]
    np.testing.assert_allclose(mean, np.arange(-15, 16, 2), atol=1.0)
    # clockwise from above, beginning behind the drone
    azimuth = np.unwrap(np.arctan2(sweep.points_lidar[:, 1], sweep.points_lidar[:, 0]).astype(float)[sweep.ring == 7])
    assert azimuth[-1] - azimuth[0] == pytest.approx(-2 * np.pi, abs=0.05)
    assert abs(abs(azimuth[0]) - np.pi) < 0.05


def test_truth_comes_at_100_hz_and_agrees_with_the_pose(flight: SimulatedFlight) -> None:
    packets = [packet for _, packet in zip(range(30), flight.packets(), strict=False)]
    stamps = np.concatenate([packet.truth.stamps_ns for packet in packets])
    assert stamps[0] == START_NS
    assert (np.diff(stamps) == 10_000_000).all()
    np.testing.assert_allclose(packets[20].truth.poses, flight.pose(packets[20].truth.stamps_ns))
    assert (packets[0].truth.parent, packets[0].truth.child) == ("map", "body")
    assert not np.allclose(flight.calibration.T_body_lidar, np.eye(4))
    assert not np.allclose(flight.calibration.T_body_imu, np.eye(4))
    assert flight.info.source == "simulated"
    assert (flight.info.site, flight.info.lidar) == ("demo", "VLP-16")


def _same(a: Sweep, b: Sweep) -> bool:
    return a.stamp_ns == b.stamp_ns and np.array_equal(a.points_lidar, b.points_lidar)


def test_same_seed_same_flight_whatever_the_threads(demo: Mine) -> None:
    config = SimulateConfig(length_m=40, seed=9, dust=0.01, sweep_loss=0.1, machine=True)
    one = SimulatedFlight(demo, config)
    other = SimulatedFlight(replace(demo, scene=Scene(demo.vertices_m, demo.triangles, threads=2)), config)
    assert one.tour == other.tour
    for first, second in zip(one.packets(), other.packets(), strict=True):
        assert (first.sweep is None) == (second.sweep is None)
        if first.sweep is not None and second.sweep is not None:
            assert _same(first.sweep, second.sweep)
        np.testing.assert_array_equal(first.imu.gyro_radps, second.imu.gyro_radps)
        np.testing.assert_array_equal(first.truth.poses, second.truth.poses)
        if first.truth.stamps_ns[0] > START_NS + 3 * 10**9:
            break
    changed = SimulatedFlight(demo, config.model_copy(update={"seed": 10}))
    assert not _same(one.sweep(30), changed.sweep(30))
    # noise of one sweep is not that of the next
    assert not np.array_equal(one.sweep(3).points_lidar[:1000], one.sweep(4).points_lidar[:1000])


def test_options_do_what_they_say(demo: Mine) -> None:
    base = SimulateConfig(length_m=60, seed=2)
    plain = SimulatedFlight(demo, base)
    slow = SimulatedFlight(demo, base.model_copy(update={"lidar_hz": 5.0}))
    assert slow.sweeps == pytest.approx(plain.sweeps / 2, abs=2)
    assert len(slow.sweep(20)) == pytest.approx(2 * len(plain.sweep(40)), rel=0.02)
    dusty = SimulatedFlight(demo, base.model_copy(update={"dust": 0.05}))
    off = demo.scene.clearance_m(_in_map(dusty, dusty.sweep(60)))
    assert 0.01 < (off > 0.2).mean() < 0.05
    assert (demo.scene.clearance_m(_in_map(plain, plain.sweep(60))) > 0.2).mean() < 0.001
    machine = SimulatedFlight(demo, base.model_copy(update={"machine": True}))
    seen = [(demo.scene.clearance_m(_in_map(machine, machine.sweep(k))) > 0.3).sum() for k in (100, 140, 180)]
    assert max(seen) > 300
    assert machine.machine is not None
    assert machine.machine.pose(0.5) is None  # hovering, it is away
    fast = SimulatedFlight(demo, base.model_copy(update={"speed_mps": 4.0}))
    assert fast.motion.end_s < plain.motion.end_s - 3


def test_lost_sweeps_have_their_share_and_come_in_runs() -> None:
    lost = missing(60_000, 0.1, np.random.default_rng(0))
    assert lost.mean() == pytest.approx(0.1, rel=0.1)
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]]))))[::2]
    assert runs.mean() == pytest.approx(3.0, rel=0.1)
    assert not lost[0]
    assert not missing(1000, 0.0, np.random.default_rng(0)).any()


def test_mine_without_walls_is_refused(tee: Mine) -> None:
    """Floor and roof alone: roadways everywhere, and nothing for the LiDAR to see."""
    x, y = np.meshgrid(np.linspace(0, 60, 31), np.linspace(0, 60, 31))
    flat = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    i = (np.arange(30)[:, None] * 31 + np.arange(30)).ravel()
    plate = np.concatenate([np.stack([i, i + 1, i + 31], 1), np.stack([i + 1, i + 32, i + 31], 1)])
    hall = Scene(
        np.concatenate([flat, flat + np.array([0, 0, 3.0])]),
        np.concatenate([plate, plate[:, ::-1] + len(flat)]),
        threads=1,
    )
    line = np.column_stack([np.linspace(20, 40, 50), np.full(50, 30.0), np.full(50, 1.5)])
    with pytest.raises(SimulationError, match="open in"):
        check_enclosed(hall, line)
    check_enclosed(tee.scene, np.column_stack([np.linspace(5, 15, 50), np.zeros(50), np.full(50, 1.5)]))


def test_smooth_straight_tunnel_can_be_flown_to_and_fro() -> None:
    flight = SimulatedFlight(load_mine("straight", threads=1), SimulateConfig(length_m=450, seed=0))
    x = flight.pose(START_NS + np.arange(0, int(flight.motion.end_s), 1) * 10**9)[:, 0, 3]
    assert 190 < np.ptp(x) < 200.1
    assert (np.diff(x) > 1).any()
    assert (np.diff(x) < -1).any()
