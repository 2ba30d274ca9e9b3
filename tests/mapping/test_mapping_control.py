from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc import se3
from mineloc.data import ControlPoint
from mineloc.mapping.control import control_table, verdict_of
from mineloc.mapping.grid_placement import GridPlacement, Sightings, find_grid

GRID = np.array([500_000.0, 7_100_000.0, -350.0])


def _yawed(yaw: float, t: np.ndarray) -> np.ndarray:
    T = se3.exp(np.array([0, 0, yaw, 0, 0, 0.0]))
    T[:3, 3] = t
    return T


def _scene(
    *, targets: int, each: int = 4, seed: int = 0, sigma_m: float = 0.01, yaw: float = 2.1, extent_m: float = 300.0
) -> tuple[Sightings, np.ndarray]:
    """Targets seen in a map, and the true placement."""
    rng = np.random.default_rng(seed)
    T = _yawed(yaw, GRID + rng.normal(size=3) * 50)
    in_map = rng.uniform(-extent_m, extent_m, (targets, 3)) * [1, 1, 0.03]
    target = np.repeat(np.arange(targets), each)
    points = in_map[target] + rng.normal(size=(len(target), 3)) * sigma_m
    return Sightings([f"T{k}" for k in range(targets)], se3.apply(T, in_map), target, points), T


def _find(seen: Sightings, most_m: float = 0.3) -> GridPlacement:
    return find_grid(seen, gate_m=0.3, most_m=most_m, min_separation_m=5.0)


def _moved(seen: Sightings, name: int, by: np.ndarray) -> Sightings:
    surveyed = seen.surveyed_grid.copy()
    surveyed[name] += by
    return replace(seen, surveyed_grid=surveyed)


def _off_m(found: GridPlacement, T: np.ndarray, seen: Sightings) -> float:
    """Where the placement puts the map's farthest sighting, against the truth."""
    assert found.T_grid_map is not None
    there = se3.apply(found.T_grid_map, seen.points_map) - se3.apply(T, seen.points_map)
    return float(np.linalg.norm(there, axis=1).max())


@settings(max_examples=30, deadline=None)
@given(yaw=st.floats(-3.2, 3.2), seed=st.integers(0, 1000), targets=st.integers(2, 9))
def test_a_map_without_error_is_placed_to_the_hundredth_of_a_millimetre(yaw: float, seed: int, targets: int) -> None:
    seen, T = _scene(targets=targets, seed=seed, sigma_m=0.0, yaw=yaw)
    found = _find(seen)
    # float64 holds N 7 100 000 m to a nanometre; a sum of squares that was not centred would lose millimetres
    assert _off_m(found, T, seen) < 1e-5
    assert (found.targets, found.misfits, found.fits.all()) == (targets, (), True)


def test_noise_averages_out_and_the_heading_s_sigma_is_honest() -> None:
    errors, z, rmse = [], [], []
    for seed in range(60):
        seen, T = _scene(targets=5, seed=seed, sigma_m=0.02)
        found = _find(seen)
        assert found.T_grid_map is not None
        yaw = float(se3.log(se3.inverse(T) @ found.T_grid_map)[2])
        errors.append(_off_m(found, T, seen))
        z.append(yaw / found.sigma_yaw_rad)
        rmse.append(found.rmse_m)
    # 20 sightings of 2 cm: 4.5 mm an axis in the middle, some more at the edge
    assert 0.004 < np.median(errors) < 0.012
    assert np.median(rmse) == pytest.approx(0.02 * np.sqrt(3), rel=0.15)
    # twenty sightings a placement tell the sigma to 1/√20
    assert 0.4 < np.std(z) < 1.3


@pytest.mark.parametrize("by", [[5, 0, 0], [0, -5, 0], [0, 0, 5], [3, 3, -2.6], [100, 0, 0], [0, 1_000_000, 0]])
@pytest.mark.parametrize("most_m", [0.3, 10.0])
def test_one_blunder_among_eight_is_named_and_bends_nothing(by: list[float], most_m: float) -> None:
    seen, T = _scene(targets=8, seed=3, sigma_m=0.01)
    clean = _off_m(_find(seen, most_m), T, seen)
    wrong = _moved(seen, 5, np.array(by))
    found = _find(wrong, most_m)
    assert found.misfits == ("T5",)
    assert not found.fits[seen.target == 5].any()
    assert _off_m(found, T, seen) < clean + 0.01
    # lower bound: a plain mean would be bent by an eighth of it
    assert np.linalg.norm(by) / 8 > clean + 0.01


def test_three_blunders_among_eight_are_named() -> None:
    seen, T = _scene(targets=8, seed=4)
    for k, by in ((1, [5, 0, 0]), (4, [0, 8, 0]), (6, [-3, 2, 4])):
        seen = _moved(seen, k, np.array(by, float))
    found = _find(seen, 6.0)
    assert found.misfits == ("T1", "T4", "T6")
    assert _off_m(found, T, seen) < 0.03


def test_single_wrong_picks_are_left_out_and_their_targets_stay() -> None:
    seen, T = _scene(targets=4, each=3, seed=5)
    points = seen.points_map.copy()
    points[[1, 5]] += [4.0, 0, 0]
    found = _find(replace(seen, points_map=points))
    assert found.misfits == ()
    assert np.flatnonzero(~found.fits).tolist() == [1, 5]
    assert _off_m(found, T, seen) < 0.03


def test_drifted_odometry_is_placed_and_a_blunder_beyond_its_drift_is_named() -> None:
    """Metres of bending along a kilometre: no sighting fits within the gate, yet all of them are right."""
    seen, T = _scene(targets=9, seed=6, extent_m=500)
    bent = seen.points_map + 1.5 * np.sin(seen.points_map[:, :1] / 150.0) * [0.0, 1.0, 0.2]
    drifted = replace(seen, points_map=bent)
    found = _find(drifted, most_m=8.0)
    assert found.misfits == ()
    assert 0.3 < found.gate_m < 8.0
    assert _off_m(found, T, seen) < 3.0
    assert _find(_moved(drifted, 2, np.array([0, 30.0, 0])), most_m=8.0).misfits == ("T2",)
    # what cannot be drift is refused
    refused = _find(drifted, most_m=0.3)
    assert refused.T_grid_map is None
    assert "control targets agree within 0.30 m: no telling who errs" in refused.reason


def test_targets_on_one_line_are_enough_for_heading_and_position() -> None:
    seen, T = _scene(targets=4, sigma_m=0.0)
    line = np.outer([0.0, 40, 90, 130], [0.6, 0.8, 0.01])
    on_line = replace(seen, surveyed_grid=se3.apply(T, line), points_map=line[seen.target])
    assert _off_m(_find(on_line), T, on_line) < 1e-5


@pytest.mark.parametrize(
    ("targets", "why"),
    [
        ([], "no control target was seen"),
        ([3], r"one control target was seen \(T3\): the heading is open, two are needed"),
    ],
)
def test_too_few_targets_are_refused_with_a_reason(targets: list[int], why: str) -> None:
    seen, _ = _scene(targets=8)
    mask = np.isin(seen.target, targets)
    found = _find(replace(seen, target=seen.target[mask], points_map=seen.points_map[mask]))
    assert found.T_grid_map is None
    with pytest.raises(AssertionError, match=why):
        raise AssertionError(found.reason)


def test_targets_at_one_spot_or_above_one_another_are_refused() -> None:
    seen, T = _scene(targets=3)
    shaft = np.array([[0.0, 0, 0], [1.0, 2.0, 40.0], [0.5, -1.0, 90.0]])
    stacked = replace(seen, surveyed_grid=se3.apply(T, shaft), points_map=shaft[seen.target])
    found = _find(stacked)
    assert found.T_grid_map is None
    assert "3 control targets were seen, all within 3.04 m horizontally: the heading is open" in found.reason


def test_doubt_between_two_or_three_targets_is_refused() -> None:
    two, _ = _scene(targets=2, seed=1)
    along = two.surveyed_grid[1] - two.surveyed_grid[0]
    stretched = _moved(two, 1, 2.0 * along / np.linalg.norm(along))
    found = _find(stretched)
    assert found.T_grid_map is None
    assert "T0 and T1 are" in found.reason
    assert "more than 0.60 m amiss" in found.reason
    three, _ = _scene(targets=3, seed=2)
    found = _find(_moved(three, 0, np.array([3.0, 1.0, 0.0])))
    assert found.T_grid_map is None
    assert "only 2 of 3 control targets agree" in found.reason
    half, _ = _scene(targets=6, seed=2)
    for k in range(3):
        half = _moved(half, k, np.array([7.0, -4.0, 2.0]))
    assert _find(half).T_grid_map is None


def test_exchanged_easting_and_northing_are_recognised() -> None:
    seen, _ = _scene(targets=5)
    found = _find(replace(seen, surveyed_grid=seen.surveyed_grid[:, [1, 0, 2]]))
    assert found.T_grid_map is None
    assert found.reason.endswith("they agree with easting and northing exchanged")


def test_many_sightings_do_not_take_for_ever() -> None:
    seen, T = _scene(targets=40, each=25, seed=8)
    found = _find(_moved(seen, 7, np.array([5.0, 0, 0])), 5.0)
    assert found.misfits == ("T7",)
    assert _off_m(found, T, seen) < 0.005


def test_a_caller_s_mistakes_are_told() -> None:
    seen, _ = _scene(targets=3)
    with pytest.raises(ValueError, match="gate_m"):
        find_grid(seen, gate_m=1.0, most_m=0.5, min_separation_m=5.0)
    with pytest.raises(ValueError, match="points_map"):
        replace(seen, points_map=seen.points_map[1:])


# The residual table


def _points(n: int, *, checks: int = 0, sigma_m: float = 0.005) -> list[ControlPoint]:
    return [
        ControlPoint(
            f"P{k}", GRID + np.array([10.0 * k, 3.0, 0.1]), sigma_m, 2 * sigma_m, "check" if k < checks else "control"
        )
        for k in range(n)
    ]


def _table(points: list[ControlPoint], off: np.ndarray, *, each: int = 1, **more):
    target = np.repeat(np.arange(len(points)), each)
    seen = np.array([points[k].position_grid for k in target]) + off
    return control_table(points, target, seen, np.full(len(target), 0.01), outlier_sigmas=5.0, gross_m=0.3, **more)


def test_the_table_holds_what_a_surveyor_would_reckon_by_hand() -> None:
    points = _points(3, checks=3)
    off = np.array([[0.03, 0.0, 0.0], [0.0, -0.04, 0.0], [0.0, 0.0, 0.05]])
    table = _table(points, off)
    first = table.rows[0]
    # 500 000 m and 7 100 000 m keep their micrometres
    assert (first.de_m, first.dn_m, first.dz_m) == pytest.approx((0.03, 0.0, 0.0), abs=2e-9)
    assert table.rows[1].dn_m == pytest.approx(-0.04, abs=2e-9)
    check = table.check
    assert check is not None
    assert table.control is None
    assert check.rmse_e_m == pytest.approx(0.03 / np.sqrt(3))
    assert check.rmse_h_m == pytest.approx(np.hypot(0.03, 0.04) / np.sqrt(3))
    assert check.rmse_3d_m**2 == pytest.approx(check.rmse_h_m**2 + check.rmse_z_m**2)
    assert check.bias_n_m == pytest.approx(-0.04 / 3)
    assert (check.max_3d_m, check.max_h_m, check.worst) == (pytest.approx(0.05), pytest.approx(0.04), "P2")
    # survey in quadrature: 5 mm twice, 10 mm of height
    assert check.survey_3d_m == pytest.approx(np.sqrt(2 * 0.005**2 + 0.01**2))
    assert check.total_3d_m == pytest.approx(np.hypot(check.rmse_3d_m, check.survey_3d_m))
    assert check.total_h_m == pytest.approx(np.hypot(check.rmse_h_m, check.survey_h_m))
    assert json.loads(json.dumps(table.to_dict()))["check"]["worst"] == "P2"


def test_observations_are_averaged_and_a_wrong_one_is_left_out() -> None:
    points = _points(2)
    rng = np.random.default_rng(0)
    off = rng.normal(size=(10, 3)) * 0.01
    off[3] += [1.0, 0, 0]
    table = _table(points, off, each=5)
    assert [row.observations for row in table.rows] == [5, 5]
    assert [row.left_out for row in table.rows] == [1, 0]
    assert table.rows[0].de_m == pytest.approx(off[[0, 1, 2, 4], 0].mean(), abs=1e-8)
    assert 0.005 < table.rows[1].spread_m < 0.03
    assert table.rows[1].sigma_m == pytest.approx(np.sqrt((2 * 0.005**2 + 0.01**2) / 3 + 0.01**2 / 5))
    # nobody is left out of two that disagree: there is no telling which
    both = _table(_points(1), np.array([[0.0, 0, 0], [1.0, 0, 0]]), each=2)
    assert (both.rows[0].left_out, both.rows[0].de_m) == (0, pytest.approx(0.5))


def test_outliers_are_named_and_only_control_is_spared_them() -> None:
    points = _points(12, checks=4)
    off = np.random.default_rng(1).normal(size=(12, 3)) * 0.01
    off[2] += [0, 0.5, 0]
    off[9] += [5.0, 0, 0]
    table = _table(points, off)
    assert table.outliers == ("P2", "P9")
    assert table.control is not None
    assert table.check is not None
    assert (table.control.count, table.check.count) == (7, 4)
    assert table.control.max_3d_m < 0.05
    assert table.check.max_3d_m > 0.4
    told = _table(points, off * 0.0, outliers=("P5",))
    assert told.outliers == ("P5",)
    assert _table(points, off[:, [0, 1, 2]] * 0.0).outliers == ()


def test_unseen_targets_are_listed() -> None:
    points = _points(3)
    none = np.zeros(0)
    table = control_table(points, np.zeros(0, np.int64), np.zeros((0, 3)), none, outlier_sigmas=5.0, gross_m=0.3)
    assert (table.rows, table.control, table.check, table.unseen) == ((), None, None, ("P0", "P1", "P2"))
    assert verdict_of(table, tolerance_m=0.1).value == "insufficient evidence"


def test_the_verdict_speaks_of_check_points_alone() -> None:
    def verdict(checks: int, size_m: float, worst_m: float | None = None):
        off = np.zeros((checks + 4, 3))
        off[:checks, 0] = size_m
        if worst_m is not None:
            off[0, 0] = worst_m
        return verdict_of(_table(_points(checks + 4, checks=checks), off), tolerance_m=0.1)

    assert verdict(2, 0.0).value == "insufficient evidence"
    assert "2 independent check points, at least 3" in verdict(2, 0.0).reasons[0]
    few = verdict(3, 0.05)
    assert few.value == "pass"
    assert few.reasons == ("3 check points, fewer than the 30 that ASPRS asks for",)
    assert verdict(30, 0.05) == verdict_of(_table(_points(34, checks=30), np.full((34, 3), 0.0)), tolerance_m=0.1)
    assert verdict(30, 0.05).reasons == ()
    # the survey's own error counts: 9.95 cm and 1.2 cm make more than 10 cm
    assert verdict(5, 0.0995).value == "fail"
    assert verdict(5, 0.0980).value == "pass"
    warned = verdict(12, 0.04, worst_m=0.21)
    assert warned.value == "warn"
    assert "P0 is 0.210 m off" in warned.reasons[0]
    assert warned.to_dict()["check_points"] == 12
