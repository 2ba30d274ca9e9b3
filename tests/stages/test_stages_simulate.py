"""The simulate stage and command: a flight that reads back, the same bytes twice, refusals that leave nothing."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from mineloc import cli
from mineloc.config import Config, SimulateConfig
from mineloc.errors import OutputError, SimulationError
from mineloc.io.flight import FlightReader
from mineloc.sim.flight import SimulatedFlight
from mineloc.sim.mine import load_mine
from mineloc.stages.progress_bar import progress_bar
from mineloc.stages.simulate import simulate

PLAN = """
name = "tee"
cell_m = 0.3
[roughness]
wall_m = 0.05
[[roadway]]
points_m = [[0, 0, 0], [30, 0, 0]]
[[roadway]]
points_m = [[15, 0, 0], [15, 20, 1]]
"""
CONFIG = Config(simulate=SimulateConfig(length_m=6, hover_s=1, seed=4))


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "tee.toml"
    path.write_text(PLAN)
    return path


@pytest.fixture(scope="module")
def written(plan: Path) -> Path:
    out = plan.parent / "one.mcap"
    simulate(plan, out=out, config=CONFIG)
    return out


def test_flight_file_holds_what_was_flown(plan: Path, written: Path) -> None:
    flight = SimulatedFlight(load_mine(plan, threads=1), CONFIG.simulate)
    packets = list(flight.packets())
    with FlightReader(written) as reader:
        assert (reader.info.site, reader.info.lidar, reader.info.source) == ("tee", "VLP-16", "simulated")
        np.testing.assert_allclose(reader.calibration.T_body_imu, flight.calibration.T_body_imu, atol=1e-9)
        np.testing.assert_allclose(reader.calibration.T_body_lidar, flight.calibration.T_body_lidar, atol=1e-9)
        sweeps = list(reader.sweeps())
        imu = reader.imu()
        reference = reader.reference()
    assert len(sweeps) == len(packets)
    for sweep, packet in zip(sweeps, packets, strict=True):
        assert packet.sweep is not None
        assert sweep.stamp_ns == packet.sweep.stamp_ns
        np.testing.assert_array_equal(sweep.points_lidar, packet.sweep.points_lidar)
        np.testing.assert_array_equal(sweep.offsets_ns, packet.sweep.offsets_ns)
        np.testing.assert_array_equal(sweep.ring, packet.sweep.ring)
    np.testing.assert_array_equal(imu.stamps_ns, np.concatenate([packet.imu.stamps_ns for packet in packets]))
    np.testing.assert_array_equal(imu.gyro_radps, np.concatenate([packet.imu.gyro_radps for packet in packets]))
    assert reference is not None
    np.testing.assert_allclose(reference.poses, flight.pose(reference.stamps_ns), atol=1e-9)
    # every sweep lies within the truth and the inertial samples
    for stamps in (reference.stamps_ns, imu.stamps_ns):
        assert stamps[0] <= sweeps[0].stamp_ns
        assert stamps[-1] >= sweeps[-1].end_ns


def test_same_bytes_twice_and_progress_to_the_end(plan: Path, written: Path, tmp_path: Path) -> None:
    told: list[tuple[float, float | None, str]] = []
    result = simulate(
        plan,
        out=tmp_path / "two.mcap",
        config=CONFIG,
        progress=lambda done, total, unit: told.append((done, total, unit)),
    )
    assert (tmp_path / "two.mcap").read_bytes() == written.read_bytes()
    assert told[-1] == (result.sweeps, result.sweeps, "sweeps")
    assert result.path_m == pytest.approx(6, rel=0.1)
    assert result.points > 25_000 * result.sweeps
    assert (result.intersections, result.roadways) == (1, 3)


def test_failures_leave_nothing_and_existing_files_alone(plan: Path, written: Path, tmp_path: Path) -> None:
    before = written.read_bytes()
    with pytest.raises(OutputError, match="exists"):
        simulate(plan, out=written, config=CONFIG)
    assert written.read_bytes() == before

    def interrupt(done: float, total: float | None, unit: str) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(plan, out=tmp_path / "x.mcap", config=CONFIG, progress=interrupt)
    narrow = Config(simulate=SimulateConfig(length_m=6, clearance_m=4))
    with pytest.raises(SimulationError, match="clearance_m"):
        simulate(plan, out=tmp_path / "x.mcap", config=narrow)
    assert list(tmp_path.iterdir()) == []


def test_bar_shows_rate_and_end_on_a_terminal_and_nothing_elsewhere() -> None:
    for terminal in (True, False):
        screen = io.StringIO()
        with progress_bar("simulate", console=Console(file=screen, force_terminal=terminal, width=100)) as progress:
            progress(0, None, "sweeps")
            progress(30, 60, "sweeps")
            progress(60, 60, "sweeps")
        assert ("simulate" in screen.getvalue() and "100%" in screen.getvalue()) == terminal


def test_command_flies_prints_and_refuses(plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runner = CliRunner()
    out = tmp_path / "f.mcap"
    common = ["simulate", str(plan), "--out", str(out), "--set", "simulate.hover_s=1", "--json"]
    done = runner.invoke(cli.app, [*common, "--length-m", "5", "--seed", "2", "--sensor", "rs16", "--speed-mps", "1.5"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["out"] == str(out)
    assert told["path_m"] == pytest.approx(5, rel=0.1)
    with FlightReader(out) as reader:
        assert reader.info.lidar == "RS-LiDAR-16"
        assert reader.sweep_count == told["sweeps"]
    with pytest.raises(OutputError):
        runner.invoke(cli.app, common, catch_exceptions=False)
    shown = runner.invoke(cli.app, [*common[:2], "--out", str(tmp_path / "h.mcap"), "--set", "simulate.length_m=4"])
    assert shown.exit_code == 0, shown.output
    assert "intersections: 1" in shown.stdout
    (tmp_path / "h.mcap").unlink()
    monkeypatch.setattr("sys.argv", ["mineloc", "simulate", "nowhere", "--out", str(tmp_path / "g.mcap")])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 1
    assert runner.invoke(cli.app, ["simulate", str(plan), "--out", str(out), "--sensor", "vlp32"]).exit_code == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f.mcap"]
