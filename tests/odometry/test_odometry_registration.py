from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc import se3
from mineloc.config import OdometryConfig
from mineloc.data import F64
from mineloc.odometry.contrast import contrast
from mineloc.odometry.motion import add_to_pose
from mineloc.odometry.registration import Linearised, Thinned, Weighting, linearise, linearise_plainly
from mineloc.odometry.voxel_map import VoxelMap

DEFAULT = Weighting.of(OdometryConfig())
STILL = np.zeros(6)


@dataclass(frozen=True)
class Place:
    """A rough room as two maps, and what is seen from a pose in it."""

    maps: tuple[VoxelMap, VoxelMap]
    sweep: Thinned
    T: F64


def place(seed: int, *, n: int = 2000, roughness_m: float = 0.02) -> Place:
    rng = np.random.default_rng(seed)
    T = se3.exp(np.concatenate([rng.normal(0, 0.3, 3), rng.normal(0, 0.5, 3)]))
    maps = VoxelMap(0.3, min_weight=5.0, growth=0.0), VoxelMap(0.9, min_weight=5.0, growth=0.0)
    for patches in maps:
        patches.insert(on_walls(rng, 10 * n, roughness_m), now=0.0)
    seen = se3.apply(se3.inverse(T), on_walls(rng, n, roughness_m))
    return Place(maps, Thinned(seen, rng.uniform(-0.1, 0, n), rng.integers(1, 9, n).astype(float)), T)


def on_walls(rng: np.random.Generator, n: int, roughness_m: float) -> F64:
    """Points on the inside of a box of 6 x 5 x 4 m, with a heap of rubble in a corner."""
    half = np.array([3.0, 2.5, 2.0])
    points = rng.uniform(-1, 1, (n, 3)) * half
    wall, side = rng.integers(0, 3, n), rng.choice([-1.0, 1.0], n)
    points[np.arange(n), wall] = side * half[wall] + rng.normal(0, roughness_m, n)
    rubble = rng.uniform(size=n) < 0.1
    points[rubble] = half * 0.7 + rng.normal(0, 0.3, (int(rubble.sum()), 3))
    return points


@settings(deadline=None, max_examples=15)
@given(
    seed=st.integers(0, 10_000),
    off=st.floats(0, 0.2),
    point_weight=st.sampled_from([0.0, 0.1, 1.0]),
    gate=st.sampled_from([1.5, 8.0]),
    width_m=st.sampled_from([0.0, 0.05, 0.12]),
    cosine=st.sampled_from([0.0, 0.15, 0.5]),
)
def test_the_kernel_agrees_with_plain_numpy(
    seed: int, off: float, point_weight: float, gate: float, width_m: float, cosine: float
) -> None:
    p = place(seed, n=500)
    T = p.T @ se3.exp(np.random.default_rng(seed).normal(0, off, 6))
    w = DEFAULT._replace(point_weight=point_weight, gate=gate, min_width_m=width_m, min_cosine=cosine)
    twist = np.random.default_rng(seed + 1).normal(0, 1, 6) * [0.5, 0.5, 0.5, 1, 1, 1]
    fast, plain = linearise(p.sweep, T, twist, p.maps, w), linearise_plainly(p.sweep, T, twist, p.maps, w)
    assert_equal(fast, plain)


def assert_equal(fast: Linearised, plain: Linearised) -> None:
    assert fast[2:5] == plain[2:5]
    scale = np.sqrt(np.diag(plain.H)) + 1e-9
    assert np.allclose(fast.H / scale / scale[:, None], plain.H / scale / scale[:, None], rtol=1e-9, atol=1e-9)
    assert np.allclose(fast.b / scale, plain.b / scale, rtol=1e-9, atol=1e-7)
    assert fast.residual_m == pytest.approx(plain.residual_m, rel=1e-9, nan_ok=True)


def test_every_kind_of_residual_takes_part() -> None:
    # else the comparison above proves little
    p = place(1)
    T = p.T @ se3.exp([0.04, 0, 0, 0.2, 0, 0])
    all_kinds = linearise(p.sweep, T, STILL, p.maps, DEFAULT)
    assert all_kinds.planar > 500
    assert all_kinds.other > 50
    assert all_kinds.rejected >= 10
    fine_only = linearise(p.sweep, T, STILL, (p.maps[0], VoxelMap(0.9)), DEFAULT)
    assert fine_only.planar < all_kinds.planar


def test_the_number_of_threads_changes_no_bit() -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one thread only")
    p = place(2)
    threads, results = numba.get_num_threads(), []
    try:
        for n in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(n)
            results.append(linearise(p.sweep, p.T, STILL, p.maps, DEFAULT))
    finally:
        numba.set_num_threads(threads)
    for other in results[1:]:
        assert np.array_equal(other.H, results[0].H)
        assert np.array_equal(other.b, results[0].b)


def test_the_gradient_and_the_hessian_are_the_numeric_ones() -> None:
    # constant variance and no robust weights, so that H and b are those of plain least squares
    p = flat_wall_place()
    w = DEFAULT._replace(
        kernel=1e9, gate=1e9, angle_sigma_rad=0.0, surface_sigma_m=10.0, point_weight=0.0, min_cosine=0
    )
    # the rate stays small: it enters to first order
    off = np.array([0.03, -0.02, 0.01, 0.05, 0.04, -0.03, 0.0, 0.0, 0.0, 0.4, -0.3, 0.2])
    axes = 1e-3 * np.diag(np.repeat([1.0, 10.0], 6))

    def at(start: F64, error: F64) -> Linearised:
        T = add_to_pose(add_to_pose(p.T, start[:6]), error[:6])
        out = linearise(p.sweep, T, start[6:] + error[6:], p.maps, w)
        assert out.planar == len(p.sweep.ranges)
        return out

    def cost(start: F64, error: F64) -> float:
        there = at(start, error)
        return 0.5 * there.residual_m**2 * there.planar / w.surface_sigma_m**2

    h = axes.sum(axis=0)
    gradient = np.array([cost(off, e) - cost(off, -e) for e in axes]) / (2 * h)
    out = at(off, np.zeros(12))
    scale = np.sqrt(np.diag(out.H))
    assert out.b / scale == pytest.approx(gradient / scale, rel=2e-3, abs=2e-3 * np.abs(gradient / scale).max())
    # at the truth the curvature of the residuals, which Gauss-Newton leaves out, does not count
    H, none = at(np.zeros(12), np.zeros(12)).H, np.zeros(12)
    for direction in np.random.default_rng(0).normal(size=(40, 12)) * h:
        along = cost(none, direction) + cost(none, -direction) - 2 * cost(none, none)
        assert direction @ H @ direction == pytest.approx(along, rel=0.02)


def flat_wall_place() -> Place:
    """One patch a wall, seen well inside the patches, so that no small motion changes what is matched."""
    rng = np.random.default_rng(5)
    normals = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0.6, 0.8, 0], [0, 0.6, 0.8]])
    fine, coarse = VoxelMap(3.0, growth=0.0), VoxelMap(9.0, growth=0.0)
    points = []
    for k, n in enumerate(normals):
        across = np.linalg.svd(n[None])[2][1:]
        centre = np.array([1.5, 1.5, 1.5]) + 3.0 * np.array([k - 2, k % 2, (k + 1) % 3])
        fine.insert(centre + rng.uniform(-1.3, 1.3, (400, 2)) @ across, now=0.0)
        points.append(centre + rng.uniform(-0.8, 0.8, (40, 2)) @ across)
    T = se3.exp([0.2, -0.1, 0.4, 1.0, 0.5, -0.3])
    seen = se3.apply(se3.inverse(T), np.concatenate(points))
    return Place((fine, coarse), Thinned(seen, rng.uniform(-0.1, 0, 200), np.ones(200)), T)


def test_at_the_truth_the_residual_and_the_step_are_nothing() -> None:
    p = flat_wall_place()
    out = linearise(p.sweep, p.T, STILL, p.maps, DEFAULT)
    assert out.residual_m < 1e-6  # fits are single precision
    assert np.abs(np.linalg.solve(out.H, out.b)).max() < 1e-5


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_gauss_newton_comes_back_to_the_truth(seed: int) -> None:
    p = place(seed, roughness_m=0.005)
    rng = np.random.default_rng(seed + 1)
    T = add_to_pose(p.T, np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 0.04, 3)]))
    for _ in range(8):
        out = linearise(p.sweep, T, STILL, p.maps, DEFAULT)
        T = add_to_pose(T, -np.linalg.solve(out.H[:6, :6], out.b[:6]))
    off = se3.inverse(p.T) @ T
    assert np.linalg.norm(off[:3, 3]) < 0.005
    assert se3.angle_rad(off) < 0.003


def test_what_is_not_on_the_map_says_nothing() -> None:
    p = place(4)
    far = p.sweep._replace(points_body=p.sweep.points_body + 100.0)
    for sweep, maps in ((far, p.maps), (p.sweep, (VoxelMap(0.3), VoxelMap(0.9)))):
        out = linearise(sweep, p.T, STILL, maps, DEFAULT)
        assert not out.H.any()
        assert not out.b.any()
        assert out[2:5] == (0, 0, 0)
        assert np.isnan(out.residual_m)


@pytest.mark.parametrize("n", [0, 1, 7, 8, 9])
def test_few_points_do_not_upset_the_chunks(n: int) -> None:
    p = place(6)
    few = Thinned(*(column[:n] for column in p.sweep))
    assert_equal(linearise(few, p.T, STILL, p.maps, DEFAULT), linearise_plainly(few, p.T, STILL, p.maps, DEFAULT))


def test_a_wrong_velocity_is_told_from_a_wrong_place() -> None:
    # the points of the sweep are shifted by v τ: only a solution with the twist finds both
    p = place(7, roughness_m=0.002)
    v = np.array([0.5, -0.3, 0.4])
    tau = p.sweep.times_s[:, None]
    smeared = p.sweep._replace(points_body=p.sweep.points_body - tau * (v @ p.T[:3, :3]))
    state = np.zeros(12)
    for _ in range(8):
        out = linearise(smeared, add_to_pose(p.T, state[:6]), state[6:], p.maps, DEFAULT)
        state = state - np.linalg.solve(out.H, out.b)
    assert state[3:6] == pytest.approx(np.zeros(3), abs=0.003)
    assert state[9:] == pytest.approx(v, abs=0.05)
    T = p.T
    for _ in range(8):
        out = linearise(smeared, T, STILL, p.maps, DEFAULT)
        T = add_to_pose(T, -np.linalg.solve(out.H[:6, :6], out.b[:6]))
    assert np.linalg.norm(T[:3, 3] - p.T[:3, 3]) > 0.02  # half of v times the sweep


def ring_on_a_rough_wall(seed: int, *, at_m: float = 4.95) -> F64:
    """Returns of one beam of a LiDAR at the origin that goes round by half a degree, 15 degrees up."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(0.002, 0.058, 400)
    beams = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(400, np.tan(np.deg2rad(15)))], axis=1)
    return beams * (at_m + rng.normal(0, 0.07, 400))[:, None]


def test_a_scanning_cone_is_no_wall() -> None:
    # roughness spreads the returns of one ring along its beams: a flat, wide patch that moves with the sensor
    fine, coarse = VoxelMap(0.3), VoxelMap(0.9)
    fine.insert(ring_on_a_rough_wall(1), now=0.0)
    seen = Thinned(ring_on_a_rough_wall(2), np.zeros(400), np.ones(400))
    fooled = linearise(seen, np.eye(4), STILL, (fine, coarse), DEFAULT._replace(min_cosine=0.0))
    assert fooled.planar > 100
    assert fooled.H[5, 5] > 10 * fooled.H[3, 3]  # it holds the height that the ring says nothing about
    out = linearise(seen, np.eye(4), STILL, (fine, coarse), DEFAULT)
    assert out.planar == 0


def test_one_ring_on_a_wall_is_no_plane() -> None:
    # range noise spreads the returns of a ring along the beams: a plane through them is the scanning cone
    rng = np.random.default_rng(0)
    along = rng.uniform(-0.14, 0.14, 300)
    beam = np.array([0.97, 0.0, 0.26])
    points = np.array([5.1, 0.15, 0.15]) + along[:, None] * [0, 1.0, 0] + rng.normal(0, 0.02, (300, 1)) * beam
    fine, coarse = VoxelMap(0.3), VoxelMap(0.9)
    fine.insert(points, now=0.0)
    few = Thinned(points[:50], np.zeros(50), np.ones(50))
    out = linearise(few, np.eye(4), STILL, (fine, coarse), DEFAULT._replace(min_cosine=0.0))
    assert out.planar == 0
    assert out.other > 0


def roadway(rng: np.random.Generator, n: int, steps_m: float) -> F64:
    """Points on floor, roof and walls of 40 x 5 x 4 m whose walls jump in and out every 3 m by `steps_m`, faces too."""
    points = rng.uniform([-20, -1, -1], [20, 1, 1], (n, 3)) * [1, 2.5, 2]
    wall, side = rng.integers(1, 3, n), rng.choice([-1.0, 1.0], n)
    into_m = np.where(points[:, 0] % 6.0 < 3.0, steps_m, 0.0)
    faces = rng.uniform(size=n) < (0.1 if steps_m else 0.0)
    points[faces, 0] = np.round(points[faces, 0] / 3.0) * 3.0
    into_m[faces] = rng.uniform(0, steps_m, int(faces.sum()))
    points[np.arange(n), wall] = side * (np.array([20.0, 2.5, 2.0])[wall] - into_m)
    return points + rng.normal(0, 0.015, (n, 3))


@pytest.mark.parametrize("steps_m", [0.0, 1.0], ids=["smooth", "stepped"])
def test_a_shift_along_a_roadway_is_seen_where_its_walls_have_faces(steps_m: float) -> None:
    rng = np.random.default_rng(0)
    maps = VoxelMap(0.3, min_weight=5.0, growth=0.0), VoxelMap(0.9, min_weight=5.0, growth=0.0)
    for patches in maps:
        patches.insert(roadway(rng, 100_000, steps_m), now=0.0)
    sweep = Thinned(roadway(rng, 3000, steps_m), np.zeros(3000), np.ones(3000))
    along, across = (contrast(sweep, np.eye(4), STILL, maps, DEFAULT, 0.1 * axis) for axis in np.eye(3)[:2])
    assert along > 0.5 if steps_m else abs(along) < 0.05
    assert across > 2.0


def test_contrast_is_infinite_where_nothing_fits() -> None:
    maps = VoxelMap(0.3), VoxelMap(0.9)
    sweep = Thinned(np.ones((5, 3)), np.zeros(5), np.ones(5))
    assert contrast(sweep, np.eye(4), STILL, maps, DEFAULT, np.array([0.1, 0.0, 0.0])) == np.inf
