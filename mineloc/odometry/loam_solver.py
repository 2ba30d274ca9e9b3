"""The least-squares problem of LOAM: one pose from point-to-line and point-to-plane distances.

Levenberg-Marquardt as Ceres runs it for A-LOAM (METHOD 4.1: Huber 0.1, four iterations, correspondences fixed), with
the Jacobians of METHOD D3 (right perturbation, rotation first).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mineloc import se3
from mineloc.compiled import njit
from mineloc.data import F64

Bool = NDArray[np.bool_]

_FIRST_RADIUS = 1e4
_LARGEST_RADIUS = 1e8
_SMALL_STEP = 1e-8
"""Ceres' trust region at the start and its parameter tolerance; the region stays small enough that a system without
information in some direction can still be solved."""


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Points and what they should lie on.

    Attributes:
        points_lidar: (n, 3) float64, deskewed.
        anchors: (n, 3) a point of the line or plane, in the frame of the target.
        axes: (n, 3) unit vectors: direction of the line, or normal of the plane.
        is_line: (n,).
        is_firm: (n,) planes that are known well enough to judge by (`loam_fit`).
    """

    points_lidar: F64
    anchors: F64
    axes: F64
    is_line: Bool
    is_firm: Bool

    def __len__(self) -> int:
        return len(self.points_lidar)

    def placed(self, T_other_target: F64) -> Matches:
        """The same lines and planes in another frame."""
        return replace(self, anchors=se3.apply(T_other_target, self.anchors), axes=self.axes @ T_other_target[:3, :3].T)

    @staticmethod
    def join(lines: Matches, planes: Matches) -> Matches:
        """Both kinds as one problem."""
        return Matches(
            np.concatenate([lines.points_lidar, planes.points_lidar]),
            np.concatenate([lines.anchors, planes.anchors]),
            np.concatenate([lines.axes, planes.axes]),
            np.concatenate([lines.is_line, planes.is_line]),
            np.concatenate([lines.is_firm, planes.is_firm]),
        )


def solve(
    matches: Matches, T_target_lidar: F64, *, iterations: int, huber_m: float, min_eigenvalue: float = 0.0
) -> tuple[F64, float]:
    """Minimise the robust distances, from a given pose.

    Args:
        matches: n ≥ 1.
        T_target_lidar: (4, 4) start.
        iterations: at most so many steps, rejected ones included.
        huber_m: distances beyond it count linearly.
        min_eigenvalue: LOAM's degeneracy handling (Zhang, Kaess, Singh, ICRA 2016): directions whose eigenvalue of
            Σ w hᵀh at the start is smaller keep the start value. 0 turns it off (A-LOAM has none).

    Returns:
        (4, 4) `T_target_lidar` and the weighted root mean square of the distances, metres.
    """
    problem = (matches.points_lidar, matches.anchors, matches.axes, matches.is_line)
    pose = T_target_lidar
    h, g, cost, rms = normal_equations(*problem, pose, huber_m)
    observed = _observed_directions(h, min_eigenvalue)
    radius, shrink = _FIRST_RADIUS, 2.0
    for _ in range(iterations):
        damping = np.clip(np.diag(h), 1e-6, 1e32) / radius
        step = observed @ np.linalg.solve(h + np.diag(damping), -g)
        if float(np.linalg.norm(step)) < _SMALL_STEP:
            break
        candidate = retract(pose, step)
        h_new, g_new, cost_new, rms_new = normal_equations(*problem, candidate, huber_m)
        expected = -float(step @ g) - 0.5 * float(step @ h @ step)
        gain = (cost - cost_new) / expected if expected > 0 else -1.0
        if gain > 1e-3:
            pose, h, g, cost, rms = candidate, h_new, g_new, cost_new, rms_new
            radius = min(radius / max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), _LARGEST_RADIUS)
            shrink = 2.0
        else:
            radius /= shrink
            shrink *= 2.0
    return pose, rms


def firm_hessian(matches: Matches, T_target_lidar: F64, *, huber_m: float) -> tuple[F64, int]:
    """What the firm matches know of a pose: (6, 6) Σ w hᵀh and their number.

    Right perturbation of the lidar, rotation first, unit noise (METHOD D3). The others are left out: lines through
    noise and planes through one arc pull at the pose in directions in which the walls say nothing.
    """
    firm = matches.is_firm
    h, _, _, _ = normal_equations(
        matches.points_lidar[firm],
        matches.anchors[firm],
        matches.axes[firm],
        matches.is_line[firm],
        T_target_lidar,
        huber_m,
    )
    return h, int(firm.sum())


def _observed_directions(h: F64, min_eigenvalue: float) -> F64:
    """V diag(λ ≥ threshold) Vᵀ; numpy's eigenvectors are columns (the transposed projector is loam_velodyne#96)."""
    if min_eigenvalue <= 0:
        return np.eye(6)
    values, vectors = np.linalg.eigh(h)
    return (vectors * (values >= min_eigenvalue)) @ vectors.T


@njit(cache=True, nogil=True)
def normal_equations(
    points: F64, anchors: F64, axes: F64, is_line: Bool, T: F64, huber_m: float
) -> tuple[F64, F64, float, float]:
    """Gauss-Newton system of the robust distances at a pose.

    Args:
        points, anchors, axes, is_line: as in `Matches`.
        T: (4, 4) `T_target_lidar`.
        huber_m: Huber's threshold.

    Returns:
        H = Σ w hᵀh (6, 6) and g = Σ w hᵀr (6,), rotation first, right perturbation; the cost ½ Σ ρ(r²); the weighted
        root mean square of r.
    """
    h = np.zeros((6, 6))
    g = np.zeros(6)
    cost = 0.0
    squares = 0.0
    weights = 0.0
    e = np.empty(3)
    axis = np.empty(3)
    row = np.empty(6)
    for i in range(points.shape[0]):
        # distance vector and axis, both turned into the lidar frame: there the Jacobian is [p × m, m] (METHOD D3)
        for k in range(3):
            e[k] = 0.0
            axis[k] = 0.0
        for r in range(3):
            q = T[r, 0] * points[i, 0] + T[r, 1] * points[i, 1] + T[r, 2] * points[i, 2] + T[r, 3] - anchors[i, r]
            for k in range(3):
                e[k] += T[r, k] * q
                axis[k] += T[r, k] * axes[i, r]
        along = e[0] * axis[0] + e[1] * axis[1] + e[2] * axis[2]
        squared = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
        r2 = max(squared - along * along, 0.0) if is_line[i] else along * along
        distance = np.sqrt(r2)
        w = 1.0 if distance <= huber_m else huber_m / distance
        cost += 0.5 * (r2 if distance <= huber_m else 2.0 * huber_m * distance - huber_m * huber_m)
        squares += w * r2
        weights += w
        if is_line[i]:
            # I − uuᵀ as the three coordinate rows less the row along u
            for k in range(3):
                _row(points[i], k, row)
                _accumulate(h, g, row, w, e[k])
            _row_along(points[i], axis, row)
            _accumulate(h, g, row, -w, along)
        else:
            _row_along(points[i], axis, row)
            _accumulate(h, g, row, w, along)
    for a in range(6):
        for b in range(a):
            h[a, b] = h[b, a]
    return h, g, cost, np.sqrt(squares / max(weights, 1e-300))


@njit(cache=True, nogil=True, inline="always")
def _row_along(p: F64, m: F64, row: F64) -> None:
    row[0] = p[1] * m[2] - p[2] * m[1]
    row[1] = p[2] * m[0] - p[0] * m[2]
    row[2] = p[0] * m[1] - p[1] * m[0]
    row[3] = m[0]
    row[4] = m[1]
    row[5] = m[2]


@njit(cache=True, nogil=True, inline="always")
def _row(p: F64, k: int, row: F64) -> None:
    row[:] = 0.0
    row[3 + k] = 1.0
    row[(k + 1) % 3] = p[(k + 2) % 3]
    row[(k + 2) % 3] = -p[(k + 1) % 3]


@njit(cache=True, nogil=True, inline="always")
def _accumulate(h: F64, g: F64, row: F64, w: float, r: float) -> None:
    for a in range(6):
        g[a] += w * row[a] * r
        for b in range(a, 6):
            h[a, b] += w * row[a] * row[b]


@njit(cache=True, nogil=True)
def retract(T: F64, step: F64) -> F64:
    """`T` after a small step of the lidar, `[rotation, translation]`: R Exp(ω), t + R v.

    To first order `T @ exp(step)`, which is all that an iteration needs, at a fiftieth of its cost.
    """
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    a = np.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-4 else 0.5
    k = np.zeros((3, 3))
    k[0, 1], k[0, 2], k[1, 2] = -step[2], step[1], -step[0]
    k[1, 0], k[2, 0], k[2, 1] = step[2], -step[1], step[0]
    r = np.ascontiguousarray(T[:3, :3])
    out = T.copy()
    out[:3, :3] = r @ (np.eye(3) + a * k + b * (k @ k))
    out[:3, 3] += r @ np.ascontiguousarray(step[3:])
    return out


def normal_equations_plainly(
    points: F64, anchors: F64, axes: F64, is_line: Bool, T: F64, huber_m: float
) -> tuple[F64, F64, float, float]:
    """`normal_equations` in plain numpy: ∂q = R [−p^ I], projected on the normal or across the line."""
    q = se3.apply(T, points) - anchors
    outer = np.einsum("ni,nj->nij", axes, axes)
    project = np.where(is_line[:, None, None], np.eye(3) - outer, outer)
    e = np.einsum("nij,nj->ni", project, q)
    distance = np.linalg.norm(e, axis=1)
    w = np.where(distance <= huber_m, 1.0, huber_m / np.maximum(distance, 1e-300))
    eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    jacobian = project @ (T[:3, :3] @ np.concatenate([-se3.hat(points), eye], axis=2))
    h = np.einsum("n,nki,nkj->ij", w, jacobian, jacobian)
    g = np.einsum("n,nki,nk->i", w, jacobian, e)
    rho = np.where(distance <= huber_m, distance**2, 2 * huber_m * distance - huber_m**2)
    rms = float(np.sqrt(np.sum(w * distance**2) / max(float(w.sum()), 1e-300)))
    return h, g, 0.5 * float(rho.sum()), rms
