"""Every kind of recording, whole and damaged (the matrix of PLATFORM 4), and what recovery must say."""

from __future__ import annotations

import os
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
import recording_files as files
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from recording_files import IMU, START_NS, STEP_NS
from rosbags.rosbag1.writer import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin

from mineloc.errors import IngestError
from mineloc.io.recording import Recording
from mineloc.io.recordings import open_recording

COUNT = 400
PADDING = 4000


def read(path: Path, topics=("/imu",)) -> tuple[list[tuple[int, bytes]], Recording]:
    with open_recording(path) as recording:
        return [(raw.log_ns, bytes(raw.data)) for raw in recording.messages(topics)], recording


def lost(recording: Recording) -> int:
    return sum(damage.messages or 0 for damage in recording.damage)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    return files.write_mcap(folder / "whole.mcap", files.imus(COUNT, padding=PADDING))


@pytest.fixture(scope="module")
def truth(whole) -> list[tuple[int, bytes]]:
    with whole.open("rb") as stream:
        return [(m.log_time, bytes(m.data)) for _, _, m in make_reader(stream, validate_crcs=True).iter_messages()]


def damaged(whole: Path, tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    return path


def flipped(data: bytes, at: int, mask: int = 1) -> bytes:
    at %= len(data)
    return data[:at] + bytes([data[at] ^ mask]) + data[at + 1 :]


def first_chunk(whole: Path) -> tuple[int, int]:
    """Where the second chunk begins and ends."""
    with whole.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    chunk = summary.chunk_indexes[1]
    return chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length


# --- whole files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda c: c.name)
def test_a_whole_mcap_gives_every_message_and_no_damage(tmp_path, compression) -> None:
    path = files.write_mcap(tmp_path / "a.mcap", files.imus(50), compression=compression)
    messages, recording = read(path)
    assert [log for log, _ in messages] == [START_NS + k * STEP_NS for k in range(50)]
    assert not recording.damage
    topic = recording.topics["/imu"]
    assert (topic.msgtype, topic.count, topic.encoding) == (IMU, 50, "cdr")
    assert (recording.kind, recording.profile) == ("mcap", "ros2")


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"use_chunking": False, "enable_data_crcs": True},
        {"use_statistics": False},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"use_summary_offsets": False},
        {"enable_crcs": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"chunk_size": 1},
    ],
    ids=str,
)
def test_whatever_a_writer_leaves_out_the_file_is_whole(tmp_path, whole, truth, options) -> None:
    path = files.write_mcap(tmp_path / "a.mcap", files.imus(COUNT, padding=PADDING), **options)
    messages, recording = read(path)
    assert messages == truth
    assert not recording.damage


@pytest.mark.parametrize("kind", ["db3", "folder", "mcap folder", "mcap folder without metadata"])
def test_rosbag2(tmp_path, kind) -> None:
    plugin = StoragePlugin.MCAP if "mcap" in kind else StoragePlugin.SQLITE3
    folder = files.write_rosbag2(tmp_path / "bag", files.imus(20), plugin=plugin)
    if "without" in kind:
        (folder / "metadata.yaml").unlink()
    messages, recording = read(next(folder.glob("*.db3")) if kind == "db3" else folder)
    assert [log for log, _ in messages] == [START_NS + k * STEP_NS for k in range(20)]
    assert recording.topics["/imu"].msgtype == IMU
    assert recording.topics["/imu"].count == 20


def test_a_split_recording_is_one_recording_in_natural_order(tmp_path) -> None:
    for part in range(12):
        start = START_NS + part * 5 * STEP_NS
        files.write_mcap(tmp_path / f"bag_{part}.mcap", files.imus(5, start_ns=start))
    messages, recording = read(tmp_path)
    assert [log for log, _ in messages] == [START_NS + k * STEP_NS for k in range(60)]
    assert recording.topics["/imu"].count == 60
    last = tmp_path / "bag_11.mcap"
    last.write_bytes(last.read_bytes()[:-100])
    messages, recording = read(tmp_path)
    assert len(messages) == 60
    assert ["bag_11.mcap" in damage.what for damage in recording.damage] == [True]


@pytest.mark.parametrize("compression", [None, *Bag1Writer.CompressionFormat], ids=str)
def test_a_ros1_bag(tmp_path, compression) -> None:
    entries = (
        ("/imu", IMU, log, files.imu(log, types=files.ROS1.types, seq=k))
        for k, log in enumerate(range(START_NS, START_NS + 30 * STEP_NS, STEP_NS))
    )
    with open_recording(files.write_bag(tmp_path / "a.bag", entries, compression=compression)) as recording:
        decoded = [raw.message for raw in recording.messages(["/imu"])]
        assert recording.topics["/imu"].count == 30
    assert [m.header.stamp.sec for m in decoded] == [(START_NS + k * STEP_NS) // 10**9 for k in range(30)]
    assert decoded[0].linear_acceleration.z == 9.81


def test_ros1_messages_in_an_mcap(tmp_path) -> None:
    entries = [("/imu", IMU, START_NS, files.imu(START_NS, types=files.ROS1.types, seq=0))]
    with open_recording(files.write_ros1_mcap(tmp_path / "a.mcap", entries)) as recording:
        (raw,) = recording.messages(["/imu"])
        assert raw.message.linear_acceleration.z == 9.81
        assert recording.topics["/imu"].msgtype == IMU


def test_the_ending_of_the_name_does_not_matter(tmp_path, whole) -> None:
    shutil.copy(whole, tmp_path / "flight.bag")
    with open_recording(tmp_path / "flight.bag") as recording:
        assert recording.kind == "mcap"


# --- order ---------------------------------------------------------------------------------------------------------


def test_messages_come_in_the_order_of_their_log_times_whatever_the_file_has(tmp_path) -> None:
    entries = list(files.imus(200, padding=600))
    shuffled = [entries[i] for i in np.random.default_rng(3).permutation(len(entries))]
    messages, _ = read(files.write_mcap(tmp_path / "a.mcap", shuffled, chunk_size=8000))
    assert [log for log, _ in messages] == [entry[2] for entry in entries]


def test_equal_times_keep_the_order_of_the_file(tmp_path) -> None:
    entries = [(topic, kind, START_NS, message) for topic, kind, _, message in files.imus(50, padding=600)]
    messages, _ = read(files.write_mcap(tmp_path / "a.mcap", entries, chunk_size=4000))
    assert [data for _, data in messages] == [files.serialized(IMU, entry[3]) for entry in entries]


def test_only_the_wanted_topics_are_read(tmp_path) -> None:
    entries = [(f"/imu{k % 3}", kind, log, message) for k, (_, kind, log, message) in enumerate(files.imus(30))]
    with open_recording(files.write_mcap(tmp_path / "a.mcap", entries)) as recording:
        assert {raw.topic for raw in recording.messages(["/imu1"])} == {"/imu1"}
        assert sum(1 for _ in recording.messages(["/imu0", "/imu2"])) == 20


def test_a_stream_can_be_left_early(whole) -> None:
    with open_recording(whole) as recording:
        for _ in range(20):
            stream = recording.messages(["/imu"])
            next(stream)
            stream.close()


# --- damaged files: the matrix -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "empty (0 bytes)"),
        (b"hello, this is no recording", "not a recording"),
        (b"\x89MCAP1\r\n" + bytes(100), "not a recording"),
    ],
    ids=["empty", "text", "another version"],
)
def test_what_is_no_recording_is_refused(tmp_path, content, says) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(IngestError, match=r"expected an \.mcap") as caught:
        open_recording(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)


def test_missing_files_and_folders_without_recordings_are_refused(tmp_path) -> None:
    with pytest.raises(IngestError, match="no such file"):
        open_recording(tmp_path / "nothing.mcap")
    with pytest.raises(IngestError, match="a folder without a recording"):
        open_recording(tmp_path)


def test_magic_alone_has_no_messages_and_says_that_it_was_not_finished(tmp_path, whole) -> None:
    messages, recording = read(damaged(whole, tmp_path, whole.read_bytes()[:8]))
    assert not messages
    assert not recording.topics
    assert [damage.open_ended for damage in recording.damage] == [True]


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_a_truncated_file_gives_all_whole_chunks(tmp_path, whole, truth, share) -> None:
    data = whole.read_bytes()
    cut = int(len(data) * share)
    expected = [m for end, messages in files.chunks_of(whole) if end <= cut for m in messages]
    messages, recording = read(damaged(whole, tmp_path, data[:cut]))
    assert messages == expected
    (damage,) = recording.damage
    assert damage.open_ended
    assert "the file ends within a chunk" in damage.what
    # the chunk that was cut says when it began and ended: sixteen messages of a tenth of a second each
    assert damage.seconds == pytest.approx(1.5, abs=0.15)
    assert damage.messages == pytest.approx(16, abs=2)
    assert damage.estimated
    assert "at least" in damage.describe()


def test_a_missing_end_magic_costs_nothing(tmp_path, whole, truth) -> None:
    messages, recording = read(damaged(whole, tmp_path, whole.read_bytes()[:-8]))
    assert messages == truth
    assert [damage.lost_something for damage in recording.damage] == [False]


def test_a_writer_that_was_killed_leaves_all_whole_chunks(tmp_path, truth) -> None:
    path = files.write_mcap(tmp_path / "a.mcap", files.imus(COUNT, padding=PADDING), finish=False)
    messages, recording = read(path)
    assert messages == truth[: len(messages)]
    assert len(truth) - len(messages) < 17  # one chunk at most
    (damage,) = recording.damage
    assert damage.open_ended
    assert "not finished" in damage.what


def test_a_flipped_byte_costs_one_chunk_and_the_loss_is_exact(tmp_path, whole, truth) -> None:
    begin, end = first_chunk(whole)
    messages, recording = read(damaged(whole, tmp_path, flipped(whole.read_bytes(), (begin + end) // 2)))
    gone = len(truth) - len(messages)
    assert set(messages) < set(truth)
    assert [log for log, _ in messages] == sorted(log for log, _ in messages)
    (damage,) = recording.damage
    assert damage.offset == begin
    assert damage.messages == gone
    assert 10 < gone < 20
    assert damage.seconds == pytest.approx(gone * 0.1)
    assert not damage.estimated


def test_a_flipped_byte_in_an_unfinished_file_costs_one_chunk_too(tmp_path, whole, truth) -> None:
    begin, end = first_chunk(whole)
    data = flipped(whole.read_bytes(), (begin + end) // 2)[:-3000]
    messages, recording = read(damaged(whole, tmp_path, data))
    flip = recording.damage[0]
    assert flip.offset == begin
    indexed = [m for k, (_, inside) in enumerate(files.chunks_of(whole)) if k == 1 for m in inside]
    assert flip.messages == len(indexed)  # told by the message index behind the chunk
    assert flip.seconds == pytest.approx(len(indexed) * 0.1)
    assert not set(indexed) & set(messages)


@pytest.mark.parametrize("back", [50, 200, 30], ids=["in the footer", "in the summary", "in the offsets"])
def test_a_damaged_summary_costs_nothing(tmp_path, whole, truth, back) -> None:
    messages, recording = read(damaged(whole, tmp_path, flipped(whole.read_bytes(), -back, 255)))
    assert messages == truth
    assert [damage.lost_something for damage in recording.damage] == [False]


def test_a_wrong_summary_checksum_is_noticed(tmp_path, whole, truth) -> None:
    data = whole.read_bytes()
    messages, recording = read(damaged(whole, tmp_path, flipped(data, -10)))
    assert messages == truth
    assert "checksum mismatch in the summary" in recording.damage[0].what


def test_zeros_at_the_end_cost_what_they_cover(tmp_path, whole, truth) -> None:
    data = whole.read_bytes()
    kept = len(data) - 65536
    messages, recording = read(damaged(whole, tmp_path, data[:kept] + bytes(65536)))
    assert messages == [m for end, inside in files.chunks_of(whole) if end <= kept for m in inside]
    assert recording.damage[-1].open_ended


def test_garbage_behind_the_end_costs_nothing(tmp_path, whole, truth) -> None:
    messages, recording = read(damaged(whole, tmp_path, whole.read_bytes() + os.urandom(5000)))
    assert messages == truth
    assert "5000 bytes after the end" in recording.damage[0].what


@pytest.mark.parametrize("finished", [True, False])
def test_a_hole_in_the_middle_costs_the_chunks_that_it_touches(tmp_path, whole, truth, finished) -> None:
    data = whole.read_bytes()
    rng = np.random.default_rng(5)
    start, size = len(data) // 3, 200_000
    broken = data[:start] + rng.bytes(size) + data[start + size :]
    kept = len(data) if finished else len(data) - 4000
    messages, recording = read(damaged(whole, tmp_path, broken[:kept]))
    chunks = files.chunks_of(whole)
    begins = [0] + [end for end, _ in chunks[:-1]]
    both = zip(begins, chunks, strict=True)
    sound = [inside for at, (end, inside) in both if end <= kept and (end <= start or at >= start + size)]
    expected = [m for inside in sound for m in inside]
    # a chunk of which only the index records behind it are hit may still be read
    assert set(expected) <= set(messages) <= set(truth)
    assert lost(recording) == pytest.approx(len(truth) - len(messages), abs=0 if finished else 2)
    holes = [d for d in recording.damage if d.lost_something and not d.open_ended]
    assert sum(d.seconds for d in holes) == pytest.approx(0.1 * (len(truth) - len(messages)), abs=0.2)


def test_a_damaged_length_does_not_end_the_reading(tmp_path, whole, truth) -> None:
    begin, end = first_chunk(whole)
    for length in (2**40, 2**63 + 5, 300_000, 0, end - begin - 9 + 700):
        data = bytearray(whole.read_bytes())
        data[begin + 1 : begin + 9] = length.to_bytes(8, "little")
        for cut in (len(data), len(data) - 8):
            messages, recording = read(damaged(whole, tmp_path, bytes(data[:cut])))
            gone = len(truth) - len(messages)
            assert 10 < gone < 20
            assert lost(recording) == gone
            assert recording.damage[0].offset == begin


def test_unchunked_messages_are_recovered_one_by_one(tmp_path, truth) -> None:
    options = {"use_chunking": False, "enable_data_crcs": True}
    path = files.write_mcap(tmp_path / "a.mcap", files.imus(COUNT, padding=PADDING), **options)
    data = path.read_bytes()
    messages, recording = read(damaged(path, tmp_path, data[: len(data) // 2]))
    assert messages == truth[: len(messages)]
    assert len(messages) in (COUNT // 2, COUNT // 2 - 1)
    assert recording.damage[0].open_ended
    # without chunks only the checksum of all data can tell that a byte is wrong, not where
    messages, recording = read(damaged(path, tmp_path, flipped(data, len(data) // 2, 4)))
    assert len(messages) == COUNT
    assert "checksum mismatch" in recording.damage[0].what


def test_messages_that_the_statistics_announce_and_nobody_has_are_damage(tmp_path, whole) -> None:
    data = bytearray(whole.read_bytes())
    # statistics: 2 message counts of the file (total, then of channel 1), then repair the summary's checksum
    with whole.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    count = summary.statistics.message_count
    entry = (1).to_bytes(2, "little") + count.to_bytes(8, "little")
    at = bytes(data).rindex(entry)
    data[at + 2 : at + 10] = (count + 7).to_bytes(8, "little")
    start = int.from_bytes(data[-28:-20], "little")
    data[-12:-8] = zlib.crc32(data[start:-12]).to_bytes(4, "little")
    messages, recording = read(damaged(whole, tmp_path, bytes(data)))
    assert len(messages) == count
    assert lost(recording) == 7


def test_two_meanings_of_one_channel_are_refused_or_told(tmp_path, whole) -> None:
    data = whole.read_bytes()
    twice = damaged(whole, tmp_path, data[:-8] + data[8:])
    messages, recording = read(twice)
    assert len(messages) == COUNT
    assert recording.damage


# --- schemas and encodings -----------------------------------------------------------------------------------------


def _one_message(path: Path, name: str, encoding: str, schema: bytes, message_encoding: str, data: bytes) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("")
        identity = writer.register_schema(name, encoding, schema) if encoding else 0
        writer.add_message(writer.register_channel("/a", message_encoding, identity), 1, data, 1)
        writer.finish()
    return path


HOSTILE = [
    b"this/is # not a definition",
    b"\xff\xfe\x00",
    b"uint8[999999999] data\n",
    b"float64[0x7fffffff] data\n",
    b"string label_of_another_message\n",
    b"geometry_msgs/Missing pose\n",
    b"sensor_msgs/msg/Imu self\n",
    b"x" * 1_000_000,
    b"import os # ) ]\nint32 A=__import__('os').getpid()\n",
]


@pytest.mark.parametrize("schema", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_definitions_are_refused(tmp_path, schema) -> None:
    path = _one_message(tmp_path / "a.mcap", IMU, "ros2msg", schema, "cdr", b"\0\1\0\0" + bytes(400))
    with open_recording(path) as recording, pytest.raises(IngestError, match="/a"):
        _ = [raw.message for raw in recording.messages(["/a"])]


@pytest.mark.parametrize(
    ("encoding", "message_encoding"), [("weird", "cdr"), ("jsonschema", "json"), ("protobuf", "protobuf"), ("", "json")]
)
def test_other_encodings_are_listed_and_refused_only_when_needed(tmp_path, encoding, message_encoding) -> None:
    path = _one_message(tmp_path / "a.mcap", "foxglove.PointCloud", encoding, b"{}", message_encoding, b"{}")
    with open_recording(path) as recording:
        assert recording.topics["/a"].encoding == message_encoding
        assert not list(recording.messages([]))
        with pytest.raises(IngestError, match="expected ROS 2 messages"):
            list(recording.messages(["/a"]))


@pytest.mark.parametrize("length", [0, 3, 4, 30, 100])
def test_a_payload_shorter_than_its_schema_is_an_error_of_that_message(tmp_path, length) -> None:
    short = files.serialized(IMU, files.imu(START_NS))[:length]
    path = files.write_mcap(tmp_path / "a.mcap", [("/imu", IMU, START_NS, short)])
    with open_recording(path) as recording:
        (raw,) = recording.messages(["/imu"])
        with pytest.raises(IngestError, match="not a whole sensor_msgs/msg/Imu"):
            _ = raw.message


def test_a_topic_with_two_types_is_refused_only_when_needed(tmp_path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for kind in (IMU, files.POSE):
            schema = writer.register_schema(
                kind, "ros2msg", files.ROS2.generate_msgdef(kind, ros_version=2)[0].encode()
            )
            message = files.imu(1) if kind == IMU else files.pose(1)
            writer.add_message(writer.register_channel("/a", "cdr", schema), 1, files.serialized(kind, message), 1)
        writer.finish()
    with open_recording(path) as recording, pytest.raises(IngestError, match="several types"):
        list(recording.messages(["/a"]))


# --- metadata, attachments -----------------------------------------------------------------------------------------


def test_metadata_and_attachments_with_their_checksums(tmp_path) -> None:
    path = files.write_mcap(
        tmp_path / "a.mcap",
        files.imus(5),
        metadata={"who": {"pilot": "Änne"}},
        attachments={"a.txt": b"control points", "b.txt": b"calibration"},
    )
    for cut in (None, -400):
        path.write_bytes(path.read_bytes()[:cut])
        with open_recording(path) as recording:
            assert recording.metadata == {"who": {"pilot": "Änne"}}
            assert list(recording.attachments()) == [
                ("a.txt", "text/plain", b"control points"),
                ("b.txt", "text/plain", b"calibration"),
            ]
    path.write_bytes(path.read_bytes().replace(b"control points", b"control Points"))
    with open_recording(path) as recording:
        assert [name for name, _, _ in recording.attachments()] == ["b.txt"]
        assert any("checksum mismatch in an attachment" in damage.what for damage in recording.damage)


# --- bags ----------------------------------------------------------------------------------------------------------


def test_damaged_bags_are_refused_in_one_line(tmp_path) -> None:
    entries = [
        ("/imu", IMU, log, files.imu(log, types=files.ROS1.types, seq=0)) for log in range(10**9, 2 * 10**9, 10**8)
    ]
    data = files.write_bag(tmp_path / "a.bag", entries).read_bytes()
    for cut in (20, 3000, len(data) // 2, len(data) - 30):
        path = tmp_path / "cut.bag"
        path.write_bytes(data[:cut])
        with pytest.raises(IngestError) as caught:
            read(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
    folder = files.write_rosbag2(tmp_path / "bag", files.imus(5))
    database = next(folder.glob("*.db3"))
    database.write_bytes(database.read_bytes()[:5000])
    with pytest.raises(IngestError):
        read(database)
    (folder / "metadata.yaml").write_text("rosbag2: [nothing")
    with pytest.raises(IngestError):
        read(folder)


class _FailingDisk:
    """A file whose sectors fail in one stretch."""

    def __init__(self, stream, bad: range) -> None:
        self._stream, self._bad = stream, bad

    def _check(self, size: int) -> None:
        at = self._stream.tell()
        if at < self._bad.stop and at + size > self._bad.start:
            raise OSError(5, "Input/output error")

    def read(self, size: int = -1) -> bytes:
        self._check(size)
        return self._stream.read(size)

    def readinto(self, buffer) -> int:
        self._check(len(buffer))
        return self._stream.readinto(buffer)

    def __getattr__(self, name: str):
        return getattr(self._stream, name)

    def __enter__(self):
        return self

    def __exit__(self, *args) -> None:
        self._stream.close()


def test_a_failing_sector_costs_one_chunk(whole, truth, monkeypatch) -> None:
    begin, end = first_chunk(whole)
    opened = Path.open

    def open_failing(path, *args, **kwargs):
        stream = opened(path, *args, **kwargs)
        return _FailingDisk(stream, range(begin + 100, end - 100)) if path == whole else stream

    monkeypatch.setattr(Path, "open", open_failing)
    messages, recording = read(whole)
    assert 10 < len(truth) - len(messages) < 20
    assert lost(recording) == len(truth) - len(messages)
    assert "the disk fails" in recording.damage[0].what
