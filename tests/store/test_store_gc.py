"""The collector never removes what is needed, always removes what is not, and waits for those who add."""

import hashlib
import multiprocessing
import os
import shutil
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule, run_state_machine_as_test

from mineloc.errors import StoreError
from mineloc.store.datasets import Datasets
from mineloc.store.gc import DAY_S, collect
from mineloc.store.record import Action
from mineloc.store.store import Store
from mineloc.store.versions import Version

FORK = multiprocessing.get_context("fork")
OUTSIDE = "f" * 64
# Thousands of stores: what a crash does is tested elsewhere, so they need no disk.
MEMORY = Path("/dev/shm")


def action(i: int, *inputs: str) -> Action:
    named = {f"in{k}": ((f"{k}", digest),) for k, digest in enumerate(inputs)}
    return Action(stage="s", schema=1, code="c", arguments={"i": i}, config={}, inputs=named)


def write(folder: Path, content: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "r.mcap").write_bytes(content)
    return folder / "r.mcap"


def sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


class Collecting(RuleBasedStateMachine):
    """A store beside a model of it: which version names what, which record read and made what."""

    steps = 0
    removed = 0
    kept = 0

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(dir=MEMORY if MEMORY.is_dir() else None))
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(os, "fsync", lambda _: None)
        self.datasets = Datasets(Store(self.folder / "store"))
        self.store = self.datasets.store
        self.versions: dict[str, Version] = {}
        self.refs: dict[tuple[str, str], str] = {}
        self.records: dict[Path, tuple[list[str], list[str]]] = {}
        self.objects: set[str] = set()
        self.count = 0

    def teardown(self) -> None:
        self.collect()
        self.patch.undo()
        shutil.rmtree(self.folder)

    def _took(self, name: str, version: Version) -> None:
        self.versions[version.id] = version
        self.refs[name, "latest"] = version.id
        self.objects |= {version.id, *(one.sha256 for one in version.recordings)}

    def _reached(self) -> set[str]:
        found: set[str] = set()
        for start in self.refs.values():
            following: str | None = start
            while following is not None:
                version = self.versions[following]
                found |= {version.id, *(one.sha256 for one in version.recordings)}
                following = version.parent
        return found

    def _expected(self) -> tuple[set[str], set[Path]]:
        founded = self._reached()
        whole = {p: io for p, io in self.records.items() if set(io[1]) <= self.objects}
        records: set[Path] = set()
        grown = True
        while grown:
            grown = False
            for path, (inputs, outputs) in whole.items():
                if path not in records and all(d in founded or d not in self.objects for d in inputs):
                    records.add(path)
                    founded |= set(outputs)
                    grown = True
        return founded & self.objects, records

    @rule(name=st.sampled_from("xy"), flight=st.sampled_from("abc"), content=st.binary(max_size=2))
    def add(self, name: str, flight: str, content: bytes) -> None:
        Collecting.steps += 1
        path = write(self.folder / "in", content)
        self._took(name, self.datasets.add(name, {flight: path}, replace=True))

    @rule(name=st.sampled_from("xy"), flight=st.sampled_from("abc"))
    def remove(self, name: str, flight: str) -> None:
        Collecting.steps += 1
        if (name, "latest") in self.refs and flight in self.versions[self.refs[name, "latest"]].flights():
            self._took(name, self.datasets.remove(name, [flight]))

    @rule(name=st.sampled_from("xy"), tag=st.sampled_from("tu"), back=st.integers(0, 3))
    def tag(self, name: str, tag: str, back: int) -> None:
        Collecting.steps += 1
        version = self.versions.get(self.refs.get((name, "latest"), ""))
        if version is None:
            return
        for _ in range(back):
            version = self.versions.get(version.parent or "", version)
        assert self.datasets.tag(f"{name}@{version.id}", tag, move=True) == version
        self.refs[name, f"tags/{tag}"] = version.id

    @rule(name=st.sampled_from("xy"), tag=st.sampled_from("tu"))
    def untag(self, name: str, tag: str) -> None:
        Collecting.steps += 1
        if self.refs.pop((name, f"tags/{tag}"), None) is not None:
            self.datasets.untag(name, tag)

    @rule(name=st.sampled_from("xy"))
    def forget(self, name: str) -> None:
        Collecting.steps += 1
        if (name, "latest") in self.refs:
            self.datasets.forget(name)
            self.refs = {key: version for key, version in self.refs.items() if key[0] != name}

    @rule(choice=st.integers(0, 50), content=st.binary(max_size=2), many=st.booleans())
    def run(self, choice: int, content: bytes, many: bool) -> None:
        Collecting.steps += 1
        known = [OUTSIDE, *sorted(self.objects)]
        inputs = [known[choice % len(known)], *([known[-1]] if many else [])]
        self.count += 1
        what = action(self.count, *inputs)

        def execute(work: Path) -> Path:
            write(work / "out", content)
            return work / "out" if many else work / "out" / "r.mcap"

        made = self.store.run(what, execute).output
        outputs = sorted({made.digest, *self.store.objects.files(made).values()})
        self.objects |= set(outputs)
        self.records[self.store.records.path(what)] = (inputs, outputs)

    @precondition(lambda self: self.records)
    @rule(choice=st.integers(0, 50))
    def damage_a_record(self, choice: int) -> None:
        Collecting.steps += 1
        path = sorted(self.records)[choice % len(self.records)]
        path.write_text(path.read_text().replace("action", "akt1on"))
        del self.records[path]

    @precondition(lambda self: self.records)
    @rule(choice=st.integers(0, 50))
    def lose_an_output(self, choice: int) -> None:
        Collecting.steps += 1
        lost = self.records[sorted(self.records)[choice % len(self.records)]][1][0]
        if lost in self.objects - self._reached():
            self.store.objects.path(lost).unlink()
            self.objects.discard(lost)

    @precondition(lambda self: self.refs)
    @rule(choice=st.integers(0, 50), manifest=st.booleans())
    def nothing_is_removed_while_it_is_unknown_what_is_needed(self, choice: int, manifest: bool) -> None:
        Collecting.steps += 1
        (name, ref), version = sorted(self.refs.items())[choice % len(self.refs)]
        path = self.store.root / "refs" / "datasets" / name / ref
        path = self.store.objects.path(version) if manifest else path
        good = path.read_bytes()
        path.chmod(0o644)
        path.write_bytes(good.replace(b"a", b"b"))
        with pytest.raises(StoreError, match="nothing was removed"):
            collect(self.store, grace_s=0)
        assert set(self.store.objects.digests()) == self.objects
        path.write_bytes(good)

    @rule()
    def collect(self) -> None:
        Collecting.steps += 1
        objects, records = self._expected()
        would = collect(self.store, grace_s=0, dry_run=True)
        assert set(self.store.objects.digests()) == self.objects
        done = collect(self.store, grace_s=0)
        assert (would.objects, would.records) == (done.objects, done.records)
        assert set(self.store.objects.digests()) == objects == self.objects - set(done.objects)
        assert set(self.store.records.paths()) == records
        assert self.datasets.verify().is_sound
        self.objects = objects
        self.records = {path: self.records[path] for path in records}
        assert collect(self.store, grace_s=0).objects == ()
        Collecting.removed += len(done.objects)
        Collecting.kept += len(objects)


def test_what_is_needed_stays_and_all_else_goes_whatever_happened():
    Collecting.steps = Collecting.removed = Collecting.kept = 0
    checks = [HealthCheck.too_slow, HealthCheck.data_too_large]
    how = settings(max_examples=20, stateful_step_count=50, deadline=None, database=None, suppress_health_check=checks)
    # How long an example becomes and what it does is left to hypothesis: until enough was done, removed and kept.
    while Collecting.steps < 2000 or min(Collecting.removed, Collecting.kept) < 100:
        run_state_machine_as_test(Collecting, settings=how)


@pytest.fixture
def datasets(tmp_path):
    return Datasets(Store(tmp_path / "store"))


@contextmanager
def aged(*old: Path):
    """Within: some files are ten days older; the kernel's time cannot be set, so that is done where it is read."""
    real = Path.stat

    def stat(path: Path, **how: bool):
        found = real(path, **how)
        return os.stat_result((*found[:9], found.st_ctime - 10 * DAY_S)) if path in old else found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "stat", stat)
        yield


def test_within_the_grace_period_nothing_goes(datasets, tmp_path):
    datasets.add("x", {"a": write(tmp_path, b"1")})
    datasets.forget("x")
    now = time.time()
    assert collect(datasets.store, now_s=now + DAY_S - 60).objects == ()
    done = collect(datasets.store, now_s=now + DAY_S + 60)
    assert (len(done.objects), done.freed_bytes > 1) == (2, True)
    assert datasets.store.objects.digests() == []


def test_old_results_go_when_told_and_what_was_made_of_them_later_stays(datasets, tmp_path):
    store = datasets.store
    old = store.run(action(1, OUTSIDE), lambda work: write(work, b"old")).output
    later = store.run(action(2, old.digest), lambda work: write(work, b"later")).output
    old_path = store.records.path(action(1, OUTSIDE))
    now = time.time()
    with aged(old_path):
        assert collect(store, grace_s=0, now_s=now).records == ()
        done = collect(store, grace_s=0, actions_older_than_s=5 * DAY_S, now_s=now + 1)
    assert done.records == (old_path,)
    assert done.objects == (old.digest,)
    assert store.objects.digests() == [later.digest]


def test_a_young_result_keeps_what_it_was_made_of(datasets, tmp_path):
    version = datasets.add("x", {"a": write(tmp_path, b"1")})
    recording = version.recordings[0].sha256
    datasets.forget("x")
    datasets.store.run(action(1, recording), lambda work: write(work, b"made"))
    with aged(*map(datasets.store.objects.path, (recording, version.id))):
        assert collect(datasets.store, grace_s=DAY_S).objects == (version.id,)
    done = collect(datasets.store, grace_s=0)
    assert set(done.objects) == {recording, sha(b"made")}


def test_what_a_running_stage_reads_stays(datasets, tmp_path):
    store = datasets.store
    ref = store.add(write(tmp_path, b"input"))

    def execute(work: Path) -> Path:
        store.objects.expose(ref, work / "in" / "r.mcap")
        assert collect(Store(store.root), grace_s=0).objects == ()
        assert (work / "in" / "r.mcap").read_bytes() == b"input"
        return write(work / "out", b"out")

    store.run(action(1, ref.digest), execute)
    assert set(collect(store, grace_s=0).objects) == {ref.digest, sha(b"out")}


def test_what_was_placed_for_reading_goes_with_its_object(datasets, tmp_path):
    version = datasets.add("x", {"a": write(tmp_path, b"1")})
    path = datasets.path(version.recordings[0])
    collect(datasets.store, grace_s=0)
    assert path.exists()
    datasets.forget("x")
    collect(datasets.store, grace_s=0)
    assert not path.parent.exists()


def test_between_an_object_and_its_record_the_collector_waits(datasets, tmp_path, monkeypatch):
    """An object is committed, the record that keeps it not yet written: the most dangerous moment."""
    store = datasets.store
    committed, go_on, collected = threading.Event(), threading.Event(), threading.Event()
    waited: list[bool] = []
    real = store.records.write

    def slowly(*args, **kwargs):
        committed.set()
        assert go_on.wait(30)
        return real(*args, **kwargs)

    monkeypatch.setattr(store.records, "write", slowly)
    running = threading.Thread(target=lambda: store.run(action(1, OUTSIDE), lambda work: write(work, b"made")))
    running.start()
    assert committed.wait(30)
    assert store.objects.path(sha(b"made")).exists()

    def clean() -> None:
        collect(Store(store.root), grace_s=0, waiting=lambda: waited.append(True))
        collected.set()

    cleaning = threading.Thread(target=clean)
    cleaning.start()
    assert not collected.wait(0.3)
    assert waited == [True]
    go_on.set()
    running.join(30)
    cleaning.join(30)
    assert collected.is_set()
    assert store.objects.digests() == [sha(b"made")]
    assert store.lookup(action(1, OUTSIDE)) is not None


def _add_for_ever(root: Path, name: str) -> None:
    datasets = Datasets(Store(root))
    for i in range(100_000):
        datasets.add(name, {f"{i % 3}": write(root.parent / name, f"{name} {i}".encode())}, replace=True)
        datasets.store.run(action(i, OUTSIDE), lambda work, i=i: write(work, f"{name} made {i}".encode()))


def test_beside_those_who_add_and_run_nothing_that_they_need_is_lost(datasets, tmp_path):
    root = datasets.store.root
    workers = [FORK.Process(target=_add_for_ever, args=(root, name)) for name in ("x", "y")]
    for worker in workers:
        worker.start()
    end = time.monotonic() + 2.0
    collections = 0
    try:
        while time.monotonic() < end or collections < 10 or _versions(datasets) < 10:
            collect(datasets.store, grace_s=0)
            collections += 1
            assert all(worker.is_alive() for worker in workers)
    finally:
        for worker in workers:
            worker.kill()
            worker.join()
    collect(datasets.store, grace_s=0)
    assert datasets.verify().is_sound
    assert all(len(one.latest.recordings) >= 1 for one in datasets.list())


def _versions(datasets: Datasets) -> int:
    return sum(one.versions for one in datasets.list())


def test_a_killed_adder_does_not_block_the_collector(datasets):
    started = FORK.Event()

    def hold() -> None:
        with Store(datasets.store.root).gate.adding():
            started.set()
            time.sleep(60)

    holder = FORK.Process(target=hold)
    holder.start()
    assert started.wait(30)
    threading.Timer(0.2, holder.kill).start()
    begin = time.monotonic()
    collect(datasets.store, grace_s=0)
    assert 0.1 < time.monotonic() - begin < 5
    holder.join()
