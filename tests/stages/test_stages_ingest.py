"""Recordings of every kind become flights; what makes none is refused in one line and leaves nothing behind."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import driver_clouds as drivers
import numpy as np
import pytest
import recording_files as files
from driver_clouds import vlp16_sweep
from fuzz_recordings import fuzz
from recording_files import CLOUD, IMU, ODOMETRY, POSE, START_NS, STEP_NS, TF

from mineloc import se3
from mineloc.cli import main
from mineloc.config import load_config
from mineloc.data import Calibration, FlightInfo, ImuSamples, Sweep, Trajectory
from mineloc.errors import IngestError, MinelocError, OutputError
from mineloc.io.flight import FlightReader, FlightWriter
from mineloc.io.health import Health
from mineloc.output import TEMP_PREFIX
from mineloc.stages.ingest import ingest

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "recordings"
IMU_STEP_NS = 5_000_000


def sweeps(count: int, *, columns: int = 40, still: bool = False) -> list[Sweep]:
    """A drone that moves forward, so that the surroundings change."""
    made = []
    for k in range(count):
        sweep = vlp16_sweep(START_NS + k * STEP_NS, columns=columns, seed=0 if still else k)
        scale = 1.0 if still else 1.0 + 0.1 * np.sin(0.3 * k)
        made.append(replace(sweep, points_lidar=sweep.points_lidar * np.float32(scale)))
    return made


def clouds(made: list[Sweep], *, topic: str = "/velodyne_points", driver=drivers.velodyne) -> list[files.Entry]:
    return [(topic, CLOUD, sweep.end_ns + 2_000_000, driver(sweep)) for sweep in made]


def samples(count: int, *, topic: str = "/imu/data", accel: float = 9.81, gyro: float = 0.2) -> list[files.Entry]:
    rng = np.random.default_rng(count)
    out = []
    for k in range(count):
        stamp = START_NS + k * IMU_STEP_NS
        message = files.imu(stamp, rng.normal(0, gyro, 3), rng.normal([0, 0, accel], 0.05 * accel), frame="imu_link")
        out.append((topic, IMU, stamp + 100_000, message))
    return out


def in_order(*groups: list[files.Entry]) -> list[files.Entry]:
    return sorted((entry for group in groups for entry in group), key=lambda entry: entry[2])


def run(tmp_path: Path, entries: list[files.Entry], *, told: str = "") -> tuple[Path, Health]:
    path = files.write_mcap(tmp_path / "recording.mcap", entries)
    sequence = None
    if told:
        sequence = tmp_path / "sequence.toml"
        sequence.write_text(told)
    out = tmp_path / "flight.mcap"
    return out, ingest(path, out=out, sequence=sequence).health


def findings(health: Health) -> dict[str, int]:
    return {finding.name: finding.count for finding in health.findings}


def assert_equal(left: Sweep, right: Sweep, *, tolerance_ns: int = 0) -> None:
    assert abs(left.stamp_ns - right.stamp_ns) <= tolerance_ns
    np.testing.assert_array_equal(left.points_lidar, right.points_lidar)
    np.testing.assert_array_equal(left.ring, right.ring)
    np.testing.assert_array_equal(left.intensity, right.intensity)
    np.testing.assert_allclose(left.offsets_ns, right.offsets_ns, atol=2 * tolerance_ns, rtol=0)


# --- what comes in comes out ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("driver", [drivers.velodyne, drivers.robosense, drivers.hesai], ids=lambda d: d.__name__)
def test_a_recording_becomes_the_flight_that_was_flown(tmp_path, driver) -> None:
    truth = sweeps(14)
    poses = [("/gt/pose", POSE, s.stamp_ns, files.pose(s.stamp_ns, (0.1 * k, 0, 0))) for k, s in enumerate(truth)]
    out, health = run(tmp_path, in_order(clouds(truth, driver=driver), samples(300), poses))
    with FlightReader(out) as flight:
        read = list(flight.sweeps())
        imu, reference = flight.imu(), flight.reference()
        assert flight.info.source == "recording.mcap"
        assert flight.health == json.loads(json.dumps(health.to_json_dict()))
    assert len(read) == len(truth)
    for left, right in zip(read, truth, strict=True):
        assert_equal(left, right, tolerance_ns=250)
    assert reference is not None
    assert len(imu) == 300
    np.testing.assert_allclose(reference.positions_m[:, 0], 0.1 * np.arange(14))
    lidar, inertial, poses_seen = health.topics
    assert (lidar.role, lidar.messages, lidar.used, lidar.gaps) == ("lidar", 14, 14, 0)
    assert lidar.rate_hz == pytest.approx(10.0, rel=1e-3)
    assert inertial.rate_hz == pytest.approx(200.0, rel=1e-6)
    assert inertial.log_delay_median_s == pytest.approx(1e-4)
    assert poses_seen.role == "reference"
    assert health.points is not None
    assert (health.points.median, health.points.point_times, health.points.rings) == (640, True, True)
    assert health.worst in (None, "info")
    assert not health.recovered


@pytest.mark.parametrize("kind", ["bag", "rosbag2", "ros1 mcap"])
def test_the_same_flight_from_any_container(tmp_path, kind) -> None:
    truth = sweeps(8)
    entries = in_order(clouds(truth), samples(100))
    if kind == "rosbag2":
        path = files.write_rosbag2(tmp_path / "bag", entries)
    else:
        write = files.write_bag if kind == "bag" else files.write_ros1_mcap
        path = write(tmp_path / ("a.bag" if kind == "bag" else "a.mcap"), [_as_ros1(entry) for entry in entries])
    whole, _ = run(tmp_path, entries)
    out = tmp_path / "other.mcap"
    ingest(path, out=out)
    with FlightReader(out) as one, FlightReader(whole) as other:
        for left, right in zip(one.sweeps(), other.sweeps(), strict=True):
            assert_equal(left, right)
        np.testing.assert_array_equal(one.imu().accel_mps2, other.imu().accel_mps2)


def _as_ros1(entry: files.Entry) -> files.Entry:
    topic, kind, log, message = entry
    at = files.header(files.ROS1.types, _stamp(message), message.header.frame_id, seq=0)
    values = {name: getattr(message, name) for name in message.__dataclass_fields__ if not name.startswith("__")}
    return topic, kind, log, files.ROS1.types[kind](**{**values, "header": at})


def _stamp(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


@pytest.mark.parametrize("with_poses", [False, True])
def test_a_flight_ingests_to_an_equal_flight(tmp_path, with_poses) -> None:
    flight = tmp_path / "flown.mcap"
    info = FlightInfo(flight="7", site="Edgar", operator="Änne", source="somewhere")
    calibration = Calibration(se3.exp(np.arange(6) * 0.1), se3.exp(np.arange(6) * -0.1))
    made = [*sweeps(12), replace(sweeps(13)[12], ring=None, intensity=None)]
    stamps = START_NS + 5_000_000 * np.arange(260)
    rng = np.random.default_rng(0)
    poses = se3.exp(np.cumsum(rng.normal(0, 0.05, (260, 6)), axis=0))
    with FlightWriter(flight, info, calibration, compression="zstd") as writer:
        writer.add_imu(ImuSamples(stamps, rng.normal(0, 0.1, (260, 3)), rng.normal([0, 0, 9.8], 0.1, (260, 3))))
        if with_poses:
            writer.add_reference(Trajectory(stamps, poses))
            writer.add_odometry(Trajectory(stamps[::20], poses[::20], "odom"))
        for sweep in made:
            writer.add_sweep(sweep, publish_ns=sweep.end_ns + 7)
        writer.add_attachment("points.csv", "text/csv", b"1,2,3")
    config = load_config(None, ["ingest.compression=zstd"])
    first = ingest(flight, out=tmp_path / "a.mcap", config=config)
    again = ingest(first.out, out=tmp_path / "b.mcap", config=config)
    if not with_poses:  # a rotation that has been a matrix comes back as a quaternion to the last digit but one
        assert first.out.read_bytes() == again.out.read_bytes()
    with FlightReader(flight) as one, FlightReader(again.out) as other:
        assert one.info == other.info
        np.testing.assert_array_equal(one.calibration.T_body_imu, other.calibration.T_body_imu)
        np.testing.assert_array_equal(one.calibration.T_body_lidar, other.calibration.T_body_lidar)
        for left, right in zip(one.sweeps(), other.sweeps(), strict=True):
            np.testing.assert_array_equal(left.points_lidar, right.points_lidar)
            np.testing.assert_array_equal(left.offsets_ns, right.offsets_ns)
            assert (left.stamp_ns, left.period_ns) == (right.stamp_ns, right.period_ns)
            assert (left.ring is None) == (right.ring is None)
        np.testing.assert_array_equal(one.imu().gyro_radps, other.imu().gyro_radps)
        if with_poses:
            np.testing.assert_allclose(one.reference().poses, other.reference().poses, atol=1e-12)
            np.testing.assert_allclose(one.odometry().poses, other.odometry().poses, atol=1e-12)
        assert other.attachment("points.csv") == b"1,2,3"


def test_a_recovered_flight_stays_recovered_when_it_is_ingested_again(tmp_path) -> None:
    path = files.write_mcap(tmp_path / "recording.mcap", in_order(clouds(sweeps(40)), samples(800)))
    path.write_bytes(path.read_bytes()[:-30_000])
    first = ingest(path, out=tmp_path / "a.mcap")
    assert first.health.recovered
    again = ingest(first.out, out=tmp_path / "b.mcap")
    assert again.health.recovered
    assert not again.health.damage
    assert first.out.read_bytes() == again.out.read_bytes()


def test_poses_alone_make_a_flight_with_reference_and_odometry(tmp_path) -> None:
    truth = [("/ground_truth", POSE, t, files.pose(t, (t - START_NS, 0, 0))) for t in range(START_NS, START_NS + 50)]
    odom = [("/odom", ODOMETRY, t, files.odometry(t, (1.0, 0, 0))) for t in range(START_NS, START_NS + 50, 5)]
    out, health = run(tmp_path, in_order(truth, odom))
    with FlightReader(out) as flight:
        assert flight.sweep_count == 0
        assert len(flight.reference()) == 50
        assert len(flight.odometry()) == 10
    assert health.points is None
    assert [topic.role for topic in health.topics] == ["reference", "odometry"]


# --- topics --------------------------------------------------------------------------------------------------------


def test_two_lidars_are_refused_with_the_lines_to_write_and_told_apart_by_them(tmp_path) -> None:
    entries = in_order(clouds(sweeps(6)), clouds(sweeps(3), topic="/filtered"))
    with pytest.raises(IngestError) as caught:
        run(tmp_path, entries)
    assert 'lidar = "/velodyne_points" or lidar = "/filtered"' in str(caught.value)
    assert "--sequence" in str(caught.value)
    assert not (tmp_path / "flight.mcap").exists()
    _, health = run(tmp_path, entries, told='[topics]\nlidar = "/filtered"')
    assert (health.topics[0].topic, health.topics[0].used) == ("/filtered", 3)


def test_two_imus_are_refused_and_none_is_an_answer(tmp_path) -> None:
    entries = in_order(clouds(sweeps(6)), samples(100), samples(100, topic="/mavros/imu"))
    with pytest.raises(IngestError, match="2 topics of type sensor_msgs/msg/Imu"):
        run(tmp_path, entries)
    out, health = run(tmp_path, entries, told='[topics]\nimu = "none"')
    assert [topic.role for topic in health.topics] == ["lidar"]
    with FlightReader(out) as flight:
        assert not len(flight.imu())


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ('[topics]\nlidar = "/points"', "no topic /points"),
        ('[topics]\nlidar = "/imu/data"', "expected sensor_msgs/msg/PointCloud2"),
        ('[topics]\nlidr = "/points"', "unknown key topics.lidr"),
        ("[topics", "not TOML"),
        ("[imu]\naccel_unit = 'furlongs'", "accel_unit"),
    ],
)
def test_a_wrong_sequence_file_is_told(tmp_path, told, says) -> None:
    with pytest.raises(MinelocError, match=says):
        run(tmp_path, in_order(clouds(sweeps(3)), samples(30)), told=told)
    assert not (tmp_path / "flight.mcap").exists()


def test_commands_are_no_reference_and_a_guess_is_told(tmp_path) -> None:
    goal = [("/move_base/goal", POSE, START_NS, files.pose(START_NS))]
    out, health = run(tmp_path, in_order(clouds(sweeps(6)), goal))
    with FlightReader(out) as flight:
        assert flight.reference() is None
    shutil.move(out, tmp_path / "first.mcap")
    local = [("/local_position/pose", POSE, s.stamp_ns, files.pose(s.stamp_ns)) for s in sweeps(6)]
    out, health = run(tmp_path, in_order(clouds(sweeps(6)), local, goal))
    assert findings(health)["topic_assumed"] == 1
    assert [topic.role for topic in health.topics] == ["lidar", "reference"]


def test_recordings_with_nothing_to_use_say_what_they_hold(tmp_path) -> None:
    with pytest.raises(IngestError, match="holds no messages"):
        run(tmp_path, [])
    with pytest.raises(IngestError, match=r"holds /imu/data \(sensor_msgs/msg/Imu\); expected a PointCloud2"):
        run(tmp_path, samples(30))


def test_sensors_are_placed_by_tf_static_and_the_sequence_file_has_the_last_word(tmp_path) -> None:
    mounted = files.transforms(START_NS, ("base_link", "mast", (0, 0, 1)), ("mast", "lidar", (0.1, 0, 0)))
    inertial = files.transforms(START_NS, ("base_link", "imu_link", (0, 0.2, 0)))
    entries = [("/tf_static", TF, START_NS, mounted), ("/tf_static", TF, START_NS + 1, inertial)]
    entries += in_order(clouds(sweeps(6)), samples(60))
    out, health = run(tmp_path, entries)
    assert findings(health)["calibration_from_tf"] == 1
    with FlightReader(out) as flight:
        np.testing.assert_allclose(flight.calibration.T_body_lidar[:3, 3], [0.1, 0, 1])
        np.testing.assert_allclose(flight.calibration.T_body_imu[:3, 3], [0, 0.2, 0])
    out.unlink()
    out, health = run(tmp_path, entries, told="[T_body.lidar]\ntranslation_m = [3, 0, 0]")
    with FlightReader(out) as flight:
        np.testing.assert_allclose(flight.calibration.T_body_lidar[:3, 3], [3, 0, 0])
    assert "calibration_from_tf" not in findings(health)


# --- health --------------------------------------------------------------------------------------------------------


def test_gaps_and_missing_sweeps_are_counted(tmp_path) -> None:
    made = sweeps(60)
    kept = [s for k, s in enumerate(made) if k not in (20, 21, 22, 40)]
    _, health = run(tmp_path, clouds(kept))
    lidar = health.topics[0]
    assert (lidar.gaps, lidar.missing, lidar.used) == (2, 4, 56)
    assert lidar.longest_gap_s == pytest.approx(0.4, abs=1e-3)
    (gap,) = [f for f in health.findings if f.name == "lidar_gaps"]
    assert "after 1.900 s of flight" in gap.detail
    assert gap.severity == "warning"


def test_repeated_and_older_messages_are_left_out_and_counted(tmp_path) -> None:
    entries = clouds(sweeps(30))
    entries.insert(11, (*entries[10][:2], entries[10][2] + 1, entries[10][3]))
    late = entries.pop(5)
    entries.insert(8, (late[0], late[1], entries[8][2] - 1, late[3]))
    out, health = run(tmp_path, entries)
    lidar = health.topics[0]
    assert (lidar.duplicates, lidar.backwards, lidar.used, lidar.messages) == (1, 1, 29, 31)
    assert {"lidar_duplicates", "lidar_backwards"} <= set(findings(health))
    with FlightReader(out) as flight:
        stamps = [sweep.stamp_ns for sweep in flight.sweeps()]
    assert stamps == sorted(set(stamps))


def test_clocks_that_differ_or_jump_are_told(tmp_path) -> None:
    entries = clouds(sweeps(40))
    moved = [(t, kind, log + (3_000_000_000 if k >= 20 else 0), m) for k, (t, kind, log, m) in enumerate(entries)]
    _, health = run(tmp_path, moved)
    assert findings(health)["lidar_clock_jumps"] == 1
    assert health.topics[0].log_delay_max_s == pytest.approx(3.0, abs=0.2)
    (tmp_path / "flight.mcap").unlink()
    _, health = run(tmp_path, [(t, kind, log + 10**18, m) for t, kind, log, m in entries])
    assert "lidar_clock_offset" in findings(health)


def test_points_that_are_no_returns_are_dropped_and_empty_clouds_left_out(tmp_path) -> None:
    made = sweeps(20)
    holes = [replace(s, points_lidar=s.points_lidar.copy()) for s in made]
    for k, sweep in enumerate(holes):
        points = sweep.points_lidar.copy()
        points[: 10 + k] = np.nan if k % 2 else 0.0
        holes[k] = replace(sweep, points_lidar=points)
    empty = replace(made[7], points_lidar=np.full_like(made[7].points_lidar, np.nan))
    holes[7] = empty
    _, health = run(tmp_path, clouds(holes, driver=lambda s: drivers.velodyne(s, header_at_end=False)))
    assert health.points is not None
    assert health.points.empty_sweeps == 1
    assert health.points.dropped == sum(10 + k for k in range(20) if k != 7)
    assert health.points.least == 640 - 29
    assert {"points_not_finite", "points_at_origin", "empty_sweeps"} <= set(findings(health))


def test_no_point_times_is_a_declared_fact(tmp_path) -> None:
    out, health = run(tmp_path, clouds(sweeps(10), driver=drivers.gazebo))
    assert "no_point_times" in findings(health)
    with FlightReader(out) as flight:
        assert not any(sweep.has_point_times for sweep in flight.sweeps())


def test_a_stationary_flight_is_told(tmp_path) -> None:
    quiet = samples(600, gyro=0.001, accel=9.81)
    quiet = [(t, kind, log, files.imu(log, (0, 0, 0.001), (0, 0, 9.81), frame="imu_link")) for t, kind, log, _ in quiet]
    _, health = run(tmp_path, in_order(clouds(sweeps(30, still=True)), quiet))
    assert "stationary" in findings(health)
    (tmp_path / "flight.mcap").unlink()
    _, health = run(tmp_path, in_order(clouds(sweeps(30, still=True)), samples(600)))
    assert "stationary" not in findings(health)  # smooth walls look alike, but the inertial sensor felt motion


def test_messages_that_do_not_decode_are_counted(tmp_path) -> None:
    entries = in_order(clouds(sweeps(20)), samples(400))
    for k in (30, 31, 200):
        topic, kind, log, message = entries[k]
        entries[k] = (topic, kind, log, files.serialized(kind, message)[:60])
    _, health = run(tmp_path, entries)
    assert sum(count for name, count in findings(health).items() if name.endswith("_unreadable")) == 3


def test_inertial_samples_that_are_not_finite_are_left_out_and_counted(tmp_path) -> None:
    inertial = samples(400)
    for k in (50, 51):
        topic, kind, log, message = inertial[k]
        inertial[k] = (topic, kind, log, files.imu(_stamp(message), (np.nan, 0, 0), frame="imu_link"))
    out, health = run(tmp_path, in_order(clouds(sweeps(20)), inertial))
    assert findings(health)["imu_not_finite"] == 2
    with FlightReader(out) as flight:
        assert len(flight.imu()) == 398


def test_damage_is_in_the_health_of_the_flight(tmp_path) -> None:
    path = files.write_mcap(tmp_path / "recording.mcap", in_order(clouds(sweeps(60, columns=100)), samples(1200)))
    data = path.read_bytes()
    at = len(data) // 2
    path.write_bytes(data[:at] + bytes([data[at] ^ 8]) + data[at + 1 :])
    result = ingest(path, out=tmp_path / "flight.mcap")
    assert result.health.recovered
    assert result.health.lost_messages == 1260 - sum(topic.messages for topic in result.health.topics)
    with FlightReader(result.out) as flight:
        assert flight.health["recovered"] is True
        assert flight.health["lost_messages"] == result.health.lost_messages
        assert "checksum mismatch" in str(flight.health["damage"])


# --- refusals ------------------------------------------------------------------------------------------------------


def nan_clouds(count: int) -> list[files.Entry]:
    return clouds([replace(s, points_lidar=np.full_like(s.points_lidar, np.nan)) for s in sweeps(count)])


def stamped(entries: list[files.Entry], stamp_ns: int) -> list[files.Entry]:
    at = files.header(files.ROS2.types, stamp_ns)
    return [(topic, kind, log, replace(message, header=at)) for topic, kind, log, message in entries]


def set_back(entries: list[files.Entry]) -> list[files.Entry]:
    """The clock is set back by an hour in the middle of the flight."""
    half = len(entries) // 2
    later = [
        (topic, kind, log, replace(m, header=files.header(files.ROS2.types, _stamp(m) - 3_600 * 10**9)))
        for topic, kind, log, m in entries[half:]
    ]
    return entries[:half] + later


REFUSED = {
    "one sweep": (lambda: clouds(sweeps(1)), "one sweep; expected a flight of at least two"),
    "no returns": (lambda: nan_clouds(8), "8 clouds without a single return"),
    "one sweep with returns": (lambda: clouds(sweeps(1)) + nan_clouds(8)[1:], "one usable sweep of 8"),
    "stamps all zero": (lambda: stamped(clouds(sweeps(9), driver=drivers.gazebo), 0), "only 1 increasing times"),
    "time set back": (lambda: set_back(clouds(sweeps(100))), "time goes backwards by 3599.9"),
    "inertial time set back": (
        lambda: in_order(clouds(sweeps(20)), set_back(samples(1000))),
        "/imu/data: time goes backwards by 3599.9",
    ),
    "g": (lambda: in_order(clouds(sweeps(30)), samples(500, accel=1.0)), "accel_unit"),
    "degrees": (lambda: in_order(clouds(sweeps(30)), samples(500, gyro=15.0)), "gyro_unit"),
    "no x": (
        lambda: clouds(sweeps(3), driver=lambda s: drivers.cloud(s.stamp_ns, {"y": s.intensity}, [("y", 0, "f4")], 4)),
        "no field x z",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_makes_no_flight_is_refused_in_one_line_and_leaves_nothing(tmp_path, case) -> None:
    make, says = REFUSED[case]
    entries = make()
    before = set(os.listdir(tmp_path))
    with pytest.raises(IngestError) as caught:
        run(tmp_path, entries)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.expected or caught.value.todo
    assert set(os.listdir(tmp_path)) - before == {"recording.mcap"}


def test_units_that_are_told_are_converted(tmp_path) -> None:
    entries = in_order(clouds(sweeps(30)), samples(500, accel=1.0))
    out, health = run(tmp_path, entries, told='[imu]\naccel_unit = "g"')
    with FlightReader(out) as flight:
        assert np.median(flight.imu().accel_mps2[:, 2]) == pytest.approx(9.8, abs=0.2)
    assert not [name for name in findings(health) if name.startswith("imu_")]


def test_an_output_that_exists_is_refused_before_anything_is_read(tmp_path) -> None:
    out = tmp_path / "flight.mcap"
    out.write_text("mine")
    with pytest.raises(OutputError, match="exists"):
        ingest(tmp_path / "nothing.mcap", out=out)
    assert out.read_text() == "mine"


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), OSError(28, "No space left on device"), OSError(5, "EIO")], ids=str
)
def test_an_interruption_or_a_full_disk_leaves_nothing(tmp_path, error) -> None:
    path = files.write_mcap(tmp_path / "recording.mcap", clouds(sweeps(30)))

    def progress(done: float, total: float | None, unit: str) -> None:
        assert (total, unit) == (30, "sweeps")
        if done == 15:
            raise error

    expected = OutputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        ingest(path, out=tmp_path / "flight.mcap", progress=progress)
    assert os.listdir(tmp_path) == ["recording.mcap"]


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("mount"), reason="needs root to make a small file system")
def test_a_full_file_system_is_told_in_one_line(tmp_path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(disk)], check=False).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        path = files.write_mcap(tmp_path / "recording.mcap", clouds(sweeps(80)))
        with pytest.raises(OutputError, match="the disk is full"):
            ingest(path, out=disk / "flight.mcap")
        assert os.listdir(disk) == []
    finally:
        subprocess.run(["umount", str(disk)], check=True)


# --- the command ---------------------------------------------------------------------------------------------------


def command(monkeypatch, *words: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["mineloc", "ingest", *map(str, words)])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


def test_the_command_prints_a_table_or_json_and_exits_with_1_in_one_line(tmp_path, monkeypatch, capsys) -> None:
    path = files.write_mcap(tmp_path / "recording.mcap", in_order(clouds(sweeps(12)), samples(200)))
    assert command(monkeypatch, path, "--out", tmp_path / "a.mcap") == 0
    assert "10.00" in capsys.readouterr().out
    assert command(monkeypatch, path, "--out", tmp_path / "b.mcap", "--json") == 0
    printed = capsys.readouterr()
    health = json.loads(printed.out)
    assert health["schema"] == "mineloc.health/1"
    assert [topic["role"] for topic in health["topics"]] == ["lidar", "imu"]
    assert command(monkeypatch, path, "--out", tmp_path / "a.mcap") == 1
    assert capsys.readouterr().err.count("\n") == 1
    path.write_bytes(path.read_bytes()[:-2000])
    assert command(monkeypatch, path, "--out", tmp_path / "c.mcap") == 0
    assert "recovered from a damaged file" in capsys.readouterr().out


# --- memory and hostile files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("crcs", [True, False])
def test_mutants_of_a_recording_become_a_flight_or_are_refused(tmp_path, crcs) -> None:
    entries = in_order(clouds(sweeps(4, columns=8)), samples(30))
    fuzz(files.write_mcap(tmp_path / "seed.mcap", entries, chunk_size=2000, enable_crcs=crcs), 40, 1, "--ingest")


@pytest.mark.slow
@pytest.mark.parametrize("crcs", [True, False])
def test_5000_mutants_of_a_recording_become_a_flight_or_are_refused(tmp_path, crcs) -> None:
    entries = in_order(clouds(sweeps(4, columns=8)), samples(30))
    fuzz(files.write_mcap(tmp_path / "seed.mcap", entries, chunk_size=2000, enable_crcs=crcs), 5000, 2, "--ingest")


@pytest.mark.slow
def test_memory_does_not_grow_with_the_recording(tmp_path) -> None:
    code = (
        "import sys; from pathlib import Path; from mineloc.stages.ingest import ingest\n"
        "from fuzz_recordings import peak_mib\n"
        "ingest(Path(sys.argv[1]), out=Path(sys.argv[2]))\n"
        "print(peak_mib())\n"
    )
    sweep = vlp16_sweep(START_NS, columns=1800)
    driver = drivers.velodyne(sweep)

    def entries(count: int):
        for k in range(count):
            stamp = START_NS + k * STEP_NS
            yield "/points", CLOUD, stamp, replace(driver, header=files.header(files.ROS2.types, stamp))
            for step in range(20):
                log = stamp + step * IMU_STEP_NS
                yield "/imu", IMU, log, files.imu(log)

    peaks = []
    path_of_tests = {"PYTHONPATH": str(Path(files.__file__).parent)}
    for count in (300, 3000):
        path = files.write_mcap(tmp_path / "a.mcap", entries(count), chunk_size=1 << 20)
        line = [sys.executable, "-c", code, str(path), str(tmp_path / f"{count}.mcap")]
        ran = subprocess.run(line, capture_output=True, text=True, check=True, env=os.environ | path_of_tests)
        peaks.append(float(ran.stdout))
    assert peaks[1] < 1024
    assert peaks[1] < peaks[0] + 60


# --- real recordings -----------------------------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.parametrize("name", ["evo_kiss_2", "evo_kiss_3", "evo_glim_1", "evo_glim_2"])
def test_real_odometry_recordings(tmp_path, name) -> None:
    path = DATA / f"{name}.mcap"
    if not path.exists():
        pytest.skip("no shared data beside the repository")
    result = ingest(path, out=tmp_path / "flight.mcap")
    roles = {topic.role: topic for topic in result.health.topics}
    assert set(roles) == {"reference", "odometry"}
    assert roles["reference"].topic == "/lidarodom/ground_truth/pose"
    with FlightReader(result.out) as flight:
        assert len(flight.reference()) == roles["reference"].used > 3000
        assert len(flight.odometry()) == roles["odometry"].used > 400


@pytest.mark.data
def test_a_real_cloud(tmp_path) -> None:
    source = DATA / "cloudini_pointcloud2_cdr.bin"
    if not source.exists():
        pytest.skip("no shared data beside the repository")
    data = bytearray(source.read_bytes())
    first = files.ROS2.deserialize_cdr(bytes(data), CLOUD)
    later = _moved(first, STEP_NS)
    stamp = _stamp(first)
    entries = [("/rslidar_points", CLOUD, stamp, bytes(data)), ("/rslidar_points", CLOUD, stamp + STEP_NS, later)]
    out, health = run(tmp_path, entries)
    assert health.points is not None
    assert health.points.point_times
    with FlightReader(out) as flight:
        one, other = flight.sweeps()
    assert 0 < len(one) <= 64_000
    assert 20_000_000 < one.end_ns - one.stamp_ns < 250_000_000
    np.testing.assert_array_equal(one.points_lidar, other.points_lidar)


def _moved(message: Any, by_ns: int) -> Any:
    """The same cloud, later: header and absolute point times (f64 seconds)."""
    data = message.data.copy().reshape(-1, message.point_step)
    field = next(f for f in message.fields if f.name == "timestamp")
    times = data[:, field.offset : field.offset + 8].copy().view("<f8")
    data[:, field.offset : field.offset + 8] = (times + by_ns * 1e-9).view(np.uint8)
    at = files.header(files.ROS2.types, _stamp(message) + by_ns, message.header.frame_id)
    return replace(message, header=at, data=data.reshape(-1))


@pytest.mark.data
def test_a_bag_of_raw_packets_is_refused_politely(tmp_path) -> None:
    path = DATA / "ouster_512x10_raw.bag"
    if not path.exists():
        pytest.skip("no shared data beside the repository")
    with pytest.raises(IngestError) as caught:
        ingest(path, out=tmp_path / "flight.mcap")
    assert "holds ouster packets (/os_node0/imu_packets, /os_node0/lidar_packets)" in str(caught.value)
    assert "expected PointCloud2; convert with the ouster driver" in str(caught.value)


def test_no_temporary_is_left_anywhere(tmp_path) -> None:
    run(tmp_path, clouds(sweeps(5)))
    assert not [name for name in os.listdir(tmp_path) if name.startswith(TEMP_PREFIX)]
