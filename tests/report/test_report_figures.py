from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_run import SyntheticRun

from mineloc import se3
from mineloc.report.along import Band, Curve, Way, curves
from mineloc.report.density import density
from mineloc.report.numbers import Numbers, metres, share, three_digits
from mineloc.report.svg import error_colors, keep_peaks
from mineloc.stages.run_folder import RunFolder


@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.integers(1, 20))
def test_thinning_keeps_ends_and_extremes_in_order(seed, n, columns):
    rng = np.random.default_rng(seed)
    x, y = np.cumsum(rng.exponential(1.0, n)), rng.standard_normal(n)
    kept = keep_peaks(x, y, columns=columns)
    assert (np.diff(kept) > 0).all()
    assert len(kept) <= 2 * columns + 2
    assert {0, n - 1, int(y.argmin()), int(y.argmax())} <= set(kept.tolist())


def test_a_hover_is_thinned_too():
    kept = keep_peaks(np.zeros(5000), np.sin(np.arange(5000)), columns=10)
    assert len(kept) <= 22


def test_density_counts_every_point_where_it_lies(synthetic_run):
    run = RunFolder.open(synthetic_run(SyntheticRun(poses=700)))
    quarter = se3.exp([0, 0, np.pi / 2, 10.0, 0.0, 0.0])
    there, turned = density(run, np.eye(4)), density(run, quarter)
    assert there is not None
    assert turned is not None
    assert there.counts.sum() == turned.counts.sum() == run.points().height
    wide = there.extent_m[1] - there.extent_m[0]
    assert turned.extent_m[3] - turned.extent_m[2] == pytest.approx(wide, rel=0.02)
    # the mean of the cells is the mean of the placed points
    poses, table = run.keyframe_poses, run.points()
    placed = np.concatenate(
        [se3.apply(poses[k], table.filter(table["keyframe"] == k).to_numpy()[:, 1:]) for k in range(len(poses))]
    )
    x = np.linspace(there.extent_m[0], there.extent_m[1], there.counts.shape[1] + 1)
    center = (there.counts.sum(axis=0) * (x[:-1] + x[1:]) / 2).sum() / there.counts.sum()
    assert center == pytest.approx(placed[:, 0].mean(), abs=0.1)


def test_equal_figures_are_equal_bytes_whatever_the_user_configured():
    line = Curve("a", np.arange(50.0), np.abs(np.sin(np.arange(50.0))))

    def drawn() -> str:
        return curves("k", [line], bands=[Band(3, 5, "untrusted")], x_label="x (m)", y_label="y (m)", alt="a curve")

    first = drawn()
    with mpl.rc_context({"font.size": 30.0, "axes.facecolor": "red", "svg.hashsalt": None}):
        assert drawn() == first
    assert first.startswith("<svg")
    assert ' width="' not in first.split(">")[0]


def test_metres_flown_are_held_at_the_ends():
    way = Way(np.array([10, 20, 30]) + 10**18, np.array([0.0, 4.0, 8.0]))
    assert way.metres(np.array([0, 15, 30, 99]) + 10**18).tolist() == [0.0, 2.0, 8.0, 8.0]


def test_large_errors_are_dark():
    luminance = error_colors(20)(np.linspace(0, 1, 20))[:, :3] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) < 0).all()
    assert luminance[0] < 0.8


@pytest.mark.parametrize(
    ("value", "written"),
    [(0.0, "0.000"), (0.0567, "0.057"), (-0.0001, "0.000"), (12.345, "12.35"), (5680.44, "5 680.4"), (-7.5, "−7.500")],
)
def test_metres_are_written_to_the_millimetre_while_that_means_something(value, written):
    assert metres(value) == written


@pytest.mark.parametrize(
    ("value", "written"),
    [(0.0, "0.00"), (0.00423, "0.00423"), (0.0589, "0.0589"), (0.137, "0.137"), (2.184, "2.18"), (39.15, "39.1")],
)
def test_percents_have_three_digits(value, written):
    assert three_digits(value) == written


@pytest.mark.parametrize(
    ("value", "written"), [(0.0, "0.0 %"), (1e-5, "< 0.1 %"), (0.5, "50.0 %"), (0.9999, "> 99.9 %"), (1.0, "100.0 %")]
)
def test_a_share_is_whole_only_when_it_is(value, written):
    assert share(value) == written


def test_an_unknown_number_is_a_dash_and_a_wrong_path_an_error():
    number = Numbers({"a": [{"b": 1.5, "c": None}]})
    assert "1.500" in number("a.0.b", "m")
    assert "data" not in number("a.0.c.further.down", "m")
    with pytest.raises(KeyError):
        number("a.0.d", "m")
