"""What a crash, a second process and rotting disks can do to datasets: nothing unseen."""

import errno
import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from mineloc.errors import OutputError, StoreError
from mineloc.store.datasets import Datasets
from mineloc.store.gc import collect
from mineloc.store.store import Store

FORK = multiprocessing.get_context("fork")


def content(i: int) -> bytes:
    return np.random.default_rng(i).bytes(20_000)


def recording(folder: Path, i: int) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / f"{i}.mcap"
    path.write_bytes(content(i))
    return path


def add_all(root: Path, numbers: range) -> None:
    datasets = Datasets(Store(root))
    for i in numbers:
        datasets.add("mine", {f"f{i}": recording(root.with_name("in"), i)})


def test_of_two_processes_that_add_none_loses_a_flight(tmp_path):
    both = [FORK.Process(target=add_all, args=(tmp_path / "store", range(k, 16, 2))) for k in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    datasets = Datasets(Store(tmp_path / "store"))
    assert set(datasets.get("mine").flights()) == {f"f{i}" for i in range(16)}
    # one version after the other: each add follows the version of the one before
    assert [len(v.recordings) for v in datasets.versions("mine")] == list(range(16, 0, -1))
    assert len(datasets.refs.log("mine")) == 16
    assert datasets.verify().is_sound


def _add_for_ever(root: Path) -> None:
    add_all(root, range(len(Datasets(Store(root)).versions("mine")), 1_000_000))


@pytest.mark.parametrize("kills", [12, pytest.param(200, marks=pytest.mark.slow)])
def test_killed_at_any_moment_of_adding_a_version_is_whole_or_not_there(tmp_path, kills):
    root = tmp_path / "store"
    rng = np.random.default_rng(3)
    start = time.monotonic()
    add_all(root, range(4))
    one_s = (time.monotonic() - start) / 4
    for done in range(10 * kills):
        looked = time.monotonic()
        versions = len(Datasets(Store(root)).versions("mine"))
        look_s = time.monotonic() - looked  # what the process begins with, too; it grows with the history
        # on a slow disk more of them die before they did anything
        if done >= kills and versions >= 4 + kills // 4:
            break
        process = FORK.Process(target=_add_for_ever, args=(root,))
        process.start()
        time.sleep(rng.uniform(0.2, 4.0) * one_s + rng.uniform(0.0, 2.0) * look_s)
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    datasets = Datasets(Store(root))
    versions = datasets.versions("mine")
    assert len(versions) >= 4 + kills // 4, "killed too early to say anything"
    assert datasets.verify().is_sound
    assert {datasets.path(r).read_bytes() for r in versions[0].recordings} == {content(i) for i in range(len(versions))}
    # what was under way left temporaries at most, and objects that nothing names: the collector takes both
    collect(datasets.store, grace_s=0)
    named = {one.sha256 for one in versions[0].recordings} | {one.id for one in versions}
    assert set(datasets.store.objects.digests()) == named
    assert list((root / "tmp").iterdir()) == []
    assert len(datasets.refs.log("mine")) == len(versions)


def test_verify_names_exactly_the_fifty_objects_in_which_one_bit_was_flipped(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda _: None)
    datasets = Datasets(Store(tmp_path / "store"))
    given = {f"f{i}": recording(tmp_path / "in", i) for i in range(60)}
    for k in range(0, 60, 10):
        some = dict(list(given.items())[k : k + 10])
        datasets.add("mine", some, health={flight: {"duration_s": float(k)} for flight in some})
    objects = datasets.store.objects
    version = datasets.get("mine")
    for one in version.recordings:
        datasets.path(one)
    rng = np.random.default_rng(5)
    # manifests apart: a damaged one hides what those before it name, and is tested by itself
    choice = sorted(set(objects.digests()) - {one.id for one in datasets.versions("mine")})
    chosen = sorted(rng.choice(choice, 50, replace=False).tolist())
    for digest in chosen:
        path = objects.path(digest)
        before, bad = path.stat(), bytearray(path.read_bytes())
        bad[rng.integers(len(bad))] ^= 1 << int(rng.integers(8))
        path.chmod(0o644)
        path.write_bytes(bad)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    findings = datasets.verify()
    assert list(findings.damaged) == chosen
    assert (findings.missing, findings.records, findings.refs) == ((), (), ())
    assert datasets.lacking(version.id) == chosen
    for one in version.recordings:
        if one.sha256 in chosen:
            with pytest.raises(StoreError, match="gone or damaged"):
                datasets.path(one)
        else:
            datasets.path(one)


def _add_on_failing_disk(datasets: Datasets, path: Path, steps: int) -> str | None:
    """What is said when the disk is full after some flushes; None when there were not as many."""
    real = os.fsync
    left = steps

    def fsync(handle: int) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(handle)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        try:
            datasets.add("mine", {"b": path})
        except OutputError as error:
            return str(error)
    return None


def test_a_disk_that_fails_at_any_step_of_adding_leaves_a_whole_version(tmp_path):
    path = recording(tmp_path / "in", 1)
    steps = 0
    while True:
        datasets = Datasets(Store(tmp_path / f"store-{steps}"))
        before = datasets.add("mine", {"a": recording(tmp_path / "in", 0)})
        said = _add_on_failing_disk(datasets, path, steps)
        if said is None:
            break
        assert "disk is full" in said
        assert "\n" not in said
        assert datasets.verify().is_sound
        # only the very last step, flushing the folder of the reference, finds it moved already
        assert datasets.get("mine") == before or set(datasets.get("mine").flights()) == {"a", "b"}
        assert set(datasets.add("mine", {"b": path}).flights()) == {"a", "b"}
        steps += 1
    assert steps >= 8, "every flush must have had its turn"
