"""Mutants of a recording, of which each may only be read or refused, in a child under memory and time limits.

    python fuzz_recordings.py SEED_FILE COUNT SEED [--ingest]

The child prints one line of JSON: how often what happened, the slowest mutant, the peak memory. It leaves the first
offender beside the seed file.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from mineloc.errors import IngestError, MinelocError
from mineloc.io.recordings import open_recording

LIMIT_S = 5
ADDRESS_SPACE = 4 << 30
_EVIL = [0, 1, 2, 0x7F, 0x80, 0xFF, 0xFFFF, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1]


def mutant(data: bytes, rng: np.random.Generator) -> bytes:
    """A few random changes: flipped bits, evil integers, cuts, repeats, zeros, swaps."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        kind, at = rng.integers(0, 8), int(rng.integers(0, max(len(out), 1)))
        size = int(rng.integers(1, 64))
        if kind <= 2 and out:
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 3:
            width = int(rng.choice([1, 2, 4, 8]))
            value = int(rng.choice(len(_EVIL)))
            out[at : at + width] = (_EVIL[value] % 2 ** (8 * width)).to_bytes(width, "little")
        elif kind == 4:
            del out[at : at + size]
        elif kind == 5:
            out[at:at] = out[at : at + size]
        elif kind == 6:
            out[at : at + size] = bytes(len(out[at : at + size]))
        else:
            out = out[:at] if rng.random() < 0.3 else out + rng.bytes(size)
    return bytes(out)


def read_all(path: Path) -> str:
    with open_recording(path) as recording:
        list(recording.attachments())
        for raw in recording.messages(list(recording.topics)):
            try:
                _ = raw.message
            except IngestError:
                continue
        return "recovered" if recording.damage else "read"


def ingest_all(path: Path) -> str:
    from mineloc.stages.ingest import ingest

    out = path.with_name("out.mcap")
    out.unlink(missing_ok=True)
    health = ingest(path, out=out).health
    return "recovered" if health.recovered else "read"


def fuzz(seed: Path, count: int, number: int, *options: str) -> None:
    """Run the child and hold it to promise 5."""
    line = [sys.executable, __file__, str(seed), str(count), str(number), *options]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(line, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    result = json.loads(done.stdout)
    allowed = {"read", "recovered", "IngestError"}
    if options:
        allowed |= {"FlightError"}
    assert set(result["seen"]) <= allowed
    assert sum(result["seen"].values()) == count
    assert result["slowest_s"] < 5
    assert result["peak_mib"] < 1024


def peak_mib() -> float:
    """Of this program alone: what getrusage tells began with the memory of the process that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def _too_slow(signum: int, frame: object) -> None:
    raise TimeoutError(f"a mutant took more than {LIMIT_S} s")


def main(seed_file: Path, count: int, seed: int, *, ingest: bool) -> None:
    data = seed_file.read_bytes()
    work = ingest_all if ingest else read_all
    path = seed_file.with_name(f"mutant-{seed}{seed_file.suffix}")
    path.write_bytes(data)
    # imports and compilations before the limits
    work(path)
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    signal.signal(signal.SIGALRM, _too_slow)
    seen: Counter[str] = Counter()
    slowest = 0.0
    for k in range(count):
        path.write_bytes(mutant(data, np.random.default_rng([seed, k])))
        signal.alarm(LIMIT_S)
        start = time.perf_counter()
        try:
            seen[work(path)] += 1
        except MinelocError as error:
            seen[type(error).__name__] += 1
            if "\n" in str(error):
                seen["several lines"] += 1
        except BaseException:
            path.rename(seed_file.with_name(f"offender-{k}{seed_file.suffix}"))
            raise
        finally:
            signal.alarm(0)
        slowest = max(slowest, time.perf_counter() - start)
    print(json.dumps({"seen": seen, "slowest_s": slowest, "peak_mib": peak_mib()}))  # noqa: T201


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), ingest="--ingest" in sys.argv)
