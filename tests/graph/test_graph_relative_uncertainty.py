"""What odometry knows between two keyframes: sums in the map frame against step-by-step propagation."""

from __future__ import annotations

import numpy as np
import pytest

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import F64, RelativePose
from mineloc.graph.noise import edge_noise
from mineloc.graph.relative_uncertainty import RelativeUncertainty


def chain(n: int, rng: np.random.Generator) -> tuple[list[F64], list[RelativePose | None]]:
    poses, edges = [np.eye(4)], [None]
    for k in range(1, n):
        moved = se3.exp(rng.normal(0, 1, 6) * [0.02, 0.02, 0.2, 1.0, 0.1, 0.1])
        root = rng.normal(0, 1, (6, 6))
        information = np.diag([4e4] * 3 + [1e4] * 3) + 100 * root @ root.T
        poses.append(se3.rigid(poses[-1] @ moved))
        edges.append(RelativePose(k - 1, k, moved, information))
    return poses, edges


def uncertainty_of(poses: list[F64], edges: list[RelativePose | None]) -> RelativeUncertainty:
    out = RelativeUncertainty(GraphConfig())
    for pose, edge in zip(poses, edges, strict=True):
        out.add(pose, edge)
    return out


def propagated(edges: list[RelativePose | None], i: int, j: int) -> F64:
    """METHOD 7.2: C <- A C A' + Q with A = Ad(Δ⁻¹), right perturbation."""
    covariance = np.zeros((6, 6))
    for edge in edges[i + 1 : j + 1]:
        assert edge is not None
        A = se3.adjoint(se3.inverse(edge.T_i_j))
        covariance = A @ covariance @ A.T + edge_noise(edge.information, GraphConfig()).covariance
    return covariance


def test_differences_of_sums_are_the_propagated_covariance() -> None:
    poses, edges = chain(150, np.random.default_rng(0))
    known = uncertainty_of(poses, edges)
    for i, j in ((0, 149), (20, 21), (40, 110)):
        found = known.between(i, j)
        assert found.covariance == pytest.approx(propagated(edges, i, j), rel=1e-6, abs=1e-12)
        assert found.T_i_j == pytest.approx(se3.inverse(poses[i]) @ poses[j], abs=1e-9)


def test_backwards_is_the_inverse_seen_from_the_other_end() -> None:
    poses, edges = chain(60, np.random.default_rng(1))
    known = uncertainty_of(poses, edges)
    there, back = known.between(5, 50), known.between(50, 5)
    A = se3.adjoint(there.T_i_j)
    assert back.covariance == pytest.approx(A @ there.covariance @ A.T, rel=1e-6)
    assert back.T_i_j == pytest.approx(se3.inverse(there.T_i_j), abs=1e-9)


def test_a_closure_shortens_the_way() -> None:
    poses, edges = chain(200, np.random.default_rng(2))
    known = uncertainty_of(poses, edges)
    before = known.between(10, 190)
    T = se3.inverse(poses[8]) @ poses[188] @ se3.exp(np.array([0, 0, 0, 0.5, 0, 0]))
    known.close(RelativePose(8, 188, T, np.eye(6) * 1e5))
    after, back = known.between(10, 190), known.between(190, 10)
    assert after.sigma_m < 0.5 * before.sigma_m
    # the prediction leads across the closure: its half metre is in it
    moved = se3.log(se3.rigid(se3.inverse(before.T_i_j) @ after.T_i_j))
    assert np.linalg.norm(moved[3:]) == pytest.approx(0.5, abs=1e-6)
    assert back.T_i_j == pytest.approx(se3.inverse(after.T_i_j), abs=1e-9)
    assert known.between(90, 100).sigma_m == pytest.approx(np.sqrt(np.trace(propagated(edges, 90, 100)[3:, 3:])))


def test_cycles_that_come_back_agree_and_others_do_not() -> None:
    poses, edges = chain(120, np.random.default_rng(3))
    known = uncertainty_of(poses, edges)

    def loop(i: int, j: int, error_m: float) -> RelativePose:
        T = se3.rigid(se3.inverse(poses[i]) @ poses[j] @ se3.exp(np.array([0, 0, 0, error_m, 0, 0])))
        return RelativePose(i, j, T, np.eye(6) * 2.5e3)

    agree = known.consistent(loop(5, 100, 0.0), [loop(9, 96, 0.0), loop(9, 96, 0.05), loop(9, 96, 3.0)])
    assert agree.tolist() == [True, True, False]
    loops = [loop(5, 100, 0.0), loop(9, 96, 0.0), loop(9, 96, 0.05), loop(9, 96, 3.0)]
    expected = [known.consistent(one, loops).tolist() for one in loops]
    assert known.agreement(loops).tolist() == expected
    assert known.agreement([]).shape == (0, 0)
    # two closures with the same error agree with one another: only others can tell
    assert known.consistent(loop(5, 100, 3.0), [loop(9, 99, 3.0)]).tolist() == [True]


def test_nothing_is_asked_of_nothing() -> None:
    poses, edges = chain(3, np.random.default_rng(4))
    known = uncertainty_of(poses, edges)
    assert len(known) == 3
    assert len(known.consistent(RelativePose(0, 2, np.eye(4), np.eye(6)), [])) == 0
    assert np.abs(known.between(1, 1).covariance).max() < 1e-15
