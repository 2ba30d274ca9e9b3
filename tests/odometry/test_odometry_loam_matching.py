from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc import se3
from mineloc.data import Sweep
from mineloc.odometry.loam_features import ring_starts
from mineloc.odometry.loam_matching import match_lines, match_planes, nearest_on_two_rings, nearest_on_two_rings_plainly


def ringed(seed: int, n: int, *, coarse: bool = False) -> Sweep:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 3, (n, 3))
    points = np.round(points) if coarse else points
    return Sweep(0, points.astype(np.float32), None, np.sort(rng.integers(0, 8, n)).astype(np.uint16))


@settings(deadline=None)
@given(
    seed=st.integers(0, 10_000), n=st.integers(0, 400), limit2=st.sampled_from([0.5, 4.0, 1e6]), coarse=st.booleans()
)
def test_the_search_agrees_with_the_matrix_of_all_distances(seed: int, n: int, limit2: float, coarse: bool) -> None:
    sweep = ringed(seed, n, coarse=coarse)  # coarse: many equal distances
    query = ringed(seed + 1, 40, coarse=coarse).points_lidar.astype(float)
    assert sweep.ring is not None
    fast = nearest_on_two_rings(query, sweep.points_lidar, ring_starts(sweep), limit2, 2)
    assert np.array_equal(fast, nearest_on_two_rings_plainly(query, sweep.points_lidar, sweep.ring, limit2, 2))


def edge_and_wall() -> tuple[Sweep, Sweep]:
    """A vertical edge at (3, 1) and a wall x = 3, seen by eight rings."""
    ring = np.arange(8, dtype=np.uint16)
    z = np.linspace(-1, 1, 8)
    edge = np.stack([np.full(8, 3.0), np.full(8, 1.0), z], 1)
    y = np.linspace(-1, 1, 21)
    wall = np.stack([np.full(168, 3.0), np.tile(y, 8), np.repeat(z, 21)], 1)
    return (
        Sweep(0, edge.astype(np.float32), None, ring),
        Sweep(0, wall.astype(np.float32), None, np.repeat(ring, 21)),
    )


def test_lines_run_along_the_edge_and_planes_across_the_wall() -> None:
    edge, wall = edge_and_wall()
    T = se3.exp([0, 0, 0.02, 0.1, 0.05, 0])
    lines = match_lines(edge, edge, T, distance_m=5, rings=2.5)
    planes = match_planes(wall, wall, T, distance_m=5, rings=2.5)
    assert len(lines) == 8
    assert len(planes) == len(wall)
    assert np.allclose(np.abs(lines.axes @ [0, 0, 1]), 1)
    assert np.allclose(np.abs(planes.axes @ [1, 0, 0]), 1)
    assert lines.is_line.all()
    assert not planes.is_line.any()
    assert not planes.is_firm.any()


def test_too_far_away_is_no_match() -> None:
    edge, wall = edge_and_wall()
    away = se3.exp([0, 0, 0, -9.0, 0, 0])
    assert len(match_lines(edge, edge, away, distance_m=5, rings=2.5)) == 0
    assert len(match_planes(wall, wall, away, distance_m=5, rings=2.5)) == 0


def test_rings_too_far_apart_make_no_line() -> None:
    edge, _ = edge_and_wall()
    sparse = edge.keep(np.array([0, 3, 6]))
    assert len(match_lines(edge, sparse, np.eye(4), distance_m=5, rings=2.5)) == 0
    assert len(match_lines(edge, sparse, np.eye(4), distance_m=5, rings=3)) == 8


def test_a_single_ring_makes_neither() -> None:
    edge, wall = edge_and_wall()
    assert edge.ring is not None
    assert wall.ring is not None
    assert len(match_lines(edge, edge.keep(edge.ring == 3), np.eye(4), distance_m=5, rings=2.5)) == 0
    assert len(match_planes(wall, wall.keep(wall.ring == 3), np.eye(4), distance_m=5, rings=2.5)) == 0


def test_equal_points_make_no_line_and_collinear_ones_no_plane() -> None:
    points = np.zeros((4, 3), np.float32)
    same = Sweep(0, points, None, np.array([0, 0, 1, 1], np.uint16))
    assert len(match_lines(same, same, np.eye(4), distance_m=5, rings=2.5)) == 0
    assert len(match_planes(same, same, np.eye(4), distance_m=5, rings=2.5)) == 0


def test_an_empty_reference_gives_no_match() -> None:
    edge, wall = edge_and_wall()
    none = np.zeros(0, np.int64)
    assert len(match_lines(edge, edge.keep(none), np.eye(4), distance_m=5, rings=2.5)) == 0
    assert len(match_planes(wall.keep(none), wall, np.eye(4), distance_m=5, rings=2.5)) == 0
