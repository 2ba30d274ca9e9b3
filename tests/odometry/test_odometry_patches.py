from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.data import F64
from mineloc.odometry.patches import COUNT, LAMBDA, MAJOR, MEAN, NORMAL, eigen_symmetric, find, patches_plainly
from mineloc.odometry.voxel_map import VoxelMap, fits_at_plainly, insert_into_both

EVERYTHING = {"cap": 1e9, "min_weight": 1.0, "growth": 0.0}


def wall(seed: int, n: int, *, extent_m: float = 4.0, thickness_m: float = 0.02) -> F64:
    """Points on a tilted wall, so that the patches have planes."""
    rng = np.random.default_rng(seed)
    along = rng.uniform(-extent_m, extent_m, (n, 2))
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return along @ axes[:2] + rng.normal(0, thickness_m, (n, 1)) * axes[2]


def row_of(patches: VoxelMap, cell: tuple[int, int, int]) -> int:
    return find(patches.arrays.keys, patches.arrays.rows, *cell)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 3000), voxel_m=st.floats(0.1, 3.0))
def test_the_kernels_agree_with_plain_numpy(seed: int, n: int, voxel_m: float) -> None:
    points = wall(seed, n)
    patches = VoxelMap(voxel_m, **EVERYTHING)
    for part in np.array_split(points, 3):
        patches.insert(part, now=0.0)
    plain = patches_plainly(points, voxel_m)
    assert len(patches) == len(plain.cells)
    rows = np.array([row_of(patches, tuple(cell)) for cell in plain.cells.tolist()])
    assert sorted(rows) == list(range(len(patches)))
    sums, centres = patches.arrays.sums[rows], patches.arrays.centres[rows]
    assert np.array_equal(sums[:, 0], plain.counts)
    assert np.allclose(centres + sums[:, 1:4] / sums[:, :1], plain.means, rtol=1e-9, atol=1e-12)
    fits = patches.arrays.fits[rows].astype(float)
    assert np.array_equal(fits[:, COUNT], plain.counts)
    assert np.allclose(centres + fits[:, MEAN : MEAN + 3], plain.means, rtol=1e-6, atol=1e-6)
    assert np.allclose(fits[:, LAMBDA : LAMBDA + 3], plain.eigenvalues, rtol=1e-6, atol=1e-10)


def test_the_fit_of_a_wall_is_its_plane() -> None:
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(0, 1, 5000), rng.uniform(0, 0.4, 5000), rng.normal(0.5, 0.01, 5000)], axis=1)
    patches = VoxelMap(1.0)
    patches.insert(points, now=0.0)
    fit = patches.arrays.fits[row_of(patches, (0, 0, 0))]
    assert abs(fit[NORMAL + 2]) > 0.9999
    assert abs(fit[MAJOR]) > 0.999
    # uniform over 1 m and 0.4 m, Gaussian of 1 cm
    assert fit[LAMBDA : LAMBDA + 3] == pytest.approx([1e-4, 0.4**2 / 12, 1 / 12], rel=0.25)


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10_000), spread=st.sampled_from([1.0, 1e-3, 1e-6, 0.0]), twins=st.booleans())
def test_eigenvalues_and_vectors_are_lapacks(seed: int, spread: float, twins: bool) -> None:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    values = np.array([spread * rng.uniform(), 1.0 if twins else rng.uniform(), 1.0])
    matrix = axes @ np.diag(values) @ axes.T
    matrix = (matrix + matrix.T) / 2
    a, v = matrix.copy(), np.empty((3, 3))
    eigen_symmetric(a, v)
    assert np.diag(a) == pytest.approx(np.linalg.eigvalsh(matrix), rel=1e-9, abs=1e-14)
    assert np.allclose(v.T @ v, np.eye(3), atol=1e-12)
    assert np.allclose(v @ np.diag(np.diag(a)) @ v.T, matrix, atol=1e-10)


def test_eigenvalues_of_a_diagonal_matrix_come_in_order() -> None:
    a, v = np.diag([3.0, 1.0, 2.0]), np.empty((3, 3))
    eigen_symmetric(a, v)
    assert np.array_equal(np.diag(a), [1.0, 2.0, 3.0])
    assert np.array_equal(np.abs(v), [[0, 0, 1], [1, 0, 0], [0, 1, 0]])


def test_a_patch_waits_for_enough_points_and_for_growth() -> None:
    points = wall(3, 200, extent_m=0.2) + 10.5
    patches = VoxelMap(1.0, min_weight=5.0, growth=0.5)
    counts = []
    for n in (4, 1, 1, 1, 1, 1):  # 4, 5, 6, 7, 8, 9 points
        patches.insert(points[:n], now=0.0)
        counts.append(fits_at_plainly(patches, np.array([[10.5, 10.5, 10.5]]))[0, COUNT])
    # fitted at 5, again when 0.5 · 5 more have come
    assert counts == [0, 5, 5, 5, 8, 8]


def test_an_old_patch_fades() -> None:
    patches = VoxelMap(1.0, cap=100.0, min_weight=1.0, growth=0.0)
    patches.insert(np.full((1000, 3), 0.2), now=0.0)
    patches.insert(np.full((100, 3), 0.8), now=1.0)
    weight, *sums = patches.arrays.sums[0]
    assert weight == pytest.approx(100.0)
    share = (np.array(sums[:3]) / weight + 0.5 - 0.2) / 0.6
    # a hundred points replace the share 1 - (1 - 1/100)^100 of the old ones
    assert share == pytest.approx([1 - 0.99**100] * 3, rel=0.01)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000), sizes=st.lists(st.integers(0, 4000), min_size=1, max_size=6))
def test_growing_loses_no_voxel(seed: int, sizes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    patches = VoxelMap(0.1, **EVERYTHING)
    points = [rng.uniform(-30, 30, (n, 3)) for n in sizes]
    for part in points:
        patches.insert(part, now=0.0)
    plain = patches_plainly(np.concatenate(points), 0.1)
    assert len(patches) == len(plain.cells)
    assert all(row_of(patches, tuple(cell)) >= 0 for cell in plain.cells.tolist())
    assert patches.arrays.sums[: len(patches), 0].sum() == sum(sizes)


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 10_000), sizes=st.lists(st.integers(0, 4000), min_size=1, max_size=4))
def test_two_maps_at_once_become_what_each_becomes_alone(seed: int, sizes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    together, alone = ((VoxelMap(0.3), VoxelMap(0.9)) for _ in range(2))
    for now, n in enumerate(sizes):
        points = rng.uniform(-5, 5, (n, 3))
        insert_into_both(together, points, now=float(now))
        for patches in alone:
            patches.insert(points, now=float(now))
    places = rng.uniform(-5, 5, (500, 3))
    for one, other in zip(together, alone, strict=True):
        assert len(one) == len(other)
        assert np.array_equal(fits_at_plainly(one, places), fits_at_plainly(other, places))


def test_forgetting_drops_what_was_not_seen_and_keeps_the_rest() -> None:
    old, both, new = (np.random.default_rng(k).uniform(0, 3, (500, 3)) + 10.0 * k for k in range(3))
    patches = VoxelMap(0.5)
    patches.insert(np.concatenate([old, both]), now=1.0)
    patches.insert(np.concatenate([both, new]), now=2.0)
    before = fits_at_plainly(patches, np.concatenate([both, new]))
    patches.forget(1.5)
    assert np.array_equal(fits_at_plainly(patches, np.concatenate([both, new])), before)
    assert not fits_at_plainly(patches, old).any()
    assert len(patches) == len(patches_plainly(np.concatenate([both, new]), 0.5).cells)
    # what is forgotten can be seen again
    patches.insert(old, now=3.0)
    again = VoxelMap(0.5)
    again.insert(old, now=0.0)
    assert np.array_equal(fits_at_plainly(patches, old), fits_at_plainly(again, old))


def test_memory_stays_with_what_is_kept() -> None:
    patches = VoxelMap(0.3)
    rng = np.random.default_rng(0)
    most = 0
    for k in range(60):
        patches.insert(rng.uniform(0, 5, (3000, 3)) + np.array([5.0 * k, 0, 0]), now=5.0 * k)
        patches.forget(5.0 * k - 20.0)
        most = max(most, len(patches))
    assert len(patches) <= most < 6 * 3000
    assert len(patches.arrays.keys) <= 1 << 17


def test_the_order_of_the_maps_axes_is_not_mixed_up() -> None:
    patches = VoxelMap(1.0, min_weight=1.0)
    patches.insert(np.array([[-0.5, 7.5, -3.5]]), now=0.0)
    assert row_of(patches, (-1, 7, -4)) == 0
    for cell in [(7, -1, -4), (-4, 7, -1), (-1, 7, -3), (-2, 7, -4), (-1, 8, -4)]:
        assert row_of(patches, cell) == -1
