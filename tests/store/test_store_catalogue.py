"""The catalogue: what manifests and records say, as tables that can be thrown away; what changed between versions."""

import json
import shutil
from pathlib import Path

import polars as pl
import pytest

from mineloc.store.catalogue import METRICS, read_catalogue, rebuild
from mineloc.store.datasets import Datasets
from mineloc.store.difference import ALL, difference
from mineloc.store.record import Action
from mineloc.store.store import Store

pytestmark = pytest.mark.usefixtures("no_flush")


def write(path: Path, content: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def statistics(rmse: float) -> dict[str, float]:
    return {"rmse": rmse, "mean": rmse / 2, "max": 3 * rmse}


def evaluation(rmse: float | None) -> bytes:
    """As the evaluate stage writes it, cut to what the catalogue reads."""
    aligned = [
        {"alignment": kind, "ape": {"translation_m": statistics(rmse or 0), "rotation_deg": turn}, "rpe": []}
        for kind, turn in (("origin", statistics(1.0)), ("se3", None))
    ]
    rep = [{"percent_of_path": p, "literal": statistics(0.5) if p == 100 else None, "strict": None} for p in (20, 100)]
    one = {"aligned": aligned, "rep": rep, "segments": {"percent": None}, "coverage": {"time": 0.75, "path": 1.0}}
    found = [{"name": name, **one} for name in ("smoothed", "online")]
    return json.dumps({"trusted_share": 0.5, "trajectories": [] if rmse is None else found}).encode()


def run(
    one: Datasets, recording: str, rmse: float | None, *, sequence: str | None = None, method="odometry", code="c"
) -> str:
    """The records of ingest, localize and evaluate, as a survey leaves them; the run's digest."""

    def stage(name: str, inputs: dict[str, str], content: bytes, **more: str) -> str:
        named = {key: ((key, digest),) for key, digest in inputs.items()}
        arguments = {"out": "x", **more}
        action = Action(stage=name, schema=1, code=code, arguments=arguments, config={"s": {"k": 1}}, inputs=named)
        return one.store.run(action, lambda work: write(work / "out", content)).output.digest

    told = {"recording": recording} | ({} if sequence is None else {"sequence": sequence})
    flight = stage("ingest", told, f"flight of {told}".encode())
    made = stage("localize", {"flight": flight}, f"{flight} {method} {code} {rmse}".encode(), method=method)
    stage("evaluate", {"run": made}, evaluation(rmse))
    return made


@pytest.fixture
def datasets(tmp_path):
    return Datasets(Store(tmp_path / "store"))


REPORT = {
    "schema": "mineloc.health/1",
    "duration_s": 61.5,
    "recovered": False,
    "sensor": "VLP-16",
    "findings": [{"severity": "info"}, {"severity": "warning"}],
}


def test_the_flights_of_all_versions_with_what_their_reports_say(datasets, tmp_path):
    first = datasets.add("mine", {"a": write(tmp_path / "a.mcap", b"1")}, health={"a": REPORT})
    second = datasets.add("mine", {"b": write(tmp_path / "b.mcap", b"22")})
    other = datasets.add("other", {"a": write(tmp_path / "a.mcap", b"1")}, health={"a": REPORT | {"recovered": True}})
    flights = rebuild(datasets).flights
    rows = {(row["dataset"], row["version"], row["flight"]): row for row in flights.iter_rows(named=True)}
    assert rows.keys() == {
        ("mine", first.id, "a"),
        ("mine", second.id, "a"),
        ("mine", second.id, "b"),
        ("other", other.id, "a"),
    }
    a, b = rows["mine", second.id, "a"], rows["mine", second.id, "b"]
    assert (a["duration_s"], a["sensor"], a["health"], a["bytes"], a["file"]) == (
        61.5,
        "VLP-16",
        "warning",
        1,
        "a.mcap",
    )
    assert (b["duration_s"], b["sensor"], b["health"], b["bytes"]) == (None, None, None, 2)
    assert rows["other", other.id, "a"]["health"] == "recovered"


def test_the_figures_of_runs_belong_to_every_version_with_their_flight(datasets, tmp_path):
    first = datasets.add("mine", {"a": write(tmp_path / "a.mcap", b"1")})
    second = datasets.add("mine", {"b": write(tmp_path / "b.mcap", b"2")})
    a, b = (one.sha256 for one in second.recordings)
    made = run(datasets, a, 0.125)
    run(datasets, b, None, method="loam")
    run(datasets, "e" * 64, 9.0)
    run(datasets, a, 9.0, sequence="d" * 64)
    runs = rebuild(datasets).runs
    assert set(runs["version"]) == {first.id, second.id}
    of_a = runs.filter((pl.col("version") == second.id) & (pl.col("flight") == "a"))
    assert of_a.height == 4, "two trajectories, two alignments"
    row = of_a.row(0, named=True)
    assert (row["run"], row["method"], row["code"], row["sha256"]) == (made, "odometry", "c", a)
    assert [row[name] for name in METRICS] == [0.125, 0.375, 1.0, 0.25, None, 75.0, 50.0]
    assert row["utc"].startswith("20")
    of_b = runs.filter(pl.col("flight") == "b").row(0, named=True)
    assert (of_b["method"], of_b["rmse_m"], of_b["trajectory"], of_b["trusted_percent"]) == ("loam", None, None, 50.0)
    assert 9.0 not in runs["rmse_m"].to_list()


def test_it_is_made_anew_from_manifests_and_records_alone(datasets, tmp_path):
    version = datasets.add("mine", {"a": write(tmp_path / "a.mcap", b"1")}, health={"a": REPORT})
    run(datasets, version.recordings[0].sha256, 0.5)
    before = rebuild(datasets)
    folder = tmp_path / "store" / "catalogue"
    kept = read_catalogue(datasets)
    assert kept.flights.equals(before.flights)
    assert kept.runs.equals(before.runs)
    shutil.rmtree(folder)
    again = read_catalogue(Datasets(Store(tmp_path / "store")))
    assert again.flights.equals(before.flights)
    assert again.runs.equals(before.runs)
    assert (before.flights.height, before.runs.height) == (1, 4)
    (folder / "runs.parquet").write_bytes(b"nonsense")
    assert read_catalogue(datasets).runs.equals(before.runs)
    pl.DataFrame({"other": [1]}).write_parquet(folder / "flights.parquet")
    assert read_catalogue(datasets).flights.equals(before.flights)


def test_an_empty_store_has_empty_tables(datasets):
    found = rebuild(datasets)
    assert (found.flights.height, found.runs.height) == (0, 0)
    assert read_catalogue(datasets).runs.schema == found.runs.schema


def test_what_changed_between_versions_and_what_that_did_to_the_figures(datasets, tmp_path):
    given = {flight: write(tmp_path / f"{flight}.mcap", flight.encode()) for flight in "abc"}
    before = datasets.add("mine", given)
    datasets.remove("mine", ["c"])
    datasets.add("mine", {"a": write(tmp_path / "a2.mcap", b"better")}, replace=True)
    after = datasets.add("mine", {"d": write(tmp_path / "d.mcap", b"d")})
    for flight, rmse in (("a", 0.4), ("b", 0.2)):
        run(datasets, before.flights()[flight].sha256, rmse)
    run(datasets, after.flights()["a"].sha256, 0.1)
    run(datasets, after.flights()["d"].sha256, 0.3, method="loam")
    found = difference(datasets, f"mine@{before.id}", "mine")
    assert ([r.flight for r in found.added], [r.flight for r in found.removed]) == (["d"], ["c"])
    assert [(was.sha256, now.sha256) for was, now in found.changed] == [
        (before.flights()["a"].sha256, after.flights()["a"].sha256)
    ]
    rmse = {(d.flight, d.trajectory, d.alignment): d for d in found.deltas if d.metric == "rmse_m"}
    assert len(rmse) == 8
    of_a, of_all = rmse["a", "smoothed", "se3"], rmse[ALL, "smoothed", "se3"]
    assert (of_a.method, of_a.before, of_a.after, of_a.change) == ("odometry", 0.4, 0.1, pytest.approx(-0.3))
    assert (of_all.before, of_all.after) == (pytest.approx(0.3), pytest.approx(0.15))
    assert {d.metric for d in found.deltas} == {"rmse_m", "max_m"}, "what is equal is not told"
    back = difference(datasets, "mine", f"mine@{before.id}")
    assert (back.added, back.removed) == (found.removed, found.added)
    none = difference(datasets, "mine", "mine")
    assert (none.added, none.removed, none.changed, none.deltas) == ((), (), (), ())


def test_of_several_runs_of_a_method_the_newest_counts(datasets, tmp_path, monkeypatch):
    before = datasets.add("mine", {"a": write(tmp_path / "a.mcap", b"1")})
    after = datasets.add("mine", {"a": write(tmp_path / "a.mcap", b"2")}, replace=True)
    run(datasets, before.recordings[0].sha256, 0.5)
    made = "mineloc.store.record._circumstances"
    for utc, rmse, code in (("2031", 0.25, "new"), ("2030", 0.75, "old")):
        monkeypatch.setattr(made, lambda utc=utc: {"utc": utc})
        run(datasets, after.recordings[0].sha256, rmse, code=code)
    found = difference(datasets, f"mine@{before.id}", "mine")
    assert {(d.before, d.after) for d in found.deltas if d.metric == "rmse_m"} == {(0.5, 0.25)}
