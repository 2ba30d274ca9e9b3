from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mineloc import se3
from mineloc.data import F64, Sweep
from mineloc.sweep.deskew import (
    deskew_constant_twist,
    deskew_constant_twist_exactly,
    deskew_poses,
    deskew_poses_exactly,
)

TWISTS = arrays(np.float64, 6, elements=st.floats(-3, 3, width=64))


def random_sweep(seed: int, *, n: int = 300, stamp_ns: int = 1_700_000_000_000_000_000) -> Sweep:
    rng = np.random.default_rng(seed)
    return Sweep(
        stamp_ns=stamp_ns,
        points_lidar=rng.normal(0, 10, (n, 3)).astype(np.float32),
        offsets_ns=np.sort(rng.integers(0, 100_000_000, n)),
        ring=rng.integers(0, 16, n).astype(np.uint16),
        intensity=rng.random(n).astype(np.float32),
    )


@given(seed=st.integers(0, 1000), target_ms=st.integers(-50, 150))
def test_no_motion_changes_no_point(seed: int, target_ms: int) -> None:
    sweep = random_sweep(seed)
    target_ns = sweep.stamp_ns + target_ms * 1_000_000
    still = deskew_constant_twist(sweep, np.zeros(6), target_ns=target_ns)
    assert np.array_equal(still.points_lidar, sweep.points_lidar)
    assert not still.has_point_times
    assert still.stamp_ns == target_ns
    assert still.ring is not None
    assert np.array_equal(still.ring, sweep.ring)  # type: ignore[arg-type]


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 1000), twist=TWISTS, target_ms=st.integers(-50, 150))
def test_the_kernel_agrees_with_one_exponential_a_point(seed: int, twist: F64, target_ms: int) -> None:
    sweep = random_sweep(seed)
    target_ns = sweep.stamp_ns + target_ms * 1_000_000
    fast = deskew_constant_twist(sweep, twist, target_ns=target_ns)
    exact = deskew_constant_twist_exactly(sweep, twist, target_ns=target_ns)
    assert np.abs(fast.points_lidar - exact.points_lidar).max() < 3e-5


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 1000), twist=TWISTS)
def test_a_static_point_seen_at_different_times_is_one_point_again(seed: int, twist: F64) -> None:
    target_ns = 60_000_000
    offsets = np.linspace(0, 99_000_000, 50).astype(np.int64)
    anchor = np.random.default_rng(seed).normal(0, 5, 3)
    T_target_t = se3.exp((offsets - target_ns)[:, None] * 1e-9 * twist)
    seen = np.array([se3.apply(se3.inverse(T), anchor[None])[0] for T in T_target_t], np.float32)
    sweep = Sweep(0, seen, offsets)
    assert np.abs(deskew_constant_twist(sweep, twist, target_ns=target_ns).points_lidar - anchor).max() < 3e-5


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 1000), twist=TWISTS)
def test_an_instant_sweep_moves_rigidly(seed: int, twist: F64) -> None:
    points = random_sweep(seed).points_lidar
    moved = deskew_constant_twist(Sweep(1_000, points), twist, target_ns=100_001_000)
    assert np.allclose(moved.points_lidar, se3.apply(se3.exp(-0.1 * twist), points), atol=1e-5)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 1000))
def test_poses_agree_with_one_interpolation_a_point(seed: int) -> None:
    sweep = random_sweep(seed)
    rng = np.random.default_rng(seed)
    stamps = sweep.stamp_ns + np.arange(-1, 22) * 5_000_000
    poses = np.empty((len(stamps), 4, 4))
    poses[0] = se3.exp(rng.normal(0, 1, 6))
    for k in range(1, len(stamps)):
        poses[k] = poses[k - 1] @ se3.exp(np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 0.02, 3)]))
    for target_ns in (sweep.stamp_ns, sweep.end_ns):
        fast = deskew_poses(sweep, stamps, poses, target_ns=target_ns)
        exact = deskew_poses_exactly(sweep, stamps, poses, target_ns=target_ns)
        assert np.abs(fast.points_lidar - exact.points_lidar).max() < 2e-4


def test_poses_at_constant_twist_agree_with_the_twist() -> None:
    sweep = random_sweep(3)
    twist = np.array([0.3, -0.2, 1.5, 2.0, 0.5, -0.3])
    stamps = sweep.stamp_ns + np.arange(-1, 102) * 1_000_000
    poses = se3.exp((stamps - sweep.stamp_ns)[:, None] * 1e-9 * twist)
    a = deskew_poses(sweep, stamps, poses, target_ns=sweep.end_ns)
    b = deskew_constant_twist(sweep, twist, target_ns=sweep.end_ns)
    assert np.allclose(a.points_lidar, b.points_lidar, atol=5e-5)
    assert not np.allclose(a.points_lidar, sweep.points_lidar, atol=0.1)


def test_the_order_of_firing_does_not_matter() -> None:
    sweep = random_sweep(5)
    twist = np.array([0.3, -0.2, 1.5, 2.0, 0.5, -0.3])
    order = np.random.default_rng(0).permutation(len(sweep))
    a = deskew_constant_twist(sweep, twist, target_ns=sweep.end_ns)
    b = deskew_constant_twist(sweep.keep(order), twist, target_ns=sweep.end_ns)
    assert np.array_equal(a.points_lidar[order], b.points_lidar)


def test_a_sequence_that_does_not_span_the_sweep_is_refused() -> None:
    sweep = random_sweep(0)
    stamps = sweep.stamp_ns + np.array([0, 50_000_000])
    with pytest.raises(ValueError, match="outside"):
        deskew_poses(sweep, stamps, np.stack([np.eye(4)] * 2), target_ns=sweep.stamp_ns)


def test_a_twist_that_is_not_a_twist_is_refused() -> None:
    for twist in (np.zeros(3), np.full(6, np.nan)):
        with pytest.raises(ValueError, match="six finite"):
            deskew_constant_twist(random_sweep(0), twist, target_ns=0)


def test_an_empty_sweep_stays_empty() -> None:
    empty = Sweep(7, np.zeros((0, 3), np.float32), np.zeros(0, np.int64))
    assert len(deskew_constant_twist(empty, np.ones(6), target_ns=9)) == 0
    assert len(deskew_poses(empty, np.array([0, 10]), np.stack([np.eye(4)] * 2), target_ns=9)) == 0
