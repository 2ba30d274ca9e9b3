"""Motion models: what is known of the pose before a sweep is registered, and how sure that is.

Both models are error-state filters whose first six errors are [rotation (body, right), position (odom)]. The prior sits
*inside* the solve (METHOD 7.3: H + Σ_prior⁻¹), and velocity and biases follow by their correlation with the pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mineloc import se3
from mineloc.compiled import njit
from mineloc.data import F64, I64


@dataclass(frozen=True, slots=True, eq=False)
class BodyPath:
    """How the body moved: the basis of motion compensation.

    Attributes:
        stamps_ns: (m,) rising, m ≥ 2, close enough that the motion between two is a straight line.
        poses: (m, 4, 4) `T_odom_body`.
    """

    stamps_ns: I64
    poses: F64


class MotionModel(Protocol):
    """A filter that is predicted to a time and corrected there.

    Attributes:
        stamp_ns: the time of the state.
        T_odom_body: (4, 4) the pose.
        covariance: (n, n) of the errors, n ≥ 6, pose first.
        measured: (12, n) what a sweep shows of the errors: [rotation, position, rate (body), velocity (odom)].
    """

    stamp_ns: int
    T_odom_body: F64
    covariance: F64
    measured: F64

    def predict(self, start_ns: int, end_ns: int) -> BodyPath:
        """Move state and covariance to `end_ns`; the path covers `start_ns` to `end_ns`."""
        ...

    def deviation(self) -> F64:
        """(n,) error of the state against what was predicted."""
        ...

    def add(self, error: F64) -> None:
        """Apply an (n,) error to the state."""
        ...


def pose_deviation(T_now: F64, T_before: F64) -> F64:
    """(6,) [rotation, position] error that takes one pose to another in the filters' convention."""
    out = np.empty(6)
    _log_so3(T_before[:3, :3].T @ T_now[:3, :3], out)
    out[3:] = T_now[:3, 3] - T_before[:3, 3]
    return out


def add_to_pose(T: F64, error: F64) -> F64:
    """The pose with a (6,) [rotation (right), position (odom)] error applied."""
    turned = T[:3, :3] @ exp_so3(np.ascontiguousarray(error[:3]))
    return se3.rigid(se3.from_rt(turned, T[:3, 3] + error[3:6]))


@njit(cache=True, nogil=True)
def _log_so3(R: F64, out: F64) -> None:
    """Rotation vector of a (3, 3) rotation into `out`; exact but for half turns, which no correction is."""
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    sine = np.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    scale = 1.0 if sine < 1e-12 else np.arctan2(sine, cosine) / sine
    out[0], out[1], out[2] = scale * x, scale * y, scale * z


@njit(cache=True, nogil=True)
def exp_so3(w: F64) -> F64:
    """(3, 3) rotation of a (3,) rotation vector (Rodrigues)."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if t2 < 1e-16:
        a, b = 1.0, 0.5
    else:
        t = np.sqrt(t2)
        a, b = np.sin(t) / t, (1.0 - np.cos(t)) / t2
    x, y, z = w[0], w[1], w[2]
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    return out
