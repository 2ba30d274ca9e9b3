"""`evaluate --baseline`: paper B's tables 1 and 2."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from synthetic_run import SyntheticRun
from typer.testing import CliRunner

from mineloc.cli import app
from mineloc.data import Trajectory
from mineloc.errors import EvaluationError
from mineloc.io.trajectories import load_trajectory, write_tum
from mineloc.stages.before_after import evaluate_before_after
from mineloc.stages.evaluate import evaluate

POSES = 900  # a bend is in it, for se3
RunMaker = Callable[[SyntheticRun], Path]


@pytest.fixture
def good(synthetic_run: RunMaker) -> Path:
    return synthetic_run(SyntheticRun(poses=POSES))


@pytest.fixture
def poor(synthetic_run: RunMaker) -> Path:
    return synthetic_run(SyntheticRun(poses=POSES, scale=4.0))


def _off(folder: Path, name: str, truth: Trajectory, lift_m: float) -> Path:
    """The truth, every second pose lifted: half of the errors are zero."""
    poses = truth.poses.copy()
    poses[::2, 2, 3] += lift_m
    write_tum(folder / name, Trajectory(truth.stamps_ns, poses))
    return folder / name


def test_the_statistics_are_those_of_each_alone_and_the_change_is_theirs(good: Path, poor: Path) -> None:
    both = evaluate_before_after(good, poor)
    kinds = ("none", "origin", "se3")
    assert [(one.trajectory, one.alignment) for one in both.changes] == [
        (name, kind) for name in ("smoothed", "online") for kind in kinds
    ]
    assert all(one.trajectory == one.baseline_trajectory for one in both.changes)
    alone = {path: evaluate(path) for path in (good, poor)}
    for k, one in enumerate(both.changes):
        scores, aligned = divmod(k, 3)
        for path, statistics in ((poor, one.before_m), (good, one.after_m)):
            assert statistics == alone[path].scores[scores].aligned[aligned].absolute.translation_m
            assert statistics.rmse**2 == pytest.approx(statistics.mean**2 + statistics.std**2)
        assert one.rmse_percent == pytest.approx(100 * (one.after_m.rmse / one.before_m.rmse - 1))
        assert one.rmse_percent < -50  # a quarter of the noise
        assert (one.before_coverage, one.after_coverage) == pytest.approx((1, 1))
    json.dumps(both.to_dict(), allow_nan=False)


def test_both_are_measured_against_the_reference_of_the_estimate(good: Path, tmp_path: Path, poor: Path) -> None:
    # the baseline as a bare file brings none along
    both = evaluate_before_after(good, poor / "trajectory.tum", align="se3")
    assert both.before.reference == both.after.reference == str(good / "reference.tum")
    assert [(one.trajectory, one.baseline_trajectory) for one in both.changes] == [
        ("smoothed", "estimate"),
        ("online", "estimate"),
    ]
    truth = load_trajectory(good / "reference.tum").trajectory
    other = _off(tmp_path, "other.tum", truth, 0.0)
    assert evaluate_before_after(good, poor, other).before.reference == str(other)
    with pytest.raises(EvaluationError, match="brings no reference along"):
        evaluate_before_after(poor / "trajectory.tum", good)


def test_known_errors_give_known_numbers_and_half_a_flight_says_so(good: Path, tmp_path: Path) -> None:
    truth = load_trajectory(good / "reference.tum").trajectory
    before, after = _off(tmp_path, "before.tum", truth, 0.4), _off(tmp_path, "after.tum", truth, 0.2)
    (one,) = evaluate_before_after(after, before, good / "reference.tum", align="none").changes
    for statistics, lift in ((one.before_m, 0.4), (one.after_m, 0.2)):
        found = (statistics.max, statistics.min, statistics.mean, statistics.rmse, statistics.std)
        assert found == pytest.approx((lift, 0, lift / 2, lift / math.sqrt(2), lift / 2), abs=1e-8)
    assert one.rmse_percent == pytest.approx(-50)
    half = Trajectory(truth.stamps_ns[: POSES // 2], truth.poses[: POSES // 2])
    write_tum(tmp_path / "half.tum", half)
    (worse,) = evaluate_before_after(before, tmp_path / "half.tum", good / "reference.tum", align="none").changes
    assert worse.before_coverage == pytest.approx(half.path_m[-1] / truth.path_m[-1], abs=1e-6)
    assert worse.after_coverage == pytest.approx(1)


def test_no_error_before_has_no_percent(good: Path) -> None:
    truth = good / "reference.tum"
    (one,) = evaluate_before_after(good / "trajectory.tum", truth, truth, align="none").changes
    assert one.before_m.rmse == 0
    assert one.rmse_percent is None


def test_alignments_that_one_of_them_leaves_open_are_left_out(good: Path, tmp_path: Path) -> None:
    truth = load_trajectory(good / "reference.tum").trajectory
    write_tum(tmp_path / "two.tum", Trajectory(truth.stamps_ns[:2], truth.poses[:2]))
    both = evaluate_before_after(good / "trajectory.tum", tmp_path / "two.tum", good / "reference.tum")
    assert [one.alignment for one in both.changes] == ["none", "origin"]


def test_the_command_prints_before_and_after_in_eighty_columns(good: Path, poor: Path) -> None:
    told = ["evaluate", str(good), "--baseline", str(poor)]
    shown = CliRunner().invoke(app, told, env={"COLUMNS": "80"})
    assert shown.exit_code == 0, shown.output
    lines = shown.stdout.splitlines()
    (head,) = (line for line in lines if line.split()[:2] == ["trajectory", "aligned"])
    assert head.split() == ["trajectory", "aligned", "max", "min", "mean", "rmse", "std", "coverage"]
    rows = lines[lines.index(head) + 1 :][:12]
    assert [row.split()[0] for row in rows] == ["before", "after"] * 6
    assert max(len(row) for row in rows) <= 80
    change = evaluate_before_after(good, poor).changes[2]
    assert (change.trajectory, change.alignment) == ("smoothed", "se3")
    before, after = f"{change.before_m.rmse:.4f}", f"{change.after_m.rmse:.4f}"
    assert f"smoothed, se3: rmse {before} -> {after} m, {change.rmse_percent:+.1f} %" in lines
    assert rows[4].split()[6] == before
    assert rows[5].split()[6] == after
    result = CliRunner().invoke(app, [*told, "--json", "--align", "origin"])
    raw = json.loads(result.stdout)
    assert [one["alignment"] for one in raw["changes"]] == ["origin", "origin"]
    assert raw["before"]["estimate"] == str(poor)
    assert set(raw["changes"][0]["after"]["translation_m"]) >= {"max", "min", "mean", "rmse", "std"}


def test_the_table_of_one_estimate_shows_least_and_spread_too(good: Path, poor: Path) -> None:
    for path in (good, poor):
        shown = CliRunner().invoke(app, ["evaluate", str(path)], env={"COLUMNS": "80"})
        lines = shown.stdout.splitlines()
        (head,) = (line for line in lines if line.split()[:3] == ["trajectory", "aligned", "rmse"])
        assert head.split()[2:] == ["rmse", "mean", "median", "std", "min", "max", "rmse", "°", "max", "°"]
        row = next(line for line in lines if line.split()[:2] == ["online", "none"]).split()
        t = evaluate(path).scores[1].aligned[0].absolute.translation_m
        assert np.array(row[2:8], float) == pytest.approx([t.rmse, t.mean, t.median, t.std, t.min, t.max], abs=6e-4)
