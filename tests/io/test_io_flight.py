from __future__ import annotations

import threading
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from driver_clouds import EPOCH_NS, PERIOD_NS, vlp16_sweep
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader

from mineloc import se3
from mineloc.data import Calibration, FlightInfo, ImuSamples, Sweep, Trajectory
from mineloc.errors import FlightError, IngestError, OutputError
from mineloc.io import canonical, flight_layout
from mineloc.io.flight import FlightReader, FlightWriter
from mineloc.io.mcap_writer import McapWriter
from mineloc.io.ros import IMU, POINT_CLOUD2, definition

INFO = FlightInfo(flight="2026-03-01/2", site="Edgar", drone="D1", lidar="VLP-16", operator="Änne")
CALIBRATION = Calibration(se3.exp(np.arange(6) * 0.1), se3.exp(np.arange(6) * -0.2))


def _imu(start_ns: int, end_ns: int, *, step_ns: int = 5_000_000) -> ImuSamples:
    stamps = np.arange(start_ns, end_ns, step_ns, dtype=np.int64)
    rng = np.random.default_rng(len(stamps))
    return ImuSamples(stamps, rng.normal(size=(len(stamps), 3)), rng.normal(size=(len(stamps), 3)))


def _reference(n: int = 60, *, step_ns: int = 10_000_000, parent: str = "map") -> Trajectory:
    steps = np.random.default_rng(1).normal(size=(n, 6)) * 0.05
    return Trajectory(EPOCH_NS + step_ns * np.arange(n), se3.exp(np.cumsum(steps, axis=0)), parent)


SWEEPS = [vlp16_sweep(EPOCH_NS + i * PERIOD_NS, columns=60, seed=i) for i in range(6)]
SAMPLES = _imu(EPOCH_NS - 20_000_000, EPOCH_NS + 700_000_000)


def _write(path: Path, *, sweeps=SWEEPS, imu=SAMPLES, reference=None, **options) -> Path:
    with FlightWriter(path, INFO, CALIBRATION, **options) as writer:
        if imu is not None:
            writer.add_imu(imu)
        if reference is not None:
            writer.add_reference(reference)
        for sweep in sweeps:
            writer.add_sweep(sweep)
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "f.mcap"
    with FlightWriter(path, INFO, CALIBRATION) as writer:
        writer.add_imu(SAMPLES)
        writer.add_reference(_reference())
        writer.add_odometry(_reference(30, step_ns=20_000_000, parent="odom"))
        writer.add_attachment("points.csv", "text/csv", b"1,2,3\n" * 100)
        with pytest.raises(ValueError, match=r"attachment 'points\.csv' exists"):
            writer.add_attachment("points.csv", "text/csv", b"")
        writer.set_health({"gaps": 0, "rates": {"lidar_hz": 10.0}})
        for sweep in SWEEPS:
            writer.add_sweep(sweep, publish_ns=sweep.end_ns + 1_000_000)
    return path


def _same_sweep(a: Sweep, b: Sweep) -> None:
    assert (a.stamp_ns, a.period_ns) == (b.stamp_ns, b.period_ns)
    for name in ("points_lidar", "offsets_ns", "ring", "intensity"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def _same_imu(a: ImuSamples, b: ImuSamples) -> None:
    for name in ("stamps_ns", "gyro_radps", "accel_mps2"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_what_was_written_is_read(flight):
    with FlightReader(flight) as reader:
        assert reader.info == INFO
        np.testing.assert_array_equal(reader.calibration.T_body_lidar, CALIBRATION.T_body_lidar)
        np.testing.assert_array_equal(reader.calibration.T_body_imu, CALIBRATION.T_body_imu)
        assert reader.health == {"gaps": 0, "rates": {"lidar_hz": 10.0}}
        assert reader.sweep_count == len(SWEEPS)
        assert reader.first_ns == SAMPLES.stamps_ns[0]
        assert reader.last_ns == SAMPLES.stamps_ns[-1]
        assert reader.duration_s == pytest.approx(0.715)
        assert reader.attachment_names == ("points.csv",)
        assert reader.attachment("points.csv") == b"1,2,3\n" * 100
        with pytest.raises(KeyError):
            reader.attachment("nothing")
        for found, sweep in zip(reader.sweeps(), SWEEPS, strict=True):
            _same_sweep(found, sweep)
        _same_imu(reader.imu(), SAMPLES)
        for found, truth in (
            (reader.reference(), _reference()),
            (reader.odometry(), _reference(30, step_ns=20_000_000, parent="odom")),
        ):
            np.testing.assert_array_equal(found.stamps_ns, truth.stamps_ns)
            np.testing.assert_allclose(found.poses, truth.poses, atol=1e-14)
            assert (found.parent, found.child) == (truth.parent, "body")


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_other_programs_read_it(tmp_path, compression):
    path = _write(tmp_path / "f.mcap", reference=_reference(), compression=compression, chunk_bytes=1 << 15)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        messages = list(reader.iter_messages())
        summary = reader.get_summary()
    times = [message.log_time for _, _, message in messages]
    assert times == sorted(times)
    counts = {c.topic: summary.statistics.channel_message_counts[i] for i, c in summary.channels.items()}
    assert counts == {"/lidar/points": 6, "/imu": len(SAMPLES), "/pose": 60, "/tf": 30, "/tf_static": 1}
    assert all(c.metadata["offered_qos_profiles"] and c.message_encoding == "cdr" for c in summary.channels.values())
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    # a chunk holds one sweep (21 kB) or a second of small messages, and never more than asked
    assert max(c.uncompressed_size for c in summary.chunk_indexes) <= 1 << 15
    with path.open("rb") as stream:
        streamed = [r for r in StreamReader(stream, validate_crcs=True).records if hasattr(r, "channel_id")]
    assert len([r for r in streamed if hasattr(r, "log_time")]) == len(messages)
    with AnyReader([path]) as reader:
        decoded = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]
        qos = {c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections}
    assert len(decoded) == len(messages)
    assert qos["/tf_static"] == "TRANSIENT_LOCAL"
    assert qos["/imu"] == "VOLATILE"
    transforms = [m.transforms[0] for topic, m in decoded if topic == "/tf"]
    assert {(t.header.frame_id, t.child_frame_id) for t in transforms} == {("map", "body")}


def test_the_same_calls_give_the_same_bytes(tmp_path):
    a = _write(tmp_path / "a.mcap", reference=_reference()).read_bytes()
    assert a == _write(tmp_path / "b.mcap", reference=_reference()).read_bytes()
    # portions do not matter either
    half = len(SAMPLES) // 2
    with FlightWriter(tmp_path / "c.mcap", INFO, CALIBRATION) as writer:
        cut = int(SAMPLES.stamps_ns[half])
        writer.add_imu(SAMPLES.between(0, cut))
        writer.add_imu(SAMPLES.between(cut, 2**62))
        writer.add_reference(_reference())
        for sweep in SWEEPS:
            writer.add_sweep(sweep)
    with FlightReader(tmp_path / "c.mcap") as reader:
        _same_imu(reader.imu(), SAMPLES)
    assert (tmp_path / "c.mcap").read_bytes() == a


def test_encoded_sweeps_may_be_handed_on(tmp_path, flight):
    with FlightWriter(tmp_path / "f.mcap", INFO, CALIBRATION) as writer:
        for s in SWEEPS:
            data = canonical.encode_sweep(s)
            writer.add_raw_sweep(data, stamp_ns=s.stamp_ns, end_ns=s.end_ns, period_ns=s.period_ns)
    with FlightReader(tmp_path / "f.mcap") as reader:
        for found, sweep in zip(reader.sweeps(), SWEEPS, strict=True):
            _same_sweep(found, sweep)


def test_sweeps_of_every_kind_in_one_flight(tmp_path):
    points = np.ones((3, 3), np.float32)
    kinds = [
        Sweep(EPOCH_NS, points),
        Sweep(EPOCH_NS + 1, points[:0], np.zeros(0, np.int64), np.zeros(0, np.uint16)),
        Sweep(EPOCH_NS + 2, points, np.array([0, 5, 2**33]), period_ns=7),
        Sweep(EPOCH_NS + 3 + 2**33, points, intensity=np.ones(3, np.float32)),
    ]
    path = _write(tmp_path / "f.mcap", sweeps=kinds, imu=None)
    with FlightReader(path) as reader:
        for found, sweep in zip(reader.sweeps(), kinds, strict=True):
            _same_sweep(found, sweep)
        assert len(reader.imu()) == 0
        assert reader.reference() is None
        assert reader.odometry() is None
        assert [(s.stamp_ns, len(imu)) for s, imu in reader.steps()] == [(s.stamp_ns, 0) for s in kinds]


def test_a_flight_may_have_no_sweeps(tmp_path):
    path = _write(tmp_path / "f.mcap", sweeps=[], imu=None, reference=_reference())
    with FlightReader(path) as reader:
        assert reader.sweep_count == 0
        assert list(reader.sweeps()) == list(reader.steps()) == []
        assert len(reader.reference()) == 60


@pytest.mark.parametrize(("a", "b"), [(0, 6), (1, 3), (2, 2), (5, 6), (6, 6)])
def test_a_part_of_the_flight(flight, a, b):
    with FlightReader(flight) as reader:
        start, end = EPOCH_NS + a * PERIOD_NS, EPOCH_NS + b * PERIOD_NS
        assert [s.stamp_ns for s in reader.sweeps(start, end)] == [s.stamp_ns for s in SWEEPS[a:b]]
        assert [s.stamp_ns for s in reader.sweeps(start - 1, end - 1)] == [s.stamp_ns for s in SWEEPS[a:b]]
        assert [s.stamp_ns for s in reader.sweeps(start_ns=start + 1)] == [s.stamp_ns for s in SWEEPS[a + 1 :]]


@st.composite
def _gappy(draw):
    """Inertial stamps with gaps, and sweeps some of which are missing, in units of 10 ms."""
    stamps = sorted(draw(st.sets(st.integers(0, 200), max_size=60)))
    starts = sorted(draw(st.sets(st.integers(0, 19), min_size=1, max_size=12)))
    return stamps, [10 * s for s in starts], draw(st.integers(0, 9))


@settings(max_examples=40, deadline=None)
@given(_gappy())
def test_steps_hold_each_sample_once_and_reach_past_the_sweep(tmp_path_factory, gappy):
    stamps, starts, length = gappy
    unit = 10_000_000
    times = EPOCH_NS + unit * np.array(stamps, dtype=np.int64)
    imu = ImuSamples(times, np.zeros((len(times), 3)), np.zeros((len(times), 3)))
    points = np.ones((2, 3), np.float32)
    sweeps = [Sweep(EPOCH_NS + unit * s, points, np.array([0, unit * length])) for s in starts]
    path = _write(tmp_path_factory.mktemp("steps") / "f.mcap", sweeps=sweeps, imu=imu)
    with FlightReader(path) as reader:
        steps = [(s.end_ns, part.stamps_ns) for s, part in reader.steps()]
    assert [end for end, _ in steps] == [s.end_ns for s in sweeps]
    given = np.concatenate([part for _, part in steps])
    np.testing.assert_array_equal(given, times[: len(given)])
    done = 0
    for end, part in steps:
        done += len(part)
        after = times[times >= end]
        if len(after) and after[0] <= end + 300_000_000:
            # up to the first at or after the end, unless an earlier sweep took more already
            expected = int(np.searchsorted(times, end)) + 1
            assert done == max(expected, done - len(part))
        else:
            assert done == max(int(np.searchsorted(times, end)), done - len(part))


def test_steps_wait_for_samples_that_come_late_in_the_file(tmp_path):
    with FlightWriter(tmp_path / "f.mcap", INFO, CALIBRATION) as writer:
        for sweep in SWEEPS:
            writer.add_sweep(sweep)
        writer.add_imu(SAMPLES)
    with FlightReader(tmp_path / "f.mcap") as reader:
        for sweep, imu in reader.steps():
            assert imu.stamps_ns[-2] < sweep.end_ns <= imu.stamps_ns[-1]


def test_readers_that_stop_early_leave_nothing_behind(flight):
    with FlightReader(flight) as reader:
        for stream in (reader.sweeps(), reader.steps()):
            next(stream)
            stream.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("mineloc")]


def test_time_that_goes_backwards_is_refused_when_written(tmp_path):
    with pytest.raises(FlightError, match="time goes backwards on /lidar/points"):
        _write(tmp_path / "f.mcap", sweeps=[SWEEPS[1], SWEEPS[0]])
    with pytest.raises(FlightError, match="time repeats on /lidar/points"):
        _write(tmp_path / "f.mcap", sweeps=[SWEEPS[1], SWEEPS[1]])
    later = replace(SAMPLES, stamps_ns=SAMPLES.stamps_ns + SAMPLES.stamps_ns[-1] - SAMPLES.stamps_ns[0])
    with FlightWriter(tmp_path / "f.mcap", INFO, CALIBRATION) as writer:
        writer.add_imu(SAMPLES)
        with pytest.raises(FlightError, match="time repeats on /imu"):
            writer.add_imu(later)
        writer.add_reference(_reference())
        with pytest.raises(FlightError, match="time goes backwards on /pose"):
            writer.add_reference(_reference())


def _foreign(path: Path, messages, *, info=None, period="100000000") -> Path:
    """A file with the record of a flight that mineloc's writer did not write; messages are (topic, log, data)."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, profile="ros2", library="other")
        ids = {}
        for topic, log_ns, data in messages:
            if topic not in ids:
                msgtype = POINT_CLOUD2 if topic == flight_layout.POINTS else IMU
                notes = {"period_ns": period} if topic == flight_layout.POINTS else {}
                ids[topic] = writer.add_channel(topic, msgtype, definition(msgtype), notes)
            writer.add_message(ids[topic], log_ns, data)
        record = flight_layout.encode_info(INFO, CALIBRATION, first_ns=0, last_ns=1) if info is None else info
        writer.finish({flight_layout.FLIGHT_RECORD: record} if record else {}, [])
    return path


def _points(sweep: Sweep, log_ns: int | None = None):
    return flight_layout.POINTS, sweep.end_ns if log_ns is None else log_ns, canonical.encode_sweep(sweep)


@pytest.mark.parametrize(("second", "match"), [(0, "goes backwards"), (1, "repeats")])
def test_time_that_goes_backwards_is_refused_when_read(tmp_path, second, match):
    path = _foreign(tmp_path / "f.mcap", [_points(SWEEPS[1], 10**18), _points(SWEEPS[second], 10**18 + 1)])
    with FlightReader(path) as reader:
        for stream in (reader.sweeps(), reader.steps()):
            with pytest.raises(FlightError, match=rf"time {match} on /lidar/points: \d+ ns after \d+ ns"):
                list(stream)


def test_repeated_inertial_samples_are_refused_when_read(tmp_path):
    rows = [
        ("/imu", int(t), row.tobytes()) for t, row in zip(SAMPLES.stamps_ns, canonical.encode_imu(SAMPLES), strict=True)
    ]
    path = _foreign(tmp_path / "f.mcap", [rows[0], rows[0]])
    with FlightReader(path) as reader, pytest.raises(FlightError, match="time repeats on /imu"):
        reader.imu()


def test_foreign_messages_are_refused(tmp_path):
    junk = b"\0\1\0\0junk"
    match = r"(points|imu) holds a sensor_msgs/msg/\w+ that mineloc did not write; .* run mineloc ingest first"
    with FlightReader(_foreign(tmp_path / "a.mcap", [("/lidar/points", 1, junk), ("/imu", 1, junk)])) as reader:
        for read in (lambda: list(reader.sweeps()), reader.imu):
            with pytest.raises(IngestError, match=match):
                read()
    path = _foreign(tmp_path / "c.mcap", [_points(SWEEPS[0])], period="soon")
    with FlightReader(path) as reader, pytest.raises(IngestError, match=match):
        list(reader.sweeps())


def test_recordings_that_are_no_flight_are_refused(tmp_path):
    record = flight_layout.encode_info(INFO, CALIBRATION, first_ns=0, last_ns=1)
    for info, match in (
        ({}, "no mineloc.flight record; expected a canonical flight; run mineloc ingest first"),
        (record | {"schema": "mineloc.flight/9"}, "flight schema 'mineloc.flight/9'; expected mineloc.flight/1"),
        (record | {"site": "elsewhere"}, "the mineloc.flight record is damaged"),
    ):
        path = _foreign(tmp_path / f"{zlib.crc32(match.encode())}.mcap", [_points(SWEEPS[0])], info=info)
        with pytest.raises(IngestError, match=match):
            FlightReader(path)
    with pytest.raises(IngestError, match="No such file"):
        FlightReader(tmp_path / "nothing.mcap")
    with pytest.raises(IngestError, match="Is a directory"):
        FlightReader(tmp_path)
    for name, content in (("empty", b""), ("text", b"hello " * 99), ("magic", b"\x89MCAP0\r\n")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(IngestError):
            FlightReader(tmp_path / name)


def _everything(path: Path):
    with FlightReader(path) as reader:
        sweeps = [(s.stamp_ns, zlib.crc32(s.points_lidar.tobytes())) for s in reader.sweeps()]
        imu, reference = reader.imu(), reader.reference()
        assert reference is not None
        names = [zlib.crc32(reader.attachment(name)) for name in reader.attachment_names]
        return (
            (reader.info, reader.calibration.T_body_imu.tobytes(), sweeps, names, sorted(reader.health)),
            (imu.gyro_radps.tobytes(), reference.poses.tobytes(), len(list(reader.steps()))),
        )


def test_a_flipped_byte_is_found_wherever_it_is(flight, tmp_path):
    """Every byte that matters is under a checksum: a changed file is refused, or reads as if unchanged."""
    whole, truth = flight.read_bytes(), _everything(flight)
    rng = np.random.default_rng(0)
    path, refused = tmp_path / "f.mcap", 0
    for at in rng.choice(len(whole), 150, replace=False):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            assert _everything(path) == truth
        except IngestError:
            refused += 1
    # message indexes, which nobody needs, are the exception
    assert refused > 130


def test_a_cut_flight_is_refused(flight, tmp_path):
    whole = flight.read_bytes()
    for share in (0.001, 0.3, 0.9, 0.999):
        path = tmp_path / "f.mcap"
        path.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(IngestError):
            FlightReader(path)


class _Full:
    """A stream on a disk that fills up."""

    def __init__(self, stream, room: int) -> None:
        self._stream, self._room = stream, room

    def write(self, data) -> int:
        self._room -= len(data)
        if self._room < 0:
            raise OSError(28, "No space left on device")
        return self._stream.write(data)


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    real = McapWriter.__init__

    for room in (100, 30_000, 120_000):
        monkeypatch.setattr(
            McapWriter, "__init__", lambda self, stream, room=room, **k: real(self, _Full(stream, room), **k)
        )
        with pytest.raises(OutputError, match="the disk is full"):
            _write(tmp_path / "f.mcap")
        assert list(tmp_path.iterdir()) == []
    assert not [t for t in threading.enumerate() if t.name.startswith("mineloc")]


def test_an_error_or_ctrl_c_inside_leaves_nothing(tmp_path):
    def write_and_fail(kind):
        with FlightWriter(tmp_path / "f.mcap", INFO, CALIBRATION) as writer:
            writer.add_sweep(SWEEPS[0])
            raise kind

    for kind in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(kind):
            write_and_fail(kind)
    assert list(tmp_path.iterdir()) == []
    assert not [t for t in threading.enumerate() if t.name.startswith("mineloc")]


def test_an_existing_file_is_kept_unless_told(tmp_path):
    path = _write(tmp_path / "f.mcap", sweeps=SWEEPS[:1])
    with pytest.raises(OutputError, match="exists"):
        _write(path)
    with FlightReader(path) as reader:
        assert reader.sweep_count == 1
    _write(path, overwrite=True)
    with FlightReader(path) as reader:
        assert reader.sweep_count == 6


def test_mistakes_of_the_caller(tmp_path):
    with pytest.raises(ValueError, match="in a with statement"):
        FlightWriter(tmp_path / "f.mcap", INFO, CALIBRATION).add_sweep(SWEEPS[0])
    with pytest.raises(ValueError, match="body in map"), FlightWriter(tmp_path / "f.mcap", INFO, CALIBRATION) as writer:
        writer.add_reference(_reference(parent="odom"))
    with pytest.raises(ValueError, match="compression 'gzip'"):
        _write(tmp_path / "f.mcap", compression="gzip")
    with pytest.raises(ValueError, match="negative"):
        _write(tmp_path / "f.mcap", sweeps=[Sweep(-5, np.ones((1, 3), np.float32))], imu=None)
    assert list(tmp_path.iterdir()) == []


def test_the_reference_is_thinned_only_for_viewers(tmp_path):
    path = _write(tmp_path / "f.mcap", reference=_reference(1000, step_ns=1_000_000))
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    counts = {c.topic: summary.statistics.channel_message_counts[i] for i, c in summary.channels.items()}
    assert counts["/pose"] == 1000
    assert 50 <= counts["/tf"] <= 51
