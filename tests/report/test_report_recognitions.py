"""Recognitions on the page: passage by passage with a reference, without one only what is known, and a lost flight."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from recognition_run import MISSED, ORIGIN, WRONG, recognition_run
from report_page import Page
from synthetic_run import SyntheticRun

from mineloc.config import Config
from mineloc.report.marks import shown_name
from mineloc.report.numbers import WRITTEN
from mineloc.report.page import write_report
from mineloc.stages.passages import most_frequent
from mineloc.stages.recognitions import recognition_of, step_of
from mineloc.stages.run_folder import RunFolder

RUN = SyntheticRun(poses=1500)


def reported(folder: Path, *runs: Path) -> tuple[Page, dict, str]:
    out = write_report(runs, folder / "report.html", config=Config())
    html = out.read_text(encoding="utf-8")
    return Page(html), json.loads(out.with_suffix(".json").read_text(encoding="utf-8")), html


@pytest.fixture(scope="module")
def scored(tmp_path_factory, synthetic_run):
    folder = tmp_path_factory.mktemp("scored")
    run, _ = recognition_run(folder, synthetic_run(RUN))
    return (*reported(folder, run), run)


def test_a_row_a_passage_with_the_numbers_of_its_best_fix(scored):
    _, document, _, _ = scored
    places = document["runs"][0]["recognitions"]["places"]
    assert [(one["name"], one["outcome"], one["accepted"]) for one in places] == [
        ("T 0", "recognised", 3),
        (MISSED, "missed", 0),
        (WRONG, "wrong", 1),
        ("bay 3", "missed", 0),
    ]
    first, missed, wrong, bay = places
    best = {"similarity": 0.83, "matrix": 0.64, "inlier_ratio": 0.9, "residual_m": 0.021}
    assert {key: first[key] for key in best} == best
    assert (first["first_s"], first["last_s"]) == (pytest.approx(19.6), pytest.approx(21.7))
    assert first["error_m"] == pytest.approx(0.0, abs=1e-6)
    assert wrong["error_m"] == pytest.approx(2.0, abs=1e-6)
    assert missed["reason"] == "similarity …, at least … needed (step 4)"
    assert missed["reason_count"] < missed["refused"]
    assert (bay["reason"], bay["refused"]) == (None, 0)
    assert first["position_m"]["x"] > ORIGIN[0] - 300
    assert first["nearest_m"] < 0.2


def test_the_totals_are_those_of_the_evaluation(scored):
    _, document, _, path = scored
    run = RunFolder.open(path)
    told, truth = document["runs"][0]["recognitions"]["score"], recognition_of(run, run.reference).to_dict()
    for key in ("precision", "recall", "recall_with_bays", "wrong", "first_m", "median_error_m", "max_error_deg"):
        assert told[key] == truth[key], key
    assert (told["precision"], told["recall"], told["recall_with_bays"]) == (0.75, pytest.approx(2 / 3), 0.5)


def test_the_page_says_what_the_sidecar_says(scored):
    page, document, html, _ = scored
    shown = {attributes["data-path"]: (attributes, text) for attributes, text in page.data}
    for path in ("score.precision", "score.recall", "score.recall_with_bays", "score.first_m", "places.0.matrix",
                 "places.2.error_m", "places.1.reason_count", "places.3.at_m", "places.0.position_m.y"):  # fmt: skip
        value = document["runs"][0]["recognitions"]
        for step in path.split("."):
            value = value[int(step)] if isinstance(value, list) else value[step]
        attributes, text = shown[f"runs.0.recognitions.{path}"]
        assert attributes["value"] == repr(value)
        assert text == WRITTEN[attributes["data-kind"]](value)
    assert "recognised, wrong 1×" in page.text
    assert "missed: no keyframe looked" in page.text
    assert "recognised 3×, 19.6 – 21.7 s" in page.text
    assert not re.search(r"\b(nan|None|inf|Undefined)\b", page.text)
    assert len(html.encode()) < 1_000_000


def test_refusals_stand_by_step_and_not_by_number(scored):
    page, document, _, path = scored
    stopped = document["runs"][0]["recognitions"]["stopped"]
    assert [one["step"] for one in stopped] == ["step 2", "step 4"]
    refused = RunFolder.open(path).fixes.filter(~pl.col("trusted"))["reason"]
    assert [one["count"] for one in stopped] == [n for _, n in sorted(Counter(r[-7:] for r in refused).items())]
    assert sum(one["share"] for one in stopped) == pytest.approx(1.0)
    assert "Is an intersection within reach?" in page.text


def test_names_with_markup_are_text_in_table_and_figure(scored):
    page, _, html, _ = scored
    assert "<b>" not in html
    svg = html[html.index("<svg") : html.index("</svg>")]
    texts = [unescape(one) for one in re.findall(r"<text[^>]*>([^<]*)</text>", svg)]
    assert {"T 0", shown_name(MISSED), shown_name(WRONG), "bay 3"} <= set(texts)
    assert {"recognised", "missed", "not passed"} <= set(texts)
    assert "@name" not in html
    assert MISSED in page.text
    assert WRONG in page.text


def test_a_long_name_is_cut_and_loses_its_control_characters():
    assert shown_name("\u202eab\n\x00c  d") == "ab c d"
    assert len(shown_name("x" * 99)) == 16


def test_without_a_reference_no_passage_is_invented(tmp_path, synthetic_run):
    run, _ = recognition_run(tmp_path, synthetic_run(RUN), reference=False)
    page, document, html = reported(tmp_path, run)
    told = document["runs"][0]["recognitions"]
    assert told["score"] is None
    assert (told["accepted"], told["refused"], told["intersections"]) == (4, 106, 5)
    assert [(one["name"], one["outcome"], one["error_m"]) for one in told["places"]] == [
        ("T 0", "recognised", None),
        (WRONG, "recognised", None),
    ]
    for word in ("Precision", "Recall", "missed,", "not passed"):
        assert word not in page.text, word
    assert "not recognised" in html
    assert "what was missed is not counted" in page.text


def test_a_flight_that_was_not_found_says_so_first(tmp_path, synthetic_run):
    run, _ = recognition_run(tmp_path, synthetic_run(RUN), found=False)
    page, document, html = reported(tmp_path, run)
    head = html[: html.index("<main>")]
    assert 'role="alert"' in head
    assert "was not found in the map" in head
    assert "similarity 0.4" in head
    told = document["runs"][0]
    assert told["map"]["found"] is False
    assert told["shown_alignment"] == "origin"
    assert told["recognitions"]["score"] is None
    assert told["recognitions"]["first_m"] is None
    assert "no fix" in page.text
    assert told["limits"][0].startswith("The flight was not found in the map")
    assert "Precision" not in page.text
    # no intersection is drawn in a frame that is not the map's
    assert "T 0" not in html[html.index("<svg") : html.index("</svg>")]


def test_a_start_that_the_map_refuted_is_told(tmp_path, synthetic_run):
    run, _ = recognition_run(tmp_path, synthetic_run(RUN))
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["map"]["start_off_m"] = 35.21
    (run / "manifest.json").write_text(json.dumps(manifest))
    _, document, html = reported(tmp_path, run)
    assert "was told to begin 35.2 m from where it did" in html
    assert any("35.2 m" in limit for limit in document["runs"][0]["limits"])


def test_a_run_without_a_map_is_as_before(tmp_path, synthetic_run):
    page, document, _ = reported(tmp_path, synthetic_run(RUN))
    assert document["runs"][0]["map"] is None
    assert "alert" not in {value for _, _, value in page.attributes}


def test_what_a_map_holds_between_intersections_is_not_scored(tmp_path, synthetic_run):
    run, _ = recognition_run(tmp_path, synthetic_run(RUN))
    fixes = pl.read_parquet(run / "fixes.parquet")
    fixes.with_columns(target=pl.when(pl.col("trusted")).then(pl.lit("map")).otherwise(pl.col("target"))).write_parquet(
        run / "fixes.parquet"
    )
    page, document, _ = reported(tmp_path, run)
    assert document["runs"][0]["recognitions"]["places"] is None
    assert "Recall" not in page.text


def test_only_so_many_rows_are_shown_and_the_wrong_ones_always(tmp_path, synthetic_run, monkeypatch):
    monkeypatch.setattr("mineloc.report.page._PLACES", 2)
    monkeypatch.setattr("mineloc.report.page._FEWEST_PLACES", 2)
    run, _ = recognition_run(tmp_path, synthetic_run(RUN))
    page, document, _ = reported(tmp_path, run)
    assert "2 more rows in the JSON sidecar" in page.text
    assert WRONG in page.text
    assert len(document["runs"][0]["recognitions"]["places"]) == 4


def test_six_runs_stand_side_by_side_with_both_estimates(tmp_path, synthetic_run):
    run = synthetic_run(RUN)
    page, document, html = reported(tmp_path, *[run] * 6)
    table = html[html.index('<table class="methods">') : html.index("</table>")]
    for k in range(6):
        for estimate in ("smoothed", "online"):
            scores = f"runs.{k}.accuracy.{estimate}"
            wanted = [f"{scores}.ape.origin.translation_m.{name}" for name in ("rmse", "max")]
            for path in [*wanted, *(f"{scores}.rep.{rep}.literal.mean" for rep in range(5))]:
                assert f'data-path="{path}"' in table, path
    assert len(document["runs"]) == 6
    assert len(html.encode()) < 1_000_000
    assert page.open == []


def test_a_reason_is_told_in_full_where_it_never_differs():
    assert most_frequent(["a 1 (step 4)", "a 1 (step 4)", "b (step 2)"]) == ("a 1 (step 4)", 2)
    assert most_frequent(["a 1 (step 4)", "a 2 (step 4)"]) == ("a … (step 4)", 2)
    assert most_frequent(["b (step 9)", "a (step 9)"]) == ("a (step 9)", 1)


def test_what_stands_in_brackets_is_not_always_a_step():
    outvoted = [f"outvoted by 831 other recognitions and odometry (weight 0.0{k})" for k in range(3)]
    assert {step_of(reason) for reason in outvoted} == {"afterwards"}
    assert most_frequent(outvoted) == ("outvoted by … other recognitions and odometry (weight …)", 3)
    assert step_of("2 places are possible (not found yet)") == "not found yet"
    assert (step_of("overlap 0.31 < 0.6"), step_of("similarity 0.3 (step 4)")) == ("other", "step 4")


def test_positions_are_those_of_the_mine_grid(scored):
    _, document, _, path = scored
    known = RunFolder.open(path).intersections()
    for one in document["runs"][0]["recognitions"]["places"]:
        row = known.row(one["id"], named=True)
        told = [one["position_m"][axis] for axis in "xyz"]
        assert told == pytest.approx((np.array([row["x_m"], row["y_m"], row["z_m"]]) + ORIGIN).tolist())


def test_a_run_that_the_map_holds_has_no_recall(scored):
    run = RunFolder.open(scored[3])
    assert recognition_of(run, run.reference) is not None
    held = run.fixes.with_columns(target=pl.when(pl.col("trusted")).then(pl.lit("map")).otherwise(pl.col("target")))
    assert recognition_of(replace(run, fixes=held), run.reference) is None
