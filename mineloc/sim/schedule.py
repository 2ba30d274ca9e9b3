"""When the drone is where on its line: speed limits, bends, turns on the spot, hover at both ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

F64 = NDArray[np.float64]


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
        moving: (n,) 0 at rest before the start, 1 in flight.
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
        pause = hover if index == 0 else 0
        turn = _turn(yaw, float(heading[0]), limits, step_s) if index else np.full(pause, heading[0])
        positions += [np.broadcast_to(points[0], (len(turn), 3)), points]
        yaws += [turn, heading]
        yaw = float(heading[-1])
    positions.append(np.broadcast_to(positions[-1][-1], (hover, 3)))
    yaws.append(np.full(hover, yaw))
    p, psi = np.concatenate(positions), np.concatenate(yaws)
    moving = np.ones(len(p))
    moving[:hover] = 0.0
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
    tangent = np.gradient(leg_m, along, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    speed = _speed_profile(along, heading, limits)
    # time to pass each piece at its mean speed; at rest the mean of 0 and v is right for constant acceleration
    time = np.concatenate([[0.0], np.cumsum(ds / ((speed[1:] + speed[:-1]) / 2))])
    at = np.arange(0.0, time[-1] + step_s, step_s)
    s = np.interp(at, time, along)
    points = np.stack([np.interp(s, along, leg_m[:, axis]) for axis in range(3)], axis=1)
    return points, np.interp(s, along, heading)


def _speed_profile(along_m: F64, heading_rad: F64, limits: Limits) -> F64:
    """Highest speed at each point: bends limit it by lateral acceleration and yaw rate, then both directions by a."""
    curvature = np.abs(np.gradient(gaussian_filter1d(heading_rad, 3, mode="nearest"), along_m))
    bend = np.maximum(curvature, 1e-9)
    limit = np.minimum(limits.speed_mps, np.sqrt(limits.accel_mps2 / bend))
    limit = np.minimum(limit, limits.yaw_rate_radps / bend)
    v2 = np.maximum(limit, 0.15) ** 2
    v2[0] = v2[-1] = 0.0
    ds = np.diff(along_m)
    for i in range(len(ds)):
        v2[i + 1] = min(v2[i + 1], v2[i] + 2 * limits.accel_mps2 * ds[i])
    for i in range(len(ds) - 1, -1, -1):
        v2[i] = min(v2[i], v2[i + 1] + 2 * limits.accel_mps2 * ds[i])
    return np.sqrt(v2)


def _turn(start_rad: float, end_rad: float, limits: Limits, step_s: float) -> F64:
    """A turn on the spot with a raised-cosine rate that peaks at the limit."""
    seconds = max(2.0 * abs(end_rad - start_rad) / limits.yaw_rate_radps, 1.0)
    u = np.linspace(0.0, 1.0, round(seconds / step_s) + 1)
    return start_rad + (end_rad - start_rad) * (u - np.sin(2 * np.pi * u) / (2 * np.pi))
