"""A simulated flight with a camera: its images are in the file, as they were taken."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mineloc import cli
from mineloc.config import SimulateConfig
from mineloc.io.flight import FlightReader
from mineloc.sim.flight import AFTER_NS, START_NS, SimulatedFlight
from mineloc.sim.mine import load_mine
from mineloc.sim.tag_camera import TagCamera
from mineloc.sim.targets import survey_of

PLAN = """
name = "tee"
cell_m = 0.3
[roughness]
wall_m = 0.0
fine_m = 0.0
[[roadway]]
points_m = [[0, 0, 0], [30, 0, 0]]
[[roadway]]
points_m = [[15, 0, 0], [15, 20, 1]]
"""
SETTINGS = {"length_m": 5, "hover_s": 1, "seed": 4, "camera_hz": 1.5, "target_every_m": 4, "tags": True}


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "tee.toml"
    path.write_text(PLAN)
    return path


def test_images_are_written_as_they_were_taken(plan: Path) -> None:
    out = plan.parent / "f.mcap"
    keys = [f"--set=simulate.{key}={str(value).lower()}" for key, value in SETTINGS.items()]
    done = CliRunner().invoke(cli.app, ["simulate", str(plan), "--out", str(out), "--camera", "--json", *keys])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    flight = SimulatedFlight(load_mine(plan, threads=1), SimulateConfig.model_validate({**SETTINGS, "camera": True}))
    with FlightReader(out) as reader:
        assert (reader.depth_count, reader.grey_count) == (told["depth_images"], told["grey_images"])
        assert reader.calibration.T_body_camera is not None
        np.testing.assert_allclose(reader.calibration.T_body_camera, flight.calibration.T_body_camera, atol=1e-12)
        depths, greys = list(reader.depth_images()), list(reader.grey_images())
        assert reader.sweep_count == told["sweeps"]
    assert len(depths) == int((flight.sweeps / 10.0 - 0.013) * 1.5) + 1
    for index in (0, len(depths) - 1):
        made = flight.depth_image(index)
        assert (depths[index].stamp_ns, depths[index].camera) == (made.stamp_ns, made.camera)
        np.testing.assert_array_equal(depths[index].depth_m, made.depth_m)
    survey = survey_of(flight)
    assert survey is not None
    camera = TagCamera(flight, survey, greys[0].camera, flight.calibration.T_body_camera, rate_hz=1.5)
    # the flight goes on a little after its last sweep
    stamps = camera.stamps_ns[camera.stamps_ns < START_NS + flight.sweeps * 100_000_000 + AFTER_NS]
    assert [grey.stamp_ns for grey in greys] == stamps.tolist()
    (made_grey,) = camera.between(int(stamps[0]), int(stamps[0]) + 1)
    # JPEG of noisy pixels
    assert np.abs(greys[0].pixels.astype(int) - made_grey.pixels).mean() < 2.0
