"""The dataset commands: what they print, what they say when something is wrong, and what they leave behind."""

import json
import subprocess
import sys
from pathlib import Path

import driver_clouds as drivers
import pytest
import recording_files as files
from driver_clouds import vlp16_sweep
from recording_files import CLOUD, START_NS, STEP_NS

from mineloc.cli import main
from mineloc.store.datasets import Datasets

pytestmark = pytest.mark.usefixtures("no_flush")


def recording(path: Path, *, seed: int = 0, sweeps: int = 5) -> Path:
    entries = []
    for k in range(sweeps):
        sweep = vlp16_sweep(START_NS + k * STEP_NS, columns=20, seed=seed + k)
        entries.append(("/velodyne_points", CLOUD, sweep.end_ns + 2_000_000, drivers.velodyne(sweep)))
    return files.write_mcap(path, entries)


class Command:
    """Runs `mineloc dataset` in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch = monkeypatch
        self._capsys = capsys
        self.err = ""

    def __call__(self, *words: object, code: int = 0) -> str:
        self._monkeypatch.setattr(sys, "argv", ["mineloc", "dataset", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            main()
        told = self._capsys.readouterr()
        self.err = told.err
        assert (end.value.code or 0) == code, told
        if code == 1:
            assert told.err.startswith("mineloc: ")
            assert told.err.strip().count("\n") == 0
        return told.out

    def json(self, *words: object, code: int = 0):
        return json.loads(self(*words, "--json", code=code))


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINELOC_STORE", "store")
    monkeypatch.setenv("COLUMNS", "200")
    return Command(monkeypatch, capsys)


def plain(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_recordings_are_added_with_their_health(command, tmp_path):
    recording(tmp_path / "n1.mcap")
    recording(tmp_path / "s1.mcap", seed=50, sweeps=7)
    out = command("add", "level4", "north=n1.mcap", "s1.mcap", "--note", "after the fire door")
    assert "level4@" in out
    assert "the first version: after the fire door" in out
    north, south = ([word for word in line.split() if word != "-"] for line in out.splitlines() if ".mcap" in line)
    assert (north[0], north[1], south[0]) == ("north", "n1.mcap", "s1")
    assert "10.00" in north
    assert north[-1] in ("good", "warning")
    shown = command.json("show", "level4")
    assert [one["flight"] for one in shown["recordings"]] == ["north", "s1"]
    datasets = Datasets.open(Path("store"))
    report = datasets.health(datasets.get("level4").flights()["s1"])
    assert report is not None
    assert report["topics"][0]["messages"] == 7
    assert "north" in command("show", "level4", "--log", "--paths")
    (listed,) = command.json("list")
    assert (listed["dataset"], listed["flights"], listed["versions"]) == ("level4", ["north", "s1"], 1)
    assert "level4" in command("list")


def test_the_health_of_a_recording_is_found_again(command, tmp_path, monkeypatch):
    recording(tmp_path / "n1.mcap")
    told = plain(tmp_path / "x.toml", b'[lidar]\nsensor = "VLP-16 of drone 2"\n')
    command("add", "level4", "n1.mcap", "--sequence", told)
    (one,) = Datasets.open(Path("store")).get("level4").recordings
    datasets = Datasets.open(Path("store"))
    assert (datasets.health(one) or {})["sensor"] == "VLP-16 of drone 2"
    from mineloc.survey.health_check import health_report

    monkeypatch.setattr("mineloc.stages.ingest.ingest", lambda *_, **__: pytest.fail("ingested again"))
    again = health_report(datasets.store, "n1", datasets.path(one), sequence=datasets.sequence_path(one))
    assert again == datasets.health(one)


def test_what_is_no_recording_is_refused_before_anything_is_kept(command, tmp_path):
    recording(tmp_path / "n1.mcap")
    plain(tmp_path / "bad.mcap", b"no recording")
    command("add", "level4", "n1.mcap", "bad.mcap", code=1)
    assert "bad.mcap" in command.err
    assert command.json("list") == []
    command("add", "level4", "bad.mcap", "--no-health")
    assert "–" in command("show", "level4")


def test_versions_change_and_the_difference_is_told(command, tmp_path):
    plain(tmp_path / "a.mcap", b"a")
    plain(tmp_path / "b.mcap", b"b")
    first = command.json("add", "mine", "a.mcap", "b.mcap", "--no-health")
    command("tag", "mine", "first")
    plain(tmp_path / "a.mcap", b"other")
    command("add", "mine", "a.mcap", "--no-health", code=1)
    assert "flight a: is there with other content" in command.err
    command("add", "mine", "a.mcap", "c=b.mcap", "--no-health", "--replace")
    last = command.json("remove", "mine", "b")
    found = command.json("diff", "mine@first", "mine")
    assert (found["before"], found["after"]) == (first["version"], last["version"])
    assert [one["flight"] for one in found["added"]] == ["c"]
    assert [one["flight"] for one in found["removed"]] == ["b"]
    assert [one["after"]["flight"] for one in found["changed"]] == ["a"]
    out = command("diff", "mine@first", "mine")
    assert [line.split()[0] for line in out.splitlines() if line.split()[1:2] in (["a"], ["b"], ["c"])] == [
        "added",
        "removed",
        "changed",
    ]
    command("tag", "mine", "first", code=1)
    assert "names version" in command.err
    command("tag", "mine", "first", "--move")
    command("tag", "mine", "first", "--delete")
    command("show", "mine@first", code=1)
    assert "no such version; expected latest, a tag (no tags)" in command.err
    assert command.json("runs", "mine") == []
    command("runs", "mine")


def test_manifests_in_git_say_what_the_store_must_hold(command, tmp_path):
    plain(tmp_path / "a.mcap", b"a")
    command("add", "mine", "a.mcap", "--no-health", "--manifest", "datasets/mine/1.json")
    command("tag", "mine", "one", "--manifest", "datasets/mine/one.json")
    assert (tmp_path / "datasets/mine/1.json").read_bytes() == (tmp_path / "datasets/mine/one.json").read_bytes()
    assert command("verify", "--manifest", "datasets/mine/1.json") == "sound\n"
    plain(tmp_path / "b.mcap", b"b")
    other = command.json("add", "mine", "b.mcap", "--no-health", "--store", "other")
    command("show", "mine", "--store", "other", "--manifest", "datasets/mine/2.json")
    out = command("verify", "--manifest", "datasets/mine/2.json", code=1)
    assert out == f"missing {other['version']}\n"
    (tmp_path / "datasets/mine/1.json").write_text("{}")
    command("verify", "--manifest", "datasets/mine/1.json", code=1)
    assert "no manifest" in command.err


def test_damage_is_named_and_mended(command, tmp_path):
    plain(tmp_path / "a.mcap", b"a")
    version = command.json("add", "mine", "a.mcap", "--no-health")
    command("export", "mine", "--out", "mine.tar")
    assert command("verify") == command("verify", "mine") == "sound\n"
    digest = version["recordings"][0]["sha256"]
    path = tmp_path / "store" / "objects" / digest[:2] / digest
    path.chmod(0o644)
    path.write_bytes(b"b")
    assert command("verify", code=1) == f"damaged {digest}\n"
    assert "1 damaged" in command.err
    assert command.json("verify", "mine", code=1)["damaged"] == [digest]
    assert "mine" in command("import", "mine.tar")
    assert command("verify") == "sound\n"


def test_a_dataset_is_forgotten_and_collected(command, tmp_path):
    plain(tmp_path / "a.mcap", b"a")
    command("add", "mine", "a.mcap", "--no-health")
    command("forget", "mine")
    assert command("gc").startswith("0 objects")
    would = command.json("gc", "--grace-h", 0, "--dry-run")
    assert (len(would["objects"]), would["dry_run"]) == (2, True)
    assert command("gc", "--grace-h", 0).startswith("2 objects")
    command("show", "mine", code=1)
    assert "no dataset 'mine'" in command.err


def test_a_dataset_is_carried_out_and_taken_in(command, tmp_path):
    plain(tmp_path / "a.mcap", b"a")
    version = command.json("add", "mine", "a.mcap", "--no-health")["version"]
    told = command.json("export", "mine", "--out", "mine.tar")
    assert (told["version"], told["members"]) == (version, 2)
    command("export", "mine", "--out", "mine.tar", code=1)
    assert "exists" in command.err
    assert command.json("import", "mine.tar", "--store", "b")["version"] == version
    assert command.json("import", "mine.tar", "--store", "b", "--as", "copy")["dataset"] == "copy"
    (tmp_path / "mine.tar").write_bytes((tmp_path / "mine.tar").read_bytes()[:-700])
    command("import", "mine.tar", "--store", "c", code=1)
    assert "damaged or incomplete" in command.err
    assert command.json("list", "--store", "c") == []


def test_a_dataset_is_pushed_and_pulled_and_the_remote_remembered(command, tmp_path):
    plain(tmp_path / "a.mcap", b"a")
    version = command.json("add", "mine", "a.mcap", "--no-health")["version"]
    command("push", "mine", code=1)
    assert "has no remote yet" in command.err
    url = f"file://{tmp_path}/nas"
    assert command.json("push", "mine", "--remote", url)["objects"] == 2
    assert command.json("push", "mine")["objects"] == 0
    assert command.json("pull", "mine", "--remote", url, "--store", "b") == {
        "remote": url,
        "version": version,
        "objects": 2,
    }
    command("pull", "mine", "--as", "theirs", "--store", "b")
    assert [one["dataset"] for one in command.json("list", "--store", "b")] == ["mine", "theirs"]


def test_bad_input_is_told_on_one_line(command, tmp_path):
    command("list", code=1)
    assert "no store" in command.err
    assert list(tmp_path.iterdir()) == []
    command("add", "mine", "gone.mcap", code=1)
    assert "gone.mcap: cannot be read" in command.err
    plain(tmp_path / "a.mcap", b"a")
    command("add", "../mine", "a.mcap", "--no-health", code=1)
    command("add", "mine", "x/y=a.mcap", "--no-health", code=1)
    command("add", "mine", "a.mcap", "a=a.mcap", "--no-health", code=2)
    command("verify", "mine", "--manifest", "x.json", code=2)
    plain(tmp_path / "odd=name.mcap", b"a")
    assert command.json("add", "mine", "odd=odd=name.mcap", "--no-health")["recordings"][0]["file"] == "odd=name.mcap"
    command("add", "mine", "odd=name.mcap", "--no-health", code=1)
    assert "odd=name" in command.err


def test_help_loads_nothing_heavy():
    program = (
        "import sys, mineloc.cli\n"
        "heavy = {'polars', 'numba', 'fsspec', 'open3d', 'prefect', 'rerun', 'gtsam'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_every_command_has_help_with_an_example(command):
    names = ["add", "remove", "list", "show", "diff", "tag", "forget", "runs"]
    for name in [*names, "verify", "gc", "export", "import", "push", "pull"]:
        assert f"E.g. dataset {name}" in " ".join(command(name, "--help").replace("│", " ").split())
