"""From information matrices of registrations to covariances that a solver can live with.

A registration in a smooth roadway says almost nothing along its axis: its information is singular there up to
rounding, and has no inverse. How much of the rest to believe is said where the information is made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.config import GraphConfig
from mineloc.data import F64


@dataclass(frozen=True, slots=True, eq=False)
class EdgeNoise:
    """Covariance of a relative pose, `[rotation, translation]`, right perturbation.

    Attributes:
        covariance: (6, 6), positive definite.
        is_weak: the information left a direction so open that the limit decided.
    """

    covariance: F64
    is_weak: bool


def edge_noise(information: F64, config: GraphConfig) -> EdgeNoise:
    """Covariance of an edge from its information, also where that is singular.

    σ is limited to `relative_max_m` and `relative_max_deg` by adding the information that those stand for: a motion
    between keyframes is never known less. The correction of the estimate along an open direction then comes from
    elsewhere in the graph, as it should.

    Args:
        information: (6, 6) symmetric, positive semidefinite up to rounding.

    Raises:
        ValueError: the information has a clearly negative eigenvalue.
    """
    # radians and metres made comparable by the limits, so that an eigenvalue of 1 means "as weak as the limit"
    limit = np.array([np.radians(config.relative_max_deg)] * 3 + [config.relative_max_m] * 3)
    scaled = limit[:, None] * (information + information.T) / 2.0 * limit
    eigenvalues, vectors = np.linalg.eigh(scaled)
    if eigenvalues[0] < -1e-6 * max(float(eigenvalues[-1]), 1.0):
        raise ValueError(f"information with a negative eigenvalue ({eigenvalues[0]:.3g} after scaling)")
    half = limit[:, None] * vectors / np.sqrt(1.0 + np.maximum(eigenvalues, 0.0))
    return EdgeNoise(half @ half.T, bool(eigenvalues[0] < 1.0))


def anchor_covariance(T_map_lidar: F64, config: GraphConfig) -> F64:
    """(6, 6) covariance of the first keyframe where nothing but itself says where the map is.

    Position and heading define the map and are certain; the tilt was measured and is not.
    """
    r = T_map_lidar[:3, :3]
    tilt, yaw = np.radians(config.anchor_tilt_deg), np.radians(config.anchor_yaw_deg)
    out = np.zeros((6, 6))
    out[:3, :3] = r.T @ np.diag([tilt**2, tilt**2, yaw**2]) @ r
    out[3:, 3:] = np.eye(3) * config.anchor_m**2
    return out


def positive_definite(covariance: F64) -> F64:
    """The covariance itself.

    Raises:
        ValueError: it is not symmetric and positive definite; a solver would fail on it later, without a name.
    """
    if not (
        np.isfinite(covariance).all()
        and np.allclose(covariance, covariance.T, rtol=0.0, atol=1e-9 * np.abs(covariance).max())
    ):
        raise ValueError("a covariance must be finite and symmetric")
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise ValueError("a covariance must be positive definite")
    return covariance
