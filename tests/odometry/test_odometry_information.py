from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mineloc import se3
from mineloc.data import F64, Degeneracy
from mineloc.odometry.information import EdgeNoise, degeneracy_of, edge_information


def hessian(points: F64, normals: F64) -> F64:
    rows = np.concatenate([np.cross(points, normals), normals], axis=1)
    return rows.T @ rows


def walls(seed: int, n: int, *, ends: bool) -> F64:
    """Hessian of a 4 m × 3 m tunnel of 20 m, with or without end walls."""
    rng = np.random.default_rng(seed)
    p = rng.uniform([-10, -2, -1.5], [10, 2, 1.5], (n, 3))
    axis = rng.integers(0 if ends else 1, 3, n)
    normal = np.eye(3)[axis]
    p[np.arange(n), axis] = np.sign(p[np.arange(n), axis]) * np.array([10, 2, 1.5])[axis]
    return hessian(p, normal)


@given(seed=st.integers(0, 1000), turn=st.floats(-3, 3))
def test_a_tunnel_is_weak_along_its_axis_and_only_there(seed: int, turn: float) -> None:
    T = se3.exp([0.1, -0.2, turn, 0, 0, 0])  # the lidar is turned in the tunnel
    adjoint = se3.adjoint(T)
    h = adjoint.T @ walls(seed, 500, ends=False) @ adjoint
    found = degeneracy_of(h, 500)
    assert found.is_degenerate
    assert found.score < 1e-6
    assert found.weak_directions.shape == (1, 3)
    assert abs(found.weak_directions[0] @ T[:3, :3].T @ [1, 0, 0]) > 1 - 1e-6


@given(seed=st.integers(0, 1000))
def test_a_tunnel_with_an_end_is_not_weak(seed: int) -> None:
    found = degeneracy_of(walls(seed, 500, ends=True), 500)
    assert not found.is_degenerate
    assert 0.1 < found.score <= 1.0


def test_a_single_plane_leaves_two_directions_weak() -> None:
    p = np.random.default_rng(0).uniform(-5, 5, (100, 3)) * [1, 1, 0] + [0, 0, -1.5]
    found = degeneracy_of(hessian(p, np.tile([0.0, 0.0, 1.0], (100, 1))), 100)
    assert len(found.weak_directions) == 2
    assert np.abs(found.weak_directions[:, 2]).max() < 1e-6


def test_without_matches_everything_is_weak() -> None:
    for h, n in ((np.zeros((6, 6)), 0), (np.zeros((6, 6)), 10), (walls(0, 500, ends=True), 0)):
        assert len(degeneracy_of(h, n).weak_directions) == 3


def test_rotation_is_taken_out() -> None:
    # plenty of rows towards x, but every one of them explained as well by a turn about z
    p = np.tile([0.0, 5.0, 0.0], (100, 1))
    h = hessian(p, np.tile([1.0, 0.0, 0.0], (100, 1))) + np.diag([1, 1, 0, 0, 100, 100.0])
    found = degeneracy_of(h, 100)
    assert found.is_degenerate
    assert abs(found.weak_directions[0, 0]) > 0.99


@given(seed=st.integers(0, 1000), n=st.integers(0, 800), ends=st.booleans(), coasted_s=st.floats(0, 30))
def test_information_is_symmetric_and_positive_definite(seed: int, n: int, ends: bool, coasted_s: float) -> None:
    h = walls(seed, n, ends=ends)
    information = edge_information(h, degeneracy_of(h, n), coasted_s=coasted_s)
    assert np.array_equal(information, information.T)
    assert np.linalg.eigvalsh(information).min() > 0


def test_many_points_do_not_make_an_edge_certain() -> None:
    noise = EdgeNoise()
    h = walls(0, 500, ends=True) * 1e6
    sigma = np.sqrt(np.diag(np.linalg.inv(edge_information(h, degeneracy_of(h, 500)))))
    assert sigma[3:] == pytest.approx(noise.floor_m, rel=0.05)
    assert sigma[:3] == pytest.approx(noise.floor_rad, rel=0.05)


def test_the_axis_of_a_tunnel_is_told_as_unknown() -> None:
    noise = EdgeNoise()
    h = walls(0, 2000, ends=False) + np.diag([0, 0, 0, 5.0, 0, 0])  # a little false information from noisy normals
    sigma = np.sqrt(np.diag(np.linalg.inv(edge_information(h, degeneracy_of(h, 2000)))))
    assert sigma[3] > 0.5
    assert sigma[3] <= noise.prior_m + 1e-9
    assert sigma[4:].max() < 0.02


def test_coasting_weakens_the_edge() -> None:
    h = walls(0, 2000, ends=True)
    found = degeneracy_of(h, 2000)
    sigmas = [
        np.sqrt(np.diag(np.linalg.inv(edge_information(h, found, coasted_s=s))))[3:].max()
        for s in (0.0, 0.1, 0.5, 60.0)
    ]
    assert sigmas == sorted(sigmas)
    assert sigmas[1] > 0.09
    assert sigmas[3] == pytest.approx(EdgeNoise().prior_m, rel=0.01)


def test_without_inflation_it_is_paper_a_made_right() -> None:
    """METHOD D3: Σ hᵀh / (2σ²)."""
    h = walls(3, 300, ends=True)
    exact = EdgeNoise(0.03, correlation=1, floor_rad=0, floor_m=0, weak_m=0, prior_rad=1e9, prior_m=1e9)
    assert np.allclose(edge_information(h, degeneracy_of(h, 300), noise=exact), h / (2 * 0.03**2))


def test_an_edge_is_no_surer_along_a_blurred_direction_than_the_probe() -> None:
    h = walls(0, 500, ends=True)
    clear = degeneracy_of(h, 500)
    blurred = Degeneracy(clear.score, clear.weak_directions, np.array([[1.0, 0.0, 0.0]]))
    assert blurred.is_degenerate
    assert not clear.is_degenerate
    sigma = [np.sqrt(np.diag(np.linalg.inv(edge_information(h, one)))[3:]) for one in (clear, blurred)]
    assert sigma[1][0] == pytest.approx(np.hypot(sigma[0][0], 0.1), rel=0.02)
    assert sigma[1][1:] == pytest.approx(sigma[0][1:], rel=0.02)
