"""Whole surveys with all stages: equal results wherever they are made, and the demonstration."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_survey import fingerprint

from mineloc.survey.pool import THREAD_VARIABLES

pytestmark = pytest.mark.slow

SURVEY = """
workers = 1
methods = ["odometry", "loam"]
[config.simulate]
hover_s = 1.0
length_m = 20.0
[[flight]]
name = "loop"
mine = "loop"
"""


def mineloc(*args: str, cwd: Path, **environment: str) -> str:
    command = [sys.executable, "-P", "-m", "mineloc.cli", *args]
    ran = subprocess.run(command, cwd=cwd, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


MAPPED = """
workers = 2
[config.simulate]
hover_s = 1.0
grid_e_m = 1000.0
target_every_m = 40.0
[[flight]]
name = "mapping"
mine = "demo"
methods = []
[flight.config.simulate]
length_m = 260.0
seed = 3
[[flight]]
name = "night"
mine = "demo"
map = "level"
methods = ["intersections", "intersections_map", "map_tracking"]
[flight.config.simulate]
length_m = 150.0
seed = 4
[[map]]
name = "level"
intersections = true
"""


@pytest.mark.parametrize("survey", [SURVEY, MAPPED], ids=["odometry", "map"])
def test_results_depend_on_nothing_but_the_survey(tmp_path, survey):
    (tmp_path / "a").mkdir()
    (tmp_path / "b" / "deeper").mkdir(parents=True)
    for folder, seed, threads in ((tmp_path / "a", "1", "1"), (tmp_path / "b" / "deeper", "2", "2")):
        (folder / "s.toml").write_text(survey)
        mineloc("run", "s.toml", "--local", cwd=folder, PYTHONHASHSEED=seed, **dict.fromkeys(THREAD_VARIABLES, threads))
    one, two = fingerprint(tmp_path / "a" / "s.results"), fingerprint(tmp_path / "b" / "deeper" / "s.results")
    assert len(one) > 10
    assert one == two


def test_the_demonstration_executes_everything_once(tmp_path):
    first = mineloc("demo", "--local", cwd=tmp_path)
    steps = first.count("✓")
    assert steps == 11
    assert (tmp_path / "demo" / "report" / "report.html").exists()
    second = mineloc("demo", "--local", cwd=tmp_path)
    assert (second.count("✓"), second.count(" known")) == (0, steps)


def test_another_flight_is_localized_in_the_map_of_the_first(tmp_path):
    (tmp_path / "s.toml").write_text(MAPPED)
    mineloc("run", "s.toml", "--local", cwd=tmp_path)
    out = tmp_path / "s.results"
    for method in ("intersections_map", "map_tracking"):
        scores = json.loads((out / "runs" / f"night-{method}" / "metrics.json").read_text())
        (rmse,) = (
            row["ape"]["translation_m"]["rmse"]
            for row in scores["trajectories"][0]["aligned"]
            if row["alignment"] == "none"
        )
        # neither was told where the flight begins
        assert rmse < 0.15
    found = json.loads((out / "runs" / "night-intersections_map" / "metrics.json").read_text())["recognition"]
    assert found["wrong"] == 0
    assert found["accepted"] > 0
