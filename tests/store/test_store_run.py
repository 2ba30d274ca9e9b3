"""Hit and miss, damage and healing, and what ends up in the folders of the user."""

import os
import stat
from dataclasses import replace
from pathlib import Path

import pytest

from mineloc.errors import OutputError, StoreError
from mineloc.store.digest import SETTLE_NS, DigestIndex
from mineloc.store.objects import tree_text
from mineloc.store.record import Action
from mineloc.store.store import Store

ACTION = Action(stage="s", schema=1, code="c", arguments={}, config={}, inputs={})


class Work:
    """A stage that counts how often it runs."""

    def __init__(self, **files: bytes) -> None:
        self.files = files
        self.runs = 0

    def __call__(self, work: Path) -> Path:
        self.runs += 1
        (work / "out").mkdir()
        for name, content in self.files.items():
            (work / "out" / name).write_bytes(content)
        return work / "out"


def flip(path: Path, *, keep_mtime: bool = False) -> None:
    """Flip the lowest bit of the last byte of a file, whatever its permissions are."""
    before = path.stat()
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.chmod(0o644)
    path.write_bytes(content)
    path.chmod(0o444)
    if keep_mtime:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        assert path.stat().st_mtime_ns == before.st_mtime_ns


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def test_the_second_run_executes_nothing(store):
    work = Work(a=b"1", b=b"2")
    first, second = store.run(ACTION, work), store.run(ACTION, work)
    assert (first.hit, second.hit, work.runs) == (False, True, 1)
    assert first.output == second.output
    assert Store(store.root).run(ACTION, work).hit


def test_a_failed_execution_leaves_nothing(store):
    def fail(work: Path) -> Path:
        (work / "half").write_bytes(b"x" * 1000)
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        store.run(ACTION, fail)
    assert store.objects.digests() == []
    assert list((store.root / "tmp").iterdir()) == []
    assert store.lookup(ACTION) is None


@pytest.mark.parametrize("keep_mtime", [False, True])
@pytest.mark.parametrize("what", ["file", "tree"])
def test_a_damaged_object_is_noticed_and_made_anew(store, what, keep_mtime):
    work = Work(a=b"1", b=b"2")
    ref = store.run(ACTION, work).output
    digest = ref.digest if what == "tree" else store.objects.files(ref)["a"]
    flip(store.objects.path(digest), keep_mtime=keep_mtime)
    with pytest.raises(StoreError, match="gone or damaged"):
        store.place(ref, store.root.parent / "there")
    again = store.run(ACTION, work)
    assert (again.hit, work.runs) == (False, 2)
    assert again.output == ref
    assert store.verify().is_sound


@pytest.mark.parametrize("what", ["file", "tree", "record"])
def test_a_deleted_object_is_noticed_and_made_anew(store, what):
    work = Work(a=b"1", b=b"2")
    ref = store.run(ACTION, work).output
    if what == "record":
        store.records.paths()[0].unlink()
    else:
        digest = ref.digest if what == "tree" else store.objects.files(ref)["b"]
        store.objects.path(digest).unlink()
        assert store.verify().missing == (digest,)
    assert not store.run(ACTION, work).hit
    assert store.run(ACTION, work).hit
    assert store.verify().is_sound


def test_what_is_made_anew_differently_leaves_no_damaged_object_behind(store):
    work = Work(a=b"1")
    ref = store.run(ACTION, work).output
    flip(store.objects.path(store.objects.files(ref)["a"]))
    work.files["a"] = b"another"
    assert store.run(ACTION, work).output != ref
    assert store.verify().is_sound


@pytest.mark.parametrize("still_json", [False, True])
def test_a_damaged_record_counts_as_none(store, still_json):
    work = Work(a=b"1")
    store.run(ACTION, work)
    (path,) = store.records.paths()
    if still_json:
        path.write_text(path.read_text().replace('"size_bytes":1', '"size_bytes":3'))
    else:
        flip(path)
    assert store.verify().records == (path,)
    assert not store.run(ACTION, work).hit
    assert store.verify().is_sound


def test_a_record_under_the_name_of_another_action_is_not_believed(store):
    store.run(ACTION, Work(a=b"1"))
    other = Action(stage="s", schema=2, code="c", arguments={}, config={}, inputs={})
    path = store.records.paths()[0]
    path.rename(path.with_name(f"{other.key}.json"))
    assert store.lookup(other) is None


def test_a_placed_folder_is_read_only_complete_and_left_alone_while_it_is_right(store, tmp_path):
    ref = store.run(ACTION, Work(a=b"1", b=b"2")).output
    to = tmp_path / "there" / "run"
    store.place(ref, to)
    inode = to.stat().st_ino
    assert {p.name: p.read_bytes() for p in to.iterdir()} == {"a": b"1", "b": b"2"}
    assert not any(
        p.stat().st_mode & 0o222
        for p in to.iterdir()
        if p.samefile(store.objects.path(store.objects.files(ref)[p.name]))
    )
    assert stat.S_IMODE(to.stat().st_mode) == 0o755
    store.place(ref, to)
    assert to.stat().st_ino == inode
    (to / "mine").write_bytes(b"3")
    store.place(ref, to, beside={"mine"})
    assert (to / "mine").exists()
    store.place(ref, to)
    assert not (to / "mine").exists()


@pytest.mark.parametrize("change", ["change", "remove"])
def test_a_placed_folder_that_somebody_changed_is_put_right(store, tmp_path, change):
    work = Work(a=b"1", b=b"2")
    ref = store.run(ACTION, work).output
    store.place(ref, tmp_path / "there")
    (tmp_path / "there" / "a").unlink()
    if change == "change":
        (tmp_path / "there" / "a").write_bytes(b"7")
    store.place(ref, tmp_path / "there")
    assert (tmp_path / "there" / "a").read_bytes() == b"1"
    assert store.run(ACTION, work).hit
    assert store.verify().is_sound


def test_writing_through_a_hard_link_is_noticed(store, tmp_path):
    work = Work(a=b"1")
    ref = store.run(ACTION, work).output
    store.place(ref, tmp_path / "there")
    flip(tmp_path / "there" / "a", keep_mtime=True)
    run = store.run(ACTION, work)
    store.place(run.output, tmp_path / "there")
    assert (tmp_path / "there" / "a").read_bytes() == b"1"
    assert store.verify().is_sound


def test_a_file_is_placed_over_another_but_not_over_a_folder(store, tmp_path):
    def execute(work: Path) -> Path:
        (work / "f.txt").write_bytes(b"new")
        return work / "f.txt"

    ref = store.run(ACTION, execute).output
    to = tmp_path / "f.txt"
    to.write_bytes(b"old")
    store.place(ref, to)
    assert to.read_bytes() == b"new"
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        store.place(ref, tmp_path / "folder")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.txt", "folder", "store"]


def test_stages_read_links_that_lead_to_the_content(store, tmp_path):
    ref = store.run(ACTION, Work(a=b"1", b=b"2")).output
    store.objects.expose(ref, tmp_path / "in" / "run")
    assert (tmp_path / "in" / "run" / "b").read_bytes() == b"2"


@pytest.mark.parametrize("name", ["../x", "/proc/x", "a/../../x", "a//x", ".", "", "a\0"])
def test_a_tree_that_leads_out_of_its_folder_is_refused(store, tmp_path, name):
    """Trees come from others too: imported, pulled."""
    (tmp_path / "f").write_bytes(b"1")
    inside = store.add(tmp_path / "f").digest
    (tmp_path / "tree").write_text(tree_text({name: (inside, 1)}))
    forged = replace(store.add(tmp_path / "tree"), kind="folder")
    with pytest.raises(StoreError, match="not a tree"):
        store.place(forged, tmp_path / "there" / "deep")
    (tmp_path / "tree").write_text(tree_text({"a": (inside, 1)}))
    fine = replace(store.add(tmp_path / "tree"), kind="folder")
    with pytest.raises(StoreError, match="outside of its folder"):
        store.place(replace(fine, volatile={name: inside}), tmp_path / "there" / "deep")
    assert not (tmp_path / "there").exists()
    store.place(fine, tmp_path / "there" / "deep")


def test_an_added_file_is_there_and_the_source_untouched(store, tmp_path):
    (tmp_path / "flight.mcap").write_bytes(b"points" * 10_000)
    ref = store.add(tmp_path / "flight.mcap")
    assert store.objects.path(ref.digest).read_bytes() == b"points" * 10_000
    assert ref == store.add(tmp_path / "flight.mcap") == store.source(tmp_path / "flight.mcap")
    assert len(store.objects.digests()) == 1
    assert (tmp_path / "flight.mcap").stat().st_mode & 0o200


def test_a_folder_that_is_no_store_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("do not touch")
    with pytest.raises(StoreError, match="not a store"):
        Store(tmp_path)
    newer = tmp_path / "newer"
    Store(newer)
    (newer / "LAYOUT").write_text("mineloc store 2\n")
    with pytest.raises(StoreError, match="store 2"):
        Store(newer)


def test_a_source_that_is_missing_is_told(store, tmp_path):
    with pytest.raises(StoreError, match=r"gone\.mcap: cannot be read"):
        store.source(tmp_path / "gone.mcap")


class TestIndex:
    """Unchanged files are not read again, changed ones always are."""

    @pytest.fixture
    def index(self, tmp_path, monkeypatch):
        monkeypatch.setattr("mineloc.store.digest.SETTLE_NS", 0)
        return DigestIndex(tmp_path / "index")

    @pytest.fixture
    def file(self, tmp_path):
        path = tmp_path / "flight.mcap"
        path.write_bytes(b"x" * 1000)
        return path

    def test_an_unchanged_file_is_not_read(self, index, file, monkeypatch):
        digest = index.digest(file)
        monkeypatch.setattr("mineloc.store.digest.sha256_of_file", lambda _: pytest.fail("read again"))
        assert index.digest(file) == digest

    @pytest.mark.parametrize("keep_mtime", [False, True])
    def test_a_changed_byte_is_seen_even_with_its_old_time(self, index, file, keep_mtime):
        digest = index.digest(file)
        flip(file, keep_mtime=keep_mtime)
        assert index.digest(file) != digest

    def test_a_file_that_takes_the_place_of_another_is_seen(self, index, file, tmp_path):
        digest = index.digest(file)
        other = tmp_path / "other"
        other.write_bytes(b"y" * 1000)
        os.utime(other, ns=(file.stat().st_atime_ns, file.stat().st_mtime_ns))
        other.replace(file)
        assert index.digest(file) != digest

    def test_a_file_that_was_written_just_now_is_read_again(self, tmp_path, file):
        assert SETTLE_NS >= 2_000_000_000
        index = DigestIndex(tmp_path / "index")
        index.digest(file)
        assert index.recall(file) is None

    def test_a_torn_entry_counts_as_none(self, index, file, tmp_path):
        digest = index.digest(file)
        (entry,) = (p for p in (tmp_path / "index").rglob("*") if p.is_file())
        entry.write_bytes(entry.read_bytes()[:-10])
        assert index.recall(file) is None
        assert index.digest(file) == digest
