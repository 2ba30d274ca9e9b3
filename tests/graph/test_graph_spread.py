from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mineloc import se3
from mineloc.data import Trajectory
from mineloc.graph.spread import spread

START_NS = 1_790_000_000_000_000_000


def _odometry(n: int, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    T, poses = se3.exp(rng.normal(size=6)), []
    for step in se3.exp(rng.normal(size=(n, 6)) * 0.02 + [0, 0, 0, 0.15, 0, 0]):
        poses.append(T)
        T = T @ step
    stamps = START_NS + np.cumsum(rng.integers(90_000_000, 110_000_000, n))
    return Trajectory(stamps, np.array(poses), parent="odom", child="lidar")


def _corrected(odometry: Trajectory, rows: np.ndarray, seed: int, size: float = 0.3) -> np.ndarray:
    return odometry.poses[rows] @ se3.exp(np.random.default_rng(seed).normal(size=(len(rows), 6)) * size)


@given(st.integers(0, 1000), st.integers(1, 12))
def test_keyframes_are_met_and_between_them_nothing_jumps(seed, count):
    odometry = _odometry(60, seed)
    rows = np.sort(np.random.default_rng(seed).choice(60, count, replace=False))
    keyframes = _corrected(odometry, rows, seed)
    smoothed = spread(odometry, odometry.stamps_ns[rows], keyframes)
    np.testing.assert_allclose(smoothed.poses[rows], keyframes, atol=1e-9)
    assert (smoothed.parent, smoothed.child) == ("map", "lidar")
    # a step differs from odometry's by its share of the correction between its keyframes
    ours = se3.inverse(smoothed.poses[:-1]) @ smoothed.poses[1:]
    theirs = se3.inverse(odometry.poses[:-1]) @ odometry.poses[1:]
    change = np.linalg.norm(se3.log(se3.inverse(theirs) @ ours), axis=1)
    inside = (np.arange(59) >= rows[0]) & (np.arange(59) < rows[-1])
    assert (change[~inside] < 1e-9).all()
    for a, b in pairwise(rows):
        whole = se3.inverse(odometry.poses[a]) @ odometry.poses[b]
        measured = se3.inverse(smoothed.poses[a]) @ smoothed.poses[b]
        correction = np.linalg.norm(se3.log(se3.inverse(whole) @ measured))
        assert change[a:b].max() <= 3.0 * correction / (b - a) * 1.3 + 1e-9 or b - a == 1


def test_without_correction_it_is_the_odometry():
    odometry = _odometry(40, 1)
    rows = np.array([0, 7, 20, 33])
    same = spread(odometry, odometry.stamps_ns[rows], odometry.poses[rows])
    np.testing.assert_allclose(same.poses, odometry.poses, atol=1e-12)


def test_a_constant_shift_moves_everything():
    odometry = _odometry(40, 2)
    rows = np.array([3, 17, 30])
    shift = se3.exp([0.1, 0.2, 0.3, 4, 5, 6])
    moved = spread(odometry, odometry.stamps_ns[rows], shift @ odometry.poses[rows])
    np.testing.assert_allclose(moved.poses, shift @ odometry.poses, atol=1e-9)


def test_keyframes_must_be_sweeps():
    odometry = _odometry(10, 4)
    with pytest.raises(ValueError, match="must be a sweep"):
        spread(odometry, odometry.stamps_ns[[2]] + 1, odometry.poses[[2]])
    with pytest.raises(ValueError, match="must be a sweep"):
        spread(odometry, odometry.stamps_ns[[4, 2]], odometry.poses[[4, 2]])
    with pytest.raises(ValueError, match="0 keyframes"):
        spread(odometry, odometry.stamps_ns[:0], odometry.poses[:0])
