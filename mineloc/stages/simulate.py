"""Simulate a flight through a mine and write it as a canonical flight file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mineloc.config import IngestConfig, SimulateConfig
from mineloc.io.flight import FlightWriter
from mineloc.progress import Progress, quiet
from mineloc.sim.flight import SimulatedFlight
from mineloc.sim.mine import load_mine


@dataclass(frozen=True, slots=True)
class SimulateResult:
    """What was flown.

    Attributes:
        flight: the file.
        sweeps: written, lost ones not counted.
        points: in all sweeps.
        path_m: length of the true path.
        duration_s: from the first sample to the last.
        roadways_seen, roadways: how many different roadways of the mine the tour takes.
        intersections: of the mine.
    """

    flight: Path
    sweeps: int
    points: int
    path_m: float
    duration_s: float
    roadways_seen: int
    roadways: int
    intersections: int


def simulate(
    mine: str | Path,
    out: Path,
    config: SimulateConfig,
    *,
    ingest: IngestConfig = IngestConfig(),
    graph: Path | None = None,
    start: int | None = None,
    overwrite: bool = False,
    progress: Progress = quiet,
) -> SimulateResult:
    """Fly a tour through a mine; the file appears whole or not at all.

    Args:
        mine: a mesh (.ply .obj .stl .dae), a plan (.toml .dxf) or a built-in name.
        out: the flight file.
        config: tour, drone, sensors and their errors.
        ingest: how flight files are compressed.
        graph: roadway graph (JSON) of a mesh, instead of the one found in it.
        start: node of the roadway graph to start from.
        overwrite: replace an existing file.
        progress: told after each sweep.

    Raises:
        SimulationError: the mine cannot be flown.
        FormatError, ConfigError: the mine's file is not what it claims.
        OutputError: the flight cannot be written.
    """
    site = load_mine(
        mine,
        graph=graph,
        roadway_width_m=config.roadway_width_m,
        roadway_height_m=config.roadway_height_m,
    )
    flight = SimulatedFlight(site, config, start=start)
    sweeps = points = 0
    path_m = 0.0
    with FlightWriter(
        out,
        flight.info,
        flight.calibration,
        compression=ingest.compression,
        chunk_bytes=ingest.chunk_bytes,
        overwrite=overwrite,
    ) as writer:
        for done, packet in enumerate(flight.packets(), start=1):
            if packet.sweep is not None:
                writer.add_sweep(packet.sweep)
                sweeps += 1
                points += len(packet.sweep)
            writer.add_imu(packet.imu)
            writer.add_reference(packet.truth)
            path_m += float(packet.truth.path_m[-1])
            progress(done, flight.sweeps, "sweeps")
    seen = {step.roadway for step in flight.tour}
    return SimulateResult(
        out,
        sweeps,
        points,
        path_m,
        flight.sweeps / config.lidar_hz,
        len(seen),
        len(site.graph.roadways),
        len(site.graph.intersections),
    )
