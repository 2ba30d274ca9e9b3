"""What holds for datasets: lossless, immutable versions, the same ids everywhere, and clear words when not."""

import hashlib
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.errors import StoreError
from mineloc.store.datasets import Datasets
from mineloc.store.store import Store
from mineloc.store.versions import Recording, Version, parse_version, read_manifest

pytestmark = pytest.mark.usefixtures("no_flush")

CONTENT = st.binary(max_size=60)
FLIGHTS = st.dictionaries(st.sampled_from(["a", "b", "c", "d"]), CONTENT, min_size=1, max_size=4)


@pytest.fixture
def datasets(tmp_path):
    return Datasets(Store(tmp_path / "store"))


def files(folder: Path, contents: dict[str, bytes]) -> dict[str, Path]:
    folder.mkdir(parents=True, exist_ok=True)
    for flight, content in contents.items():
        (folder / f"{flight}.mcap").write_bytes(content)
    return {flight: folder / f"{flight}.mcap" for flight in contents}


def one(tmp_path: Path, content: bytes = b"points", name: str = "north.mcap") -> Path:
    (tmp_path / name).write_bytes(content)
    return tmp_path / name


@settings(max_examples=15, deadline=None)
@given(first=FLIGHTS, second=FLIGHTS)
def test_what_is_added_comes_back_byte_by_byte_and_is_kept_once(first, second, tmp_path_factory):
    root = tmp_path_factory.mktemp("law")
    datasets = Datasets(Store(root / "store"))
    datasets.add("mine", files(root / "1", first))
    version = datasets.add("mine", files(root / "2", second), replace=True)
    kept = first | second
    assert {r.flight: datasets.path(r).read_bytes() for r in version.recordings} == kept
    assert all(datasets.path(r).name == f"{r.flight}.mcap" for r in version.recordings)
    assert {r.flight: r.sha256 for r in version.recordings} == {
        f: hashlib.sha256(c).hexdigest() for f, c in kept.items()
    }
    contents = {*first.values(), *second.values()}
    assert len(datasets.store.objects.digests()) == len(contents) + len(datasets.versions("mine"))
    assert datasets.verify().is_sound


@settings(max_examples=15, deadline=None)
@given(contents=FLIGHTS, order=st.randoms())
def test_a_version_is_named_by_its_content_alone(contents, order, tmp_path_factory):
    root = tmp_path_factory.mktemp("law")
    shuffled = list(contents.items())
    order.shuffle(shuffled)
    here = Datasets(Store(root / "here")).add("mine", files(root / "a", contents))
    there = Datasets(Store(root / "there")).add("mine", files(root / "b", dict(shuffled)))
    assert here.id == there.id == hashlib.sha256(here.manifest.encode()).hexdigest()
    assert parse_version(here.manifest, "") == here


def test_who_and_when_are_in_the_log_and_nowhere_else(datasets, tmp_path):
    first = datasets.add("mine", {"a": one(tmp_path)})
    second = datasets.add("mine", {"b": one(tmp_path, b"2")})
    datasets.tag("mine", "t")
    datasets.untag("mine", "t")
    log = datasets.refs.log("mine")
    assert [(m.ref, m.version, m.before) for m in log] == [
        ("latest", first.id, None),
        ("latest", second.id, first.id),
        ("tags/t", second.id, None),
        ("tags/t", None, second.id),
    ]
    assert all(m.who and m.node and m.utc.startswith("20") for m in log)
    assert log[0].utc[:10] not in second.manifest


def test_a_torn_line_of_the_log_spoils_no_other(datasets, tmp_path):
    for i in range(3):
        datasets.add("mine", {f"{i}": one(tmp_path, bytes([i]))})
    log = tmp_path / "store" / "refs" / "datasets" / "mine" / "log"
    log.write_bytes(log.read_bytes()[:-20])
    datasets.add("mine", {"3": one(tmp_path, b"3")})
    assert len(datasets.refs.log("mine")) == 3


def test_the_same_content_makes_no_new_version(datasets, tmp_path):
    first = datasets.add("mine", {"north": one(tmp_path)}, note="first")
    again = datasets.add("mine", {"north": one(tmp_path, name="renamed.mcap")}, note="again")
    assert again == first == datasets.get("mine")
    assert datasets.add("mine", {"north": one(tmp_path)}, health={"north": {"duration_s": 1.0}}).parent == first.id
    with_health = datasets.get("mine")
    assert datasets.add("mine", {"north": one(tmp_path)}, health={"north": {"duration_s": 2.0}}) == with_health
    assert datasets.health(with_health.recordings[0]) == {"duration_s": 1.0}


def test_other_content_under_a_known_flight_is_refused_and_leaves_nothing(datasets, tmp_path):
    first = datasets.add("mine", {"north": one(tmp_path)})
    before = datasets.store.objects.digests()
    with pytest.raises(StoreError, match="flight north: is there with other content") as error:
        datasets.add("mine", {"south": one(tmp_path, b"s", "s.mcap"), "north": one(tmp_path, b"other")})
    assert "\n" not in str(error.value)
    assert datasets.get("mine") == first
    assert datasets.store.objects.digests() == before
    assert list((tmp_path / "store" / "tmp").iterdir()) == []
    with pytest.raises(StoreError, match="other content"):
        datasets.refuse_other_content("mine", {"north": one(tmp_path, b"other")})
    datasets.refuse_other_content("mine", {"north": one(tmp_path), "south": one(tmp_path, b"s", "s.mcap")})
    second = datasets.add("mine", {"north": one(tmp_path, b"other")}, replace=True)
    assert (second.parent, datasets.path(second.recordings[0]).read_bytes()) == (first.id, b"other")
    assert datasets.path(first.recordings[0]).read_bytes() == b"points"


def test_another_sequence_file_is_other_content_too(datasets, tmp_path):
    told = one(tmp_path, b"[lidar]\n", "x.toml")
    first = datasets.add("mine", {"north": one(tmp_path)}, sequence=told)
    assert datasets.sequence_path(first.recordings[0]).read_bytes() == b"[lidar]\n"
    assert datasets.sequence_path(first.recordings[0]).name == "sequence.toml"
    assert datasets.add("mine", {"north": one(tmp_path)}) == first
    other = one(tmp_path, b"[imu]\n", "y.toml")
    with pytest.raises(StoreError, match="another sequence file"):
        datasets.add("mine", {"north": one(tmp_path)}, sequence=other)
    second = datasets.add("mine", {"north": one(tmp_path)}, sequence=other, replace=True)
    assert second.recordings[0].sequence != first.recordings[0].sequence


def test_a_rosbag2_folder_comes_back_and_has_the_same_name_inside_and_outside(datasets, tmp_path):
    bag = tmp_path / "bag"
    (bag / "sub").mkdir(parents=True)
    (bag / "metadata.yaml").write_text("version: 5")
    (bag / "sub" / "0.db3").write_bytes(b"x" * 100)
    (bag / "sub" / "1.db3").write_bytes(b"x" * 100)
    version = datasets.add("mine", {"north": bag})
    (recording,) = version.recordings
    assert (recording.kind, recording.file, recording.bytes) == ("folder", "bag", 210)
    path = datasets.path(recording)
    assert {p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file()} == {
        "metadata.yaml",
        "sub/0.db3",
        "sub/1.db3",
    }
    assert datasets.store.source(bag) == datasets.store.source(path) == recording.ref
    assert datasets.verify().is_sound


def test_flights_are_removed_from_the_next_version_only(datasets, tmp_path):
    first = datasets.add("mine", files(tmp_path, {"a": b"1", "b": b"2"}))
    second = datasets.remove("mine", ["a"], note="blurred")
    assert (list(second.flights()), second.parent, second.note) == (["b"], first.id, "blurred")
    with pytest.raises(StoreError, match="no flight 'a'; expected one of b"):
        datasets.remove("mine", ["a"])


def test_versions_are_found_by_tag_and_by_the_beginning_of_their_id(datasets, tmp_path):
    ids = [datasets.add("mine", {f"{i}": one(tmp_path, bytes([i]))}).id for i in range(3)]
    datasets.tag(f"mine@{ids[0]}", "2026-10")
    assert datasets.get("mine@2026-10").id == ids[0]
    assert [datasets.get(f"mine@{i[:10]}").id for i in ids] == ids
    assert datasets.get("mine").id == datasets.get("mine@latest").id == ids[2]
    with pytest.raises(StoreError, match=r"mine@2026-11: no such version; expected latest, a tag \(2026-10\)"):
        datasets.get("mine@2026-11")
    with pytest.raises(StoreError, match="no dataset 'mines'; expected one of: mine"):
        datasets.get("mines@latest")
    with pytest.raises(StoreError, match="no such version"):
        datasets.get(f"mine@{ids[0][:3]}")


def test_a_beginning_that_several_versions_share_is_refused(datasets, tmp_path, monkeypatch):
    monkeypatch.setattr("mineloc.store.dataset_reader.SHORTEST_ID", 1)
    ids = [datasets.add("mine", {f"{i}": one(tmp_path, bytes([i]))}).id for i in range(17)]
    shared = next(i[0] for i in ids if sum(j[0] == i[0] for j in ids) > 1)
    with pytest.raises(StoreError, match=r"the beginning of [2-9] versions"):
        datasets.get(f"mine@{shared}")


def test_a_tag_moves_only_when_told_and_latest_is_none(datasets, tmp_path):
    datasets.add("mine", {"a": one(tmp_path)})
    datasets.tag("mine", "good")
    second = datasets.add("mine", {"b": one(tmp_path, b"2")})
    with pytest.raises(StoreError, match="names version"):
        datasets.tag("mine", "good")
    assert datasets.tag("mine", "good", move=True) == second == datasets.get("mine@good")
    with pytest.raises(StoreError, match="is the newest version"):
        datasets.tag("mine", "latest")
    with pytest.raises(StoreError, match="no such tag; expected good"):
        datasets.untag("mine", "better")


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a b", "x" * 101, "a@b"])
def test_names_that_lead_elsewhere_are_refused(datasets, tmp_path, name):
    with pytest.raises(StoreError, match="choose another name"):
        datasets.add(name, {"a": one(tmp_path)})
    with pytest.raises(StoreError, match="choose another name"):
        datasets.add("mine", {name: one(tmp_path)})
    datasets.add("mine", {"a": one(tmp_path)})
    with pytest.raises(StoreError, match="choose another name"):
        datasets.tag("mine", name)


def test_a_recording_that_is_missing_or_changes_is_refused(datasets, tmp_path, monkeypatch):
    with pytest.raises(StoreError, match=r"gone\.mcap: cannot be read"):
        datasets.add("mine", {"a": tmp_path / "gone.mcap"})
    path = one(tmp_path)
    real = hashlib.sha256

    def write_meanwhile(*args):
        with path.open("ab") as f:
            f.write(b"more")
        return real(*args)

    monkeypatch.setattr("mineloc.store.digest.hashlib.sha256", write_meanwhile)
    with pytest.raises(StoreError, match="changed while it was copied"):
        datasets.store.add(path)
    monkeypatch.undo()
    assert datasets.store.objects.digests() == []


def test_a_damaged_recording_is_noticed_when_it_is_read_and_mended_by_adding_it_again(datasets, tmp_path):
    version = datasets.add("mine", {"a": one(tmp_path)})
    (recording,) = version.recordings
    path = datasets.path(recording)
    for place in (path, datasets.store.objects.path(recording.sha256)):
        before = place.stat()
        place.chmod(0o644)
        place.write_bytes(b"pointz")
        os.utime(place, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(StoreError, match="gone or damaged"):
        datasets.path(recording)
    assert datasets.add("mine", {"a": one(tmp_path)}) == version
    assert datasets.path(recording).read_bytes() == b"points"
    assert datasets.verify().is_sound


def test_a_damaged_reference_or_manifest_is_told(datasets, tmp_path):
    version = datasets.add("mine", {"a": one(tmp_path)})
    latest = tmp_path / "store" / "refs" / "datasets" / "mine" / "latest"
    good = latest.read_text()
    latest.write_text(good.replace("latest", "lat3st"))
    with pytest.raises(StoreError, match="a damaged reference"):
        datasets.get("mine")
    assert datasets.verify().refs == ("mine/latest",)
    latest.write_text(good)
    datasets.store.objects.path(version.id).unlink()
    with pytest.raises(StoreError, match="gone or damaged"):
        datasets.get("mine")
    assert datasets.verify().missing == (version.id,)
    assert datasets.lacking(version.id) == [version.id]


GOOD = Recording("a", "a.mcap", "0" * 64, 3, "file")


@pytest.mark.parametrize(
    "version",
    [
        Version("..", None, (GOOD,)),
        Version("mine", "beef", (GOOD,)),
        Version("mine", None, (GOOD, GOOD)),
        Version("mine", None, (Recording("b", "b", "0" * 64, 3, "file"), GOOD)),
        Version("mine", None, (Recording("a/..", "a.mcap", "0" * 64, 3, "file"),)),
        Version("mine", None, (Recording("a", "../a.mcap", "0" * 64, 3, "file"),)),
        Version("mine", None, (Recording("a", "..", "0" * 64, 3, "file"),)),
        Version("mine", None, (Recording("a", "a", "0" * 63, 3, "file"),)),
        Version("mine", None, (Recording("a", "a", "0" * 64, -3, "file"),)),
        Version("mine", None, (Recording("a", "a", "0" * 64, 3, "pipe"),)),  # type: ignore[arg-type]
        Version("mine", None, (Recording("a", "a", "0" * 64, 3, "file", health="x"),)),
    ],
)
def test_manifests_that_say_what_cannot_be_are_refused(version):
    assert parse_version(Version("mine", None, (GOOD,)).manifest, "") == Version("mine", None, (GOOD,))
    with pytest.raises(StoreError, match="no manifest"):
        parse_version(version.manifest, "here")


@pytest.mark.parametrize("text", ["", "{}", "[]", "nonsense", '{"schema": "mineloc.dataset/2"}'])
def test_other_texts_are_no_manifests(text, tmp_path):
    with pytest.raises(StoreError, match="no manifest"):
        parse_version(text, "here")
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(StoreError, match="no manifest"):
        read_manifest(tmp_path / "x.json")


def test_a_manifest_in_git_is_a_fact_a_line_and_the_same_version(datasets, tmp_path):
    version = datasets.add("mine", files(tmp_path, {"a": b"1", "b": b"2"}), note="Größe")
    (tmp_path / "m.json").write_bytes(version.file_text.encode())
    assert read_manifest(tmp_path / "m.json") == version
    assert len(version.file_text.splitlines()) > 20


def test_a_forgotten_dataset_is_gone_and_its_name_free(datasets, tmp_path):
    datasets.add("mine", {"a": one(tmp_path)})
    datasets.tag("mine", "t")
    datasets.forget("mine")
    assert datasets.list() == []
    with pytest.raises(StoreError, match="none yet"):
        datasets.get("mine")
    assert datasets.add("mine", {"a": one(tmp_path, b"other")}).parent is None


def test_a_store_that_is_not_there_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MINELOC_STORE", raising=False)
    with pytest.raises(StoreError, match="no store"):
        Datasets.open()
    assert list(tmp_path.iterdir()) == []
    Datasets.open(create=True)
    assert (tmp_path / ".mineloc" / "store" / "LAYOUT").exists()
    monkeypatch.setenv("MINELOC_STORE", str(tmp_path / "elsewhere"))
    assert Datasets.open(create=True).store.root == tmp_path / "elsewhere"
