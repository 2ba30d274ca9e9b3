"""Promises 5 and 6: whatever is cut or changed, whole chunks come back, no byte is altered, nothing else happens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import recording_files as files
from fuzz_recordings import fuzz
from mcap.writer import CompressionType

from mineloc.io.recordings import open_recording

KINDS = ["zstd", "lz4", "none", "unchunked", "crcless", "bag", "db3"]


@pytest.fixture(scope="module", params=["zstd", "none"])
def whole(request, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("laws") / "whole.mcap"
    compression = CompressionType[request.param.upper()]
    return files.write_mcap(path, files.imus(300, padding=600), compression=compression, chunk_size=12_000)


def read(path: Path):
    with open_recording(path) as recording:
        return [(raw.log_ns, bytes(raw.data)) for raw in recording.messages(["/imu"])], list(recording.damage)


def check_cut(path: Path, data: bytes, chunks, cut: int) -> None:
    path.write_bytes(data[:cut])
    messages, damage = read(path)
    assert messages == [m for end, inside in chunks if end <= cut for m in inside]
    assert damage, "a truncated file says so"
    text = damage[-1].describe()
    gone = sum(len(inside) for end, inside in chunks) - len(messages)
    if not gone:
        return
    assert damage[-1].open_ended
    assert "what came after is unknown" in text
    if damage[-1].messages:
        # it speaks of the chunk that was cut: as many messages as in the others, give or take two
        assert damage[-1].estimated
        assert damage[-1].messages <= max(len(inside) for _, inside in chunks) + 2
        assert damage[-1].seconds is not None


def cuts(size: int, count: int, seed: int) -> list[int]:
    rng = np.random.default_rng(seed)
    return [int(cut) for cut in rng.integers(9, size, count)]


def test_truncation_gives_back_all_messages_of_whole_chunks(whole, tmp_path) -> None:
    data, chunks = whole.read_bytes(), files.chunks_of(whole)
    borders = [end + step for end, _ in chunks[:4] for step in (-1, 0, 1)]
    for cut in [*cuts(len(data), 30, 1), *borders, len(data) - 1]:
        check_cut(tmp_path / "cut.mcap", data, chunks, cut)


@pytest.mark.slow
def test_truncation_at_200_random_places(whole, tmp_path) -> None:
    data, chunks = whole.read_bytes(), files.chunks_of(whole)
    for cut in cuts(len(data), 200, 2):
        check_cut(tmp_path / "cut.mcap", data, chunks, cut)


def check_flip(path: Path, data: bytes, truth: set[tuple[int, bytes]], at: int, mask: int) -> None:
    path.write_bytes(data[:at] + bytes([data[at] ^ mask]) + data[at + 1 :])
    messages, damage = read(path)
    assert set(messages) <= truth, "no message is altered"
    assert len(messages) == len(set(messages))
    if len(messages) < len(truth):
        assert sum(d.messages or 0 for d in damage) == len(truth) - len(messages), "the loss is told, and exactly"


def flips(size: int, count: int, seed: int) -> list[tuple[int, int]]:
    rng = np.random.default_rng(seed)
    # the first bytes are the magic: without it the file is no recording at all
    return [(int(rng.integers(8, size)), 1 << int(rng.integers(0, 8))) for _ in range(count)]


def test_a_flipped_bit_alters_nothing_and_loses_nothing_silently(whole, tmp_path) -> None:
    data = whole.read_bytes()
    truth = {m for _, inside in files.chunks_of(whole) for m in inside}
    # half of them in the summary, which is where the other half of the code looks
    tail = int.from_bytes(data[-28:-20], "little")
    places = flips(len(data), 40, 3) + [(tail + at % (len(data) - tail), mask) for at, mask in flips(len(data), 40, 4)]
    for at, mask in places:
        check_flip(tmp_path / "flip.mcap", data, truth, at, mask)


@pytest.mark.slow
def test_500_flipped_bits(whole, tmp_path) -> None:
    data = whole.read_bytes()
    truth = {m for _, inside in files.chunks_of(whole) for m in inside}
    for at, mask in flips(len(data), 500, 5):
        check_flip(tmp_path / "flip.mcap", data, truth, at, mask)


def seed_file(folder: Path, kind: str) -> Path:
    """A small recording of one kind, for mutants."""
    entries = list(files.imus(12))
    if kind == "bag":
        ros1 = [(topic, name, log, files.imu(log, types=files.ROS1.types, seq=0)) for topic, name, log, _ in entries]
        return files.write_bag(folder / "seed.bag", ros1)
    if kind == "db3":
        return next(files.write_rosbag2(folder / "bag", entries).glob("*.db3"))
    options = {"unchunked": {"use_chunking": False}, "crcless": {"enable_crcs": False}}.get(kind, {})
    compression = CompressionType[kind.upper()] if kind in ("zstd", "lz4", "none") else CompressionType.ZSTD
    return files.write_mcap(
        folder / "seed.mcap",
        entries,
        compression=compression,
        chunk_size=1000,
        metadata={"mineloc": {"a": "b"}},
        attachments={"a.txt": b"text"},
        **options,
    )


@pytest.mark.parametrize("kind", KINDS)
def test_mutants_are_read_or_refused_in_one_line(tmp_path, kind) -> None:
    fuzz(seed_file(tmp_path, kind), 100, 1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_10000_mutants_are_read_or_refused_in_one_line(tmp_path, kind) -> None:
    fuzz(seed_file(tmp_path, kind), 10_000, 2)
