"""The drone's true motion as a smooth function of time: pose, velocity and acceleration, all analytic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from mineloc import se3

F64 = NDArray[np.float64]

DEGREE = 5
GRAVITY_MPS2 = 9.80665


@dataclass(frozen=True, slots=True, eq=False)
class Kinematics:
    """State of the body at n times.

    Attributes:
        T_map_body: (n, 4, 4).
        velocity_mps, accel_mps2: (n, 3) of the body's origin in the map frame.
        rate_radps, rate_change_radps2: (n, 3) angular velocity and acceleration in the body frame.
    """

    T_map_body: F64
    velocity_mps: F64
    accel_mps2: F64
    rate_radps: F64
    rate_change_radps2: F64


class Motion:
    """Six splines of degree 5 over time (x, y, z, yaw, pitch, roll) and vibration on top.

    The control points are the schedule's positions: the spline stays in their convex hull, so it cannot overshoot
    into a wall, and has continuous jerk and more. Time zero is the first control point, at rest as the last is.

    Args:
        control: (n, 6) control points `[x y z yaw pitch roll]` every `step_s`.
        step_s: their distance in time.
        vibration: added to all six.
    """

    def __init__(self, control: F64, step_s: float, vibration: Vibration) -> None:
        padded = np.pad(control, ((DEGREE, DEGREE), (0, 0)), mode="edge")
        # the basis function of control point i peaks in the middle of its knots: at time i * step_s
        knots = (np.arange(len(padded) + DEGREE + 1) - DEGREE - (DEGREE + 1) / 2) * step_s
        self._splines = [BSpline(knots, padded, DEGREE)]
        self._splines += [self._splines[0].derivative(order) for order in (1, 2)]
        self._vibration = vibration
        self.end_s = (len(control) - 1) * step_s

    def pose(self, t_s: F64) -> F64:
        """(n, 4, 4) `T_map_body` at (n,) seconds."""
        value = self._value(t_s, 0)
        return se3.from_rt(_rotation(value[:, 3:]), value[:, :3])

    def at(self, t_s: F64) -> Kinematics:
        """Everything at (n,) seconds."""
        q, dq, ddq = (self._value(t_s, order) for order in range(3))
        rate, rate_change = _body_rates(q[:, 3:], dq[:, 3:], ddq[:, 3:])
        return Kinematics(se3.from_rt(_rotation(q[:, 3:]), q[:, :3]), dq[:, :3], ddq[:, :3], rate, rate_change)

    def _value(self, t_s: F64, order: int) -> F64:
        return self._splines[order](t_s) + self._vibration.value(t_s, order)


@dataclass(frozen=True, slots=True, eq=False)
class Vibration:
    """A sum of sinusoids on `[x y z yaw pitch roll]`.

    Attributes:
        frequency_hz: (k,).
        phase_rad: (k, 6).
        amplitude: (k, 6) metres and radians.
    """

    frequency_hz: F64
    phase_rad: F64
    amplitude: F64

    @staticmethod
    def none() -> Vibration:
        """A drone that does not shake."""
        return Vibration(np.zeros(0), np.zeros((0, 6)), np.zeros((0, 6)))

    @staticmethod
    def of_rotors(accel_mps2: float, rate_radps: float, rng: np.random.Generator, *, lines: int = 6) -> Vibration:
        """Lines between 15 and 85 Hz with the given root mean square of acceleration and angular rate an axis."""
        frequency = np.sort(rng.uniform(15.0, 85.0, lines))
        omega = 2 * np.pi * frequency[:, None]
        share = np.sqrt(2.0 / lines)
        amplitude = np.concatenate(
            [np.repeat(share * accel_mps2 / omega**2, 3, axis=1), np.repeat(share * rate_radps / omega, 3, axis=1)],
            axis=1,
        )
        return Vibration(frequency, rng.uniform(0, 2 * np.pi, (lines, 6)), amplitude)

    def value(self, t_s: F64, order: int) -> F64:
        """(n, 6) value (`order` 0) or derivative at (n,) seconds."""
        omega = 2 * np.pi * self.frequency_hz
        angle = (omega * t_s[:, None])[:, :, None] + self.phase_rad + order * np.pi / 2
        return np.einsum("nkj,kj->nj", np.sin(angle), self.amplitude * omega[:, None] ** order)


def tilt_from_thrust(accel_mps2: F64, yaw_rad: F64) -> tuple[F64, F64]:
    """(pitch, roll) of a multirotor whose thrust alone makes (n, 3) specific force `accel + g` at (n,) headings."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x = c * accel_mps2[:, 0] + s * accel_mps2[:, 1]
    y = -s * accel_mps2[:, 0] + c * accel_mps2[:, 1]
    z = accel_mps2[:, 2] + GRAVITY_MPS2
    return np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))


def _rotation(euler: F64) -> F64:
    """(n, 3, 3) `Rz(yaw) Ry(pitch) Rx(roll)` of (n, 3) `[yaw pitch roll]`."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(euler).T, np.sin(euler).T
    out = np.empty((len(euler), 3, 3))
    out[:, 0] = np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], axis=1)
    out[:, 1] = np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], axis=1)
    out[:, 2] = np.stack([-sp, cp * sr, cp * cr], axis=1)
    return out


def _body_rates(euler: F64, first: F64, second: F64) -> tuple[F64, F64]:
    """Angular velocity and acceleration in the body frame of `[yaw pitch roll]` and their derivatives, (n, 3) each."""
    _, p, r = euler.T
    dy, dp, dr = first.T
    ddy, ddp, ddr = second.T
    cp, sp, cr, sr = np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    rate = np.stack([dr - dy * sp, dp * cr + dy * sr * cp, -dp * sr + dy * cr * cp], axis=1)
    change = np.stack(
        [
            ddr - ddy * sp - dy * dp * cp,
            ddp * cr - dp * dr * sr + ddy * sr * cp + dy * (dr * cr * cp - dp * sr * sp),
            -ddp * sr - dp * dr * cr + ddy * cr * cp - dy * (dr * sr * cp + dp * cr * sp),
        ],
        axis=1,
    )
    return rate, change
