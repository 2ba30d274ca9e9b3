from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from report_page import Page
from synthetic_run import SyntheticRun, write_synthetic_run
from typer.testing import CliRunner

from mineloc.cli import app
from mineloc.config import Config, load_config
from mineloc.errors import FormatError, OutputError
from mineloc.io.trajectories import write_tum
from mineloc.metrics.absolute import absolute_error
from mineloc.metrics.association import associate
from mineloc.metrics.coverage import coverage
from mineloc.metrics.subtrajectories import percent_errors
from mineloc.report.numbers import WRITTEN
from mineloc.report.page import MAX_BYTES, letter_of, write_report
from mineloc.stages.run_folder import RunFolder

NASTY = 'Ψ "7" <script>alert(1)</script> & $x^2$ {{ 7*7 }} пещера 矿井 \u202e'


def _report(
    folder: Path, *runs: Path, config: Config | None = None, title: str | None = None
) -> tuple[Page, dict, str]:
    out = write_report(runs, folder / "report.html", config=config or Config(), title=title, overwrite=True)
    html = out.read_text(encoding="utf-8")
    return Page(html), json.loads(out.with_suffix(".json").read_text(encoding="utf-8")), html


def _at(document, path: str):
    for step in path.split("."):
        document = document[int(step)] if isinstance(document, list) else document[step]
    return document


def _never_invents(page: Page) -> None:
    assert not re.search(r"\b(nan|None|inf|Undefined)\b", page.text), page.text


@pytest.fixture(scope="module")
def two(tmp_path_factory, synthetic_run):
    a = synthetic_run(SyntheticRun(poses=3000))
    b = synthetic_run(SyntheticRun(poses=3000, method="loam", front_end="loam", scale=4.0, seed=2))
    return (*_report(tmp_path_factory.mktemp("two"), a, b), (a, b))


def test_every_number_of_the_page_is_one_of_the_sidecar(two):
    page, document, _, _ = two
    assert len(page.data) > 250
    for attributes, written in page.data:
        value = _at(document, attributes["data-path"])
        assert value is not None
        assert attributes["value"] == repr(value), attributes
        assert written == WRITTEN[attributes["data-kind"]](value)
    shown = {attributes["data-path"] for attributes, _ in page.data}
    for estimate in ("smoothed", "online"):
        for kind in ("none", "origin", "se3"):
            for name in ("max", "rmse", "mean", "median", "std"):
                assert f"runs.1.accuracy.{estimate}.ape.{kind}.translation_m.{name}" in shown
        assert {f"runs.0.accuracy.{estimate}.rep.{k}.literal.mean" for k in range(5)} <= shown
        assert f"runs.0.accuracy.{estimate}.rep.4.strict.mean" in shown
        assert f"runs.0.accuracy.{estimate}.drift.one_in" in shown
        assert f"runs.0.accuracy.{estimate}.coverage.time" in shown


def test_the_numbers_are_those_of_the_metrics_room(two):
    _, document, _, runs = two
    for number, path in enumerate(runs):
        run = RunFolder.open(path)
        for name, estimate in (("smoothed", run.smoothed), ("online", run.online)):
            told = document["runs"][number]["accuracy"][name]
            pairs = associate(run.reference, estimate)
            for kind in ("none", "origin", "se3"):
                assert told["ape"][kind] == absolute_error(pairs, kind).to_dict()
            reps = percent_errors(pairs, path_length_m=run.reference.path_m[-1], percents=(20, 40, 60, 80, 100))
            assert told["rep"] == [json.loads(json.dumps(one.to_dict())) for one in reps]
            assert told["coverage"] == coverage(run.reference, estimate).to_dict()
    # the truth of the synthetic run: the smoothed error is 0.3 of the online one
    one = document["runs"][0]["accuracy"]
    smoothed, online = (one[name]["ape"]["none"]["translation_m"]["rmse"] for name in ("smoothed", "online"))
    assert smoothed == pytest.approx(0.3 * online, rel=0.02)


def test_the_page_needs_nothing_but_itself(two):
    page, _, html, _ = two
    assert len(html.encode()) < MAX_BYTES
    for tag, name, value in page.attributes:
        if not name.startswith("xmlns"):
            assert "http:" not in value, (tag, name, value)
            assert "https:" not in value, (tag, name, value)
        if name in ("href", "xlink:href", "src"):
            assert value.startswith(("#", "data:image/png;base64,")), (tag, name, value[:80])
    assert not {"script", "link", "iframe", "object", "img"} & set(page.tags)
    assert ("meta", "content", "default-src 'none'; style-src 'unsafe-inline'; img-src data:") in page.attributes
    assert "@import" not in html
    assert "url(http" not in html


def test_what_is_referred_to_is_there_once(two):
    page, _, _, _ = two
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    for _, name, value in page.attributes:
        for target in re.findall(r"url\(#([^)]+)\)", value) + (
            [value[1:]] if name in ("href", "xlink:href") and value.startswith("#") else []
        ):
            assert target in ids, target


def test_the_figures_say_what_they_show(two):
    page, _, html, _ = two
    assert page.tags.count("svg") == 1 + 2 * 3
    assert html.count('role="img" aria-label="') == 7
    for label in (
        "x (m)",
        "y (m)",
        "height z (m)",
        "distance flown (m)",
        "position error (m)",
        "degenerate",
        "untrusted",
    ):
        assert label in page.text, label
    # several runs are named by letters in figures, by their names in the table
    assert [value for tag, name, value in page.attributes if tag == "section" and name == "id"] == ["run-A", "run-B"]
    for image in re.findall(r'href="data:image/png;base64,([^"]+)"', html):
        assert base64.b64decode(image).startswith(b"\x89PNG")


def test_stretches_and_recognitions_are_told(two):
    page, document, _, (path, _) = two
    registration = document["runs"][0]["registration"]
    assert [round(one["from_s"], 1) for one in registration["degenerate"]] == [45.1, 115.1, 185.1, 255.1]
    assert all(one["duration_s"] == pytest.approx(10.8) for one in registration["degenerate"])
    assert registration["degenerate"][0]["from_m"] == pytest.approx(RunFolder.open(path).reference.path_m[451])
    assert [one["reason"] for one in registration["untrusted"]] == ["inlier ratio 0.08 < 0.2"] * 3
    assert registration["degenerate_share"] == pytest.approx(4 * 109 / 3000)
    assert "inlier ratio 0.08 < 0.2" in page.text
    recognitions = document["runs"][0]["recognitions"]
    (stopped,) = recognitions["stopped"]
    assert (stopped["reason"], stopped["count"]) == ("overlap 0.31 < 0.6", recognitions["refused"])
    assert recognitions["places"] is None
    assert recognitions["accepted"] == 11


def test_equal_runs_give_equal_bytes_wherever_they_lie(tmp_path, synthetic_run):
    runs = [synthetic_run(SyntheticRun(poses=200)), synthetic_run(SyntheticRun(poses=400, reference=False))]
    _, _, html = _report(tmp_path, *runs)
    folders = [tmp_path / name / path.name for name, path in zip("ab", runs, strict=True)]
    for path, folder in zip(runs, folders, strict=True):
        shutil.copytree(path, folder)
    _, _, again = _report(tmp_path, *folders)
    assert again == html


def test_names_are_text(tmp_path, synthetic_run):
    run = synthetic_run(SyntheticRun(poses=200, flight=NASTY, method=NASTY, front_end=NASTY, site=NASTY))
    page, document, html = _report(tmp_path, run, run, title=NASTY)
    assert document["title"] == NASTY
    assert document["runs"][0]["identity"]["method"] == NASTY
    assert "<script" not in html
    assert " ".join(NASTY.split()) in page.text
    assert "{{ 7*7 }}" in page.text
    # a figure never holds a name from outside
    assert not [svg for svg in re.findall(r"<svg.*?</svg>", html, re.S) if "пещера" in svg]
    _never_invents(page)


def test_without_a_reference_nothing_is_claimed(tmp_path, synthetic_run):
    page, document, _ = _report(tmp_path, synthetic_run(SyntheticRun(poses=400, reference=False)))
    (run,) = document["runs"]
    assert run["accuracy"] is None
    assert "the accuracy of this run is not known" in page.text
    assert "RMSE" not in page.text
    assert "claimed uncertainty" in page.text
    assert run["uncertainty"]["sigma_xy_m_max"] == pytest.approx(0.01 + 1e-3 * np.sqrt(60), rel=0.05)
    _never_invents(page)


def test_without_reference_and_covariance_the_page_still_is_right(tmp_path, synthetic_run):
    import polars as pl

    bare = tmp_path / "bare"
    shutil.copytree(synthetic_run(SyntheticRun(poses=400, reference=False)), bare)
    keyframes = pl.read_parquet(bare / "keyframes.parquet")
    names = ("sigma_xy_m", "sigma_z_m", "sigma_yaw_deg")
    keyframes.with_columns(**{n: pl.lit(None, pl.Float64) for n in names}).write_parquet(bare / "keyframes.parquet")
    pl.read_parquet(bare / "points.parquet").clear().write_parquet(bare / "points.parquet")
    pl.read_parquet(bare / "fixes.parquet").clear().write_parquet(bare / "fixes.parquet")
    page, document, _ = _report(tmp_path, bare)
    assert document["runs"][0]["uncertainty"] is None
    assert document["runs"][0]["recognitions"] is None
    assert "neither a reference nor a covariance" in page.text
    _never_invents(page)


def test_one_pose(tmp_path, synthetic_run):
    for reference in (True, False):
        page, document, _ = _report(tmp_path, synthetic_run(SyntheticRun(poses=1, reference=reference)))
        assert document["runs"][0]["size"]["poses"] == 1
        assert document["runs"][0]["size"]["path_m"] == 0
        _never_invents(page)
    assert "No sweep was degenerate." in page.text


def test_a_reference_of_another_time_counts_as_none(tmp_path, synthetic_run):
    late = tmp_path / "late"
    shutil.copytree(synthetic_run(SyntheticRun(poses=200)), late)
    run = RunFolder.open(late)
    later = type(run.smoothed)(run.reference.stamps_ns + 10**12, run.reference.poses)
    write_tum(late / "reference.tum", later, overwrite=True)
    page, document, _ = _report(tmp_path, late)
    assert document["runs"][0]["accuracy"] is None
    assert "no moment in common" in page.text


def test_a_run_that_covers_half_of_the_flight_says_so(tmp_path, synthetic_run):
    half = tmp_path / "half"
    shutil.copytree(synthetic_run(SyntheticRun(poses=1000)), half)
    run = RunFolder.open(half)
    for name, one in (("trajectory.tum", run.smoothed), ("trajectory_online.tum", run.online)):
        write_tum(half / name, type(one)(one.stamps_ns[:500], one.poses[:500]), overwrite=True)
    page, document, _ = _report(tmp_path, half)
    assert document["runs"][0]["accuracy"]["smoothed"]["coverage"]["time"] == pytest.approx(0.5, abs=0.01)
    assert document["runs"][0]["size"]["pose_share"] == 0.5
    assert "The scores speak of 49.9 % of the reference's duration" in page.text


def test_the_health_of_the_recording_is_shown_with_its_damage(tmp_path, synthetic_run):
    hurt = tmp_path / "hurt"
    shutil.copytree(synthetic_run(SyntheticRun(poses=200)), hurt)
    manifest = json.loads((hurt / "manifest.json").read_text())
    topic = {"role": "lidar", "topic": "/points", "msgtype": "PointCloud2", "messages": 200, "used": 190}
    topic |= {"first_ns": 0, "last_ns": 1, "rate_hz": None, "gaps": 3, "missing": 10, "longest_gap_s": 1.25}
    topic |= {"backwards": 0, "duplicates": 0, "clock_jumps": 0, "log_delay_median_s": None}
    health = {"schema": "mineloc.health/1", "source": "<b>.mcap", "kind": "mcap", "recovered": True, "duration_s": 20.0}
    health |= {"lost_messages": 7, "lost_s": 0.7, "topics": [topic], "points": None, "damage": []}
    health |= {
        "findings": [{"name": "lidar_gaps", "severity": "warning", "count": 3, "detail": "3 gaps <i>of</i> 1 s"}]
    }
    (hurt / "manifest.json").write_text(json.dumps(manifest | {"health": health}))
    page, _, html = _report(tmp_path, hurt)
    assert "Made from a damaged recording" in page.text
    assert "3 gaps <i>of</i> 1 s" in page.text
    assert "<i>" not in html
    written = {attributes["data-path"]: text for attributes, text in page.data}
    assert written["runs.0.health.topics.0.missing"] == "10"
    assert written["runs.0.health.lost_messages"] == "7"
    _never_invents(page)


def test_a_long_flight_with_many_stretches_stays_small_and_keeps_its_peak(tmp_path, synthetic_run):
    spiky = tmp_path / "spiky"
    shutil.copytree(synthetic_run(SyntheticRun(poses=11_300, points_per_keyframe=20)), spiky)
    run = RunFolder.open(spiky)
    poses = run.online.poses.copy()
    poses[9_345, 0, 3] += 50.0
    write_tum(spiky / "trajectory_online.tum", type(run.online)(run.online.stamps_ns, poses), overwrite=True)
    page, document, html = _report(tmp_path, spiky)
    assert len(document["runs"][0]["registration"]["degenerate"]) == 16
    assert "The 15 longest of 16; the sidecar has all." in page.text
    assert document["runs"][0]["accuracy"]["online"]["ape"]["none"]["translation_m"]["max"] > 45
    # one pose of 11 300 is thrown off: the axis of the thinned curve still reaches up to it
    assert "40" in [text.strip() for text in page.texts]
    assert len(html.encode()) < 600_000


@pytest.mark.slow
def test_two_hundred_thousand_poses_in_six_runs_stay_below_a_megabyte(tmp_path):
    what = [SyntheticRun(poses=200_000, seed=k, points_per_keyframe=30) for k in range(2)]
    runs = [write_synthetic_run(tmp_path / f"run{k}", one) for k, one in enumerate(what)]
    page, document, html = _report(tmp_path, *runs, *runs, *runs)
    assert len(html.encode()) < MAX_BYTES
    assert [run["letter"] for run in document["runs"]] == list("ABCDEF")
    _never_invents(page)


def test_what_exists_is_not_overwritten_and_nothing_is_left_behind(tmp_path, synthetic_run):
    run = synthetic_run(SyntheticRun(poses=60))
    (tmp_path / "report.json").write_text("mine")
    with pytest.raises(OutputError, match="exists"):
        write_report([run], tmp_path / "report.html", config=Config())
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]
    with pytest.raises(OutputError, match="sidecar"):
        write_report([run], tmp_path / "other.json", config=Config())
    with pytest.raises(FormatError, match="is not a run folder"):
        write_report([tmp_path], tmp_path / "other.html", config=Config())
    with pytest.raises(ValueError, match="needs a run"):
        write_report([], tmp_path / "other.html", config=Config())
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_of_more_runs_than_fit_the_worst_have_sections_and_all_stand_in_the_table(tmp_path, synthetic_run, monkeypatch):
    # 1 MB holds 14 of such runs; the rule is the same for a quarter of it
    monkeypatch.setattr("mineloc.report.page.MAX_BYTES", 300_000)
    runs = [synthetic_run(SyntheticRun(poses=60, seed=k, flight=f"flight {k}")) for k in range(6)]
    page, document, html = _report(tmp_path, *runs)
    assert len(html.encode()) < 300_000
    shown = [value.removeprefix("run-") for tag, name, value in page.attributes if (tag, name) == ("section", "id")]
    assert 1 <= len(shown) < 6
    by_letter = {run["letter"]: run for run in document["runs"]}
    errors = {
        letter: run["accuracy"]["smoothed"]["ape"][run["shown_alignment"]]["translation_m"]["max"]
        for letter, run in by_letter.items()
    }
    assert set(shown) == set(sorted(errors, key=lambda letter: -errors[letter])[: len(shown)])
    assert shown == sorted(shown), "in the order in which they were given"
    assert f"Below are the {len(shown)} of 6 runs" in page.text
    assert all(f"flight {k}" in page.text for k in range(6))
    assert all(f'href="#run-{letter}"' in html for letter in shown)
    assert html.count('href="#run-') == len(shown)


def test_a_page_that_cannot_be_small_enough_is_refused(tmp_path, synthetic_run, monkeypatch):
    monkeypatch.setattr("mineloc.report.page.MAX_BYTES", 20_000)
    monkeypatch.setattr("mineloc.report.page._DETAILS", (1.0, 0.2))
    with pytest.raises(OutputError, match="report fewer runs"):
        write_report([synthetic_run(SyntheticRun(poses=60))], tmp_path / "r.html", config=Config())
    assert list(tmp_path.iterdir()) == []


def test_letters_go_on_after_z():
    assert [letter_of(k) for k in (0, 1, 25, 26, 27, 701, 702)] == ["A", "B", "Z", "AA", "AB", "ZZ", "AAA"]


def test_the_command(tmp_path, synthetic_run):
    run, out = synthetic_run(SyntheticRun(poses=60)), tmp_path / "report.html"
    arguments = ["report", str(run), "--out", str(out), "--title", "Shift 3", "--set", "evaluate.shown_alignment=none"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stdout.split() == [str(out), str(tmp_path / "report.json")]
    document = json.loads((tmp_path / "report.json").read_text())
    assert (document["title"], document["runs"][0]["shown_alignment"]) == ("Shift 3", "none")
    assert load_config(None, []).report.title in Config().report.title
    assert CliRunner().invoke(app, arguments).exit_code == 1
