"""A recognised intersection in the recording: what was stored beside what was seen, and the nine steps."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from recognition_run import ACCEPTED, MISSED, WRONG, recognition_run
from rrd_columns import Recording
from synthetic_run import PERIOD_NS, START_NS, SyntheticRun

from mineloc.config import Config
from mineloc.errors import FormatError
from mineloc.stages.run_folder import RunFolder
from mineloc.view.about import escaped
from mineloc.view.decisions import run_decisions
from mineloc.view.evidence import seen_lines
from mineloc.view.run import record_run
from mineloc.view.show import show

RUN = SyntheticRun(poses=1500)
FIRST_NS, SECOND_NS = START_NS + PERIOD_NS * 7 * 29, START_NS + PERIOD_NS * 7 * 115


@pytest.fixture(scope="module")
def made(tmp_path_factory, synthetic_run) -> tuple[Path, Path]:
    return recognition_run(tmp_path_factory.mktemp("made"), synthetic_run(RUN))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, made) -> Recording:
    run, database = made
    out = tmp_path_factory.mktemp("rrd") / "run.rrd"
    return Recording(record_run(run, out, database=database, config=Config()))


def entity(recorded: Recording, name: str, root: str = "recognised") -> str:
    (found,) = {e.rpartition("/")[0] for e in recorded.entities if e.startswith(f"/{root}/") and name in e}
    return found


def test_every_recognised_passage_has_an_entry_and_no_other(recorded):
    entries = {e.rpartition("/")[0] for e in recorded.entities if e.startswith("/recognised/")}
    assert len(entries) == 2
    for root in ("recognised", "contours"):
        for name in ("T\\ 0/1", "矿井"):
            base = entity(recorded, name, root)
            assert {f"{base}/stored", f"{base}/seen"} <= recorded.entities, (root, name)
    assert not any("Кривая" in e for e in recorded.entities)
    assert {"/recognitions/steps", "/recognitions/list", "/contours/rings"} <= recorded.entities


def test_clouds_lie_around_the_invariant_point_and_the_roof_is_off(recorded):
    base = entity(recorded, "T\\ 0/1")
    stored = np.array(recorded.values[f"{base}/stored", "Points3D:positions"][0])
    assert np.hypot(stored[:, 0], stored[:, 1]) == pytest.approx(2.0, abs=0.02)
    seen = np.array(recorded.values[f"{base}/seen", "Points3D:positions"][0])
    # points of the synthetic run: a tube of 2 m around a lidar 1.42 m above the point
    assert 500 < len(seen) <= 1500
    assert seen[:, 2].min() == pytest.approx(1.42 - 2.1, abs=0.4)
    assert np.hypot(seen[:, 0], seen[:, 1]).max() < 12.0


def test_one_recognition_gives_way_to_the_next(recorded):
    first, second = entity(recorded, "T\\ 0/1"), entity(recorded, "矿井")
    assert recorded.times[f"{first}/seen"] == [FIRST_NS, SECOND_NS]
    sizes = [len(points) for points in recorded.values[f"{first}/seen", "Points3D:positions"]]
    assert sizes[0] > 0
    assert sizes[1] == 0
    assert recorded.times[f"{second}/seen"] == [SECOND_NS]
    assert recorded.times["/recognitions/steps"] == [FIRST_NS, SECOND_NS]


def test_the_page_tells_every_step_with_its_number_and_what_was_needed(recorded):
    first, second = (value[0] for value in recorded.values["/recognitions/steps", "TextDocument:text"])
    settings = Config()
    needed = settings.intersections
    for row in (
        f"| 1 | keyframes laid over each other | up to {needed.window_keyframes} |  |",
        f"| 4 | contours alike | {ACCEPTED['matched_similarity']:.2f} | ≥ 0.50 |",
        "|  | candidates that may be here | 2 | ≥ 1 |",
        "| 5 | one candidate alone | no |  |",
        f"| 6 | matrices alike (CWC) | {ACCEPTED['matrix']:.2f} |  |",
        f"|  | better than the second by | 0.23 | ≥ {needed.matrix_margin:.2f} |",
        f"| 7, 8 | keyframes in a row that agree | 2 | ≥ {needed.same_needed_known} |",
        f"| 9 | inliers of the registration | 0.90 | ≥ {needed.verify_inlier_ratio:.2f} |",
        f"|  | residual | 0.021 m | ≤ {needed.verify_residual_m:.3f} m |",
        f"|  | from the prediction | 1.3 sigmas | ≤ {settings.prior_map.max_moved_sigmas:.1f} sigmas |",
        "|  | from the reference | 0.000 m, 0.00° |  |",
    ):
        assert row in first, row
    assert "of 3 accepted on this passage" in first
    assert "from the reference | 2.000 m" in second
    assert f"# {escaped(WRONG)}" in second
    listed = [value[0] for value in recorded.values["/recognitions/list", "TextLog:text"]]
    assert listed[0].startswith("T 0 (T): accepted 3×, contours alike 0.83, inliers 0.90")


def test_the_prediction_is_where_the_keyframe_before_and_odometry_put_it(made, recorded):
    run = RunFolder.open(made[0])
    online, keyframes = run.online.compose(right=run.T_body_lidar, child="lidar"), run.keyframes
    # in the synthetic run odometry is the online estimate, so the prediction is the online pose itself
    row = int(np.searchsorted(online.stamps_ns, keyframes["stamp_ns"][29]))
    fix = run.fixes.filter(pl.col("keyframe") == 29).select("x_m", "y_m", "z_m").row(0)
    away = float(np.linalg.norm(online.poses[row, :3, 3] - fix))
    (first, _) = (value[0] for value in recorded.values["/recognitions/steps", "TextDocument:text"])
    assert f"| that is | {away:.3f} m" in first


def test_a_contour_is_the_nearest_wall_in_each_direction():
    bearing = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = np.column_stack([np.cos(bearing), np.sin(bearing)])
    closed = seen_lines(np.concatenate([3.0 * ring, 5.0 * ring, 20.0 * ring]), 8.0)
    assert len(closed) == 1
    assert np.linalg.norm(closed[0], axis=1) == pytest.approx(3.0)
    open_to_the_west = seen_lines(3.0 * ring[np.abs(bearing - np.pi) > 0.4], 8.0)
    assert len(open_to_the_west) == 1
    assert open_to_the_west[0][:, 0].min() > -2.9
    assert seen_lines(np.zeros((0, 2)), 8.0) == []


def test_equal_runs_give_equal_recordings(made, tmp_path):
    run, database = made
    one, two = (Recording(record_run(run, tmp_path / f"{k}.rrd", database=database, config=Config())) for k in range(2))
    assert one.values == two.values
    assert one.times == two.times


def test_without_a_database_or_a_place_in_the_map_there_is_no_tab(tmp_path, synthetic_run, made):
    run, database = recognition_run(tmp_path, synthetic_run(RUN), found=False)
    for k, given in enumerate((database, None)):
        recording = Recording(record_run(run, tmp_path / f"{k}.rrd", database=given, config=Config()))
        assert not any(e.startswith(("/recogni", "/contours")) for e in recording.entities)
    recording = Recording(record_run(made[0], tmp_path / "none.rrd", config=Config()))
    assert not any(e.startswith("/recogni") for e in recording.entities)


def test_the_database_must_be_that_of_the_run(tmp_path, synthetic_run, made):
    run, database = made
    with pytest.raises(FormatError, match="was not used by the run"):
        show(synthetic_run(RUN), database=database, save=tmp_path / "a.rrd", config=Config())
    other = tmp_path / "other"
    shutil.copytree(run, other)
    manifest = json.loads((other / "manifest.json").read_text())
    manifest["map"]["manifest_sha256"] = "ef" * 32
    (other / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(FormatError, match="is of another map"):
        show(other, database=database, save=tmp_path / "a.rrd", config=Config())
    with pytest.raises(FormatError, match="--database"):
        show(database, database=database, save=tmp_path / "a.rrd", config=Config())
    assert not list(tmp_path.glob("*.rrd"))


def test_the_log_tells_what_was_decided_in_words(made):
    run = RunFolder.open(made[0])
    texts = [text for _, _, text in run_decisions(run, run.smoothed)]
    assert (
        "keyframe 29: recognised T 0 (contours alike 0.83, matrices alike 0.64, 2 keyframes agree, inliers 0.90, "
        "residual 0.021 m, 1.3 sigmas from the prediction)"
    ) in texts
    assert any(text.startswith("keyframes 37 to") and "no intersection within reach" in text for text in texts)
    refused = [text for text in texts if "refused, similarity …, at least … needed (step 4)" in text]
    assert len(refused) == len({text.split(":")[0] for text in refused}) > 2
    assert not any(MISSED in text for text in texts)
