"""M2DGR hall_02 with the sequence file that comes along: a bag as its drivers wrote it, and its tracker's file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import recording_files as files
from driver_clouds import XYZ, cloud
from recording_files import CLOUD, IMU, ROS1, START_NS, STEP_NS
from typer.testing import CliRunner

from mineloc import se3
from mineloc.cli import app
from mineloc.data import Trajectory
from mineloc.errors import EvaluationError, FormatError, IngestError
from mineloc.io.flight import FlightReader
from mineloc.io.trajectories import load_trajectory, write_tum
from mineloc.stages.evaluate import evaluate
from mineloc.stages.ingest import ingest

SEQUENCE = Path(__file__).resolve().parents[2] / "datasets" / "m2dgr_hall_02.toml"
PRISM_LIDAR_M = np.array([-0.21374, 0.00146, 0.68356])
# VLP-32C by laser id (manual): a third of a degree apart near the horizon, up to nine below it
ELEVATIONS_DEG = np.array(
    [
        *(-25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667),
        *(-4, -4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667, -2.333, -2, 15, 10.333, -1.333),
    ]
)
AZIMUTHS_DEG = np.array([1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4] * 4)  # of the pattern, not of each laser
RINGS = ELEVATIONS_DEG.argsort().argsort()  # velodyne_pointcloud: rank of the elevation
COLUMNS = 60
COLUMN_NS = STEP_NS // COLUMNS
PAIR_NS = 2304


def sweep_message(stamp_ns: int, *, seed: int):
    """A sweep that begins at `stamp_ns`: points, times and header as the driver gives them; and the true offsets."""
    rng = np.random.default_rng(seed)
    azimuth = np.deg2rad(-360 * np.arange(COLUMNS)[:, None] / COLUMNS - AZIMUTHS_DEG)
    elevation = np.broadcast_to(np.deg2rad(ELEVATIONS_DEG), azimuth.shape)
    r = rng.uniform(3, 12, azimuth.shape)
    x, y = r * np.cos(elevation) * np.cos(azimuth), r * np.cos(elevation) * np.sin(azimuth)
    offsets = np.arange(COLUMNS)[:, None] * COLUMN_NS + np.arange(32) // 2 * PAIR_NS
    last_packet = stamp_ns + int(offsets[-1, 0])
    columns = {"x": x, "y": y, "z": r * np.sin(elevation), "intensity": rng.uniform(0, 255, r.shape)}
    columns |= {"ring": np.broadcast_to(RINGS, r.shape), "time": (offsets + stamp_ns - last_packet) * 1e-9}
    fields = [*XYZ, ("intensity", 12, "f4"), ("ring", 16, "u2"), ("time", 18, "f4")]
    message = cloud(last_packet, {name: values.reshape(-1) for name, values in columns.items()}, fields, 22)
    return message, offsets.reshape(-1)


def as_ros1(message):
    types = ROS1.types
    stamp = message.header.stamp
    at = files.header(types, stamp.sec * 10**9 + stamp.nanosec, "velodyne", seq=0)
    values = {name: getattr(message, name) for name in message.__dataclass_fields__ if not name.startswith("__")}
    return types[CLOUD](**{**values, "header": at})


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.2 s with the two IMUs of the robot."""
    entries: list[files.Entry] = []
    for k in range(12):
        message, offsets = sweep_message(START_NS + k * STEP_NS, seed=k)
        entries.append(("/velodyne_points", CLOUD, START_NS + k * STEP_NS + int(offsets[-1]) + 10**6, as_ros1(message)))
    for topic, rate_hz, gyro in (("/handsfree/imu", 150, 0.3), ("/camera/imu", 200, 9.0)):
        for k in range(int(1.2 * rate_hz)):
            stamp = START_NS + k * 10**9 // rate_hz
            noise = np.random.default_rng(k).normal(0, 0.01, 3)
            entries.append(
                (topic, IMU, stamp + 10**5, files.imu(stamp, (noise[0], noise[1], gyro), types=ROS1.types, seq=k))
            )
    return files.write_bag(
        tmp_path_factory.mktemp("m2dgr") / "hall_02.bag", sorted(entries, key=lambda entry: entry[2])
    )


def test_negative_times_rings_and_the_right_imu(bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "hall_02.mcap"
    health = ingest(bag, out=out, sequence=SEQUENCE).health
    with FlightReader(out) as flight:
        sweeps, imu, calibration, info = list(flight.sweeps()), flight.imu(), flight.calibration, flight.info
        assert flight.reference() is None
    assert len(sweeps) == 12
    for k, sweep in enumerate(sweeps):
        _, offsets = sweep_message(START_NS + k * STEP_NS, seed=k)
        # the header is the last packet: the first point is as long before it as the times say, in float32
        assert abs(sweep.stamp_ns - (START_NS + k * STEP_NS)) < 50
        assert sweep.offsets_ns is not None
        assert sweep.offsets_ns.min() == 0
        np.testing.assert_allclose(sweep.offsets_ns, offsets, atol=50)
        elevation = np.rad2deg(np.arctan2(sweep.points_lidar[:, 2], np.hypot(*sweep.points_lidar[:, :2].T)))
        assert sweep.ring is not None
        np.testing.assert_allclose(elevation, np.sort(ELEVATIONS_DEG)[sweep.ring], atol=1e-3)
    assert len(imu) == 180
    assert imu.gyro_radps[:, 2] == pytest.approx(np.full(180, 0.3))
    np.testing.assert_allclose(calibration.T_lidar_imu[:3, 3], [-0.27255, 0.00053, -0.17954], atol=1e-9)
    np.testing.assert_allclose(se3.inverse(calibration.T_body_lidar)[:3, 3], PRISM_LIDAR_M, atol=1e-9)
    assert info.lidar == "Velodyne VLP-32C"
    assert health.points is not None
    assert (health.points.rings, health.points.point_times) == (True, True)


def test_equally_spaced_beams_would_be_wrong_rings() -> None:
    # A-LOAM's formula for 32 beams is the HDL-32E's: many VLP-32C beams share a line, others stay empty
    formula = np.clip(((ELEVATIONS_DEG + 92.0 / 3.0) * 3.0 / 4.0).astype(int), 0, 31)
    assert len(np.unique(formula)) < 20
    assert len(np.unique(RINGS)) == 32


def test_without_the_sequence_file_the_two_imus_are_refused(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(IngestError, match="imu"):
        ingest(bag, out=tmp_path / "flight.mcap")


# --- the tracker's file


def _walk(n: int = 400) -> Trajectory:
    """A robot that turns as it drives: the LiDAR's poses."""
    t = 0.1 * np.arange(n)
    xi = np.zeros((n, 6))
    xi[:, 2] = 0.4 * t
    poses = se3.exp(xi)
    poses[:, :3, 3] = np.stack([3 * np.sin(0.4 * t), 2 * np.sin(0.23 * t), 0.02 * t], axis=1)
    return Trajectory(START_NS + np.round(t * 1e9).astype(np.int64), poses)


def _tracked(path: Path, positions_m: np.ndarray, stamps_ns: np.ndarray) -> Path:
    rows = zip(stamps_ns.tolist(), positions_m.tolist(), strict=True)
    path.write_text("".join(f"{t // 10**9}.{t % 10**9:09d} {x:.6f} {y:.6f} {z:.6f} 0 0 0 0\n" for t, (x, y, z) in rows))
    return path


def test_a_trackers_positions_are_a_reference(tmp_path: Path) -> None:
    lidar = _walk()
    prism = lidar.compose(right=se3.from_rt(np.eye(3), PRISM_LIDAR_M))
    T_tracker_map = se3.exp([0.0, 0.0, 1.1, 4.0, -7.0, 1.0])
    reference = _tracked(tmp_path / "hall_02.txt", prism.compose(left=T_tracker_map).positions_m, prism.stamps_ns)
    loaded = load_trajectory(reference)
    assert loaded.positions_only
    assert (loaded.trajectory.poses[:, :3, :3] == np.eye(3)).all()
    write_tum(tmp_path / "prism.tum", prism)
    write_tum(tmp_path / "lidar.tum", lidar)
    evaluation = evaluate(tmp_path / "prism.tum", reference)
    (scores,) = evaluation.scores
    assert [one.absolute.alignment for one in scores.aligned] == ["none", "se3"]
    assert scores.aligned[1].absolute.translation_m.max < 1e-5
    assert (scores.percent, scores.segments.count, scores.aligned[1].relative) == ((), 0, ())
    assert any("positions only" in note for note in evaluation.notes)
    raw = evaluation.to_dict()["trajectories"][0]["aligned"][1]["ape"]
    assert raw["rotation_deg"] is None
    # who compares the LiDAR's own trajectory with the prism's measures the lever
    off = evaluate(tmp_path / "lidar.tum", reference, align="se3").scores[0].aligned[0].absolute.translation_m
    assert 0.15 < off.rmse < 0.25
    with pytest.raises(EvaluationError, match="needs orientations"):
        evaluate(tmp_path / "prism.tum", reference, align="origin")
    shown = CliRunner().invoke(app, ["evaluate", str(tmp_path / "prism.tum"), "--reference", str(reference)])
    assert shown.exit_code == 0
    assert "REP" not in shown.stdout
    (row,) = (line.split() for line in shown.stdout.splitlines() if line.split()[:2] == ["estimate", "se3"])
    assert row[-2:] == ["-", "-"]
    names = [str(path) for path in (tmp_path / "prism.tum", tmp_path / "lidar.tum", reference)]
    words = ["evaluate", names[0], "--baseline", names[1], "--reference", names[2], "--align", "se3"]
    both = CliRunner().invoke(app, words)
    assert "-100.0 %" in both.stdout


def test_a_quaternion_that_is_missing_now_and_then_is_a_mistake(tmp_path: Path) -> None:
    path = tmp_path / "some.tum"
    path.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 0\n")
    with pytest.raises(FormatError, match="line 2: a quaternion of length 0"):
        load_trajectory(path)
