"""(4, 4) float64 rigid transforms: the few operations that scipy and gtsam do not give on plain arrays.

Tangent vectors are rotation first, `[rx ry rz tx ty tz]`, perturbations are on the right (body side):
`T ∘ ξ = T @ exp(ξ)`. This is gtsam's convention; paper A writes translation first and perturbs on the left
(METHOD 7.6).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

F64 = NDArray[np.float64]


def from_rt(rotation: ArrayLike, translation_m: ArrayLike) -> F64:
    """A (4, 4) transform, or (n, 4, 4), from (…, 3, 3) rotations and (…, 3) translations in metres."""
    r = np.asarray(rotation, dtype=np.float64)
    t = np.asarray(translation_m, dtype=np.float64)
    out = np.zeros((*np.broadcast_shapes(r.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3] = r
    out[..., :3, 3] = t
    out[..., 3, 3] = 1.0
    return out


def inverse(T: F64) -> F64:
    """Inverse of (…, 4, 4) rigid transforms."""
    r = np.swapaxes(T[..., :3, :3], -1, -2)
    return from_rt(r, -np.einsum("...ij,...j->...i", r, T[..., :3, 3]))


def rigid(T: F64) -> F64:
    """(…, 4, 4) with rotations that were orthonormal but for rounding made so again.

    Rounding grows along a chain of products, and `inverse` doubles it. One step of Newton's iteration for the polar
    factor squares an error e: 1.5 e² is left.
    """
    r = T[..., :3, :3]
    out = T.copy()
    out[..., :3, :3] = 1.5 * r - 0.5 * r @ (np.swapaxes(r, -1, -2) @ r)
    return out


def apply(T: F64, points: ArrayLike) -> F64:
    """Take (n, 3) points through one (4, 4) transform, float64 out."""
    return np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def hat(v: ArrayLike) -> F64:
    """Skew matrices (…, 3, 3) of (…, 3) vectors: `hat(a) @ b == cross(a, b)`."""
    x, y, z = np.moveaxis(np.asarray(v, dtype=np.float64), -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def _left_jacobian_so3(phi: F64) -> F64:
    """J_l(φ) for (n, 3): integrates a rotating translation, `t = J_l(φ) ρ`."""
    theta2 = np.einsum("ni,ni->n", phi, phi)
    theta = np.sqrt(theta2)
    small = theta < 1e-4
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 0.5 - theta2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - theta2 / 120.0, (safe - np.sin(safe)) / safe**3)
    k = hat(phi)
    out = np.eye(3) + a[:, None, None] * k + b[:, None, None] * (k @ k)
    return np.asarray(out, dtype=np.float64)


def exp(xi: ArrayLike) -> F64:
    """SE(3) exponential of (6,) or (n, 6) tangent vectors `[rotation, translation]`."""
    x = np.asarray(xi, dtype=np.float64)
    flat = x.reshape(-1, 6)
    r = Rotation.from_rotvec(flat[:, :3]).as_matrix()
    t = np.einsum("nij,nj->ni", _left_jacobian_so3(flat[:, :3]), flat[:, 3:])
    return from_rt(r, t).reshape(*x.shape[:-1], 4, 4)


def log(T: F64) -> F64:
    """SE(3) logarithm: (6,) or (n, 6) `[rotation, translation]` of (4, 4) or (n, 4, 4)."""
    flat = T.reshape(-1, 4, 4)
    phi = Rotation.from_matrix(flat[:, :3, :3]).as_rotvec()
    rho = np.linalg.solve(_left_jacobian_so3(phi), flat[:, :3, 3, None])[..., 0]
    return np.concatenate([phi, np.asarray(rho, dtype=np.float64)], axis=1).reshape(*T.shape[:-2], 6)


def adjoint(T: F64) -> F64:
    """(…, 6, 6) adjoint for `[rotation, translation]`: `T @ exp(ξ) == exp(Ad(T) ξ) @ T`."""
    r = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = r
    out[..., 3:, 3:] = r
    out[..., 3:, :3] = hat(T[..., :3, 3]) @ r
    return out


def angle_rad(T: F64) -> F64:
    """Rotation angle in [0, π] of (…, 4, 4), exact near zero (paper A, eq. 9, without its arccos)."""
    r = T[..., :3, :3]
    sin2 = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)
    return np.arctan2(np.linalg.norm(sin2, axis=-1), np.trace(r, axis1=-2, axis2=-1) - 1.0)


def interpolate(stamps_ns: NDArray[np.int64], poses: F64, at_ns: NDArray[np.int64]) -> F64:
    """Poses at other times: linear in translation, slerp in rotation. All of `at_ns` must lie within `stamps_ns`.

    Args:
        stamps_ns: (n,) strictly increasing, n ≥ 2.
        poses: (n, 4, 4).
        at_ns: (m,).

    Raises:
        ValueError: a time outside the span.
    """
    if at_ns.size and (at_ns.min() < stamps_ns[0] or at_ns.max() > stamps_ns[-1]):
        raise ValueError(f"times outside [{stamps_ns[0]}, {stamps_ns[-1]}]")
    hi = np.clip(np.searchsorted(stamps_ns, at_ns, side="left"), 1, len(stamps_ns) - 1)
    lo = hi - 1
    # int64 differences first: seconds since the epoch in float64 keep only 0.2 µs
    u = (at_ns - stamps_ns[lo]) / (stamps_ns[hi] - stamps_ns[lo])
    t = (1 - u)[:, None] * poses[lo, :3, 3] + u[:, None] * poses[hi, :3, 3]
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    r = Slerp(seconds, Rotation.from_matrix(poses[:, :3, :3]))(np.clip((at_ns - stamps_ns[0]) * 1e-9, 0, seconds[-1]))
    return from_rt(r.as_matrix(), t)


def from_xyzw(translation_m: ArrayLike, quaternion_xyzw: ArrayLike) -> F64:
    """Transforms from (…, 3) translations and (…, 4) xyzw quaternions (normalised here)."""
    q = np.asarray(quaternion_xyzw, dtype=np.float64)
    r = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)
    return from_rt(r, translation_m)


def to_xyzw(T: F64) -> tuple[F64, F64]:
    """Translations (…, 3) and xyzw quaternions (…, 4) of transforms."""
    q = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat()
    return T[..., :3, 3].copy(), q.reshape(*T.shape[:-2], 4)


def rotation_between(a: ArrayLike, b: ArrayLike) -> F64:
    """The smallest (3, 3) rotation that takes direction `a` to direction `b`; used to level with gravity."""
    u = np.asarray(a, dtype=np.float64) / np.linalg.norm(a)
    v = np.asarray(b, dtype=np.float64) / np.linalg.norm(b)
    axis = np.cross(u, v)
    s, c = float(np.linalg.norm(axis)), float(u @ v)
    if s < 1e-12:
        if c > 0:
            return np.eye(3)
        axis = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
        return Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix()
    return Rotation.from_rotvec(axis / s * np.arctan2(s, c)).as_matrix()
