from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from mineloc import se3
from mineloc.data import F64
from mineloc.odometry.loam_solver import (
    Matches,
    firm_hessian,
    normal_equations,
    normal_equations_plainly,
    retract,
    solve,
)


def matches(
    seed: int, n: int = 200, *, sigma_m: float = 0.0, axes_used: tuple[int, ...] = (0, 1, 2)
) -> tuple[Matches, F64]:
    """Points that lie on lines and planes at a known pose."""
    rng = np.random.default_rng(seed)
    T = se3.exp(np.concatenate([rng.normal(0, 0.3, 3), rng.normal(0, 2, 3)]))
    p = rng.normal(0, 5, (n, 3))
    axes = np.eye(3)[rng.choice(axes_used, n)]
    is_line = rng.random(n) < 0.3
    anchors = se3.apply(T, p) + rng.normal(0, sigma_m, (n, 3))
    slide = np.where(is_line[:, None], axes * rng.normal(0, 1, (n, 1)), np.cross(axes, rng.normal(0, 1, (n, 3))))
    return Matches(p, anchors + slide, axes, is_line, ~is_line), T


def problem(m: Matches) -> tuple[F64, F64, F64, np.ndarray]:
    return m.points_lidar, m.anchors, m.axes, m.is_line


@settings(deadline=None)
@given(seed=st.integers(0, 1000), n=st.integers(0, 200), huber_m=st.sampled_from([0.1, 1.0, 1e9]))
def test_the_kernel_agrees_with_plain_numpy(seed: int, n: int, huber_m: float) -> None:
    m, T = matches(seed, n, sigma_m=0.5)
    fast = normal_equations(*problem(m), T, huber_m)
    plain = normal_equations_plainly(*problem(m), T, huber_m)
    for a, b in zip(fast, plain, strict=True):
        assert np.allclose(a, b, rtol=1e-9, atol=1e-9)


@settings(deadline=None)
@given(seed=st.integers(0, 1000))
def test_the_gradient_is_the_derivative_of_the_cost(seed: int) -> None:
    m, T = matches(seed, 50, sigma_m=0.3)
    _, g, _, _ = normal_equations(*problem(m), T, 0.1)
    h = 1e-6
    for k, unit in enumerate(np.eye(6)):
        ahead = normal_equations(*problem(m), T @ se3.exp(h * unit), 0.1)[2]
        behind = normal_equations(*problem(m), T @ se3.exp(-h * unit), 0.1)[2]
        assert (ahead - behind) / (2 * h) == pytest.approx(g[k], abs=1e-4 * max(1, abs(g[k])))


@settings(deadline=None)
@given(seed=st.integers(0, 1000))
def test_retraction_is_the_exponential_to_first_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, step = se3.exp(rng.normal(0, 1, 6)), rng.normal(0, 1, 6)
    for size in (1e-2, 1e-3):
        off = retract(T, size * step) - T @ se3.exp(size * step)
        assert np.abs(off).max() < 5 * size**2
    moved = retract(T, step)[:3, :3]
    assert np.allclose(moved @ moved.T, np.eye(3))
    assert np.allclose(retract(T, np.zeros(6)), T)


@settings(deadline=None)
@given(seed=st.integers(0, 1000))
def test_a_known_pose_is_found_from_nearby(seed: int) -> None:
    m, T = matches(seed)
    rng = np.random.default_rng(seed)
    start = T @ se3.exp(np.concatenate([rng.normal(0, 0.02, 3), rng.normal(0, 0.1, 3)]))
    found, residual_m = solve(m, start, iterations=20, huber_m=0.1)
    assert np.abs(se3.log(se3.inverse(T) @ found)).max() < 1e-5
    assert residual_m < 1e-5


def test_scipy_finds_the_same_minimum() -> None:
    m, T = matches(4, sigma_m=0.05)

    def distances(xi: F64) -> F64:
        q = se3.apply(T @ se3.exp(xi), m.points_lidar) - m.anchors
        along = np.einsum("ni,ni->n", q, m.axes)
        return np.where(m.is_line, np.sqrt(np.maximum(np.sum(q**2, axis=1) - along**2, 1e-300)), along)

    oracle = least_squares(distances, np.zeros(6), loss="huber", f_scale=0.1, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    found, _ = solve(m, T, iterations=50, huber_m=0.1)
    assert np.allclose(se3.log(se3.inverse(T) @ found), oracle.x, atol=1e-5)


def test_outliers_pull_little() -> None:
    m, T = matches(5, n=300, sigma_m=0.01)
    anchors = m.anchors.copy()
    anchors[:30] += 3.0
    spoilt = Matches(m.points_lidar, anchors, m.axes, m.is_line, m.is_firm)
    robust, _ = solve(spoilt, T, iterations=50, huber_m=0.1)
    plain, _ = solve(spoilt, T, iterations=50, huber_m=1e9)
    assert np.abs(se3.log(se3.inverse(T) @ robust)[3:]).max() < 0.03
    assert np.abs(se3.log(se3.inverse(T) @ plain)[3:]).max() > 0.1


def test_remapping_keeps_the_prediction_where_nothing_is_seen() -> None:
    rng = np.random.default_rng(0)
    m, T = matches(6, axes_used=(1, 2))
    planes = ~m.is_line
    weak = Matches(*(a[planes] for a in (m.points_lidar, m.anchors, m.axes, m.is_line, m.is_firm)))
    anchors = weak.anchors + rng.normal(0, 0.02, weak.anchors.shape)
    tilted = weak.axes + rng.normal(0, 0.02, weak.axes.shape)  # normals that pretend to know the axis
    tilted /= np.linalg.norm(tilted, axis=1)[:, None]
    weak = Matches(weak.points_lidar, anchors, tilted, weak.is_line, weak.is_firm)
    start = T @ se3.exp([0, 0, 0, 0, 0.05, -0.05])
    free, _ = solve(weak, start, iterations=20, huber_m=0.1)
    kept, _ = solve(weak, start, iterations=20, huber_m=0.1, min_eigenvalue=10.0)
    assert abs((free - start)[0, 3]) > 0.03
    assert abs((kept - start)[0, 3]) < 0.001
    assert np.abs((kept - T)[1:3, 3]).max() < 0.015


def test_nothing_moves_without_iterations_or_when_all_is_remapped() -> None:
    m, T = matches(7)
    start = T @ se3.exp([0, 0, 0.01, 0.1, 0, 0])
    assert np.array_equal(solve(m, start, iterations=0, huber_m=0.1)[0], start)
    assert np.allclose(solve(m, start, iterations=5, huber_m=0.1, min_eigenvalue=1e12)[0], start)


def test_a_single_plane_is_solved_where_it_can_be() -> None:
    p = np.random.default_rng(0).uniform(-5, 5, (50, 3)) * [1, 1, 0]
    up = np.tile([0.0, 0.0, 1.0], (50, 1))
    plane = Matches(p, p - [0, 0, 0.05], up, np.zeros(50, np.bool_), np.ones(50, np.bool_))
    found, residual_m = solve(plane, np.eye(4), iterations=200, huber_m=0.1)
    assert found[2, 3] == pytest.approx(-0.05, abs=1e-6)
    assert np.abs(found[:2, 3]).max() < 1e-3  # unseen: it stays
    assert residual_m < 1e-6


def test_only_firm_matches_count_as_knowledge() -> None:
    m, T = matches(8)
    h, n = firm_hessian(m, T, huber_m=0.1)
    firm = [a[m.is_firm] for a in problem(m)]
    assert n == m.is_firm.sum()
    assert np.allclose(h, normal_equations_plainly(*firm, T, 0.1)[0])  # type: ignore[arg-type]
    none = Matches(*problem(m), np.zeros(len(m), np.bool_))
    assert firm_hessian(none, T, huber_m=0.1)[1] == 0
