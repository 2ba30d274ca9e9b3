"""Surveys on a version of a dataset: its flights, refined by the file, with results in the dataset's store."""

from pathlib import Path

import driver_clouds as drivers
import pytest
import recording_files as files
from driver_clouds import vlp16_sweep
from recording_files import CLOUD, START_NS, STEP_NS

from mineloc.errors import ConfigError
from mineloc.store.datasets import Datasets
from mineloc.store.store import Store
from mineloc.survey.health_check import health_report
from mineloc.survey.plan import plan_survey
from mineloc.survey.spec import read_survey

SURVEY = """
dataset = "level4@good"
store = "kept"
methods = ["odometry"]
[[flight]]
name = "rehearsal"
mine = "demo"
[[flight]]
name = "north"
reference = "north.tum"
methods = ["loam"]
[flight.config.evaluate]
max_time_difference_s = 0.5
"""


@pytest.fixture
def folder(tmp_path):
    datasets = Datasets(Store(tmp_path / "kept"))
    for name in ("n1.mcap", "s1.mcap", "late.mcap", "x.toml", "north.tum"):
        (tmp_path / name).write_text(name)
    datasets.add("level4", {"north": tmp_path / "n1.mcap"}, sequence=tmp_path / "x.toml")
    datasets.add("level4", {"south": tmp_path / "s1.mcap"})
    datasets.tag("level4", "good")
    datasets.add("level4", {"late": tmp_path / "late.mcap"})
    return tmp_path


def survey(folder: Path, text: str = SURVEY):
    (folder / "survey.toml").write_text(text)
    return read_survey(folder / "survey.toml")


def test_the_flights_of_the_version_come_first_refined_by_the_file(folder):
    found = survey(folder)
    assert [flight.name for flight in found.flights] == ["north", "south", "rehearsal"]
    north, south, rehearsal = found.flights
    assert north.recording is not None
    assert (north.recording.name, north.recording.read_text()) == ("n1.mcap", "n1.mcap")
    assert north.sequence is not None
    assert (north.sequence.name, north.sequence.read_text()) == ("sequence.toml", "x.toml")
    assert (north.reference, north.methods) == (folder / "north.tum", ("loam",))
    assert north.config.evaluate.max_time_difference_s == 0.5
    assert south.recording is not None
    assert (south.recording.read_text(), south.sequence, south.methods) == ("s1.mcap", None, None)
    assert (rehearsal.recording, rehearsal.mine) == (None, "demo")


def test_results_are_kept_with_the_dataset(folder):
    plan = plan_survey(survey(folder))
    assert plan.store == folder / "kept"
    assert plan.state == folder / "survey.results" / ".mineloc"
    alone = plan_survey(survey(folder, '[[flight]]\nname = "a"\nmine = "demo"'))
    assert alone.store == alone.state / "store"


def test_without_a_store_in_the_file_the_one_of_the_commands_is_meant(folder, monkeypatch):
    text = 'dataset = "level4"'
    monkeypatch.delenv("MINELOC_STORE", raising=False)
    with pytest.raises(ConfigError, match="no store"):
        survey(folder, text)
    monkeypatch.setenv("MINELOC_STORE", str(folder / "kept"))
    found = survey(folder, text)
    assert [flight.name for flight in found.flights] == ["late", "north", "south"]


def test_what_the_health_check_ingested_is_not_ingested_again(tmp_path):
    entries = []
    for k in range(5):
        sweep = vlp16_sweep(START_NS + k * STEP_NS, columns=20, seed=k)
        entries.append(("/velodyne_points", CLOUD, sweep.end_ns + 2_000_000, drivers.velodyne(sweep)))
    recording = files.write_mcap(tmp_path / "n1.mcap", entries)
    (tmp_path / "told.toml").write_text('[lidar]\nsensor = "x"\n')
    datasets = Datasets(Store(tmp_path / "kept"))
    sequence = datasets.keep_sequence(tmp_path / "told.toml")
    report = health_report(datasets.store, "north", recording, sequence=sequence)
    datasets.add("level4", {"north": recording}, sequence=tmp_path / "told.toml", health={"north": report})
    plan = plan_survey(survey(tmp_path, 'dataset = "level4"\nstore = "kept"'))
    store = Store(plan.store)
    assert plan.step("north ingest").job(plan, store, {}).lookup(store) is not None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("level4@good", "level4@best", "no such version; expected latest, a tag (good)"),
        ("level4@good", "level5", "no dataset 'level5'; expected one of: level4"),
        ('"kept"', '"lost"', "no store"),
        ("store", "stores", "unknown key stores"),
        ('dataset = "level4@good"', "", "a store without a dataset"),
        ('reference = "north.tum"', 'recording = "s1.mcap"', "flight north: its recording comes from dataset"),
        ('reference = "north.tum"', 'sequence = "x.toml"', "flight north: its recording comes from dataset"),
        ('"rehearsal"', '"South"', "flights 'south' and 'South'"),
    ],
)
def test_what_is_wrong_is_said_before_any_work(folder, old, new, said):
    assert old in SURVEY
    with pytest.raises(ConfigError) as error:
        survey(folder, SURVEY.replace(old, new, 1))
    assert said in str(error.value)
    assert "survey.toml" in str(error.value)
    assert "\n" not in str(error.value)
    assert not (folder / "survey.results").exists()


def test_a_damaged_recording_is_said_before_any_work(folder):
    datasets = Datasets(Store(folder / "kept"))
    one = datasets.get("level4@good").flights()["south"]
    path = datasets.store.objects.path(one.sha256)
    path.chmod(0o644)
    path.write_bytes(b"x")
    with pytest.raises(ConfigError, match="gone or damaged"):
        survey(folder)


def test_a_survey_without_any_flight_is_refused(folder):
    with pytest.raises(ConfigError, match="no flight"):
        survey(folder, 'title = "nothing"')
