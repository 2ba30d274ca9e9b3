"""What holds for every content: it comes back as it was, it is kept once, its name depends on nothing else."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.errors import StoreError
from mineloc.store.digest import canonical_json, sha256_of_file
from mineloc.store.record import Action
from mineloc.store.store import Store

NAMES = st.text("abcXYZ09-_ é", min_size=1, max_size=8).map(str.strip).filter(bool)
PATHS = st.lists(NAMES, min_size=1, max_size=3).map(tuple)
CONTENT = st.binary(max_size=200)


def _prefix_free(files: dict[tuple[str, ...], bytes]) -> bool:
    return not any(a != b and b[: len(a)] == a for a in files for b in files)


FOLDERS = st.dictionaries(PATHS, CONTENT, min_size=1, max_size=6).filter(_prefix_free)


def write(folder: Path, files: dict[tuple[str, ...], bytes]) -> Path:
    folder.mkdir(parents=True)
    for path, content in files.items():
        file = folder.joinpath(*path)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    return folder


def contents(folder: Path) -> dict[tuple[str, ...], bytes]:
    return {p.relative_to(folder).parts: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def action(**changes: object) -> Action:
    base = Action(
        stage="s", schema=1, code="c", arguments={"a": 1}, config={"x": {"k": 1.5}}, inputs={"i": (("n", "d"),)}
    )
    return replace(base, **changes)


@settings(max_examples=12, deadline=None)
@given(files=FOLDERS)
def test_a_folder_comes_back_as_it_was_and_its_name_is_its_content(files, tmp_path_factory):
    root = tmp_path_factory.mktemp("law")
    store = Store(root / "store")
    first = store.run(action(), lambda work: write(work / "out", files))
    backwards = dict(reversed(files.items()))
    second = store.run(action(schema=2), lambda work: write(work / "out", backwards))
    assert first.output == second.output
    store.place(first.output, root / "here")
    assert contents(root / "here") == files
    # every file once, and the tree
    assert len(store.objects.digests()) == len(set(files.values())) + 1
    assert all(sha256_of_file(store.objects.path(d)) == d for d in store.objects.digests())
    assert store.verify().is_sound


@settings(max_examples=12, deadline=None)
@given(files=FOLDERS, other=FOLDERS)
def test_folders_have_equal_names_only_if_they_are_equal(files, other, tmp_path_factory):
    store = Store(tmp_path_factory.mktemp("law") / "store")
    one = store.run(action(), lambda work: write(work / "out", files)).output
    two = store.run(action(schema=2), lambda work: write(work / "out", other)).output
    assert (one.digest == two.digest) == (files == other)


def test_volatile_files_come_back_but_are_no_part_of_the_name(tmp_path):
    store = Store(tmp_path / "store")

    def make(seconds: str, schema: int):
        files = {("t.json",): seconds.encode(), ("run.tum",): b"0 0"}
        return store.run(action(schema=schema), lambda work: write(work / "out", files), volatile={"t.json"}).output

    one, two = make("1.0", 1), make("2.0", 2)
    assert one.digest == two.digest
    assert one.volatile != two.volatile
    store.place(two, tmp_path / "two")
    assert (tmp_path / "two" / "t.json").read_text() == "2.0"


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-5, 5)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(value=st.dictionaries(st.text(max_size=3), JSON, max_size=4))
def test_canonical_json_reads_back_and_forgets_the_order_of_keys(value):
    text = canonical_json(value)
    assert json.loads(text) == value
    assert canonical_json(dict(reversed(value.items()))) == text


@pytest.mark.parametrize("value", [{"a": {1, 2}}, {"a": float("nan")}, {"a": float("inf")}, {"a": object()}])
def test_what_has_no_order_or_no_value_is_no_key(value):
    with pytest.raises(ValueError):  # noqa: PT011  # json words it differently for each
        canonical_json(value)


@pytest.mark.parametrize(
    "changes",
    [
        {"stage": "t"},
        {"schema": 2},
        {"code": "d"},
        {"arguments": {"a": 2}},
        {"arguments": {}},
        {"config": {"x": {"k": 1.25}}},
        {"config": {"y": {"k": 1.5}}},
        {"inputs": {"i": (("n", "e"),)}},
        {"inputs": {"i": (("m", "d"),)}},
        {"inputs": {"j": (("n", "d"),)}},
        {"inputs": {"i": (("n", "d"), ("n", "d"))}},
    ],
)
def test_whatever_the_result_depends_on_changes_the_key(changes):
    assert action(**changes).key != action().key
    assert action().key == action().key


def test_links_are_no_results(tmp_path):
    store = Store(tmp_path / "store")

    def execute(work: Path) -> Path:
        (work / "out").mkdir()
        (work / "out" / "link").symlink_to("/etc/hostname")
        return work / "out"

    with pytest.raises(StoreError, match="neither a file nor a folder"):
        store.run(action(), execute)
    assert store.lookup(action()) is None
    assert store.verify().is_sound
