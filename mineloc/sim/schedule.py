"""When the drone is where on its line: speed limits, bends, turns on the spot, hover at both ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

F64 = NDArray[np.float64]

HEADING_M = 0.5
SLOWEST_MPS = 0.1


@dataclass(frozen=True, slots=True)
class Limits:
    """What the drone may do.

    Attributes:
        speed_mps: on a straight line.
        accel_mps2: along and across the line.
        yaw_rate_radps: in bends and turning on the spot.
        hover_s: time at rest before the start and after the end.
    """

    speed_mps: float
    accel_mps2: float
    yaw_rate_radps: float
    hover_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """Positions and headings at equal time steps.

    Attributes:
        step_s: time between two of them.
        positions_m: (n, 3).
        yaw_rad: (n,) unwrapped.
        moving: (n,) 0 at rest at both ends, 1 in flight.
    """

    step_s: float
    positions_m: F64
    yaw_rad: F64
    moving: F64


def schedule(legs: list[F64], limits: Limits, *, step_s: float = 0.1) -> Schedule:
    """Fly the legs one after the other, turning round in between.

    Args:
        legs: (n, 3) points at equal distances.
        limits: of speed, acceleration and yaw.
        step_s: time step of the result.
    """
    positions: list[F64] = []
    yaws: list[F64] = []
    hover = round(limits.hover_s / step_s)
    yaw = 0.0
    for index, leg in enumerate(legs):
        points, heading = _fly_leg(leg, limits, step_s)
        # the shortest way round: within half a turn of the heading before
        heading = heading + 2 * np.pi * round((yaw - heading[0]) / (2 * np.pi)) if index else heading
        if index:
            u = _turn(abs(float(heading[0]) - yaw), limits, step_s)
            # the same roadway flown back begins some centimetres beside where it ended
            positions.append(positions[-1][-1] + u[:, None] * (points[0] - positions[-1][-1]))
            yaws.append(yaw + u * (heading[0] - yaw))
        else:
            positions.append(np.broadcast_to(points[0], (hover, 3)))
            yaws.append(np.full(hover, heading[0]))
        positions.append(points)
        yaws.append(heading)
        yaw = float(heading[-1])
    positions.append(np.broadcast_to(positions[-1][-1], (hover, 3)))
    yaws.append(np.full(hover, yaw))
    p, psi = np.concatenate(positions), _rate_limited(np.concatenate(yaws), limits.yaw_rate_radps * step_s)
    moving = np.ones(len(p))
    moving[: hover + 5] = moving[len(moving) - hover - 5 :] = 0.0
    blur = 0.3 / step_s
    return Schedule(
        step_s,
        gaussian_filter1d(p, blur, axis=0, mode="nearest"),
        gaussian_filter1d(psi, 2 * blur, mode="nearest"),
        gaussian_filter1d(moving, 1.0 / step_s, mode="nearest"),
    )


def _fly_leg(leg_m: F64, limits: Limits, step_s: float) -> tuple[F64, F64]:
    """Positions (k, 3) and headings (k,) along one leg from rest to rest."""
    ds = np.linalg.norm(np.diff(leg_m, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(ds)])
    heading = _heading(leg_m, float(along[-1]) / len(ds))
    speed = _speed_profile(leg_m, along, heading, limits)
    # over each piece the acceleration is constant, so the mean of both speeds is exact, also from rest
    time = np.concatenate([[0.0], np.cumsum(ds / ((speed[1:] + speed[:-1]) / 2))])
    at = np.arange(0.0, time[-1] + step_s, step_s)
    s = np.interp(at, time, along)
    points = np.stack([np.interp(s, along, leg_m[:, axis]) for axis in range(3)], axis=1)
    return points, np.interp(s, along, heading)


def _heading(leg_m: F64, step_m: float) -> F64:
    """(n,) direction of flight in plan, unwrapped.

    Averaged over about a metre as vectors: where the line is steep, the metres before and after decide.
    """
    ahead = gaussian_filter1d(np.gradient(leg_m[:, :2], axis=0), HEADING_M / step_m, axis=0, mode="nearest")
    return np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def _speed_profile(leg_m: F64, along_m: F64, heading_rad: F64, limits: Limits) -> F64:
    """Highest speed at each point: bends limit it by lateral acceleration and yaw rate, then both directions by a."""
    # across and along the line at once must stay within the limit
    accel = limits.accel_mps2 / np.sqrt(2)
    tangent = np.gradient(leg_m, along_m, axis=0)
    bend = np.linalg.norm(np.gradient(gaussian_filter1d(tangent, 2, axis=0, mode="nearest"), along_m, axis=0), axis=1)
    turn = np.abs(np.gradient(heading_rad, along_m))
    limit = np.minimum(limits.speed_mps, np.sqrt(accel / np.maximum(bend, 1e-9)))
    limit = np.minimum(limit, limits.yaw_rate_radps / np.maximum(turn, 1e-9))
    v2 = np.maximum(limit, SLOWEST_MPS) ** 2
    v2[0] = v2[-1] = 0.0
    ds = np.diff(along_m)
    for i in range(len(ds)):
        v2[i + 1] = min(v2[i + 1], v2[i] + 2 * accel * ds[i])
    for i in range(len(ds) - 1, -1, -1):
        v2[i] = min(v2[i], v2[i + 1] + 2 * accel * ds[i])
    return np.sqrt(v2)


def _rate_limited(yaw_rad: F64, step_rad: float) -> F64:
    """Follow the headings as fast as allowed: on steep lines they may swing round faster than a drone can."""
    out = yaw_rad.copy()
    for i in range(1, len(out)):
        out[i] = out[i - 1] + min(max(yaw_rad[i] - out[i - 1], -step_rad), step_rad)
    return out


def _turn(angle_rad: float, limits: Limits, step_s: float) -> F64:
    """Share of a turn on the spot done at each step: a raised-cosine rate that peaks at the limit."""
    seconds = max(2.0 * angle_rad / limits.yaw_rate_radps, 1.0)
    u = np.linspace(0.0, 1.0, round(seconds / step_s) + 1)
    return u - np.sin(2 * np.pi * u) / (2 * np.pi)
