"""Simulate a flight through a mine and write it as a canonical flight file."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mineloc.config import Config
from mineloc.io import control_points as survey_files
from mineloc.io.flight import FlightWriter
from mineloc.progress import Progress, quiet
from mineloc.sim.camera_mount import camera_model
from mineloc.sim.changes import CHANGES_FILE, changed_mine, changes_json
from mineloc.sim.flight import TRUTH_NS, Packet, SimulatedFlight
from mineloc.sim.mine import load_mine
from mineloc.sim.tag_camera import TagCamera
from mineloc.sim.targets import GRID_FILE, TargetSurvey, grid_json, survey_of


@dataclass(frozen=True, slots=True)
class SimulateResult:
    """What was flown.

    Attributes:
        out: the flight file.
        sweeps, points, depth_images, grey_images: written; lost sweeps are not counted.
        path_m: length of the true path.
        duration_s: of the flight.
        roadways_m: length of all roadways of the mine.
        intersections: of the mine.
        roadways_seen, roadways: how many of the roadways that a drone fits through the tour takes, and how many there
            are.
    """

    out: Path
    sweeps: int
    points: int
    path_m: float
    duration_s: float
    roadways_m: float
    intersections: int
    roadways_seen: int
    roadways: int
    depth_images: int = 0
    grey_images: int = 0

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "out": str(self.out)}


def simulate(
    mine: str | Path,
    *,
    out: Path,
    graph: Path | None = None,
    start: int | None = None,
    config: Config | None = None,
    progress: Progress = quiet,
) -> SimulateResult:
    """Fly a tour through a mine; the file appears whole or not at all.

    Args:
        mine: a mesh (.ply .obj .stl .dae), a plan (.toml .dxf) or a built-in name.
        out: the flight file.
        graph: roadway graph (JSON) of a mesh, instead of the one found in it.
        start: node of the roadway graph to start from.
        config: tour, drone, sensors and their errors in `simulate`, and what of the mine has changed.
        progress: told after each sweep.

    Raises:
        SimulationError: the mine cannot be flown.
        FormatError, ConfigError: the mine's file is not what it claims.
        OutputError: the flight cannot be written.
    """
    settings = (config or Config()).simulate
    site = load_mine(
        mine,
        graph=graph,
        roadway_width_m=settings.roadway_width_m,
        roadway_height_m=settings.roadway_height_m,
    )
    site = changed_mine(site, closed=settings.closed, widened=settings.widened)
    flight = SimulatedFlight(site, settings, start=start)
    counts, path_m = _write(flight, out, progress)
    return SimulateResult(
        out=out,
        sweeps=counts["sweeps"],
        points=counts["points"],
        depth_images=counts["depth"],
        grey_images=counts["grey"],
        path_m=path_m,
        duration_s=flight.sweeps / settings.lidar_hz,
        roadways_m=site.graph.length_m,
        intersections=len(site.graph.intersections),
        roadways_seen=len({step.roadway for step in flight.tour}),
        roadways=len(flight.graph.roadways),
    )


def _write(flight: SimulatedFlight, out: Path, progress: Progress) -> tuple[Counter[str], float]:
    """What was written, counted, and the length of the true path."""
    counts: Counter[str] = Counter()
    path_m, last_m = 0.0, flight.motion.pose(np.zeros(1))[0, :3, 3]
    survey = survey_of(flight)
    with FlightWriter(out, flight.info, flight.calibration) as writer:
        if survey is not None:
            _attach(survey, writer)
        if (grid := grid_json(flight.config)) is not None:
            writer.add_attachment(GRID_FILE, "application/json", grid)
        if (changes := changes_json(flight.config)) is not None:
            writer.add_attachment(CHANGES_FILE, "application/json", changes)
        tags = _tag_camera(flight, survey)
        for done, packet in enumerate(flight.packets(), start=1):
            # images before the sweep: it ends later than they were taken
            for image in packet.depth:
                writer.add_depth(image)
                counts["depth"] += 1
            for picture in () if tags is None else tags.between(*_span(packet)):
                writer.add_grey(picture)
                counts["grey"] += 1
            if packet.sweep is not None:
                writer.add_sweep(packet.sweep)
                counts["sweeps"] += 1
                counts["points"] += len(packet.sweep)
            writer.add_imu(packet.imu)
            writer.add_reference(packet.truth)
            line_m = np.vstack([last_m, packet.truth.positions_m])
            path_m += float(np.linalg.norm(np.diff(line_m, axis=0), axis=1).sum())
            last_m = line_m[-1]
            progress(done, flight.sweeps, "sweeps")
    return counts, path_m


def _tag_camera(flight: SimulatedFlight, survey: TargetSurvey | None) -> TagCamera | None:
    """Who takes the grey images; None when there are no tags."""
    config, T_body_camera = flight.config, flight.calibration.T_body_camera
    if not config.tags or survey is None or T_body_camera is None:
        return None
    return TagCamera(flight, survey, camera_model("848x480"), T_body_camera, rate_hz=config.camera_hz)


def _span(packet: Packet) -> tuple[int, int]:
    """The time of a packet, from its first true pose to before the next packet's."""
    return int(packet.truth.stamps_ns[0]), int(packet.truth.stamps_ns[-1]) + TRUTH_NS


def _attach(survey: TargetSurvey, writer: FlightWriter) -> None:
    """The targets, and what was picked of them."""
    writer.add_attachment(
        survey_files.TARGETS_FILE, survey_files.MEDIA_TYPE, survey_files.control_points_csv(survey.points)
    )
    writer.add_attachment(
        survey_files.OBSERVATIONS_FILE, survey_files.MEDIA_TYPE, survey_files.observations_csv(survey.observations)
    )
