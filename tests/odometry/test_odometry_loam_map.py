from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from mineloc import se3
from mineloc.data import F32
from mineloc.odometry.loam_fit import FIRM, FITS, NO_FIT, eigenvalues, eigenvector, fit_line, fit_plane
from mineloc.odometry.loam_map import FeatureMap
from mineloc.sweep import voxel_centroids

REACH = (100.0, 100.0, 50.0)


def walls(seed: int, n: int = 4000) -> F32:
    """Points on the walls of a tunnel, with some roughness."""
    rng = np.random.default_rng(seed)
    p = rng.uniform([-8, -2, -1.5], [8, 2, 1.5], (n, 3))
    axis = rng.integers(1, 3, n)
    p[np.arange(n), axis] = np.sign(p[np.arange(n), axis]) * np.array([0, 2, 1.5])[axis] + rng.normal(0, 0.03, n)
    return p.astype(np.float32)


def feature_map(*clouds: F32, leaf_m: float = 0.4) -> FeatureMap:
    found = FeatureMap(leaf_m=leaf_m, search_m=1.0, reach_m=REACH)
    for cloud in clouds:
        found.add(cloud, np.zeros(3))
    return found


@settings(deadline=None)
@given(seed=st.integers(0, 1000), shape=st.sampled_from(["any", "flat", "thin", "round", "point"]))
def test_eigenvalues_and_vectors_agree_with_numpy(seed: int, shape: str) -> None:
    rng = np.random.default_rng(seed)
    scale = {"any": [3, 2, 1], "flat": [1, 1, 0], "thin": [1, 0, 0], "round": [1, 1, 1], "point": [0, 0, 0]}[shape]
    r = se3.exp(rng.normal(0, 1, 6))[:3, :3]
    a = (r * np.asarray(scale, float)) @ r.T * 10.0 ** rng.integers(-6, 3)
    a = 0.5 * (a + a.T)
    values = np.array(eigenvalues(a))
    size = max(np.abs(values).max(), 1e-30)
    assert np.allclose(values / size, np.linalg.eigvalsh(a) / size, atol=1e-7)
    for value in (values[0], values[2]):
        v = np.empty(3)
        eigenvector(a, value, v)
        assert np.linalg.norm(v) == pytest.approx(1)
        assert np.linalg.norm(a @ v - value * v) < 1e-6 * size


def fit(points: np.ndarray, kind: str, limit: float) -> tuple[int, np.ndarray, np.ndarray]:
    centre, axis = np.empty(3), np.empty(3)
    verdict = (fit_line if kind == "line" else fit_plane)(points, limit, centre, axis)
    return int(verdict), centre, axis


def test_a_line_needs_three_times_the_spread() -> None:
    line = np.array([[0.1 * k, 0.01 * (-1) ** k, 0] for k in range(5)])
    verdict, centre, axis = fit(line, "line", 3.0)
    assert verdict == FITS
    assert np.allclose(centre, line.mean(axis=0))
    assert abs(axis[0]) > 0.99
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 0.0]])
    assert fit(square, "line", 3.0)[0] == NO_FIT
    assert fit(np.zeros((5, 3)), "line", 3.0)[0] == NO_FIT


def test_a_plane_is_firm_when_its_points_spread_in_two_directions() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.02], [0.5, 0.5, 0.0]]) + 7.0
    verdict, _, axis = fit(square, "plane", 0.2)
    assert verdict == FIRM
    assert abs(axis[2]) > 0.99
    arc = np.array([[0.3 * k, 0.02 * k * k, 0.001 * k] for k in range(5)])
    assert fit(arc, "plane", 0.2)[0] == FITS
    tent = square + np.array([0, 0, 0, 0, 0.6])[:, None] * [0, 0, 1]
    assert fit(tent, "plane", 0.2)[0] == NO_FIT


def test_a_plane_through_the_origin_is_a_plane() -> None:
    square = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0], [0, 0, 0.0]])
    assert fit(square, "plane", 0.2)[0] == FIRM


def test_one_sweep_is_kept_as_its_voxel_centroids() -> None:
    cloud = walls(0)
    kept = feature_map(cloud).points_map
    expected = voxel_centroids(cloud, 0.4)
    assert len(kept) == len(expected)
    distance, _ = cKDTree(expected).query(kept)
    assert distance.max() < 1e-5


def test_a_voxel_moves_to_the_mean_of_itself_and_what_arrives() -> None:
    first = np.array([[0.1, 0.1, 0.1]], np.float32)
    second = np.array([[0.3, 0.1, 0.1], [0.2, 0.3, 0.1]], np.float32)
    assert np.allclose(feature_map(first, second).points_map, [[0.2, 0.5 / 3, 0.1]])


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), leaf_m=st.sampled_from([0.2, 0.3, 0.4, 1.0, 1.7]))
def test_neighbours_and_fits_agree_with_a_kd_tree(seed: int, leaf_m: float) -> None:
    rng = np.random.default_rng(seed)
    chart = feature_map(walls(seed), walls(seed + 1), leaf_m=leaf_m)
    points = chart.points_map.astype(float)
    query = (walls(seed + 2, 300) + rng.normal(0, 0.3, (300, 3))).astype(np.float32)
    T = se3.exp([0.01, 0.02, 0.1, 0.3, -0.2, 0.1])
    distance, index = cKDTree(points).query(se3.apply(T, query), k=5)
    near = distance[:, 4] < 1.0
    fives = points[index[near]]
    centres = fives.mean(axis=1)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", fives - centres[:, None], fives - centres[:, None]) / 5)
    normals = vectors[:, :, 0]
    flat = np.abs(np.einsum("nki,ni->nk", fives - centres[:, None], normals)).max(axis=1) <= 0.2
    planes = chart.match_planes(query, T, tolerance_m=0.2)
    assert np.array_equal(planes.points_lidar, query[near][flat].astype(float))
    assert np.allclose(planes.anchors, centres[flat], atol=1e-5)
    clear = values[flat, 1] > 4 * values[flat, 0] + 1e-9
    assert np.allclose(np.abs(np.einsum("ni,ni->n", planes.axes, normals[flat]))[clear], 1, atol=1e-5)
    lines = chart.match_lines(query, T, ratio=3.0)
    assert np.array_equal(lines.points_lidar, query[near][values[:, 2] > 3 * values[:, 1]].astype(float))
    assert not lines.is_firm.any()


def test_order_of_arrival_and_growth_lose_nothing() -> None:
    clouds = [walls(k, 500) + np.float32([6 * k, 0, 0]) for k in range(12)]
    chart = FeatureMap(leaf_m=0.4, search_m=1.0, reach_m=(1e4, 1e4, 1e4))
    for cloud in clouds:
        chart.add(cloud, np.zeros(3))
    cells = {tuple(c) for cloud in clouds for c in np.floor(cloud.astype(float) / 0.4).astype(int)}
    assert len(chart) == pytest.approx(len(cells), abs=3)
    distance, _ = cKDTree(chart.points_map).query(np.concatenate(clouds))
    assert distance.max() < 0.4 * np.sqrt(3)


def test_memory_is_bounded_by_the_reach() -> None:
    chart = FeatureMap(leaf_m=0.4, search_m=1.0, reach_m=(30.0, 30.0, 20.0))
    sizes: list[int] = []
    for k in range(80):
        here = np.array([4.0 * k, 0.0, 0.0])
        chart.add(walls(k, 800) + here.astype(np.float32), here)
        sizes.append(len(chart))
    assert max(sizes[40:]) < 1.3 * sizes[12]
    assert np.abs(chart.points_map[:, 0] - 4.0 * 79).max() < 30 + 3 + 1.2 + 8


def test_an_empty_map_matches_nothing() -> None:
    chart = FeatureMap(leaf_m=0.4, search_m=1.0, reach_m=REACH)
    assert len(chart) == 0
    assert len(chart.match_planes(walls(0, 50), np.eye(4), tolerance_m=0.2)) == 0
    chart.add(np.zeros((0, 3), np.float32), np.zeros(3))
    assert len(chart.match_lines(walls(0, 50), np.eye(4), ratio=3.0)) == 0


def test_a_point_that_is_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        feature_map(np.array([[0, np.nan, 0]], np.float32))
