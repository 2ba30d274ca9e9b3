"""Local map quality: a tunnel whose nearest points are a formula, bent, turned, blurred, and with things in it."""

from __future__ import annotations

import numpy as np
import pytest

from mineloc import se3
from mineloc.metrics.map_quality import align_to_surface, map_quality, pieces_along

HALF = np.array([1.8, 1.4])


def _nearest(points_m: np.ndarray) -> np.ndarray:
    """Nearest points of a box tunnel along x with a ripple on its left wall."""
    x, y, z = points_m.T
    t = x.copy()
    for _ in range(6):  # to the foot of the perpendicular on the ripple
        slope = 0.15 * np.cos(t)
        t -= (t - x + (HALF[0] + 0.15 * np.sin(t) - y) * slope) / (1 + slope**2)
    left = np.column_stack([t, HALF[0] + 0.15 * np.sin(t), z])
    right = np.column_stack([x, np.full_like(x, -HALF[0]), z])
    up, down = (np.column_stack([x, y, np.full_like(x, sign * HALF[1])]) for sign in (1, -1))
    feet = np.stack([left, right, up, down])
    least = np.argmin(np.linalg.norm(feet - points_m, axis=2), axis=0)
    return feet[least, np.arange(len(x))]


def _straight(points_m: np.ndarray) -> np.ndarray:
    """Of a round smooth tunnel along x."""
    radius = np.linalg.norm(points_m[:, 1:], axis=1, keepdims=True)
    return np.column_stack([points_m[:, :1], points_m[:, 1:] / radius * 2.0])


def _walls(rng: np.random.Generator, count: int, length_m: float = 100.0) -> np.ndarray:
    """Points on walls, floor and roof, away from the corners."""
    x, across = rng.uniform(0, length_m, count), rng.uniform(-1, 1, count)
    side = rng.integers(0, 4, count)
    y = np.choose(side, [HALF[0] + 0.15 * np.sin(x), np.full(count, -HALF[0]), across, across])
    z = np.choose(side, [across, across, np.full(count, HALF[1]), np.full(count, -HALF[1])])
    return np.column_stack([x, y, z])


def test_distances_after_alignment_are_the_noise_whatever_the_map_drifted() -> None:
    rng = np.random.default_rng(0)
    truth = _walls(rng, 12_000)
    piece = (truth[:, 0] / 20).astype(np.int64)
    noise = rng.normal(0, 0.02, truth.shape)
    moved = truth + noise
    for number in range(5):
        # each piece is off by another motion, as drift leaves it
        T = se3.exp(np.concatenate([rng.normal(0, 0.003, 3), rng.normal(0, 0.1, 3)]))
        moved[piece == number] = se3.apply(T, moved[piece == number])
    found = map_quality(moved, piece, _nearest)
    # the median of |N(0, σ)|; the noise has one component across the wall
    np.testing.assert_allclose(found.median_m, 0.6745 * 0.02, rtol=0.12)
    np.testing.assert_allclose(found.p95_m, 1.96 * 0.02, rtol=0.15)
    assert found.overall_median_m == pytest.approx(0.6745 * 0.02, rel=0.06)
    assert (found.shift_m > 0.02).any()
    # told without alignment, the drift is all there is to see
    raw = np.linalg.norm(moved - _nearest(moved), axis=1)
    assert np.median(raw) > 3 * found.overall_median_m


def test_a_bend_within_a_piece_is_not_aligned_away() -> None:
    rng = np.random.default_rng(1)
    truth = _walls(rng, 8000, 20.0)
    truth = truth[np.abs(truth[:, 2]) < 1.2]  # the walls alone
    truth[:, 1] += 0.1 * np.cos(truth[:, 0] / 20 * 4 * np.pi)
    found = map_quality(truth, np.zeros(len(truth), np.int64), _nearest)
    # the median of |0.1 cos| is 0.07; a robust fit may favour where the bend is slow
    assert 0.03 < found.median_m[0] < 0.1


def test_what_is_not_there_is_counted_and_pulls_nothing() -> None:
    rng = np.random.default_rng(2)
    truth = _walls(rng, 4000, 20.0) + rng.normal(0, 0.005, (4000, 3))
    machine = np.column_stack([rng.uniform(5, 8, 400), rng.uniform(0.2, 0.9, 400), rng.uniform(-0.5, 0.5, 400)])
    both = np.concatenate([truth, machine])
    found = map_quality(both, np.zeros(len(both), np.int64), _nearest)
    assert found.share_over[0] == pytest.approx(400 / 4400, abs=0.01)
    assert found.shift_m[0] < 0.003
    assert found.median_m[0] < 0.005


def test_smooth_tunnel_is_not_slid_along() -> None:
    """Nothing holds a piece along a smooth round tunnel, nor about its axis: the alignment must leave both alone."""
    rng = np.random.default_rng(3)
    angle = rng.uniform(0, 2 * np.pi, 3000)
    tube = np.column_stack([rng.uniform(0, 20, 3000), 2 * np.cos(angle), 2 * np.sin(angle)])
    T = align_to_surface(tube + np.array([0.7, 0.05, -0.03]) + rng.normal(0, 0.01, tube.shape), _straight)
    np.testing.assert_allclose(T[1:3, 3] + (T[:3, :3] @ [10.0, 0, 0])[1:], [-0.05, 0.03], atol=0.003)
    assert abs(T[0, 3]) < 0.01
    assert np.linalg.norm(se3.log(T)[:3]) < 0.002


def test_pieces_follow_the_way_and_far_points_belong_to_none() -> None:
    line = np.column_stack([np.arange(0, 60, 0.5), np.zeros(120), np.zeros(120)])
    points = np.array([[1.0, 2, 0], [21.0, -3, 1], [59.0, 0, 0], [30.0, 20.0, 0]])
    assert pieces_along(points, line).tolist() == [0, 1, 2, -1]
    assert pieces_along(points, line, piece_m=10.0).tolist() == [0, 2, 5, -1]


def test_small_pieces_are_told_without_numbers_and_nothing_is_nothing() -> None:
    rng = np.random.default_rng(4)
    truth = _walls(rng, 300, 20.0)
    found = map_quality(truth, np.r_[np.zeros(290, np.int64), np.full(9, 7), -1], _nearest)
    assert found.piece.tolist() == [0, 7]
    assert found.points.tolist() == [290, 9]
    assert np.isnan(found.median_m[1])
    assert np.isfinite(found.overall_median_m)
    nothing = map_quality(np.zeros((0, 3)), np.zeros(0, np.int64), _nearest)
    assert np.isnan(nothing.overall_median_m)
    assert len(nothing.piece) == 0
