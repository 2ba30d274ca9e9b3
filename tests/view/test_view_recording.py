from __future__ import annotations

import json
import os
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from rrd_columns import Recording
from synthetic_run import START_NS, SyntheticRun
from typer.testing import CliRunner

from mineloc import se3
from mineloc.cli import app
from mineloc.config import Config, ViewConfig
from mineloc.data import Calibration, FlightInfo, ImuSamples, Sweep, Trajectory
from mineloc.errors import FlightError, FormatError, OutputError
from mineloc.io.flight import FlightWriter
from mineloc.io.trajectories import write_tum
from mineloc.stages.comparison import compare
from mineloc.stages.run_folder import RunFolder
from mineloc.view import viewer
from mineloc.view.about import escaped
from mineloc.view.flight import record_flight
from mineloc.view.placed import keyframe_clouds, local_origin, thinned
from mineloc.view.run import record_run
from mineloc.view.show import show


def _recorded(folder: Path, run: Path, **kwargs) -> Recording:
    return Recording(record_run(run, folder / "run.rrd", config=Config(), overwrite=True, **kwargs))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, synthetic_run):
    run = synthetic_run(SyntheticRun(poses=1500))
    return _recorded(tmp_path_factory.mktemp("rrd"), run), RunFolder.open(run)


def test_everything_that_a_run_knows_is_there(recorded):
    recording, _ = recorded
    assert {
        "/about",
        "/curves/error/online",
        "/curves/error/smoothed",
        "/curves/health/inliers",
        "/curves/health/degeneracy_score",
        "/curves/speed/speed",
        "/log",
        "/map/body",
        "/map/graph/edges",
        "/map/graph/fixes",
        "/map/graph/keyframes",
        "/map/mine",
        "/map/online",
        "/map/reference",
        "/map/smoothed",
        "/map/sweep",
        "/states/registration",
    } <= recording.entities
    (blueprint,) = recording.reader.blueprints()
    assert blueprint.application_id == "mineloc"


def test_the_curves_are_the_metrics(recorded):
    recording, run = recorded
    for name, one in compare(run, Config().evaluate).items():
        entity = f"/curves/error/{name}"
        assert np.array_equal(recording.array(entity, "Scalars:scalars"), one.shown.error_m)
        assert recording.times[entity] == one.shown.stamps_ns.tolist()
    inliers = recording.array("/curves/health/inliers", "Scalars:scalars")
    assert np.array_equal(inliers, run.sweeps["inlier_ratio"].to_numpy())
    speed = recording.array("/curves/speed/speed", "Scalars:scalars")
    assert np.median(speed) == pytest.approx(1.5, rel=0.02)


def test_the_estimate_lies_on_the_reference_where_it_starts(recorded):
    recording, run = recorded
    reference = recording.array("/map/reference", "LineStrips3D:strips")[0]
    assert np.abs(reference - run.reference.positions_m).max() < 1e-4
    body = recording.array("/map/body", "Transform3D:translation").reshape(-1, 3)
    T = compare(run, Config().evaluate)["smoothed"].shown.T_reference_estimate
    assert np.abs(body - (T @ run.smoothed.poses)[:, :3, 3]).max() < 1e-4
    assert np.abs(body[0] - reference[0]).max() < 1e-4
    xyzw = recording.array("/map/body", "Transform3D:quaternion").reshape(-1, 4)
    turned = se3.from_xyzw(body, xyzw)
    assert se3.angle_rad(se3.inverse(turned) @ (T @ run.smoothed.poses)).max() < 1e-5


def test_the_mine_is_made_of_the_placed_points_to_the_centimetre(recorded):
    recording, run = recorded
    mine = recording.array("/map/mine", "Points3D:positions")
    mine = mine.reshape(-1, 3)
    T = compare(run, Config().evaluate)["smoothed"].shown.T_reference_estimate
    placed = np.concatenate([cloud for _, cloud in keyframe_clouds(run, T)])
    assert 1000 < len(mine) <= len(placed)
    known = {tuple(p) for p in np.round(placed, 2).astype(np.float32).tolist()}
    assert sum(tuple(p) in known for p in mine.astype(np.float32).tolist()) == len(mine)
    assert len(recording.times["/map/sweep"]) == len(run.keyframes)


def test_decisions_tell_time_level_and_reason(recorded):
    recording, _ = recorded
    texts = [value[0] for value in recording.values["/log", "TextLog:text"]]
    levels = [value[0] for value in recording.values["/log", "TextLog:level"]]
    assert len(texts) == len(levels) == len(recording.times["/log"])
    assert sorted(recording.times["/log"]) == recording.times["/log"]
    lost = [k for k, text in enumerate(texts) if "motion prior alone" in text]
    assert [texts[k] for k in lost] == [
        "pose by motion prior alone for 5 sweeps (0.4 s): inlier ratio 0.08 < 0.2",
        "pose by motion prior alone for 5 sweeps (0.4 s): inlier ratio 0.08 < 0.2",
    ]
    assert {levels[k] for k in lost} == {"WARN"}
    assert recording.times["/log"][lost[0]] == START_NS + 501 * 100_000_000
    assert any(text.startswith("degenerate for 16 m (10.8 s)") for text in texts)
    assert "keyframe 5: recognised J1 (overlap 0.9)" in texts
    assert "keyframe 25: refused, overlap 0.31 < 0.6" in texts
    assert texts[0] == "first pose; 1500 sweeps, 215 keyframes"
    assert texts[-1].startswith("last pose, 222.")
    states = [value[0] for value in recording.values["/states/registration", "StateChange:state"]]
    assert states[:4] == ["held on all sides", "degenerate", "motion prior alone", "degenerate"]


def test_a_sweep_that_was_degenerate_paints_its_edge(recorded):
    recording, run = recorded
    colors = recording.values["/map/graph/edges", "LineStrips3D:colors"][0]
    assert len(colors) == len(run.keyframes) - 1
    weak = run.sweeps.filter(run.sweeps["is_degenerate"])["stamp_ns"].to_numpy()
    stamps = run.keyframes["stamp_ns"].to_numpy()
    expected = [bool(((weak >= a) & (weak < b)).any()) for a, b in pairwise(stamps)]
    assert [color != colors[0] for color in colors] == expected


def test_equal_runs_give_equal_recordings(tmp_path, synthetic_run):
    run = synthetic_run(SyntheticRun(poses=200))
    one, two = _recorded(tmp_path, run), _recorded(tmp_path, run)
    assert one.reader.recordings() == two.reader.recordings()
    assert one.values == two.values
    assert one.times == two.times


@pytest.mark.parametrize("poses", [1, 2, 60])
@pytest.mark.parametrize("reference", [True, False])
def test_short_runs_with_and_without_reference(tmp_path, synthetic_run, poses, reference):
    recording = _recorded(tmp_path, synthetic_run(SyntheticRun(poses=poses, reference=reference)))
    assert ("/curves/error/online" in recording.entities) == reference
    assert ("/curves/uncertainty/horizontal" in recording.entities) == (not reference)
    assert ("/map/reference" in recording.entities) == (reference and poses > 1)
    (text,) = recording.values["/about", "TextDocument:text"]
    assert ("No reference" in text[0]) == (not reference)


def test_names_do_not_become_markup(tmp_path, synthetic_run):
    name = "# **Ψ** [x](http://a.b) | <b>矿井</b>\n\n# two"
    (text,) = _recorded(tmp_path, synthetic_run(SyntheticRun(poses=60, flight=name))).values[
        "/about", "TextDocument:text"
    ]
    assert text[0].startswith("# " + escaped(name) + "\n")
    assert escaped("a_b|c\nd") == r"a\_b\|c d"


def test_large_coordinates_are_shown_around_a_told_origin(tmp_path, synthetic_run):
    far = tmp_path / "far"
    shutil.copytree(synthetic_run(SyntheticRun(poses=200)), far)
    run = RunFolder.open(far)
    shift = se3.from_rt(np.eye(3), [500_120.0, 7_100_345.0, 210.0])
    write_tum(far / "reference.tum", run.reference.compose(left=shift), overwrite=True)
    recording = _recorded(tmp_path, far)
    assert local_origin(np.array([[500_120.0, 7_100_345.0, 210.0]])).tolist() == [500_000, 7_100_000, 0]
    (text,) = recording.values["/about", "TextDocument:text"]
    assert "x 500000 m, y 7100000 m, z 0 m" in text[0]
    body = recording.array("/map/body", "Transform3D:translation").reshape(-1, 3)
    step = np.linalg.norm(np.diff(body, axis=0), axis=1)
    # float32 at 7 100 000 m would move in steps of half a metre
    assert np.abs(step[50:] - 0.15).max() < 0.01


def test_clouds_are_thinned_to_what_was_asked_for():
    clouds = [(k, np.zeros((5000, 3))) for k in range(100)]
    for points in (1000, 20_000, 10**6):
        some = thinned(clouds, ViewConfig(sweep_points=points))
        assert 0 < sum(len(cloud) for _, cloud in some) <= points
    assert thinned([], ViewConfig()) == []
    assert sum(len(c) for _, c in thinned(clouds, ViewConfig(sweep_points=10**6))) == 500_000


def _truth(stamps_ns: np.ndarray) -> np.ndarray:
    t = (stamps_ns - START_NS) * 1e-9
    xi = np.zeros((len(t), 6))
    xi[:, 2] = 0.3 * t
    poses = se3.exp(xi)
    poses[:, :3, 3] = np.stack([1.5 * t, 0.2 * t, 0 * t], axis=1)
    return poses


def _flight(path: Path, *, reference: bool = True, sweeps: int = 40) -> Path:
    """Sweeps of one post that stands still at (10, 3, 1), each point fired at its own time."""
    calibration = Calibration(T_body_lidar=se3.exp([0.1, 0.2, 0.3, 0.1, 0.0, 0.2]))
    with FlightWriter(path, FlightInfo(flight="post <b>"), calibration) as writer:
        for k in range(sweeps):
            start = START_NS + 100_000_000 * k
            offsets = np.arange(0, 100_000_000, 1_000_000)
            lidar = _truth(start + offsets) @ calibration.T_body_lidar
            points = np.einsum("nij,j->ni", se3.inverse(lidar)[:, :3], [10.0, 3.0, 1.0, 1.0])
            writer.add_sweep(Sweep(start, points.astype(np.float32), offsets_ns=offsets))
        stamps = np.arange(START_NS, START_NS + 100_000_000 * sweeps, 5_000_000)
        writer.add_imu(ImuSamples(stamps, np.full((len(stamps), 3), 0.1), np.tile([0.0, 0.0, 9.81], (len(stamps), 1))))
        if reference:
            writer.add_reference(Trajectory(stamps, _truth(stamps)))
    return path


def test_the_sweeps_of_a_flight_are_deskewed_along_its_reference(tmp_path):
    flight = _flight(tmp_path / "f.mcap")
    recording = Recording(record_flight(flight, tmp_path / "f.rrd", config=Config()))
    points = recording.array("/map/sweep", "Points3D:positions")
    assert len(recording.times["/map/sweep"]) == 8
    assert np.abs(points.reshape(-1, 3) - [10, 3, 1]).max() < 0.011
    assert {
        "/map/mine",
        "/map/reference",
        "/curves/force/specific_force",
        "/curves/turn/turn_rate",
    } <= recording.entities
    assert recording.array("/curves/turn/turn_rate", "Scalars:scalars") == pytest.approx(np.degrees(0.1 * 3**0.5))


def test_a_flight_without_poses_is_shown_in_the_lidar_frame(tmp_path):
    recording = Recording(
        record_flight(_flight(tmp_path / "f.mcap", reference=False), tmp_path / "f.rrd", config=Config())
    )
    assert "/map/mine" not in recording.entities
    assert len(recording.times["/map/sweep"]) == 8
    (text,) = recording.values["/about", "TextDocument:text"]
    assert "brings no poses" in text[0]
    assert "post \\<b\\>" in text[0]


def test_a_flight_without_sweeps_is_refused(tmp_path):
    with pytest.raises(FlightError, match="holds no sweeps"):
        record_flight(_flight(tmp_path / "f.mcap", sweeps=0, reference=False), tmp_path / "f.rrd", config=Config())
    assert [p.name for p in tmp_path.iterdir()] == ["f.mcap"]


def test_the_flight_of_a_run_gives_its_sweeps(tmp_path, synthetic_run):
    run = tmp_path / "run"
    shutil.copytree(synthetic_run(SyntheticRun(poses=40)), run)
    stamps = START_NS + 100_000_000 * np.arange(40) + 123
    (run / "reference.tum").unlink()
    manifest = json.loads((run / "manifest.json").read_text())
    T_body_lidar = se3.exp([0.1, 0.2, 0.3, 0.1, 0.0, 0.2]).tolist()
    manifest["calibration"]["T_body_lidar"] = T_body_lidar
    (run / "manifest.json").write_text(json.dumps(manifest))
    for name in ("trajectory.tum", "trajectory_online.tum"):
        write_tum(run / name, Trajectory(stamps, _truth(stamps)), overwrite=True)
    flight = _flight(tmp_path / "f.mcap")
    recording = _recorded(tmp_path, run, flight=flight)
    points = recording.array("/map/sweep", "Points3D:positions").reshape(-1, 3)
    assert np.abs(points - [10, 3, 1]).max() < 0.02
    assert len(recording.times["/map/sweep"]) == 7
    write_tum(run / "trajectory.tum", Trajectory(stamps + 10**12, _truth(stamps)), overwrite=True)
    with pytest.raises(FormatError, match="another time"):
        _recorded(tmp_path, run, flight=flight)


def test_show_takes_runs_flights_and_recordings_and_nothing_else(tmp_path, synthetic_run):
    run = synthetic_run(SyntheticRun(poses=60))
    saved = tmp_path / "run.rrd"
    assert show(run, save=saved, config=Config()) == [saved]
    with pytest.raises(OutputError, match="exists"):
        show(run, save=saved, config=Config())
    assert show(_flight(tmp_path / "f.mcap"), save=tmp_path / "f.rrd", config=Config()) == [tmp_path / "f.rrd"]
    for wrong in (tmp_path / "none", tmp_path / "x.txt"):
        if wrong.suffix:
            wrong.write_text("")
        with pytest.raises(FormatError):
            show(wrong, save=tmp_path / "y.rrd", config=Config())
    with pytest.raises(FormatError, match="--flight"):
        show(tmp_path / "f.mcap", flight=tmp_path / "f.mcap", save=tmp_path / "y.rrd", config=Config())


def test_the_command_prints_what_it_wrote(tmp_path, synthetic_run):
    out = tmp_path / "run.rrd"
    run = synthetic_run(SyntheticRun(poses=60))
    result = CliRunner().invoke(app, ["view", str(run), "--save", str(out)], catch_exceptions=False)
    assert (result.exit_code, result.stdout.strip()) == (0, str(out))
    assert out.stat().st_size < 1_000_000


@pytest.mark.parametrize(
    ("log", "says"),
    [
        (b"thread main panicked: No graphics adapter was found", "mesa-vulkan-drivers"),
        (b"Error: neither WAYLAND_DISPLAY nor DISPLAY is set", "no screen"),
        (b"first\nsomething broke\n\n", "something broke"),
        (b"", "no message"),
    ],
)
def test_a_viewer_that_does_not_start_is_one_clear_line(tmp_path, monkeypatch, log, says):
    fake = tmp_path / "viewer"
    fake.write_text(f"#!/bin/sh\nprintf '%b' '{log.decode()}'\nexit 1\n".replace("\n\n", "\n"))
    fake.chmod(0o755)
    monkeypatch.setattr(viewer, "_executable", lambda: fake)
    with pytest.raises(OutputError, match=says) as caught:
        viewer.open_viewer(tmp_path / "x.rrd")
    assert "\n" not in str(caught.value)
    with pytest.raises(OutputError, match=says):
        viewer.screenshot(tmp_path / "x.rrd", tmp_path / "x.png", at_ns=None)
    assert [p.name for p in tmp_path.iterdir()] == ["viewer"]


def _has_vulkan() -> bool:
    folders = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
    return any(os.path.isdir(folder) and os.listdir(folder) for folder in folders)


@pytest.mark.slow
@pytest.mark.skipif(not _has_vulkan(), reason="no Vulkan driver: apt-get install mesa-vulkan-drivers")
def test_the_picture_shows_the_mine(tmp_path, synthetic_run):
    run = synthetic_run(SyntheticRun(poses=1500))
    written = show(run, save=tmp_path / "run.rrd", picture=tmp_path / "run.png", config=Config())
    assert [path.name for path in written] == ["run.rrd", "run.png"]
    image = matplotlib.image.imread(tmp_path / "run.png")[..., :3]
    mine = image[: image.shape[0] // 2, : image.shape[1] // 2]
    # neither black nor one colour: walls are grey, the trajectory is coloured
    assert (mine.max(axis=2) > 0.3).mean() > 0.005
    assert (np.ptp(mine, axis=2) > 0.25).sum() > 200
    left = subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True, text=True, check=False)
    assert left.stdout == ""
