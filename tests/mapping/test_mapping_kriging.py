"""Bayesian kriging: its limits, an oracle, and the kernel against plain numpy (METHOD part 10)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pykrige.ok import OrdinaryKriging
from pykrige.uk import UniversalKriging

from mineloc.mapping.kriging import fit_drift, krige_near, krige_plainly
from mineloc.mapping.variogram import bin_lags, fit_exponential

SILL, RANGE = 2.0, 9.0
FREE, NONE = np.diag([1e6, 1e4, 1e4]), np.zeros((3, 3))


def field(seed: int, n: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, values of an exponential field with a slope, and places to ask for."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 30, (n, 2))
    gap = np.linalg.norm(places[:, None] - places[None], axis=-1)
    values = np.linalg.cholesky(SILL * np.exp(-gap / RANGE) + 1e-9 * np.eye(n)) @ rng.standard_normal(n)
    return places, values + 3.0 + 0.1 * places[:, 0], rng.uniform(2, 28, (15, 2))


def test_without_freedom_of_the_drift_it_is_simple_kriging() -> None:
    places, values, at = field(0)
    mean = np.array([3.0, 0.1, 0.0])
    found, variance = krige_plainly(places, values, np.zeros(40), at, sill=SILL, range_=RANGE, mean=mean, prior=NONE)
    gap = np.linalg.norm(places[:, None] - places[None], axis=-1)
    k = SILL * np.exp(-np.linalg.norm(places[:, None] - at[None], axis=-1) / RANGE)
    weights = np.linalg.solve(SILL * np.exp(-gap / RANGE), k)
    expected = 3.0 + 0.1 * at[:, 0] + weights.T @ (values - 3.0 - 0.1 * places[:, 0])
    assert found == pytest.approx(expected, abs=1e-9)
    assert variance == pytest.approx(SILL - np.einsum("nm,nm->m", k, weights), abs=1e-9)


def test_with_a_free_mean_it_is_ordinary_kriging() -> None:
    places, values, at = field(1)
    free = np.diag([1e8, 0.0, 0.0])
    found, variance = krige_plainly(
        places, values, np.zeros(40), at, sill=SILL, range_=RANGE, mean=np.zeros(3), prior=free
    )
    # pykrige's exponential model has the practical range: 1 - exp(-3 h / r)
    oracle = OrdinaryKriging(
        *places.T, values, variogram_model="exponential",
        variogram_parameters={"sill": SILL, "range": 3 * RANGE, "nugget": 0.0},
    )  # fmt: skip
    expected, expected_variance = oracle.execute("points", *at.T)
    assert found == pytest.approx(np.asarray(expected), abs=1e-4)
    assert variance == pytest.approx(np.asarray(expected_variance), abs=1e-4)


def test_with_a_free_plane_it_is_universal_kriging() -> None:
    places, values, at = field(2)
    found, _ = krige_plainly(places, values, np.zeros(40), at, sill=SILL, range_=RANGE, mean=np.zeros(3), prior=FREE)
    oracle = UniversalKriging(
        *places.T, values, variogram_model="exponential", drift_terms=["regional_linear"],
        variogram_parameters={"sill": SILL, "range": 3 * RANGE, "nugget": 0.0},
    )  # fmt: skip
    expected, _ = oracle.execute("points", *at.T)
    assert found == pytest.approx(np.asarray(expected), abs=1e-3)


@settings(deadline=None)
@given(st.integers(0, 1000), st.floats(1e-6, 1e3))
def test_the_kernel_is_the_plain_version(seed: int, freedom: float) -> None:
    places, values, at = field(seed, n=20)
    rng = np.random.default_rng(seed)
    noise = rng.uniform(1e-3, 0.5, 20)
    mean, prior = rng.normal(size=3), np.diag([freedom, freedom * 1e-2, freedom * 1e-2])
    law = {"sill": SILL, "range_": RANGE, "mean": mean, "prior": prior}
    near = np.stack([rng.permutation(20) for _ in at])
    near[0, 7:] = -1
    near[1] = -1
    found, variance = krige_near(places, values, noise, at, near, **law)
    expected, expected_variance = krige_plainly(places, values, noise, at[2:], **law)
    assert found[2:] == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert variance[2:] == pytest.approx(expected_variance, rel=1e-5, abs=1e-6)
    few = near[0, :7]
    assert found[0] == pytest.approx(
        krige_plainly(places[few], values[few], noise[few], at[:1], **law)[0][0], rel=1e-6, abs=1e-6
    )
    # without neighbours the prior is all that is known
    f = np.array([1.0, *at[1]])
    assert found[1] == pytest.approx(f @ mean, rel=1e-9)
    assert variance[1] == pytest.approx(SILL + f @ prior @ f, rel=1e-9)


def test_noise_free_samples_are_kept_and_noisy_ones_are_filtered() -> None:
    places, values, _ = field(3)
    law = {"sill": SILL, "range_": RANGE, "mean": np.zeros(3), "prior": FREE}
    exact, variance = krige_plainly(places, values, np.zeros(40), places, **law)
    assert exact == pytest.approx(values, abs=1e-5)
    assert variance.max() < 1e-5
    noisy = values + np.random.default_rng(4).normal(0, 0.7, 40)
    filtered, spread = krige_plainly(places, noisy, np.full(40, 0.49), places, **law)
    assert np.std(filtered - values) < 0.8 * np.std(noisy - values)
    assert np.sqrt(np.mean((filtered - values) ** 2 / spread)) == pytest.approx(1.0, abs=0.35)


def test_the_variogram_of_a_field_is_found() -> None:
    gammas = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        places = rng.uniform(0, 80, (350, 2))
        gap = np.linalg.norm(places[:, None] - places[None], axis=-1)
        values = np.linalg.cholesky(SILL * np.exp(-gap / RANGE) + 1e-9 * np.eye(350)) @ rng.standard_normal(350)
        gammas.append(
            fit_exponential(bin_lags(places, values + rng.normal(0, 0.5, 350), lags=12, reach=40.0), nugget=0.25)
        )
    sill, range_ = np.mean([found for found in gammas if found is not None], axis=0)
    assert sill == pytest.approx(SILL, rel=0.25)
    assert range_ == pytest.approx(RANGE, rel=0.4)
    assert fit_exponential(bin_lags(np.zeros((1, 2)), np.zeros(1), lags=12, reach=40.0), nugget=0.0) is None


def test_a_drift_is_learned_and_doubt_shrinks() -> None:
    rng = np.random.default_rng(5)
    places = rng.uniform(-100, 100, (500, 2))
    true = np.array([0.4, 0.003, -0.002])
    values = true[0] + places @ true[1:] + rng.normal(0, 0.1, 500)
    prior = np.diag([1.0, 1e-4, 1e-4])
    mean, covariance = fit_drift(places, values, 0.01, mean=np.zeros(3), prior=prior, count=500)
    assert mean == pytest.approx(true, abs=4 * np.sqrt(np.diag(covariance)).max())
    _, doubtful = fit_drift(places, values, 0.01, mean=np.zeros(3), prior=prior, count=5)
    assert (np.diag(doubtful) > 10 * np.diag(covariance)).all()
