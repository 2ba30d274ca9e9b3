"""The plan of a survey: which stage on what, after what, and what each result depends on."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mineloc.config import Config, layered_config
from mineloc.localize import METHODS
from mineloc.stages.stage import Input, Job
from mineloc.store.objects import Ref
from mineloc.survey.methods import KNOW_A_MAP
from mineloc.survey.plan import Made, plan_survey
from mineloc.survey.registry import DATABASE, EVALUATE, INGEST, LOCALIZE, RECONSTRUCT, RECORD, REPORT, SIMULATE
from mineloc.survey.spec import Flight, Map, Survey

STAGES = (SIMULATE, INGEST, RECONSTRUCT, DATABASE, LOCALIZE, EVALUATE, RECORD, REPORT)


def flight(name: str, **what: object) -> Flight:
    nothing = Flight(name, recording=None, sequence=None, mine=None, graph=None, reference=None, config=Config())
    return replace(nothing, **(what or {"mine": "demo"}))


def survey(*flights: Flight, methods: tuple[str, ...] = ("odometry",)) -> Survey:
    return Survey(Path("s.toml"), "t", Path("out"), methods, 2, flights, Config())


@given(
    kinds=st.lists(st.booleans(), min_size=1, max_size=4),
    methods=st.lists(st.sampled_from(["a", "b", "c"]), min_size=1, max_size=3, unique=True),
)
def test_every_step_comes_after_what_it_needs_and_has_a_place_of_its_own(kinds, methods):
    flights = [
        flight(f"f{i}", **({"mine": "demo"} if made else {"recording": Path("r")})) for i, made in enumerate(kinds)
    ]
    plan = plan_survey(survey(*flights, methods=tuple(methods)))
    seen: set[str] = set()
    for step in plan.steps:
        assert set(step.needs()) <= seen
        assert step.name not in seen
        seen.add(step.name)
    assert len({step.to for step in plan.steps}) == len(plan.steps)
    assert len(plan.steps) == sum(2 if made else 1 for made in kinds) + 3 * len(kinds) * len(methods) + 1
    assert len(plan.runs) == len(kinds) * len(methods)


def test_what_a_flight_brings_along_is_read_where_it_matters():
    what = {"recording": Path("r.bag"), "sequence": Path("s.toml"), "reference": Path("t.tum")}
    plan = plan_survey(survey(flight("f", **what)))
    assert plan.step("f ingest").inputs == {"recording": Path("r.bag"), "sequence": Path("s.toml")}
    assert plan.step("f evaluate odometry").inputs["reference"] == Path("t.tum")
    plan = plan_survey(survey(flight("f", mine=Path("m.ply"), graph=Path("g.json"))))
    assert plan.step("f simulate").inputs == {"mine": Path("m.ply"), "graph": Path("g.json")}
    assert plan.step("f ingest").inputs == {"recording": Made("f simulate")}


def test_a_map_is_made_of_its_flights_and_targets():
    maps = (Map("m", ("b", "a"), "odometry_loops", Path("t.csv"), None, intersections=True),)
    plan = plan_survey(replace(survey(flight("a"), flight("b")), maps=maps))
    step = plan.step("m reconstruct")
    assert step.needs() == ["b ingest", "a ingest"]
    assert step.inputs["control"] == Path("t.csv")
    assert "observations" not in step.inputs
    assert step.to == "maps/m"
    assert plan.step("m database").needs() == ["m reconstruct"]
    assert plan.step("m database").to == "maps/m.intersections.mcap"
    assert plan.steps[-1].needs() == ["a localize odometry", "b localize odometry"]


def test_a_flight_is_localized_in_the_map_of_others():
    maps = (Map("m", ("a",), "odometry_loops", None, None, intersections=True),)
    known = flight("b", recording=Path("b.mcap"), map="m", methods=("odometry", "map_tracking", "intersections_map"))
    plan = plan_survey(replace(survey(flight("a", mine="demo", methods=()), known), maps=maps))
    assert plan.step("b localize odometry").needs() == ["b ingest"]
    assert plan.step("b localize map_tracking").needs() == ["b ingest", "m reconstruct", "m database"]
    assert plan.step("b localize intersections_map").needs() == ["b ingest", "m database"]
    # the recording shows beside what was recognised what the database knew of it
    for method, known_to in (("odometry", []), ("map_tracking", ["m database"]), ("intersections_map", ["m database"])):
        assert plan.step(f"b record {method}").needs() == [f"b localize {method}", "b ingest", *known_to]
    assert [run.method for run in plan.runs] == ["odometry", "map_tracking", "intersections_map"]
    assert plan.steps[-1].needs() == [f"b localize {run.method}" for run in plan.runs]
    seen: set[str] = set()
    for step in plan.steps:
        assert set(step.needs()) <= seen
        seen.add(step.name)


def test_plans_know_which_methods_know_a_map():
    assert {name for name, method in METHODS.items() if method.tracks is not None} == KNOW_A_MAP


def test_the_report_reads_all_runs_in_order():
    plan = plan_survey(survey(flight("a"), flight("b"), methods=("x", "y")))
    assert plan.steps[-1].needs() == ["a localize x", "a localize y", "b localize x", "b localize y"]
    assert plan.report == Path("out/report/report.html")


def job(stage, config: Config, digest: str = "d") -> Job:
    given = {"run": Input(Path("here/f.mcap"), Ref(digest, "file", 1), is_source=False)}
    return Job(stage, "out", given, {"method": "odometry"}, config)


CHANGES = {
    "simulate": "simulate.seed=7",
    "ingest": "ingest.gap_factor=3",
    "sweep": "sweep.max_range_m=55",
    "keyframe": "keyframe.distance_m=2",
    "odometry": "odometry.use_imu=false",
    "loam": "loam.huber_m=0.3",
    "evaluate": "evaluate.max_time_difference_s=0.03",
    "report": 'report.title="other"',
    "view": "view.map_points=5000",
}


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
@pytest.mark.parametrize("section", CHANGES)
def test_a_stage_depends_on_its_own_sections_and_on_no_others(stage, section):
    changed = layered_config([], [CHANGES[section]], where="test")
    assert changed != Config()
    same = job(stage, changed).action().key == job(stage, Config()).action().key
    assert same == (section not in stage.sections)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_a_stage_depends_on_its_input_s_content_and_name_but_not_on_where_it_lies(stage):
    one = job(stage, Config())
    moved = replace(one, inputs={"run": Input(Path("/elsewhere/f.mcap"), Ref("d", "file", 1), is_source=True)})
    renamed = replace(one, inputs={"run": Input(Path("here/g.mcap"), Ref("d", "file", 1), is_source=False)})
    assert moved.action().key == one.action().key
    assert renamed.action().key != one.action().key
    assert job(stage, Config(), "e").action().key != one.action().key


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_every_stage_exists_and_names_sections_that_exist(stage):
    assert callable(stage.function())
    assert set(stage.sections) <= set(Config.model_fields)


def test_every_section_is_read_by_some_stage():
    assert {name for stage in STAGES for name in stage.sections} == set(Config.model_fields)
