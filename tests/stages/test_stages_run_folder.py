from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_run import T_BODY_LIDAR, SyntheticRun, write_synthetic_run

from mineloc import se3
from mineloc.data import Fix, Trajectory
from mineloc.errors import FormatError
from mineloc.stages.run_folder import RunFolder, write_run_folder
from mineloc.stages.run_tables import FIXES, fixes_table, pose_columns, poses_of, sigmas


def _parts(run: RunFolder) -> dict:
    return {
        "smoothed": run.smoothed,
        "online": run.online,
        "reference": run.reference,
        "sweeps": run.sweeps,
        "keyframes": run.keyframes,
        "points": run.points(),
        "fixes": run.fixes,
        "timing": run.timing,
        "manifest": run.manifest,
    }


def test_what_is_written_is_read(tmp_path, synthetic_run):
    run = RunFolder.open(synthetic_run(SyntheticRun(poses=60)))
    again = tmp_path / "again"
    again.mkdir()
    write_run_folder(again, **_parts(run))
    copy = RunFolder.open(again)
    for name in ("sweeps", "keyframes", "fixes"):
        assert getattr(copy, name).equals(getattr(run, name)), name
    assert copy.points().equals(run.points())
    for name in ("smoothed", "online", "reference"):
        before, after = getattr(run, name), getattr(copy, name)
        assert (before.stamps_ns == after.stamps_ns).all()
        assert np.abs(before.poses - after.poses).max() < 1e-9
    assert (copy.manifest, copy.timing) == (run.manifest, run.timing)


def test_equal_runs_are_equal_bytes(tmp_path):
    a = write_synthetic_run(tmp_path / "a", SyntheticRun(poses=40))
    b = write_synthetic_run(tmp_path / "b", SyntheticRun(poses=40))
    names = sorted(p.name for p in a.iterdir())
    assert names == sorted(p.name for p in b.iterdir())
    assert len(names) == 9
    assert [n for n in names if (a / n).read_bytes() != (b / n).read_bytes()] == []


def test_nan_becomes_null(synthetic_run):
    run = RunFolder.open(synthetic_run(SyntheticRun(poses=600)))
    lost = run.sweeps.filter(~run.sweeps["trusted"])
    assert len(lost) == 5
    assert lost["residual_m"].null_count() == 5
    assert not run.sweeps["residual_m"].is_nan().any()


def test_no_reference_and_no_recognitions(tmp_path, synthetic_run):
    parts = _parts(RunFolder.open(synthetic_run(SyntheticRun(poses=30, reference=False)))) | {"fixes": fixes_table([])}
    assert parts["reference"] is None
    write_run_folder(tmp_path, **parts)
    copy = RunFolder.open(tmp_path)
    assert copy.reference is None
    assert copy.fixes.is_empty()
    assert copy.fixes.schema == FIXES


def _without_column(parts: dict) -> dict:
    return parts | {"sweeps": parts["sweeps"].drop("trusted")}


def _with_another(parts: dict) -> dict:
    return parts | {"keyframes": parts["keyframes"].with_columns(extra=pl.lit(1))}


def _text_for_numbers(parts: dict) -> dict:
    return parts | {"points": parts["points"].with_columns(x_m=pl.lit("far"))}


def _whole_for_real(parts: dict) -> dict:
    return parts | {"keyframes": parts["keyframes"].with_columns(index=pl.col("index").cast(pl.Float64))}


def _null_pose(parts: dict) -> dict:
    return parts | {"keyframes": parts["keyframes"].with_columns(z_m=pl.lit(float("nan")))}


def _unknown_keyframe(parts: dict) -> dict:
    return parts | {"points": parts["points"].with_columns(keyframe=pl.lit(9999, pl.Int32))}


def _unknown_stamp(parts: dict) -> dict:
    moved = Trajectory(parts["online"].stamps_ns + 1, parts["online"].poses)
    return parts | {"online": moved}


def _backwards(parts: dict) -> dict:
    return parts | {"sweeps": parts["sweeps"].reverse()}


def _no_pose(parts: dict) -> dict:
    return parts | {"smoothed": Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))}


def _no_method(parts: dict) -> dict:
    return parts | {"manifest": {k: v for k, v in parts["manifest"].items() if k != "method"}}


def _nan_in_json(parts: dict) -> dict:
    return parts | {"timing": {**parts["timing"], "sweeps_per_s": float("nan")}}


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (_without_column, "sweeps: missing columns .'trusted'."),
        (_with_another, "keyframes: .* unknown columns .'extra'."),
        (_text_for_numbers, "points.x_m"),
        (_whole_for_real, "keyframes.index"),
        (_null_pose, "keyframes.z_m has nulls"),
        (_unknown_keyframe, "points: a keyframe"),
        (_unknown_stamp, "online: every pose"),
        (_backwards, "stamp_ns must increase"),
        (_no_pose, "at least one pose"),
        (_no_method, "manifest: missing keys .'method'."),
        (_nan_in_json, "JSON compliant"),
    ],
)
def test_what_does_not_fit_is_not_written(tmp_path, synthetic_run, spoil, says):
    parts = spoil(_parts(RunFolder.open(synthetic_run(SyntheticRun(poses=60)))))
    with pytest.raises(ValueError, match=says):
        write_run_folder(tmp_path, **parts)
    assert list(tmp_path.iterdir()) == []


def _remove(name: str):
    return lambda run: (run / name).unlink()


def _cut(name: str):
    return lambda run: (run / name).write_bytes((run / name).read_bytes()[:-40])


def _rewrite(name: str, text: str):
    return lambda run: (run / name).write_text(text, encoding="utf-8")


def _other_columns(run: Path) -> None:
    pl.DataFrame({"keyframe": [1]}).write_parquet(run / "fixes.parquet")


def _older(run: Path) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps(manifest | {"schema": "mineloc.run/0"}))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (_remove("manifest.json"), "is not a run folder"),
        (_remove("trajectory.tum"), "trajectory.tum: is missing"),
        (_remove("sweeps.parquet"), "sweeps.parquet: is missing"),
        (_cut("keyframes.parquet"), "keyframes.parquet: cannot be read"),
        (_rewrite("timing.json", "{"), "timing.json: cannot be read"),
        (_rewrite("timing.json", "[]"), "timing.json: holds a list"),
        (_rewrite("timing.json", "{}"), "timing.json: lacks modules, real_time_factor, sweeps_per_s"),
        (_rewrite("trajectory_online.tum", "1 2 3\n"), "trajectory_online.tum"),
        (_rewrite("trajectory_online.tum", "1.0 nan 0 0 0 0 0 1\n"), "NaN"),
        (_other_columns, "fixes.parquet: other columns"),
        (_older, "schema 'mineloc.run/0'"),
    ],
)
def test_what_is_no_whole_run_is_refused_in_one_line(tmp_path, synthetic_run, spoil, says):
    run = tmp_path / "run"
    shutil.copytree(synthetic_run(SyntheticRun(poses=60)), run)
    spoil(run)
    with pytest.raises(FormatError, match=says) as caught:
        RunFolder.open(run)
    assert "\n" not in str(caught.value)


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.floats(1e-6, 1.0), st.floats(1e-6, 1.0))
def test_level_turns_do_not_change_how_sure_the_heights_are(xi, horizontal, vertical):
    covariance = np.diag([1e-6, 1e-6, 4e-6, horizontal, horizontal, vertical])
    xy, z, yaw = sigmas(se3.exp([0, 0, xi[2], *xi[3:]]), covariance)
    assert xy == pytest.approx(np.sqrt(2 * horizontal))
    assert z == pytest.approx(np.sqrt(vertical))
    assert yaw == pytest.approx(np.degrees(2e-3))


def test_a_lidar_on_its_side_is_sure_in_the_map_not_in_itself():
    on_its_side = se3.exp([np.pi / 2, 0, 0, 0, 0, 0])
    _, z, _ = sigmas(on_its_side, np.diag([1e-6, 1e-6, 1e-6, 0.0, 4.0, 0.0]))
    assert z == pytest.approx(2.0)


@given(st.lists(st.lists(st.floats(-100, 100), min_size=6, max_size=6), max_size=5))
def test_poses_go_into_columns_and_back(xis):
    poses = se3.exp(np.array(xis).reshape(-1, 6)) if xis else np.zeros((0, 4, 4))
    back = poses_of(pl.DataFrame(pose_columns(poses, prefix="odom_")), prefix="odom_")
    assert back.shape == poses.shape
    assert np.abs(back - poses).max(initial=0.0) < 1e-9


def test_a_recognition_without_pose_has_nulls_and_its_reason():
    refused = Fix(5, 2, None, None, False, reason="overlap 0.3 < 0.6", scores={"overlap": 0.3, "rest": float("nan")})
    accepted = Fix(9, 4, T_BODY_LIDAR, None, True, target="J7")
    table = fixes_table([refused, accepted])
    assert table["x_m"].to_list() == [None, pytest.approx(0.05)]
    assert table["sigma_xy_m"].null_count() == 2
    assert table["reason"].to_list() == ["overlap 0.3 < 0.6", ""]
    assert json.loads(table["scores"][0]) == {"overlap": 0.3, "rest": None}
