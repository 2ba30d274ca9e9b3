"""Bayesian kriging: the drift has a Gaussian prior (Omre 1987; METHOD 6.1), between simple and universal kriging.

With y = F β + ε + noise, β ~ N(b₀, S₀), ε stationary with an exponential covariance, and noise of known variance:

    K' = C + F S₀ Fᵀ + N,   k' = c₀ + F S₀ f₀
    ẑ₀ = f₀ᵀ b₀ + k'ᵀ K'⁻¹ (y - F b₀),   var = f₀ᵀ S₀ f₀ + C(0) - k'ᵀ K'⁻¹ k'

S₀ -> 0 is simple kriging with the mean F b₀, S₀ -> ∞ is universal kriging. The variance is that of the field itself,
without a measurement's noise.
"""

from __future__ import annotations

import numpy as np

from mineloc.compiled import njit, prange
from mineloc.data import F64, I64
from mineloc.data.checks import need

DRIFTS = 3
"""The drift is b₀ + b₁ x + b₂ y."""


def krige_plainly(
    places: F64, values: F64, noise: F64, at: F64, *, sill: float, range_: float, mean: F64, prior: F64
) -> tuple[F64, F64]:
    """The field at `at` from all values, in plain numpy.

    Args:
        places: (n, 2).
        values: (n,).
        noise: (n,) variances.
        at: (m, 2).
        sill, range_: the covariance is sill · exp(-h / range).
        mean, prior: (3,) b₀ and (3, 3) S₀ of the drift 1, x, y.

    Returns:
        (m,) estimates and (m,) variances.
    """
    F = np.column_stack([np.ones(len(places)), places])
    f = np.column_stack([np.ones(len(at)), at])
    gap = np.linalg.norm(places[:, None] - places[None], axis=-1)
    K = sill * np.exp(-gap / range_) + F @ prior @ F.T + np.diag(noise)
    k = sill * np.exp(-np.linalg.norm(places[:, None] - at[None], axis=-1) / range_) + F @ prior @ f.T
    weights = np.linalg.solve(K, k)
    estimate = f @ mean + weights.T @ (values - F @ mean)
    variance = np.einsum("mi,ij,mj->m", f, prior, f) + sill - np.einsum("nm,nm->m", k, weights)
    return estimate, np.maximum(variance, 0.0)


def krige_near(
    places: F64,
    values: F64,
    noise: F64,
    at: F64,
    near: I64,
    *,
    sill: float,
    range_: float,
    mean: F64,
    prior: F64,
) -> tuple[F64, F64]:
    """As `krige_plainly`, each place from its own neighbours: a small system a place, side by side.

    Args:
        near: (m, k) indices of the neighbours of each place; -1: none, and none after it.

    Raises:
        ValueError: a neighbour that is not there, sizes that do not fit.
    """
    need(near.ndim == 2 and len(near) == len(at), "a row of neighbours for every place")
    need(int(near.max(initial=-1)) < len(values), "a neighbour is not among the values")
    need(len(places) == len(values) == len(noise), "a place and a noise for every value")
    return _krige(places, values, noise, at, near, sill, range_, mean, prior)


@njit(cache=True, parallel=True)
def _krige(
    places: F64, values: F64, noise: F64, at: F64, near: I64, sill: float, range_: float, mean: F64, prior: F64
) -> tuple[F64, F64]:
    m, most = near.shape
    estimate, variance = np.empty(m), np.empty(m)
    for i in prange(m):
        n = 0
        while n < most and near[i, n] >= 0:
            n += 1
        L, k, y = np.empty((n, n)), np.empty(n), np.empty(n)
        fx, fy = at[i, 0], at[i, 1]
        own = _drift_covariance(prior, fx, fy, fx, fy)
        for a in range(n):
            p = near[i, a]
            ax, ay = places[p, 0], places[p, 1]
            y[a] = values[p] - (mean[0] + mean[1] * ax + mean[2] * ay)
            k[a] = sill * np.exp(-np.hypot(ax - fx, ay - fy) / range_) + _drift_covariance(prior, ax, ay, fx, fy)
            for b in range(a + 1):
                q = near[i, b]
                bx, by = places[q, 0], places[q, 1]
                L[a, b] = sill * np.exp(-np.hypot(ax - bx, ay - by) / range_) + _drift_covariance(prior, ax, ay, bx, by)
            L[a, a] += noise[p]
        # Cholesky, then both right-hand sides forward: ẑ = (L⁻¹k)·(L⁻¹y), the variance's share is |L⁻¹k|²
        dot, square = 0.0, 0.0
        for a in range(n):
            for b in range(a):
                for c in range(b):
                    L[a, b] -= L[a, c] * L[b, c]
                L[a, b] /= L[b, b]
            for c in range(a):
                L[a, a] -= L[a, c] ** 2
            L[a, a] = np.sqrt(max(L[a, a], 1e-300))
            for c in range(a):
                k[a] -= L[a, c] * k[c]
                y[a] -= L[a, c] * y[c]
            k[a] /= L[a, a]
            y[a] /= L[a, a]
            dot += k[a] * y[a]
            square += k[a] ** 2
        estimate[i] = mean[0] + mean[1] * fx + mean[2] * fy + dot
        variance[i] = max(own + sill - square, 0.0)
    return estimate, variance


@njit(cache=True, nogil=True)
def _drift_covariance(S: F64, ax: float, ay: float, bx: float, by: float) -> float:
    """f(a)ᵀ S f(b)."""
    u = S[0, 0] + S[0, 1] * bx + S[0, 2] * by
    v = S[1, 0] + S[1, 1] * bx + S[1, 2] * by
    w = S[2, 0] + S[2, 1] * bx + S[2, 2] * by
    return u + ax * v + ay * w


def fit_drift(places: F64, values: F64, variance: float, *, mean: F64, prior: F64, count: float) -> tuple[F64, F64]:
    """Posterior mean and covariance of the drift's three coefficients.

    Args:
        places, values: (n, 2), (n,).
        variance: of one value about the drift.
        mean, prior: (3,), (3, 3) before.
        count: so many independent values the n are worth; neighbours share their errors.
    """
    F = np.column_stack([np.ones(len(places)), places])
    share = min(count / max(len(places), 1), 1.0) / variance
    before = np.linalg.inv(prior)
    covariance = np.asarray(np.linalg.inv(before + share * F.T @ F), dtype=np.float64)
    return covariance @ (before @ mean + share * F.T @ values), covariance
