"""Paper B's front end: LOAM aided by LinK3D where keypoints match, LOAM alone elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_scenes import flight, from_rest, room, smooth_tunnel, with_pillar

from mineloc import se3
from mineloc.config import Config, KeyframeConfig, Link3dConfig, LoamConfig
from mineloc.data import Calibration, ImuSamples, Sweep
from mineloc.errors import FlightError
from mineloc.localize.method import METHODS
from mineloc.odometry.link3d_front_end import Link3dFrontEnd
from mineloc.odometry.loam import LoamFrontEnd

NO_IMU = ImuSamples.empty()


def front_end(**changes: object) -> Link3dFrontEnd:
    return Link3dFrontEnd(Link3dConfig.model_validate(changes), LoamConfig(), KeyframeConfig())


def pillared() -> list[tuple[Sweep, np.ndarray]]:
    scene = room(9.0, 6.0, 1.5)
    for x, y, half in ((4.0, 2.5, 0.4), (-4.0, 3.0, 0.25), (2.0, -3.5, 0.3), (-3.0, -2.0, 0.2), (6.0, -1.5, 0.35)):
        scene = with_pillar(scene, x, y, half)
    return list(flight(scene, from_rest((0, 0, 0.2, 0.8, 0.2, 0.05), ramp=5, cruise=7), sigma_m=0.01))


@pytest.fixture(scope="module")
def recorded() -> list[tuple[Sweep, np.ndarray]]:
    return pillared()


def error_m(steps, truth) -> float:
    moved, true = (se3.inverse(T[0]) @ T[-1] for T in ([s.T_odom_lidar for s in steps], truth))
    return float(np.linalg.norm((se3.inverse(true) @ moved)[:3, 3]))


def test_a_known_motion_is_recovered_with_linked_edges(recorded) -> None:
    link3d = front_end()
    steps = [link3d.step(sweep, NO_IMU) for sweep, _ in recorded]
    # LOAM alone: 0.02; smooth walls are where gathered edges gain nothing
    assert error_m(steps, [T for _, T in recorded]) < 0.08
    assert link3d.counts["link3d_sweeps"] >= 0.8 * (len(recorded) - 1)
    assert link3d.counts["link3d_sweeps"] + link3d.counts["fallback_sweeps"] == len(recorded) - 1
    assert all(step.trusted for step in steps)


def test_without_matches_it_is_loam(recorded) -> None:
    """Nothing matches at an impossible score: features, start and constraints are LOAM's own."""
    alone = front_end(min_score=10_000, isolated_gap_m=1e6)
    loam = LoamFrontEnd(LoamConfig(), KeyframeConfig())
    for sweep, _ in recorded[:8]:
        a, b = alone.step(sweep, NO_IMU), loam.step(sweep, NO_IMU)
        assert np.array_equal(a.T_odom_lidar, b.T_odom_lidar)
    assert alone.counts == {"link3d_sweeps": 0, "fallback_sweeps": 7}


def test_where_the_gate_starves_it_every_sweep_falls_back() -> None:
    """The published gate in a smooth roadway: no keypoints at all (BoW3D#5, paper B's combination)."""
    link3d = front_end(gate="fixed")
    tunnel = flight(smooth_tunnel(), from_rest((0, 0, 0, 1.0, 0, 0), cruise=2, ramp=2), sigma_m=0.02)
    steps = [link3d.step(sweep, NO_IMU) for sweep, _ in tunnel]
    assert link3d.counts == {"link3d_sweeps": 0, "fallback_sweeps": len(steps) - 1}


def test_a_wrong_start_is_refused(recorded) -> None:
    """With a gate of a micrometre no motion of keypoints is believed; the answer stays right."""
    link3d = front_end(start_gate_m=1e-6, constraint_gate_m=1e-6)
    steps = [link3d.step(sweep, NO_IMU) for sweep, _ in recorded]
    assert error_m(steps, [T for _, T in recorded]) < 0.08


def test_the_same_sweeps_give_the_same_poses(recorded) -> None:
    a, b = front_end(), front_end()
    for sweep, _ in recorded[:6]:
        assert np.array_equal(a.step(sweep, NO_IMU).T_odom_lidar, b.step(sweep, NO_IMU).T_odom_lidar)


def test_wrong_input_is_refused_as_by_loam(recorded) -> None:
    link3d = front_end()
    sweep = recorded[0][0]
    no_rings = Sweep(sweep.stamp_ns, sweep.points_lidar, sweep.offsets_ns, None, None)
    with pytest.raises(FlightError, match="ring"):
        link3d.step(no_rings, NO_IMU)
    link3d = front_end()
    link3d.step(sweep, NO_IMU)
    with pytest.raises(FlightError, match="not later"):
        link3d.step(sweep, NO_IMU)
    empty = sweep.keep(np.zeros(len(sweep), np.bool_))
    later = Sweep(sweep.stamp_ns + 10**8, empty.points_lidar, empty.offsets_ns, empty.ring, None)
    assert not link3d.step(later, NO_IMU).trusted


def test_it_is_a_method_with_and_without_loops() -> None:
    for name in ("link3d", "link3d_scan_context"):
        made = METHODS[name].make_front_end(Config(), Calibration())
        assert isinstance(made, Link3dFrontEnd)
    assert METHODS["link3d_scan_context"].loops == frozenset({"place"})
