"""What the equations say and what gtsam does (METHOD D1, 1.4, 1.7, 7.6)."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import Fix, Keyframe, RelativePose
from mineloc.graph.measurements import PointFix
from mineloc.graph.pose_graph import PoseGraph, values_of

NO_POINTS = np.zeros((0, 3), np.float32)
SWAP = np.r_[3:6, 0:3]  # [rotation, translation] <-> paper A's [translation, rotation]


def _poses(seed: int) -> tuple[np.ndarray, np.ndarray]:
    a, b = se3.exp(np.random.default_rng(seed).normal(size=(2, 6)) * [0.5, 0.5, 0.5, 20, 20, 5])
    return a, b


def _graph(a: np.ndarray, b: np.ndarray, **kwargs) -> PoseGraph:
    graph = PoseGraph(GraphConfig(**kwargs))
    graph.add_first(Keyframe(0, 0, a, NO_POINTS, a[:3, :3].T @ [0, 0, 1.0]))
    graph.add_next(
        Keyframe(1, 1, b, NO_POINTS, b[:3, :3].T @ [0, 0, 1.0]),
        RelativePose(0, 1, se3.inverse(a) @ b, np.eye(6) * 100),
    )
    return graph


@pytest.mark.parametrize("seed", range(5))
def test_every_residual_is_zero_at_the_truth(seed):
    a, b = _poses(seed)
    graph = _graph(a, b)
    graph.add_loop(RelativePose(1, 0, se3.inverse(b) @ a, np.eye(6)))
    graph.add_fix(Fix(1, 1, b, np.eye(6), True))
    seen = np.array([3.0, -2.0, 0.5])
    graph.add_point_fix(PointFix(1, se3.apply(b, seen[None])[0], seen, np.eye(3)))
    kinds = {factor.kind for factor in graph.factors}
    assert kinds == {"prior", "gravity", "relative", "loop", "fix", "point_fix"}
    values = values_of([a, b])
    for factor in graph.factors:
        residual = factor.gtsam_factor.unwhitenedError(values)
        assert len(residual) == len(factor.covariance)
        assert np.abs(residual).max() < 1e-9, factor.kind


def test_the_papers_measurement_is_not_zero_at_the_truth():
    # D1: with A(10) as printed, T_j^-1 T_i, the residual A(11) is twice the motion
    a, b = _poses(0)
    printed = se3.inverse(b) @ a
    assert np.abs(se3.log(se3.inverse(printed) @ se3.inverse(a) @ b)).max() > 1.0
    assert np.abs(se3.log(se3.inverse(se3.inverse(a) @ b) @ se3.inverse(a) @ b)).max() < 1e-9


def _right_jacobian_inverse(e: np.ndarray) -> np.ndarray:
    """d Log(Exp(e) Exp(x)) / dx at 0, by central differences."""
    out = np.empty((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        out[:, k] = (se3.log(se3.exp(e) @ se3.exp(step)) - se3.log(se3.exp(e) @ se3.exp(-step))) / 2e-6
    return out


@pytest.mark.parametrize("seed", range(4))
def test_the_papers_jacobians_hold_for_left_perturbation_and_are_gtsams_moved_by_the_adjoint(seed):
    a, b = _poses(seed)
    z = se3.inverse(a) @ b @ se3.exp(np.random.default_rng(seed + 9).normal(size=6) * 0.2)

    def error(left_i, left_j):
        return se3.log(se3.inverse(z) @ se3.inverse(se3.exp(left_i) @ a) @ se3.exp(left_j) @ b)

    e = error(np.zeros(6), np.zeros(6))
    a14 = _right_jacobian_inverse(e) @ se3.adjoint(se3.inverse(b))
    a13 = -a14
    numeric_i, numeric_j = np.empty((6, 6)), np.empty((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        numeric_i[:, k] = (error(step, np.zeros(6)) - error(-step, np.zeros(6))) / 2e-6
        numeric_j[:, k] = (error(np.zeros(6), step) - error(np.zeros(6), -step)) / 2e-6
    np.testing.assert_allclose(numeric_i, a13, atol=2e-5)
    np.testing.assert_allclose(numeric_j, a14, atol=2e-5)

    factor = gtsam.BetweenFactorPose3(0, 1, gtsam.Pose3(z), gtsam.noiseModel.Unit.Create(6))
    values = values_of([a, b])
    jacobian, _ = factor.linearize(values).jacobian()
    # gtsam perturbs on the right: left = Ad(T) right
    np.testing.assert_allclose(jacobian[:, :6], a13 @ se3.adjoint(a), atol=2e-5)
    np.testing.assert_allclose(jacobian[:, 6:], a14 @ se3.adjoint(b), atol=2e-5)
    # translation first, as in the paper, is a permutation of both sides
    ordered = a14[np.ix_(SWAP, SWAP)]
    assert np.abs(ordered[:3, :3] - a14[3:, 3:]).max() == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_intersection_jacobians_a26_to_a28(seed):
    T, _ = _poses(seed)
    rng = np.random.default_rng(seed)
    seen, place = rng.normal(size=3) * 5, rng.normal(size=3) * 30
    r, t = T[:3, :3], T[:3, 3]

    def error(phi, moved, seen_moved):
        turned = Rotation.from_rotvec(phi).as_matrix() @ r
        return place - (t + moved) - turned @ (seen + seen_moved)  # A(22)

    analytic = (se3.hat(r @ seen), -np.eye(3), -r)
    for block, expected in enumerate(analytic):
        for k in range(3):
            steps = [np.zeros(3), np.zeros(3), np.zeros(3)]
            steps[block][k] = 1e-6
            slope = (error(*steps) - error(*(-s for s in steps))) / 2e-6
            np.testing.assert_allclose(slope, expected[:, k], atol=1e-6)
    # gtsam's residual is the paper's with the other sign
    graph = _graph(T, T)
    graph.add_point_fix(PointFix(0, place, seen, np.eye(3)))
    residual = graph.factors[-1].gtsam_factor.unwhitenedError(values_of([T, T]))
    np.testing.assert_allclose(residual, -error(np.zeros(3), np.zeros(3), np.zeros(3)), atol=1e-9)


def test_covariances_are_right_perturbations_rotation_first():
    a, b = _poses(1)
    graph = _graph(a, b)
    sigma = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    graph.add_fix(Fix(1, 1, b, np.diag(sigma**2), True))
    factor = graph.factors[-1].gtsam_factor
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-4
        residual = factor.unwhitenedError(values_of([a, b @ se3.exp(step)]))
        np.testing.assert_allclose(residual, step, atol=1e-9)


def test_a_position_fix_takes_the_covariance_to_the_map():
    T, _ = _poses(3)
    covariance = np.diag([1, 1, 1, 0.01, 0.04, 0.09])
    point = PointFix.of(Fix(0, 0, T, covariance, True))
    np.testing.assert_allclose(point.point_map, T[:3, 3])
    np.testing.assert_allclose(np.linalg.eigvalsh(point.covariance), [0.01, 0.04, 0.09])
    np.testing.assert_allclose(T[:3, :3].T @ point.covariance @ T[:3, :3], covariance[3:, 3:], atol=1e-12)
    with pytest.raises(ValueError, match="without pose"):
        PointFix.of(Fix(0, 0, None, None, False, "refused"))
