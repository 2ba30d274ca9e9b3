"""A version carried in one file: the same bytes everywhere, checked to the last, never at the cost of history."""

import json
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mineloc.errors import OutputError, StoreError
from mineloc.store.archive import HEAD, _header, _padding, export_version, import_version
from mineloc.store.datasets import Datasets
from mineloc.store.digest import canonical_json, sealed
from mineloc.store.record import Action, parse_record, read_action
from mineloc.store.store import Store

pytestmark = pytest.mark.usefixtures("no_flush")


def datasets(root: Path) -> Datasets:
    return Datasets(Store(root))


def recording(folder: Path, content: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "r.mcap").write_bytes(content)
    return folder / "r.mcap"


def action(stage: str, **inputs: str) -> Action:
    named = {name: ((name, digest),) for name, digest in inputs.items()}
    return Action(stage=stage, schema=1, code="c", arguments={}, config={}, inputs=named)


def fill(root: Path) -> Datasets:
    """Two versions with a file, a folder, a sequence, a report, a tag; results of both recordings."""
    made = datasets(root / "store")
    bag = root / "bag"
    (bag / "sub").mkdir(parents=True)
    (bag / "metadata.yaml").write_bytes(b"bag")
    (bag / "sub" / "0.db3").write_bytes(b"x" * 1500)
    told = root / "x.toml"
    told.write_bytes(b"[lidar]\n")
    made.add("mine", {"a": recording(root / "in", b"points" * 100)}, health={"a": {"duration_s": 2.0}})
    version = made.add("mine", {"b": bag}, sequence=told)
    made.tag("mine", "good")
    a, b = version.recordings
    out = made.store.run(action("ingest", recording=a.sha256), lambda work: recording(work, b"flight")).output

    def run(work: Path) -> Path:
        recording(work / "out", b"trajectory")
        (work / "out" / "timing.json").write_text("{}")
        return work / "out"

    made.store.run(action("localize", flight=out.digest), run, volatile={"timing.json"})
    made.store.run(action("ingest", recording=b.sha256), lambda work: recording(work, b"flight b"))
    made.store.run(action("ingest", recording="e" * 64), lambda work: recording(work, b"of another"))
    return made


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    root = tmp_path_factory.mktemp("filled")
    made = fill(root)
    export_version(made, "mine@good", root / "good.tar")
    export_version(made, "mine@good", root / "runs.tar", runs=True)
    return root, made


def contents(one: Datasets) -> dict[str, bytes]:
    return {digest: one.store.objects.path(digest).read_bytes() for digest in one.store.objects.digests()}


def test_an_import_has_everything_and_nothing_else(filled, tmp_path):
    root, source = filled
    here = datasets(tmp_path / "store")
    name, version = import_version(here, root / "good.tar")
    assert (name, version) == ("mine", source.get("mine"))
    assert here.get("mine@good") == here.get("mine") == version
    assert [one.id for one in here.versions("mine")] == [one.id for one in source.versions("mine")]
    assert here.verify().is_sound
    assert here.lacking(version.id) == []
    for one in version.recordings:
        assert here.store.source(here.path(one)) == one.ref
    # two manifests, a, its report, the bag's tree and two files, the sequence
    assert len(here.store.objects.digests()) == 8
    assert here.store.records.paths() == []


def test_results_come_along_when_asked_for(filled, tmp_path):
    root, source = filled
    here = datasets(tmp_path / "store")
    import_version(here, root / "runs.tar")
    assert len(here.store.records.paths()) == 3
    known = source.store.lookup(action("localize", flight=_flight(source)))
    found = here.store.lookup(action("localize", flight=_flight(source)))
    assert known is not None
    assert found is not None
    assert found.output == known.output
    assert here.store.lookup(action("ingest", recording="e" * 64)) is None
    here.store.place(found.output, tmp_path / "run")
    assert (tmp_path / "run" / "timing.json").read_text() == "{}"
    assert here.verify().is_sound


def _flight(one: Datasets) -> str:
    found = one.store.lookup(action("ingest", recording=one.get("mine").flights()["a"].sha256))
    assert found is not None
    return found.output.digest


def test_the_same_content_gives_the_same_bytes_and_any_tar_reads_it(filled, tmp_path):
    root, source = filled
    again = fill(tmp_path)
    export_version(again, "mine@good", tmp_path / "again.tar")
    assert (tmp_path / "again.tar").read_bytes() == (root / "good.tar").read_bytes()
    with tarfile.open(root / "good.tar") as tar:
        names = tar.getnames()
        assert names[0] == "mineloc-dataset"
        assert names[1:] == sorted(names[1:])
        assert {m.mtime for m in tar.getmembers()} == {0}
        for digest, content in contents(source).items():
            if f"objects/{digest}" in names:
                member = tar.extractfile(f"objects/{digest}")
                assert member is not None
                assert member.read() == content


def test_an_import_again_changes_nothing_and_mends_what_is_damaged(filled, tmp_path):
    root, _ = filled
    here = datasets(tmp_path / "store")
    _, version = import_version(here, root / "good.tar")
    before = contents(here)
    path = here.store.objects.path(version.recordings[0].sha256)
    path.chmod(0o644)
    path.write_bytes(b"bad")
    assert not here.verify().is_sound
    import_version(here, root / "good.tar")
    assert contents(here) == before
    assert here.verify().is_sound
    assert len(here.refs.log("mine")) == 2


@pytest.mark.parametrize("what", ["good.tar", "runs.tar"])
def test_a_file_in_which_any_bit_was_flipped_is_refused_and_leaves_nothing(filled, tmp_path, what):
    root, _ = filled
    here = datasets(tmp_path / "store")
    good = (root / what).read_bytes()
    rng = np.random.default_rng(1)
    # every part of the head, then anywhere: headers, contents, padding, the end
    places = [*range(0, 512, 37), 512, 600, *rng.integers(0, len(good), 60).tolist(), len(good) - 1]
    for place in places:
        bad = bytearray(good)
        bad[place] ^= 1 << int(rng.integers(8))
        (tmp_path / "bad.tar").write_bytes(bad)
        with pytest.raises(StoreError) as error:
            import_version(here, tmp_path / "bad.tar")
        assert "bad.tar: " in str(error.value), place
        assert "\n" not in str(error.value)
        assert here.list() == []
    assert here.store.objects.digests() == []
    assert here.store.records.paths() == []
    assert list((tmp_path / "store" / "tmp").iterdir()) == []
    (tmp_path / "bad.tar").write_bytes(good)
    import_version(here, tmp_path / "bad.tar")


def test_a_file_that_ends_early_or_goes_on_is_refused_and_leaves_nothing(filled, tmp_path):
    root, _ = filled
    here = datasets(tmp_path / "store")
    good = (root / "runs.tar").read_bytes()
    rng = np.random.default_rng(2)
    for size in (0, 1, 511, 512, 513, *rng.integers(0, len(good), 30).tolist(), len(good) - 512, len(good) - 1):
        (tmp_path / "bad.tar").write_bytes(good[:size])
        with pytest.raises(StoreError, match=r"bad\.tar: (damaged or incomplete|no export)"):
            import_version(here, tmp_path / "bad.tar")
    (tmp_path / "bad.tar").write_bytes(good + b"\0")
    with pytest.raises(StoreError, match="damaged or incomplete"):
        import_version(here, tmp_path / "bad.tar")
    assert here.store.objects.digests() == []


def _forged(root: Path, to: Path, change) -> Path:
    """The file with another head, sealed and with a right header."""
    good = (root / "good.tar").read_bytes()
    size = tarfile.TarInfo.frombuf(good[:512], "utf-8", "strict").size
    raw = json.loads(good[512 : 512 + size].split(b"\n")[1])
    change(raw)
    head = sealed(canonical_json(raw)).encode()
    rest = good[512 + size + len(_padding(size)) :]
    to.write_bytes(_header(HEAD, len(head)) + head + _padding(len(head)) + rest)
    return to


@pytest.mark.parametrize(
    "change",
    [
        lambda raw: raw.update(dataset="../x"),
        lambda raw: raw.update(dataset=3),
        lambda raw: raw.update(version="0" * 64),
        lambda raw: raw.update(version="x"),
        lambda raw: raw.update(tag="a/b"),
        lambda raw: raw.update(schema="mineloc.dataset.export/2"),
        lambda raw: raw["members"].pop(),
        lambda raw: raw["members"].insert(0, ["objects/" + "0" * 64, 0]),
        lambda raw: raw["members"].insert(0, ["../../etc/passwd", 0]),
        lambda raw: raw["members"][0].__setitem__(1, -1),
    ],
)
def test_a_forged_head_is_refused_and_leaves_nothing(filled, tmp_path, change):
    root, _ = filled
    here = datasets(tmp_path / "store")
    assert import_version(datasets(tmp_path / "fine"), _forged(root, tmp_path / "f.tar", lambda _: None))
    with pytest.raises(StoreError):
        import_version(here, _forged(root, tmp_path / "f.tar", change))
    assert here.store.objects.digests() == []
    assert here.list() == []


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"x" * 5000])
def test_foreign_files_are_refused_in_one_line(tmp_path, content):
    (tmp_path / "x.tar").write_bytes(content)
    with pytest.raises(StoreError, match=r"x\.tar: no export of a dataset"):
        import_version(datasets(tmp_path / "store"), tmp_path / "x.tar")
    with tarfile.open(tmp_path / "y.tar", "w") as tar:
        tar.add(tmp_path / "x.tar", "x")
    with pytest.raises(StoreError, match=r"y\.tar: no export of a dataset"):
        import_version(datasets(tmp_path / "store"), tmp_path / "y.tar")
    with pytest.raises(StoreError, match="cannot be read"):
        import_version(datasets(tmp_path / "store"), tmp_path / "gone.tar")


def test_a_dataset_moves_on_and_never_back(filled, tmp_path):
    root, source = filled
    here = datasets(tmp_path / "store")
    first = source.versions("mine")[1]
    export_version(source, f"mine@{first.id}", tmp_path / "first.tar")
    import_version(here, tmp_path / "first.tar")
    assert here.get("mine").id == first.id
    import_version(here, root / "good.tar")
    assert here.get("mine") == source.get("mine")
    import_version(here, tmp_path / "first.tar")
    assert here.get("mine") == source.get("mine"), "an older version is there already"


def test_a_dataset_of_that_name_with_a_history_of_its_own_is_kept(filled, tmp_path):
    root, _ = filled
    here = datasets(tmp_path / "store")
    own = here.add("mine", {"c": recording(tmp_path / "in", b"own")})
    before = here.store.objects.digests()
    with pytest.raises(StoreError, match="whose history would be lost; import it as another dataset"):
        import_version(here, root / "good.tar")
    assert here.get("mine") == own
    assert here.store.objects.digests() == before
    name, version = import_version(here, root / "good.tar", name="theirs")
    assert (name, here.get("theirs"), here.get("mine")) == ("theirs", version, own)
    further = here.add("theirs", {"c": recording(tmp_path / "in", b"own")})
    assert (further.parent, further.dataset) == (version.id, "theirs")


def test_a_tag_that_names_another_version_here_is_kept(filled, tmp_path):
    root, source = filled
    here = datasets(tmp_path / "store")
    export_version(source, f"mine@{source.versions('mine')[1].id}", tmp_path / "first.tar")
    import_version(here, tmp_path / "first.tar")
    first = here.tag("mine", "good")
    with pytest.raises(StoreError, match="names version"):
        import_version(here, root / "good.tar")
    assert here.get("mine") == here.get("mine@good") == first


def test_what_is_damaged_is_not_exported(filled, tmp_path):
    made = fill(tmp_path)
    path = made.store.objects.path(made.get("mine").recordings[0].sha256)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(StoreError, match="damaged; expected an intact object"):
        export_version(made, "mine", tmp_path / "out.tar")
    path.unlink()
    with pytest.raises(StoreError, match="gone"):
        export_version(made, "mine", tmp_path / "out.tar")
    assert not list(tmp_path.glob("*.tar"))


def test_an_existing_file_is_not_written_over(filled, tmp_path):
    root, source = filled
    with pytest.raises(OutputError, match="exists"):
        export_version(source, "mine", root / "good.tar")


def test_a_record_that_says_another_key_is_refused(filled):
    """Whoever forges a result must at least forge its action."""
    path = filled[1].store.records.paths()[0]
    found = read_action(path)
    assert found is not None
    other = replace(found[0], code="another").key
    assert parse_record(path.read_text()) is not None
    assert parse_record(path.read_text().replace(found[0].key, other)) is None
    body = path.read_text().split("\n")[1].replace(found[0].key, other)
    assert parse_record(sealed(body)) is None
