"""What the sensor makes of a surface: noise, drop-outs, dust; the kernel against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from mineloc.sim.lidar import lidar_model
from mineloc.sim.machine import in_front
from mineloc.sim.scene import Hits, Scene
from mineloc.sim.shots import RangeErrors, Returns, Shots, measure, points_of

VLP16 = lidar_model("vlp16")
QUIET = RangeErrors(sigma_m=0.02, grazing=0.0009, loss=0.0, dust=0.0, dust_depth_m=1.5)


def _shots(n: int, incidence_rad: float = 0.0) -> tuple[Shots, np.ndarray]:
    """Rays along +x from places all over, and normals at the wanted incidence."""
    rays = np.zeros((n, 6), np.float32)
    rays[:, :3] = np.random.default_rng(1).uniform(-50, 50, (n, 3))
    rays[:, 3] = 1.0
    normals = np.tile(np.array([-np.cos(incidence_rad), np.sin(incidence_rad), 0], np.float32), (n, 1))
    directions = rays[:, 3:].astype(np.float64)
    return Shots(np.zeros((n, 3)), directions, rays, np.arange(n), np.zeros(n, np.uint16)), normals


def _measure(range_m: float, incidence_deg: float, errors: RangeErrors = QUIET, n: int = 40_000) -> Returns:
    shots, normals = _shots(n, np.deg2rad(incidence_deg))
    hits = Hits(np.full(n, range_m, np.float32), normals)
    return measure(VLP16, shots, hits, errors, np.random.default_rng(3))


def test_noise_is_the_sensor_s_at_normal_incidence_and_grows_at_grazing() -> None:
    straight = _measure(5.0, 0.0)
    assert straight.seen.mean() > 0.999
    assert straight.range_m[straight.seen].mean() == pytest.approx(5.0, abs=1e-3)
    assert straight.range_m[straight.seen].std() == pytest.approx(0.02, rel=0.03)
    grazing = _measure(15.0, 75.0)
    expected = np.hypot(0.02, 0.0009 * 15.0 * np.tan(np.deg2rad(75.0)))
    assert grazing.range_m[grazing.seen].std() == pytest.approx(expected, rel=0.05)
    # the tangent is cut at 6, about 80.5°
    limit = np.hypot(0.02, 0.0009 * 10.0 * 6.0)
    flat = _measure(10.0, 88.0)
    assert flat.range_m[flat.seen].std() == pytest.approx(limit, rel=0.06)


def test_ranges_come_in_steps_within_the_limits() -> None:
    back = _measure(3.0, 0.0)
    steps = back.range_m[back.seen] / VLP16.quantum_m
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    near = _measure(VLP16.min_range_m, 0.0)
    assert 0.4 < near.seen.mean() < 0.6
    assert near.range_m[near.seen].min() >= VLP16.min_range_m
    assert not _measure(101.0, 0.0).seen.any()
    assert not _measure(np.inf, 0.0).seen.any()


def test_far_and_grazing_shots_are_lost() -> None:
    shares = [_measure(r, 0.0).seen.mean() for r in (10.0, 60.0, 90.0)]
    assert shares[0] > 0.999
    assert shares[0] > shares[1] > shares[2] > 0.05
    assert _measure(20.0, 88.0).seen.mean() < 0.5 < _measure(20.0, 60.0).seen.mean()


def test_losses_and_dust_have_their_shares() -> None:
    lossy = _measure(5.0, 0.0, RangeErrors(0.02, 0.0009, 0.1, 0.0, 1.5))
    assert lossy.seen.mean() == pytest.approx(0.9, abs=0.01)
    dusty = _measure(20.0, 0.0, RangeErrors(0.02, 0.0009, 0.0, 0.2, 1.5))
    short = dusty.range_m[dusty.seen] < 19.0
    assert short.mean() == pytest.approx(0.2, abs=0.01)
    depth = dusty.range_m[dusty.seen][short] - VLP16.min_range_m
    assert depth.mean() == pytest.approx(1.5, rel=0.05)
    # dust behind the wall is not seen
    assert (_measure(1.0, 0.0, RangeErrors(0.0, 0.0, 0.0, 0.9, 1.5)).range_m <= 1.001).all()


def test_intensity_is_within_a_byte_and_falls_at_grazing() -> None:
    straight, grazing = _measure(5.0, 0.0), _measure(5.0, 70.0)
    for back in (straight, grazing):
        assert back.intensity[back.seen].min() >= 0
        assert back.intensity[back.seen].max() <= 255
        assert (back.intensity == np.rint(back.intensity)).all()
    assert grazing.intensity[grazing.seen].mean() < 0.7 * straight.intensity[straight.seen].mean()


def test_kernel_equals_plain_numpy() -> None:
    n = 5000
    rng = np.random.default_rng(0)
    shots, _ = _shots(n)
    true = np.where(rng.random(n) < 0.1, np.inf, rng.uniform(0.2, 110, n)).astype(np.float32)
    normals = rng.standard_normal((n, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    errors = RangeErrors(0.02, 0.0009, 0.05, 0.1, 1.5)
    got = measure(VLP16, shots, Hits(true, normals), errors, np.random.default_rng(9))
    seen, ranges, intensity = _plain(shots, true, normals, errors, np.random.default_rng(9))
    np.testing.assert_array_equal(got.seen, seen)
    np.testing.assert_allclose(got.range_m[seen], ranges[seen], atol=1e-9)
    np.testing.assert_array_equal(got.intensity[seen], intensity[seen])
    index = np.flatnonzero(seen)
    expected = shots.origins_lidar[index] + ranges[index, None] * shots.directions_lidar[index]
    np.testing.assert_array_equal(points_of(shots, index, got.range_m), expected.astype(np.float32))


def _plain(
    shots: Shots, true: np.ndarray, normals: np.ndarray, errors: RangeErrors, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(true)
    noise = rng.standard_normal(n, dtype=np.float32)
    chance = rng.random((3, n), dtype=np.float32).astype(np.float64)
    r = true.astype(np.float64)
    finite = np.isfinite(r)
    p = shots.rays[:, :3].astype(np.float64) + np.where(finite, r, 0)[:, None] * shots.rays[:, 3:]
    wide = np.sin(0.9 * p[:, 0] + 1.7 * p[:, 2]) * np.sin(1.1 * p[:, 1] - 0.7 * p[:, 2])
    fine = np.sin(5.1 * p[:, 0] - 3.3 * p[:, 2]) * np.sin(4.7 * p[:, 1] + 6.1 * p[:, 2])
    rho = 0.22 + 0.1 * wide + 0.06 * fine
    cos = np.maximum(np.abs((shots.rays[:, 3:] * normals).sum(axis=1, dtype=np.float32)), 1e-3).astype(np.float64)
    tan = np.minimum(np.sqrt(np.maximum(1 - cos**2, 0)) / cos, 6.0)
    sigma = np.sqrt(errors.sigma_m**2 + (errors.grazing * np.where(finite, r, 0) * tan) ** 2)
    depth = VLP16.min_range_m - errors.dust_depth_m * np.log(1 - chance[1])
    dust = (chance[0] < errors.dust) & (depth < r)
    r, rho, cos, sigma = (
        np.where(dust, a, b) for a, b in ((depth, r), (0.02, rho), (1.0, cos), (errors.sigma_m, sigma))
    )
    signal = rho / 0.1 * cos * (VLP16.range_10_percent_m / np.maximum(r, 0.1)) ** 2
    with np.errstate(divide="ignore"):
        detected = (chance[2] - errors.loss) / (1 - errors.loss) <= 1 / (1 + signal**-4.0)
    measured = np.rint((np.where(np.isfinite(r), r, 0) + sigma * noise) / VLP16.quantum_m) * VLP16.quantum_m
    inside = (measured >= VLP16.min_range_m) & (measured <= VLP16.max_range_m)
    seen = np.isfinite(r) & (chance[2] >= errors.loss) & detected & inside
    return seen, measured, np.rint(np.clip(255 * rho * np.sqrt(cos), 0, 255)).astype(np.float32)


def test_machine_hides_the_wall_as_a_box_mesh_would() -> None:
    size = np.array([4.0, 1.7, 1.8])
    T = np.eye(4)
    T[:3, :3] = [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    T[:3, 3] = [5.0, 1.0, -0.3]
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
    scene = Scene(corners @ T[:3, :3].T + T[:3, 3], np.array(faces), threads=1)
    rng = np.random.default_rng(0)
    rays = np.zeros((20_000, 6), np.float32)
    rays[:, 3:] = rng.standard_normal((20_000, 3)) * [1, 1, 0.3]
    rays[:, 3:] /= np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    wall = Hits(np.full(len(rays), 6.0, np.float32), np.zeros((len(rays), 3), np.float32))
    got = in_front(wall, rays, T)
    local = rays.copy()
    local[:, :3] -= scene.origin_m.astype(np.float32)
    box = scene.cast(local)
    expected = np.minimum(box.range_m, 6.0)
    assert (expected < 6.0).sum() > 500
    # rays along an edge may go either way
    same = np.isclose(got.range_m, expected, atol=1e-3)
    assert same.mean() > 0.999
    hit = same & (expected < 6.0)
    aligned = np.abs((got.normals[hit] * box.normals[hit]).sum(axis=1))
    assert (aligned > 0.999).mean() > 0.995
    assert wall.range_m.min() == 6.0
