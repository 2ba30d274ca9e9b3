"""The motion between two sweeps from matched points, most of which are right: RANSAC (METHOD 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.compiled import njit
from mineloc.data import F64, I64, Bool

_SAMPLE = 3
_LEAST_SINE = 0.05
"""Three points nearer to one line fix no rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A rigid motion and what supports it.

    Attributes:
        T_target_source: (4, 4).
        inliers: (n,) the pairs that agree.
        residual_m: root mean square distance of the inliers.
    """

    T_target_source: F64
    inliers: Bool
    residual_m: float


def motion_of(
    source: F64, target: F64, *, inlier_m: float, trials: int, min_inliers: int, rng: np.random.Generator
) -> Motion | None:
    """The rigid motion that most pairs agree on, fitted to all of those; None with too few.

    Args:
        source, target: (n, 3) paired points.
        inlier_m: largest distance of a pair that agrees.
        trials: samples of three pairs.
        min_inliers: fewest pairs, at least three.
        rng: draws the samples.
    """
    n = len(source)
    if n < max(min_inliers, _SAMPLE):
        return None
    # distinct ones: each is drawn among those that the ones before left
    draws = np.stack([rng.integers(0, n - k, trials) for k in range(_SAMPLE)], axis=1)
    best, count = best_sample(source, target, draws, inlier_m**2)
    if count < max(min_inliers, _SAMPLE):
        return None
    T, inliers = best, _near(best, source, target, inlier_m)
    for _ in range(2):  # the fit to all inliers has inliers of its own
        T = fit_rigid(source[inliers], target[inliers])
        again = _near(T, source, target, inlier_m)
        if again.sum() < inliers.sum():
            break
        inliers = again
    off2 = np.sum((se3.apply(T, source[inliers]) - target[inliers]) ** 2, axis=1)
    return Motion(se3.from_rt(T[:3, :3], T[:3, 3]), inliers, float(np.sqrt(off2.mean())))


def _near(T: F64, source: F64, target: F64, inlier_m: float) -> Bool:
    return np.sum((se3.apply(T, source) - target) ** 2, axis=1) < inlier_m**2


@njit(cache=True, nogil=True)
def fit_rigid(source: F64, target: F64) -> F64:
    """(4, 4) least-squares motion of paired (n, 3) points (Arun 1987, with Umeyama's sign: no mirror)."""
    n = source.shape[0]
    from_mean, to_mean = np.zeros(3), np.zeros(3)
    for i in range(n):
        from_mean += source[i] / n
        to_mean += target[i] / n
    spread = np.zeros((3, 3))
    for i in range(n):
        for a in range(3):
            for b in range(3):
                spread[a, b] += (target[i, a] - to_mean[a]) * (source[i, b] - from_mean[b])
    u, _, vt = np.linalg.svd(spread)
    if np.linalg.det(u) * np.linalg.det(vt) < 0:
        u[:, 2] = -u[:, 2]
    out = np.eye(4)
    out[:3, :3] = np.ascontiguousarray(u) @ np.ascontiguousarray(vt)
    for a in range(3):
        out[a, 3] = to_mean[a]
        for b in range(3):
            out[a, 3] -= out[a, b] * from_mean[b]
    return out


@njit(cache=True, nogil=True)
def best_sample(source: F64, target: F64, draws: I64, inlier2: float) -> tuple[F64, int]:
    """The motion of the sample with the most inliers, and their number; 0 where every sample lies on a line."""
    n = source.shape[0]
    best = np.eye(4)
    most = 0
    pick = np.empty(3, np.int64)
    for trial in range(draws.shape[0]):
        pick[0] = draws[trial, 0]
        pick[1] = draws[trial, 1] + (draws[trial, 1] >= pick[0])
        low, high = min(pick[0], pick[1]), max(pick[0], pick[1])
        pick[2] = draws[trial, 2] + (draws[trial, 2] >= low)
        pick[2] += pick[2] >= high
        a, b = source[pick[1]] - source[pick[0]], source[pick[2]] - source[pick[0]]
        if np.sum(np.cross(a, b) ** 2) <= _LEAST_SINE**2 * np.sum(a**2) * np.sum(b**2):
            continue
        T = fit_rigid(source[pick], target[pick])
        count = 0
        for i in range(n):
            off2 = 0.0
            for k in range(3):
                d = T[k, 3] - target[i, k]
                for m in range(3):
                    d += T[k, m] * source[i, m]
                off2 += d * d
            count += off2 < inlier2
        if count > most:
            most = count
            best = T
    return best, most
