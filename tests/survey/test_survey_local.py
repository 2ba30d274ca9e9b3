"""A survey without Prefect: order, failures that stop only what needs them, known results, the folder of the user."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from synthetic_run import SyntheticRun, write_synthetic_run

from mineloc.config import Config
from mineloc.errors import MinelocError, OutputError
from mineloc.survey.engine import engine
from mineloc.survey.events import Event
from mineloc.survey.local import run_local
from mineloc.survey.plan import METRICS, Made, Plan, Run, Step
from mineloc.survey.pool import Pool
from mineloc.survey.registry import EVALUATE, REPORT
from mineloc.survey.summary import KEYS, summary


def step(name: str, run: Path | Made) -> Step:
    return Step(f"{name} evaluate", name, EVALUATE, f"runs/{name}/{METRICS}", {"run": run}, Config())


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    (folder / "broken").mkdir()
    (folder / "broken" / "x").write_text("")
    for name in ("good", "bare"):
        write_synthetic_run(folder / name, SyntheticRun(poses=200, flight=name, reference=name == "good"))
    return folder


def plan(out: Path, *steps: Step) -> Plan:
    shown = tuple(Run(step.flight, "odometry", out / "runs" / step.flight) for step in steps)
    return Plan(out, 1, steps, shown)


class Heard(list[Event]):
    def __call__(self, event: Event) -> None:
        self.append(Event.from_line(event.to_line()))

    def ended(self) -> dict[str, str]:
        return {e.step: e.state for e in self if e.state in ("done", "known", "failed")}


@pytest.fixture(scope="module")
def done(tmp_path_factory, runs):
    """A survey with a flight that is fine, its twin, one without a reference, and one that fails."""
    after = Step("after", "", REPORT, "report", {"runs": (Made("broken evaluate"),)}, Config())
    steps = (step("broken", runs / "broken"), after, step("good", runs / "good"), step("bare", runs / "bare"))
    heard = Heard()
    what = plan(tmp_path_factory.mktemp("survey"), *steps, step("twin", runs / "good"))
    with pytest.raises(MinelocError, match="broken"):
        run_local(what, heard)
    return what, heard


def test_a_failed_step_stops_only_what_needs_it(done):
    what, heard = done
    ended = heard.ended()
    assert ended.pop("twin evaluate") in ("done", "known"), "it shares its result with the good one"
    assert ended == {"broken evaluate": "failed", "good evaluate": "done", "bare evaluate": "done"}
    assert (what.out / "runs" / "twin" / METRICS).exists()
    assert next(e.line for e in heard if e.state == "failed").count("\n") == 0


def test_the_second_time_no_process_is_started(done, monkeypatch):
    sound = replace(done[0], steps=done[0].steps[2:])
    monkeypatch.setattr(Pool, "_start", lambda _: pytest.fail("a process was started"))
    file = sound.out / "runs" / "good" / METRICS
    first, heard = file.stat(), Heard()
    made = run_local(sound, heard)
    assert set(heard.ended().values()) == {"known"}
    assert made["good evaluate"].output == made["twin evaluate"].output
    assert file.stat() == first
    file.unlink()
    run_local(sound, heard)
    assert json.loads(file.read_text())["trajectories"]


def test_one_changed_byte_of_a_source_makes_its_steps_run_again_and_no_others(tmp_path, runs):
    mine = write_synthetic_run(tmp_path / "mine", SyntheticRun(poses=100))
    what = plan(tmp_path / "out", step("good", runs / "good"), step("mine", mine))
    run_local(what, Heard())
    timing = (mine / "timing.json").read_text()
    (mine / "timing.json").write_text(timing.replace("1", "2", 1))
    heard = Heard()
    run_local(what, heard)
    assert heard.ended() == {"good evaluate": "known", "mine evaluate": "done"}


def test_a_folder_in_which_another_survey_is_at_work_is_refused(tmp_path, runs):
    what = plan(tmp_path, step("good", runs / "good"))
    with engine(what, Heard()), pytest.raises(OutputError, match="another run is at work here"):
        run_local(what, Heard())


def test_a_source_that_is_gone_is_said(tmp_path, runs):
    heard = Heard()
    with pytest.raises(MinelocError, match="cannot be read"):
        run_local(plan(tmp_path, step("gone", runs / "gone")), heard)
    assert heard.ended() == {"gone evaluate": "failed"}


def test_the_summary_has_the_figures_of_each_trajectory_and_dashes_without_a_reference(done):
    what = replace(done[0], runs=done[0].runs[2:4])
    rows = summary(what)
    assert [(row["flight"], row["trajectory"]) for row in rows] == [
        ("good", "smoothed"),
        ("good", "online"),
        ("bare", None),
    ]
    assert all(tuple(row) == KEYS for row in rows)
    metrics = json.loads((what.out / "runs/good" / METRICS).read_text())
    origin = next(a for a in metrics["trajectories"][0]["aligned"] if a["alignment"] == "origin")
    assert rows[0]["ape_rmse_m"] == pytest.approx(origin["ape"]["translation_m"]["rmse"], abs=1e-4)
    assert rows[0]["coverage_percent"] == 100.0
    assert summary(what, flight="bare") == rows[2:]
