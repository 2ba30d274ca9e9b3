"""What a registration knows: its degeneracy, and the information of the relative pose it gives (METHOD D2, D3, 7.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.data import F64, Degeneracy

WEAK_RATIO = 0.005
"""A direction is weak when its eigenvalue is below this share of the largest (METHOD 7.3: 0.002-0.005; 0.02 fires on
healthy sweeps)."""


@dataclass(frozen=True, slots=True)
class EdgeNoise:
    """How Σ hᵀh becomes an honest covariance.

    Attributes:
        sigma_m: noise of one point; both partners of a pair are noisy, hence 2σ² (paper A, eq. 18).
        correlation: so many neighbouring rows share one error (wall roughness, map voxel, deskew), so that n rows count
            as n / correlation.
        floor_rad, floor_m: added to every edge: errors that do not average out however many points there are.
        weak_m: added along weak directions: what looks like information there is mostly noise of the normals.
        blurred_m: added along blurred directions.
        prior_rad, prior_m: what is known of an edge without any registration.
        coast_radps, coast_mps: added for every second that rests on the motion prior alone.
    """

    sigma_m: float = 0.03
    correlation: float = 20.0
    floor_rad: float = 0.0005
    floor_m: float = 0.005
    weak_m: float = 1.0
    blurred_m: float = 0.1
    prior_rad: float = 0.3
    prior_m: float = 1.0
    coast_radps: float = 0.2
    coast_mps: float = 1.0


def degeneracy_of(hessian: F64, matches: int, *, weak_ratio: float = WEAK_RATIO) -> Degeneracy:
    """Judge a registration by the translation block of its information, rotation taken out (Schur complement).

    Args:
        hessian: (6, 6) Σ w hᵀh, `[rotation, translation]`, right perturbation of the lidar.
        matches: number of inliers; none means that every direction is weak.
        weak_ratio: eigenvalues below this share of the largest are weak.
    """
    if matches <= 0:
        return Degeneracy(0.0, np.eye(3))
    values, vectors = np.linalg.eigh(_translation_block(hessian))
    largest = max(float(values[-1]), 0.0)
    if largest <= 0.0:
        return Degeneracy(0.0, np.eye(3))
    ratios = np.clip(values / largest, 0.0, 1.0)
    return Degeneracy(float(ratios[0]), vectors.T[ratios < weak_ratio])


def weakest_direction(hessian: F64) -> F64:
    """(3,) unit vector in the lidar frame of the least translation information; arguments as for `degeneracy_of`."""
    return np.linalg.eigh(_translation_block(hessian))[1][:, 0]


def edge_information(
    hessian: F64, degeneracy: Degeneracy, *, noise: EdgeNoise | None = None, coasted_s: float = 0.0
) -> F64:
    """Information matrix of the relative pose to a keyframe, from the registration of that keyframe.

    I = (H'⁻¹ + F)⁻¹ + P with H' = H / (2σ² · correlation); F holds the floor, the weak directions and coasting, P the
    prior, without which a graph could not be solved where nothing was seen. One matrix an edge, never accumulated
    (METHOD D2). The first term is computed as (1 + H' F)⁻¹ H', which holds for singular H.

    Args:
        hessian: (6, 6) as for `degeneracy_of`.
        degeneracy: its judgement.
        noise: defaults to `EdgeNoise()`.
        coasted_s: seconds between the keyframes that no registration supports.

    Returns:
        (6, 6) symmetric, positive definite, `[rotation, translation]`, right perturbation of the later keyframe.
    """
    noise = noise or EdgeNoise()
    h = hessian / (2.0 * noise.sigma_m**2 * noise.correlation)
    inflation = np.zeros((6, 6))
    inflation[:3, :3] = np.eye(3) * (noise.floor_rad**2 + (noise.coast_radps * coasted_s) ** 2)
    inflation[3:, 3:] = np.eye(3) * (noise.floor_m**2 + (noise.coast_mps * coasted_s) ** 2)
    weak = degeneracy.weak_directions
    inflation[3:, 3:] += noise.weak_m**2 * weak.T @ weak
    blurred = degeneracy.blurred_directions
    inflation[3:, 3:] += noise.blurred_m**2 * blurred.T @ blurred
    information = np.linalg.solve(np.eye(6) + h @ inflation, h)
    prior = np.diag([1.0 / noise.prior_rad**2] * 3 + [1.0 / noise.prior_m**2] * 3)
    return 0.5 * (information + information.T) + prior


def _translation_block(hessian: F64) -> F64:
    rotation, cross, translation = hessian[:3, :3], hessian[:3, 3:], hessian[3:, 3:]
    # the pseudo-inverse: what no point turns says nothing
    values, vectors = np.linalg.eigh(rotation)
    known = values > 1e-12 * max(float(values[-1]), 0.0)
    half = vectors[:, known].T @ cross / np.sqrt(values[known])[:, None]
    return translation - half.T @ half
