from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.data import F32
from mineloc.sweep.voxel_grid import PARTS, first_in_voxels, voxel_centroids, voxel_means, voxel_members_plainly


def cloud(seed: int, n: int) -> F32:
    rng = np.random.default_rng(seed)
    return (rng.normal(0, 3, (n, 3)) * rng.choice([0.1, 1.0, 10.0])).astype(np.float32)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), n=st.integers(0, 2000), voxel_m=st.floats(0.05, 5.0))
def test_the_kernels_agree_with_plain_numpy(seed: int, n: int, voxel_m: float) -> None:
    points = cloud(seed, n)
    first, centroids = voxel_members_plainly(points, voxel_m)
    assert np.array_equal(first_in_voxels(points, voxel_m), first)
    assert np.allclose(voxel_centroids(points, voxel_m), centroids, rtol=1e-6, atol=1e-6)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 2000), voxel_m=st.floats(0.05, 5.0))
def test_one_point_a_voxel_and_none_lost(seed: int, n: int, voxel_m: float) -> None:
    points = cloud(seed, n)
    first = first_in_voxels(points, voxel_m)
    cells = {tuple(c) for c in np.floor(points.astype(float) / voxel_m).astype(int)}
    kept = [tuple(c) for c in np.floor(points[first].astype(float) * (1 / voxel_m)).astype(int)]
    assert len(set(kept)) == len(kept)
    assert abs(len(cells) - len(kept)) <= 2  # a point on a face may fall either way by one rounding
    assert np.array_equal(first_in_voxels(points[first], voxel_m), np.arange(len(first)))  # idempotent


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), n=st.integers(0, 2000), voxel_m=st.floats(0.05, 5.0), rings=st.sampled_from([0, 3]))
def test_means_are_those_of_each_part(seed: int, n: int, voxel_m: float, rings: int) -> None:
    points, rng = cloud(seed, n), np.random.default_rng(seed)
    times_s, weights = rng.uniform(-0.1, 0.0, n), rng.integers(1, 5, n).astype(float)
    ring = rng.integers(0, rings, n).astype(np.uint16) if rings else None
    means = voxel_means(points, times_s, weights, voxel_m, ring=ring)
    size = -(-n // PARTS)
    parts = [slice(k * size, (k + 1) * size) for k in range(PARTS)]
    # a point as often as its weight is the plain way to weigh it
    often = [np.repeat(points[part], weights[part].astype(int), axis=0) for part in parts]
    expected = np.concatenate([voxel_members_plainly(some, voxel_m)[1] for some in often if len(some)] or [points])
    assert np.allclose(means.points, expected, rtol=1e-6, atol=1e-6)
    assert means.weights.sum() == weights.sum()
    assert means.times_s @ means.weights == pytest.approx(times_s @ weights)
    everything = voxel_means(*means, 1e6)
    if n:
        assert np.average(everything.points, axis=0, weights=everything.weights) == pytest.approx(
            np.average(points.astype(float), axis=0, weights=weights), abs=1e-5
        )


@pytest.mark.parametrize("bad", [np.nan, np.inf, 3e6])
def test_a_point_out_of_reach_is_refused(bad: float) -> None:
    points = np.array([[0, 0, 0], [0, bad, 0]], np.float32)
    with pytest.raises(ValueError, match="away"):
        first_in_voxels(points, 1.0)
    with pytest.raises(ValueError, match="away"):
        voxel_means(points, np.zeros(2), np.ones(2), 1.0)


@pytest.mark.parametrize("voxel_m", [0.0, -1.0, float("nan")])
def test_a_voxel_without_size_is_refused(voxel_m: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        voxel_centroids(np.zeros((1, 3), np.float32), voxel_m)
