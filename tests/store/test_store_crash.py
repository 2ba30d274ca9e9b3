"""What a crash, a full or failing disk and a second process can do to the store: nothing."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mineloc.errors import OutputError
from mineloc.store import objects as objects_module
from mineloc.store import record as record_module
from mineloc.store.record import Action
from mineloc.store.store import Store

FORK = multiprocessing.get_context("fork")
FILES = 2


def action(i: int) -> Action:
    return Action(stage="s", schema=1, code="c", arguments={"i": i}, config={}, inputs={})


def make(work: Path, i: int) -> Path:
    (work / "out").mkdir()
    for k in range(FILES):
        (work / "out" / f"{k}").write_bytes(np.random.default_rng([i, k]).bytes(20_000))
    return work / "out"


def run_all(root: Path, n: int) -> int:
    """Run n actions; how many of them had to be executed."""
    store = Store(root)
    return sum(not store.run(action(i), lambda work, i=i: make(work, i)).hit for i in range(n))


def run_for_ever(root: Path) -> None:
    store = Store(root)
    for i in range(1_000_000):
        store.run(action(i), lambda work, i=i: make(work, i))


def _kill_at_random(root: Path, kills: int) -> int:
    rng = np.random.default_rng(7)
    start = time.monotonic()
    run_all(root.with_name("measured"), 3)
    one_s = (time.monotonic() - start) / 3
    for _ in range(kills):
        process = FORK.Process(target=run_for_ever, args=(root,))
        process.start()
        time.sleep(rng.uniform(0.0, 4.0 * one_s))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    return len(Store(root).records.paths())


@pytest.mark.parametrize("kills", [20, pytest.param(500, marks=pytest.mark.slow)])
def test_killed_at_any_moment_the_store_stays_sound_and_loses_one_stage_at_most(tmp_path, kills):
    committed = _kill_at_random(tmp_path / "store", kills)
    store = Store(tmp_path / "store")
    assert store.verify().is_sound
    assert committed >= kills // 10, "killed too early to say anything"
    # what was recorded is there: only what was never recorded is executed
    assert run_all(tmp_path / "store", committed + 1) == 1
    store.sweep()
    assert list((tmp_path / "store" / "tmp").iterdir()) == []
    assert store.verify().is_sound


def test_sweeping_spares_the_living(tmp_path):
    store = Store(tmp_path / "store")
    (tmp_path / "store" / "tmp" / "dead").mkdir(parents=True)

    def execute(work: Path) -> Path:
        (work / "half").write_bytes(b"1")
        assert Store(store.root).sweep() == ["dead"]
        assert (work / "half").exists()
        return make(work, 0)

    assert not store.run(action(0), execute).hit


def _slow(root: Path, seconds: float, told: object) -> None:
    def execute(work: Path) -> Path:
        told.put("started")  # type: ignore[attr-defined]
        time.sleep(seconds)
        return make(work, 0)

    hit = Store(root).run(action(0), execute, waiting=lambda: told.put("waiting")).hit  # type: ignore[attr-defined]
    told.put(hit)  # type: ignore[attr-defined]


def test_two_processes_execute_once(tmp_path):
    told = FORK.Queue()
    both = [FORK.Process(target=_slow, args=(tmp_path / "store", 0.5, told)) for _ in range(2)]
    for process in both:
        process.start()
    words = [told.get(timeout=30) for _ in range(4)]
    for process in both:
        process.join()
    assert words[:2] == ["started", "waiting"]
    assert sorted(words[2:]) == [False, True]


def test_the_death_of_the_one_at_work_lets_the_next_begin_within_a_second(tmp_path):
    told = FORK.Queue()
    first = FORK.Process(target=_slow, args=(tmp_path / "store", 60.0, told))
    first.start()
    assert told.get(timeout=30) == "started"
    second = FORK.Process(target=_slow, args=(tmp_path / "store", 0.0, told))
    second.start()
    assert told.get(timeout=30) == "waiting"
    first.kill()
    killed = time.monotonic()
    assert told.get(timeout=30) == "started"
    assert time.monotonic() - killed < 1.0
    assert told.get(timeout=30) is False
    first.join()
    second.join()
    assert list((tmp_path / "store" / "tmp").iterdir()) == []


class FailingDisk:
    """Lets `fsync` and `rename` succeed a given number of times, then fail for ever."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, succeed: int, code: int) -> None:
        self.left = succeed
        self.code = code
        real_fsync, real_replace = os.fsync, Path.replace
        monkeypatch.setattr(os, "fsync", lambda handle: (self.step(), real_fsync(handle))[1])
        monkeypatch.setattr(Path, "replace", lambda path, to: (self.step(), real_replace(path, to))[1])
        assert objects_module.fsync_path is record_module.fsync_path

    def step(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError(self.code, os.strerror(self.code))


def _run_on_failing_disk(root: Path, steps: int, code: int) -> str | None:
    """What is said when the disk fails after some steps; None when there were not as many."""
    store = Store(root)
    with pytest.MonkeyPatch.context() as patch:
        FailingDisk(patch, steps, code)
        try:
            store.run(action(0), lambda work: make(work, 0))
            return None
        except OutputError as error:
            line = str(error)
    assert store.verify().is_sound
    # only the very last step, flushing the folder of a record that is there, loses nothing
    known = store.lookup(action(0)) is not None
    assert run_all(root, 1) == (0 if known else 1)
    return line


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_a_disk_that_fails_at_any_step_gives_one_line_and_a_sound_store(tmp_path, code):
    said = {errno.ENOSPC: "disk is full", errno.EIO: "input/output error", errno.EROFS: "cannot be written"}
    steps = 0
    while (said_now := _run_on_failing_disk(tmp_path / f"store-{steps}", steps, code)) is not None:
        assert said[code] in said_now
        assert "\n" not in said_now
        steps += 1
    assert steps >= 3 * (FILES + 2), "every fsync and rename must have had its turn"


def test_a_full_file_system_gives_one_line_and_a_sound_store(tmp_path):
    """On a real file system of 400 kB, in a mount namespace of its own."""
    program = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from test_store_crash import action, make, run_all
from mineloc.errors import OutputError
from mineloc.store.store import Store
root = Path({str(tmp_path / "small")!r})
done = 0
try:
    for done in range(1000):
        Store(root).run(action(done), lambda work: make(work, done))
except OutputError as error:
    assert "disk is full" in str(error), error
assert 0 < done < 100, done
assert Store(root).verify().is_sound
assert run_all(root, done) == 0
"""
    (tmp_path / "small").mkdir()
    mount = f"mount -t tmpfs -o size=400k tmpfs {tmp_path}/small"
    namespace = ["unshare", "--mount", "--map-root-user", "sh", "-c"]
    try:
        subprocess.run([*namespace, mount], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no mount namespace may be made here")
    done = subprocess.run(
        [*namespace, f'{mount} && exec "$0" -c "$1"', sys.executable, program],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_gives_one_line(tmp_path):
    (tmp_path / "mine").mkdir(mode=0o555)
    with pytest.raises(OutputError, match="cannot be written"):
        Store(tmp_path / "mine" / "store")


@pytest.mark.parametrize("n", [1, 50])
def test_verify_names_exactly_the_objects_in_which_one_bit_was_flipped(tmp_path, n):
    run_all(tmp_path / "store", 30)
    store = Store(tmp_path / "store")
    rng = np.random.default_rng(n)
    chosen = sorted(rng.choice(store.objects.digests(), n, replace=False).tolist())
    for digest in chosen:
        path = store.objects.path(digest)
        before, content = path.stat(), bytearray(path.read_bytes())
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        path.chmod(0o644)
        path.write_bytes(content)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    findings = store.verify()
    assert list(findings.damaged) == chosen
    assert findings.missing == ()
    assert findings.records == ()
