"""Whether a registered candidate is a loop closure: the checks that it passes by itself, each with its number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import LoopsConfig
from mineloc.data import F64, RelativePose
from mineloc.graph.relative_uncertainty import Prediction
from mineloc.mapping.submap_registration import SubmapRegistration
from mineloc.odometry.information import EdgeNoise, degeneracy_of, edge_information


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """What became of a candidate.

    Attributes:
        loop: the closure, None when refused.
        reason: the check that refused it and its number; empty when none did.
        T_i_j: (4, 4) where registration put it, None without one.
        scores: every number that was looked at.
    """

    loop: RelativePose | None
    reason: str
    T_i_j: F64 | None
    scores: Mapping[str, float]


def judge_loop(
    i: int,
    j: int,
    registration: SubmapRegistration | None,
    expected: Prediction,
    config: LoopsConfig,
    scores: Mapping[str, float],
) -> Judgement:
    """Fit, residual, open directions, distance from what is expected: in this order.

    Args:
        i, j: keyframes, the earlier one first.
        registration: of j's submap in i's; None when there was too little to register.
        expected: T_i_j without this closure.
        config: thresholds.
        scores: of the search, to be told with those of the judgement.
    """
    if registration is None:
        return Judgement(None, f"a submap has fewer than {config.min_inliers} points", None, dict(scores))
    T_i_j = registration.T_target_source
    eigenvalue = _least_translation(registration)
    away = _sigmas_away(T_i_j, expected, config)
    told = {
        **scores,
        "overlap": registration.overlap,
        "residual_m": registration.residual_m,
        "inliers": float(registration.inliers),
        "eigenvalue": eigenvalue,
        "sigmas": away,
    }
    reason = _refusal(registration, eigenvalue, away, config)
    if reason:
        return Judgement(None, reason, T_i_j, told)
    degeneracy = degeneracy_of(registration.hessian, registration.inliers)
    noise = EdgeNoise(
        sigma_m=max(registration.residual_m, 0.01),
        floor_rad=float(np.radians(config.sigma_deg)),
        floor_m=config.sigma_m,
    )
    information = edge_information(registration.hessian, degeneracy, noise=noise)
    return Judgement(RelativePose(i, j, T_i_j, information), "", T_i_j, told)


def _refusal(registration: SubmapRegistration, eigenvalue: float, away: float, config: LoopsConfig) -> str:
    if registration.inliers < config.min_inliers:
        return f"{registration.inliers} inliers, at least {config.min_inliers} needed"
    if registration.overlap < config.min_overlap:
        return f"overlap {registration.overlap:.2f}, at least {config.min_overlap} needed"
    if registration.residual_m > config.max_residual_m:
        return f"residual {registration.residual_m:.3f} m, at most {config.max_residual_m} m allowed"
    if eigenvalue < config.min_eigenvalue:
        return f"eigenvalue {eigenvalue:.4f} in the weakest direction, at least {config.min_eigenvalue} needed"
    if away > config.gate_sigmas:
        return f"{away:.1f} sigmas from the prediction, at most {config.gate_sigmas} allowed"
    return ""


def _least_translation(registration: SubmapRegistration) -> float:
    """Smallest eigenvalue of the translation block an inlier: what share of the normals holds the weakest direction."""
    block = registration.hessian[3:, 3:] / max(registration.inliers, 1)
    return float(np.linalg.eigvalsh(block)[0])


def _sigmas_away(T_i_j: F64, expected: Prediction, config: LoopsConfig) -> float:
    """Mahalanobis distance from the expected pose, a component."""
    error = se3.log(se3.rigid(se3.inverse(expected.T_i_j) @ T_i_j))
    floor = [np.radians(config.gate_floor_deg)] * 3 + [config.gate_floor_m] * 3
    covariance = expected.covariance + np.diag(np.square(floor))
    return float(np.sqrt(error @ np.linalg.solve(covariance, error) / 6.0))
