"""The variogram of a field seen at places: an exponential with a nugget, by weighted least squares on binned lags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.compiled import njit
from mineloc.data import F64
from mineloc.data.checks import freeze

RANGES = 24


@dataclass(frozen=True, slots=True, eq=False)
class BinnedLags:
    """Semivariances by distance.

    Attributes:
        lag: (k,) mean distance of the pairs of a bin.
        gamma: (k,) half the mean squared difference.
        pairs: (k,) how many.
    """

    lag: F64
    gamma: F64
    pairs: F64

    def __post_init__(self) -> None:
        freeze(self)

    def blended(self, newer: BinnedLags, share: float) -> BinnedLags:
        """A running mean over images: the newer one counts for `share`, by its pairs."""
        old, new = (1.0 - share) * self.pairs, share * newer.pairs
        total = np.maximum(old + new, 1e-12)
        return BinnedLags(
            (old * self.lag + new * newer.lag) / total, (old * self.gamma + new * newer.gamma) / total, old + new
        )


def bin_lags(places: F64, values: F64, *, lags: int, reach: float) -> BinnedLags:
    """Bin all pairs of (n, 2) places with (n,) values by their distance, up to `reach`."""
    lag, gamma, pairs = _bin(places, values, lags, reach)
    some = np.maximum(pairs, 1.0)
    return BinnedLags(lag / some, gamma / some, pairs)


@njit(cache=True, nogil=True)
def _bin(places: F64, values: F64, lags: int, reach: float) -> tuple[F64, F64, F64]:
    lag, gamma, pairs = np.zeros(lags), np.zeros(lags), np.zeros(lags)
    for i in range(len(values)):
        for j in range(i):
            h = np.hypot(places[i, 0] - places[j, 0], places[i, 1] - places[j, 1])
            if h < reach:
                k = int(h / reach * lags)
                lag[k] += h
                gamma[k] += 0.5 * (values[i] - values[j]) ** 2
                pairs[k] += 1.0
    return lag, gamma, pairs


def fit_exponential(binned: BinnedLags, *, nugget: float) -> tuple[float, float] | None:
    """Sill and range of γ(h) = nugget + sill (1 - exp(-h / range)); None without pairs.

    The nugget, the noise of the measurements, is known. Ranges are tried, the sill for each is linear; lags weigh by
    their pairs over γ² (Cressie 1985).
    """
    some = binned.pairs > 0
    if some.sum() < 3:
        return None
    h, gamma, pairs = binned.lag[some], binned.gamma[some], binned.pairs[some]
    weight = pairs / np.maximum(gamma, 1e-30) ** 2
    best: tuple[float, float, float] | None = None
    for range_ in np.geomspace(0.5 * h[0] + 1e-9, h[-1], RANGES):
        shape = 1.0 - np.exp(-h / range_)
        sill = max(float((weight * shape * (gamma - nugget)).sum() / (weight * shape * shape).sum()), 0.0)
        misfit = float((weight * (gamma - nugget - sill * shape) ** 2).sum())
        if best is None or misfit < best[0]:
            best = misfit, sill, float(range_)
    assert best is not None
    return best[1], best[2]
