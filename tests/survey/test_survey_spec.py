"""Survey files: what they say, and what is wrong with them, on one line."""

from pathlib import Path

import pytest

from mineloc.errors import ConfigError
from mineloc.survey.demo import DEMO, write_demo
from mineloc.survey.spec import read_survey, slug

GOOD = """
title = "Level 4"
methods = ["odometry", "loam", "odometry"]
workers = 3
[config.odometry]
use_imu = false
[config.evaluate]
max_time_difference_s = 0.02
[[flight]]
name = "north_1"
recording = "bags/north.mcap"
reference = "north.tum"
[flight.config.evaluate]
max_time_difference_s = 0.05
[[flight]]
name = "rehearsal"
mine = "demo"
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags" / "north.mcap").write_bytes(b"")
    (tmp_path / "north.tum").write_text("")
    return tmp_path


def survey(folder: Path, text: str, *overrides: str):
    (folder / "level4.toml").write_text(text)
    return read_survey(folder / "level4.toml", overrides)


def test_what_a_survey_says(folder):
    found = survey(folder, GOOD)
    north, rehearsal = found.flights
    assert (found.title, found.methods, found.workers) == ("Level 4", ("odometry", "loam"), 3)
    assert found.out == folder / "level4.results"
    assert (north.recording, north.reference, north.mine) == (folder / "bags/north.mcap", folder / "north.tum", None)
    assert (rehearsal.recording, rehearsal.mine) == (None, "demo")


def test_a_flight_goes_over_the_survey_and_an_override_over_both(folder):
    found = survey(folder, GOOD)
    assert [f.config.evaluate.max_time_difference_s for f in found.flights] == [0.05, 0.02]
    assert [f.config.odometry.use_imu for f in found.flights] == [False, False]
    assert found.config.evaluate.max_time_difference_s == 0.02
    set_ = survey(folder, GOOD, "evaluate.max_time_difference_s=0.5")
    assert [f.config.evaluate.max_time_difference_s for f in set_.flights] == [0.5, 0.5]
    assert set_.config.evaluate.max_time_difference_s == 0.5


def test_a_mine_in_a_file_goes_over_a_built_in_one(folder):
    (folder / "demo").mkdir()
    (folder / "plan.toml").write_text("")
    assert survey(folder, GOOD).flights[1].mine == folder / "demo"
    assert survey(folder, GOOD.replace('"demo"', '"plan.toml"')).flights[1].mine == folder / "plan.toml"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("title", "titel", "unknown key titel"),
        ("use_imu", "use_imv", "unknown key odometry.use_imv"),
        ("[flight.config.evaluate]", "[flight.config.evaluation]", "flight north_1: unknown key evaluation"),
        ("0.05", "-1", "evaluate.max_time_difference_s = -1"),
        ("workers = 3", "workers = 0", "workers = 0"),
        ('methods = ["odometry", "loam", "odometry"]', "methods = []", "methods"),
        ("bags/north.mcap", "bags/south.mcap", "recording = 'bags/south.mcap': no such file"),
        ('"demo"', '"mines/demo.ply"', "mine = 'mines/demo.ply': no such file"),
        ('mine = "demo"', "", "rehearsal: needs a recording or a mine"),
        ('mine = "demo"', 'mine = "demo"\nrecording = "bags/north.mcap"', "rehearsal: needs a recording or a mine"),
        ('"rehearsal"', '"North-1"', "flights 'north_1' and 'North-1'"),
        ('"rehearsal"', '"../rehearsal"', "flight.1.name = '../rehearsal'"),
        ('"rehearsal"', '""', "flight.1.name = ''"),
        ("[[flight]]", "[[flights]]", "flight"),
        ("title =", "title ==", "not TOML"),
    ],
)
def test_what_is_wrong_is_said_on_one_line(folder, old, new, said):
    assert old in GOOD
    with pytest.raises(ConfigError) as error:
        survey(folder, GOOD.replace(old, new))
    assert said in str(error.value)
    assert "level4.toml" in str(error.value)
    assert "\n" not in str(error.value)


MAPPED = """
methods = ["odometry", "map_tracking"]
[[flight]]
name = "mapping"
mine = "demo"
methods = []
[[flight]]
name = "night"
mine = "demo"
map = "level4"
[[map]]
name = "level4"
"""


def test_a_flight_is_localized_in_a_map_of_the_others(folder):
    found = survey(folder, MAPPED)
    assert [found.methods_of(flight) for flight in found.flights] == [(), ("odometry", "map_tracking")]
    assert found.flights[1].map == "level4"
    assert found.maps[0].flights == ("mapping",)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('map = "level4"', "", "flight night: map_tracking needs a map"),
        ('map = "level4"', 'map = "level5"', "no map 'level5'; expected level4"),
        ("[[map]]", '[[map]]\nflights = ["night"]', "flight night: map 'level4' is made of it"),
        ("methods = []", 'map = "level4"', "map level4: all flights are localized in it"),
        ('"map_tracking"', '"intersections_map"', "needs the intersections of map 'level4'"),
        ('map = "level4"', "methods = []", "no flight is localized"),
    ],
)
def test_a_method_that_knows_a_map_has_one(folder, old, new, said):
    assert old in MAPPED
    with pytest.raises(ConfigError) as error:
        survey(folder, MAPPED.replace(old, new, 1))
    assert said in str(error.value)


def test_a_survey_that_is_missing_is_said(tmp_path):
    with pytest.raises(ConfigError, match=r"gone\.toml: no such file"):
        read_survey(tmp_path / "gone.toml")


def test_names_of_flights_become_keys_of_prefect():
    assert slug("North_1 (second).Try") == "north-1-second-try"


def test_the_demonstration_is_a_survey_of_two_different_flights(tmp_path):
    found = read_survey(write_demo(tmp_path))
    assert found.out.resolve() == tmp_path.resolve()
    assert {f.mine for f in found.flights} == {"demo"}
    assert len({f.config.simulate.seed for f in found.flights}) == 2
    assert write_demo(tmp_path).read_text() == DEMO
