"""Strapdown integration: from inertial samples to motion, with the covariance of what was integrated.

Errors are [rotation (body, right), position (odom), velocity (odom), gyro bias, accelerometer bias]; z of odom is up.
The kernel is compiled; `integrate_plainly` says the same in numpy and scipy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.compiled import njit
from mineloc.data import F64, Bool
from mineloc.odometry.motion import exp_so3

GRAVITY_MPS2 = 9.80665
ERRORS = 15
_GUESS_RADPS2, _GUESS_MPS2 = 2.0, 3.0
"""What a drone may do unseen: its rates drift by so much a second, its acceleration is wrong by so much."""


class Known(NamedTuple):
    """What is known of each of (k,) steps.

    Attributes:
        guessed: there was no measurement in it; rate and force are worth little.
        blind: nor anything to guess the force from; the velocity stays.
    """

    guessed: Bool
    blind: Bool


class ImuNoise(NamedTuple):
    """Densities: gyro rad/s/√Hz, accelerometer m/s²/√Hz (vibration included), and the walks of their biases."""

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """A state in motion.

    Attributes:
        poses: (m, 4, 4) `T_odom_body` at the nodes.
        velocity_mps: (3,) at the last.
        covariance: (15, 15) there.
    """

    poses: F64
    velocity_mps: F64
    covariance: F64


def integrate(
    times_s: F64, gyro: F64, accel: F64, known: Known, T: F64, velocity_mps: F64, covariance: F64, noise: ImuNoise
) -> Moved:
    """Constant rate a step, midpoint in the attitude; the covariance by first-order transition a step.

    Args:
        times_s: (m,) rising, m ≥ 2.
        gyro, accel: (m - 1, 3) mean rate rad/s and specific force m/s² of each step, biases taken off.
        known: of each step; `accel` of blind ones is not looked at.
        T, velocity_mps, covariance: (4, 4), (3,), (15, 15) at the first time.
        noise: of the samples.
    """
    m = len(times_s)
    poses = np.tile(np.eye(4), (m, 1, 1))
    poses[0] = T
    v, P = velocity_mps.copy(), covariance.copy()
    _integrate(times_s, gyro, accel, known, poses, v, P, noise)
    return Moved(poses, v, P)


@njit(cache=True, nogil=True)
def _integrate(
    times_s: F64, gyro: F64, accel: F64, known: Known, poses: F64, v: F64, P: F64, noise: ImuNoise
) -> None:  # fmt: skip
    """`poses[0]` is the start, the others are filled in; `v` and `P` go to the end in place."""
    w, half, f = np.empty(3), np.empty(3), np.empty(3)
    F, work = np.zeros((ERRORS, ERRORS)), np.empty((ERRORS, ERRORS))
    for k in range(len(times_s) - 1):
        dt = times_s[k + 1] - times_s[k]
        now, then = poses[k], poses[k + 1]
        for i in range(3):
            w[i] = dt * gyro[k, i]
            half[i] = 0.5 * w[i]
            f[i] = 0.0 if known.blind[k] else accel[k, i]
        turn, midway = exp_so3(w), exp_so3(half)
        _transition(now, turn, f, dt, 0.0 if known.blind[k] else dt, F)
        _carry(P, F, work)
        _add_noise(P, noise, known.guessed[k], dt)
        for i in range(3):
            a = 0.0 if known.blind[k] or i < 2 else -GRAVITY_MPS2
            for j in range(3):
                then[i, j] = now[i, 0] * turn[0, j] + now[i, 1] * turn[1, j] + now[i, 2] * turn[2, j]
                a += now[i, j] * (midway[j, 0] * f[0] + midway[j, 1] * f[1] + midway[j, 2] * f[2])
            then[i, 3] = now[i, 3] + v[i] * dt + 0.5 * a * dt * dt
            v[i] += a * dt


@njit(cache=True, nogil=True)
def _transition(T: F64, turn: F64, f: F64, dt: float, felt_s: float, F: F64) -> None:
    """(15, 15) error transition of one step; F comes as zeros or as an earlier transition.

    `felt_s` is the time in which the sensors, and so their biases, had a say: zero in a blind step.
    """
    for i in range(3):
        r0, r1, r2 = T[i, 0], T[i, 1], T[i, 2]
        # a tilted drone feels its own lift elsewhere: -R [f]x dt
        F[6 + i, 0] = (r2 * f[1] - r1 * f[2]) * felt_s
        F[6 + i, 1] = (r0 * f[2] - r2 * f[0]) * felt_s
        F[6 + i, 2] = (r1 * f[0] - r0 * f[1]) * felt_s
        for j in range(3):
            F[i, j] = turn[j, i]
            F[6 + i, 12 + j] = -T[i, j] * felt_s
            F[3 + i, j] = 0.5 * dt * F[6 + i, j]
            F[3 + i, 12 + j] = 0.5 * dt * F[6 + i, 12 + j]
        F[i, 9 + i] = -felt_s
        F[3 + i, 6 + i] = dt
        for first in range(3, ERRORS, 3):
            F[first + i, first + i] = 1.0


@njit(cache=True, nogil=True)
def _carry(P: F64, F: F64, work: F64) -> None:
    """P becomes F P Fᵀ. Most of F is zero: skipping that beats a dense product."""
    n = len(P)
    for i in range(n):
        for j in range(n):
            work[i, j] = 0.0
        for k in range(n):
            if F[i, k] != 0.0:
                for j in range(n):
                    work[i, j] += F[i, k] * P[k, j]
    for i in range(n):
        for j in range(n):
            P[i, j] = 0.0
        for k in range(n):
            if F[i, k] != 0.0:
                for j in range(n):
                    P[i, j] += F[i, k] * work[j, k]


@njit(cache=True, nogil=True)
def _add_noise(P: F64, noise: ImuNoise, guessed: bool, dt: float) -> None:
    gyro2, accel2 = noise.gyro**2, noise.accel**2
    if guessed:
        gyro2 += (_GUESS_RADPS2 * dt) ** 2
        accel2 += _GUESS_MPS2**2
    for i in range(3):
        P[i, i] += gyro2 * dt
        P[3 + i, 3 + i] += accel2 * dt**3 / 3.0
        P[6 + i, 6 + i] += accel2 * dt
        P[9 + i, 9 + i] += noise.gyro_walk**2 * dt
        P[12 + i, 12 + i] += noise.accel_walk**2 * dt


def integrate_plainly(
    times_s: F64, gyro: F64, accel: F64, known: Known, T: F64, velocity_mps: F64, covariance: F64, noise: ImuNoise
) -> Moved:
    """`integrate` in plain numpy and scipy: what the kernel is held to."""
    poses, v, P = [T], velocity_mps, covariance
    for k, dt in enumerate(np.diff(times_s)):
        turn = Rotation.from_rotvec(gyro[k] * dt).as_matrix()
        R, p = poses[-1][:3, :3], poses[-1][:3, 3]
        felt = 0.0 if known.blind[k] else 1.0
        f = felt * accel[k]
        a = R @ Rotation.from_rotvec(0.5 * dt * gyro[k]).apply(f) - [0.0, 0.0, felt * GRAVITY_MPS2]
        F = np.eye(ERRORS)
        F[0:3, 0:3], F[0:3, 9:12] = turn.T, -felt * dt * np.eye(3)
        F[6:9, 0:3], F[6:9, 12:15] = -dt * R @ se3.hat(f), -felt * dt * R
        F[3:6, 0:3], F[3:6, 6:9], F[3:6, 12:15] = 0.5 * dt * F[6:9, 0:3], dt * np.eye(3), 0.5 * dt * F[6:9, 12:15]
        gyro2 = noise.gyro**2 + known.guessed[k] * (_GUESS_RADPS2 * dt) ** 2
        accel2 = noise.accel**2 + known.guessed[k] * _GUESS_MPS2**2
        walks = [noise.gyro_walk**2 * dt, noise.accel_walk**2 * dt]
        P = F @ P @ F.T + np.diag(np.repeat([gyro2 * dt, accel2 * dt**3 / 3, accel2 * dt, *walks], 3))
        poses.append(se3.from_rt(R @ turn, p + v * dt + 0.5 * a * dt**2))
        v = v + a * dt
    return Moved(np.stack(poses), v, P)
