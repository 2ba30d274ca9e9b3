from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mineloc import se3
from mineloc.data import Trajectory
from mineloc.metrics.association import associate, nearest_indices


def _line(stamps_s, *, timed: bool = True) -> Trajectory:
    """One metre a second along x, turning at 0.1 rad/s."""
    t = np.asarray(stamps_s, dtype=np.float64)
    xi = np.zeros((len(t), 6))
    xi[:, 2] = 0.1 * t
    poses = se3.exp(xi)
    poses[:, 0, 3] = t
    return Trajectory(np.round(t * 1e9).astype(np.int64), poses, timed=timed)


stamps = st.lists(st.integers(0, 2000), min_size=1, max_size=40, unique=True).map(
    lambda x: np.array(sorted(x), np.int64) * 1_000_000
)


@given(short=stamps, long=stamps)
def test_nearest_pairs_are_one_to_one_near_and_in_order(short, long):
    i, j = nearest_indices(short, long, 0.05)
    assert (np.diff(i) > 0).all()
    assert (np.diff(j) > 0).all()
    difference = np.abs(short[i] - long[j])
    assert (difference <= 50_000_001).all()
    # nothing else is nearer, and whoever went without lost to a nearer one or had nobody near
    np.testing.assert_array_equal(difference, np.abs(short[i][:, None] - long).min(axis=1))
    for k in set(range(len(short))) - set(i.tolist()):
        best = np.abs(long - short[k]).min()
        rivals = difference[np.abs(long[j] - short[k]) == best]
        assert best > 49_999_999 or (len(rivals) and rivals.min() <= best)


def test_interpolation_is_exact_on_a_line_and_leaves_out_gaps_and_the_outside():
    reference = _line([0.0, 0.4, 0.8, 3.0, 3.4])
    estimate = _line([-0.1, 0.0, 0.1, 0.5, 1.5, 3.0, 3.3, 3.5])
    pairs = associate(reference, estimate, method="interpolate", max_reference_gap_s=0.5)
    assert (pairs.stamps_ns * 1e-9).tolist() == pytest.approx([0.0, 0.1, 0.5, 3.0, 3.3])
    np.testing.assert_allclose(pairs.reference, pairs.estimate, atol=1e-12)
    assert pairs.to_dict()["method"] == "interpolate"


def test_auto_takes_the_nearest_where_the_reference_is_dense_and_interpolates_where_rates_differ():
    estimate = _line(np.arange(0.003, 10, 0.1))
    dense = associate(_line(np.arange(0, 10, 0.008)), estimate)
    assert dense.method == "nearest"
    assert 0 < dense.to_dict()["time_difference_max_s"] <= 0.004 + 1e-9
    sparse = associate(_line(np.arange(0.05, 10, 0.3)), estimate)
    assert sparse.method == "interpolate"
    assert sparse.to_dict()["pairs"] == len(estimate) - 1  # the first comes before the reference
    # 10 Hz against 10 Hz, half a period apart
    assert associate(_line(np.arange(0, 10, 0.1)), _line(np.arange(0.05, 10, 0.1))).method == "interpolate"
    # a dense estimate against a sparse reference on its times
    assert associate(_line(np.arange(0, 10, 1.0)), _line(np.arange(0, 10, 0.01))).method == "nearest"


def test_no_common_time_gives_no_pairs():
    for method in ("auto", "nearest", "interpolate"):
        assert len(associate(_line([0.0, 1.0]), _line([5.0, 6.0]), method=method)) == 0


def test_without_times_the_count_decides():
    a, b = _line([0, 1, 2], timed=False), _line([3, 4, 5], timed=False)
    pairs = associate(a, b)
    assert (pairs.method, len(pairs)) == ("index", 3)
    with pytest.raises(ValueError, match="3 poses against 2"):
        associate(_line([0, 1], timed=False), a)
    with pytest.raises(ValueError, match="the estimate has no times"):
        associate(_line([0, 1, 2]), a)
    with pytest.raises(ValueError, match="the reference has no times"):
        associate(a, _line([0, 1, 2]))
