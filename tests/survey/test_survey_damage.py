"""Rotten objects, full disks and folders that may not be written: no stage eats what is damaged, and all is told."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_survey import FLIGHTS, STEPS, fingerprint, run_here, store_of, write_sources

from mineloc.errors import MinelocError, OutputError, StoreError
from mineloc.stages.stage import Input, Job


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sources(tmp_path_factory.mktemp("sources"))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, sources: Path) -> Path:
    out = tmp_path_factory.mktemp("done") / "out"
    run_here(sources, out)
    return out


def flip(path: Path, rng: np.random.Generator) -> None:
    """One bit; size and time of the last change stay as they were."""
    before, content = path.stat(), bytearray(path.read_bytes())
    content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    path.chmod(0o644)
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def test_damaged_results_are_made_again_and_are_the_same(done: Path, sources: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_here(sources, out)
    store = store_of(out)
    names = store.objects.digests()
    rng = np.random.default_rng(5)
    for name in names:
        flip(store.objects.path(name), rng)
    assert list(store.verify().damaged) == sorted(names)
    ran: list[str] = []
    run_here(sources, out, lambda job: ran.append(job.stage.name))
    # ingested again, a flight stays what it is: the first ingest mends both
    assert len(ran) == STEPS - FLIGHTS
    assert store.verify().is_sound
    assert fingerprint(out) == fingerprint(done)


def test_an_input_that_rots_before_it_is_read_is_not_read(sources: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    rotten: list[str] = []
    rng = np.random.default_rng(6)

    def rot(job: Job) -> None:
        recording = job.inputs.get("recording")
        if isinstance(recording, Input) and not recording.is_source and not rotten:
            rotten.append(recording.ref.digest)
            flip(store_of(out).objects.path(recording.ref.digest), rng)

    with pytest.raises(StoreError, match="damaged") as told:
        run_here(sources, out, rot)
    assert rotten[0] in str(told.value)
    # the other flights are done, the next run mends this one
    ran: list[str] = []
    run_here(sources, out, lambda job: ran.append(job.stage.name))
    assert ran == ["ingest", "ingest"]
    assert store_of(out).verify().is_sound


@pytest.mark.parametrize(
    ("code", "said", "flushes"),
    [
        (errno.ENOSPC, "disk is full", (0, 3, 11)),
        (errno.EIO, "input/output error", (7,)),
        (errno.EROFS, "cannot be written", (5,)),
    ],
)
def test_a_disk_that_fails_while_a_stage_writes(
    done: Path,
    sources: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    code: int,
    said: str,
    flushes: tuple[int, ...],
) -> None:
    """After so many flushes nothing more reaches the disk."""
    out = tmp_path / "out"
    real = os.fsync
    for succeed in flushes:
        shutil.rmtree(out, ignore_errors=True)
        left = [succeed]

        def failing(handle: int, left: list[int] = left) -> None:
            left[0] -= 1
            if left[0] < 0:
                raise OSError(code, os.strerror(code))
            real(handle)

        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", failing)
            with pytest.raises(OutputError) as told:
                run_here(sources, out)
        assert said in str(told.value)
        assert "\n" not in told.value.line()
        assert store_of(out).verify().is_sound
        run_here(sources, out)
        assert fingerprint(out) == fingerprint(done)


def test_a_failing_source_is_told(sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Path.open

    class Failing:
        """A file object on a disk with a bad block."""

        def __init__(self, stream) -> None:
            self._stream, self._left = stream, 3

        def read(self, *words):
            self._left -= 1
            if self._left < 0:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return self._stream.read(*words)

        def __getattr__(self, name: str):
            return getattr(self._stream, name)

        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None:
            self._stream.close()

    def opened(path: Path, mode: str = "r", *words, **options):
        stream = real(path, mode, *words, **options)
        return Failing(stream) if path.name == "flight1.mcap" and path.parent == sources else stream

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", opened)
        with pytest.raises(MinelocError, match=r"flight1\.mcap"):
            run_here(sources, out)
    assert store_of(out).verify().is_sound
    assert (out / "flight2.again.mcap").exists()
    run_here(sources, out)


SMALL_DISK = """
mount -t tmpfs -o size=700k tmpfs small
"$0" program.py; code=$?
[ $code -eq 7 ] || { echo "exit code $code"; exit 1; }
mount -o remount,size=40m small
"$0" program.py || exit 2
mount -o remount,ro small
rm -f started
"$0" program.py read-only
"""

PROGRAM = """
import sys
from pathlib import Path
sys.path[:0] = {paths!r}
from small_survey import run_here, store_of
from mineloc.errors import OutputError
try:
    run_here(Path({sources!r}), Path("small/out"))
except OutputError as error:
    print(error.line())
    assert store_of(Path("small/out")).verify().is_sound
    sys.exit(7)
"""


def test_on_a_small_disk_it_stops_with_a_line_and_goes_on_when_there_is_room(sources: Path, tmp_path: Path) -> None:
    """On a real file system of 700 kB, then of 40 MB, then one that may not be written, in a namespace of its own."""
    tests = Path(__file__).parents[1]
    (tmp_path / "small").mkdir()
    (tmp_path / "program.py").write_text(
        PROGRAM.format(paths=[str(tests), str(tests / "io"), str(tests.parent)], sources=str(sources))
    )
    namespace = ["unshare", "--mount", "--map-root-user"]
    try:
        subprocess.run(
            [*namespace, "mount", "-t", "tmpfs", "t", "small"], check=True, capture_output=True, cwd=tmp_path
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no mount namespace may be made here")
    words = [*namespace, "sh", "-c", SMALL_DISK, sys.executable]
    ran = subprocess.run(words, capture_output=True, text=True, check=False, cwd=tmp_path)
    lines = ran.stdout.splitlines()
    assert ran.returncode == 7, ran.stdout + ran.stderr
    assert len(lines) == 2
    assert "disk is full" in lines[0]
    assert "cannot be written" in lines[1]
