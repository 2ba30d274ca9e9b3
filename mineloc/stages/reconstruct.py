"""The stage that makes a map of mapping flights: canonical flights in, a map folder out (DESIGN.md, "A map folder")."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import OdometryStep, Trajectory
from mineloc.errors import ConfigError
from mineloc.io.flight import FlightReader
from mineloc.localize.flown import Flown, Watch, fly
from mineloc.localize.localization import Clock, FlightData
from mineloc.localize.method import Method, method_named
from mineloc.localize.reconstruction import Reconstruction, reconstruct_flights
from mineloc.mapping.map_builder import MapBuilder
from mineloc.mapping.survey_map import SurveyMap, survey_map
from mineloc.output import new_folder
from mineloc.progress import Progress, quiet
from mineloc.stages.camera_pieces import CameraPieces
from mineloc.stages.control_survey import control_rmse, gathered_survey
from mineloc.stages.map_folder import write_map_folder
from mineloc.stages.map_manifest import degenerate_m, manifest_of, timing_of
from mineloc.stages.map_pieces import MapPieces
from mineloc.stages.map_tables import coverage_table, fixes_tables, keyframes_table

METHOD = "odometry_loops"


@dataclass(frozen=True, slots=True)
class ReconstructResult:
    """What `reconstruct` left.

    Attributes:
        out: the map folder.
        flights, sweeps, keyframes: counts.
        path_m: flown, all flights together.
        loops, refused: closures in the graph, candidates that are not.
        degenerate_m: of the way, where a direction was weakly observed.
        points: of the map.
        roadways_m: length of the roadways found.
        intersections: found.
        complete: share of the roadways' length of which floor, walls and roof are seen.
        control: RMSE in space of control and check points, None without.
        seconds, real_time_factor: of the whole work.
    """

    out: Path
    flights: int
    sweeps: int
    keyframes: int
    path_m: float
    loops: int
    refused: int
    degenerate_m: float
    points: int
    roadways_m: float
    intersections: int
    complete: float | None
    control: dict[str, float | None] | None
    seconds: float
    real_time_factor: float

    def to_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {**asdict(self), "out": str(self.out)}


def reconstruct(
    flights: Sequence[Path],
    out: Path,
    *,
    method: str = METHOD,
    control: Path | None = None,
    observations: Path | None = None,
    use_control: bool = True,
    config: Config | None = None,
    progress: Progress = quiet,
) -> ReconstructResult:
    """Make a map of one or more mapping flights.

    Args:
        flights: canonical flights of one mine.
        out: the map folder.
        method: front end and loop closures, by the name of a method of `localize`.
        control: surveyed targets (CSV); without it those that are attached to the flights.
        observations: of the targets (CSV); without it those that are attached to the flights.
        use_control: False leaves all control points out.
        config: all sections.
        progress: told the sweeps that are done, of all flights.

    Raises:
        ConfigError: no such method, no flight, two flights of one name, observations without targets.
        IngestError: a file is not a canonical flight, or damaged.
        FlightError: a flight holds too little, or nothing joins it to the others.
        FormatError: a file of control points is not what it claims.
        OutputError: `out` exists or cannot be written.
    """
    started, clock = perf_counter(), Clock()
    config = config or Config()
    chosen = method_named(method)
    if chosen.tracks is not None:
        raise ConfigError("--method", f"{method} needs a map", expected="a method that makes one", todo=f"try {METHOD}")
    with new_folder(out) as folder, ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=folder)))
        readers = _opened(flights, stack)
        survey = gathered_survey(readers, control, observations, config.control) if use_control else None
        flown, pieces = _flown(readers, chosen, config, work, progress, stack)
        with clock.of("graph"):
            found = reconstruct_flights(flown, config, closer=chosen.closer(config), survey=survey)
        with clock.of("map"):
            product = _product(found, pieces, config)
        stack.close()
        seconds = perf_counter() - started
        result = _result(out, readers, flown, found, product, seconds)
        write_map_folder(
            folder,
            product=product,
            grid_origin_m=found.origin_m,
            trajectories=_body_trajectories(readers, found),
            keyframes=keyframes_table(list(readers), found),
            fixes=fixes_tables(list(readers), found),
            coverage=coverage_table(product.coverage),
            flown=_day(readers),
            timing=timing_of(flown, clock, result.seconds, result.real_time_factor),
            manifest=manifest_of(readers, method, chosen.front_end, config, flown, found, product),
        )
    return result


def _opened(flights: Sequence[Path], stack: ExitStack) -> dict[str, FlightReader]:
    """Readers by the names of the flights."""
    if not flights:
        raise ConfigError("reconstruct", "no flight", expected="at least one flight file", todo="name one")
    readers: dict[str, FlightReader] = {}
    for path in flights:
        reader = stack.enter_context(FlightReader(path))
        name = reader.info.flight or path.stem
        if name in readers:
            raise ConfigError(
                path,
                f"flight {name!r} is there already ({readers[name].path})",
                expected="flights with names of their own",
                todo="leave one of them out",
            )
        readers[name] = reader
    return readers


def _flown(
    readers: Mapping[str, FlightReader],
    method: Method,
    config: Config,
    work: Path,
    progress: Progress,
    stack: ExitStack,
) -> tuple[dict[str, Flown], list[MapPieces]]:
    """Every flight through the front end; its points wait in `work`."""
    total = sum(reader.sweep_count for reader in readers.values())
    before = 0
    flown: dict[str, Flown] = {}
    pieces: list[MapPieces] = []
    for k, (name, reader) in enumerate(readers.items()):
        piece = MapPieces(work / f"{k}.points", voxel_m=config.map.piece_voxel_m, max_range_m=config.map.max_range_m)

        watch = _watch(reader, piece, config, stack)
        front_end = method.make_front_end(config, reader.calibration)
        flight = FlightData(reader.steps(), reader.calibration)
        flown[name] = fly(front_end, flight, config, progress=_offset(progress, before, total), watch=watch)
        piece.close()
        pieces.append(piece)
        before += reader.sweep_count
    return flown, pieces


def _watch(reader: FlightReader, piece: MapPieces, config: Config, stack: ExitStack) -> Watch:
    """What takes the points of a flight: the sweeps', and the camera's where there is one."""
    if not reader.depth_count or reader.calibration.T_body_camera is None:
        return piece.watch
    # images and sweeps are read side by side: each from its own chunks
    second = stack.enter_context(FlightReader(reader.path))
    camera = CameraPieces(second.depth_images(), reader.calibration, config.fusion, piece)

    def watch(step: OdometryStep) -> None:
        piece.watch(step)
        camera.watch(step)

    return watch


def _offset(progress: Progress, before: int, all_flights: int) -> Progress:
    """Progress of one flight, told as that of all."""

    def counted(done: float, total: float | None, unit: str) -> None:
        del total
        progress(before + done, all_flights, unit)

    return counted


def _product(found: Reconstruction, pieces: Sequence[MapPieces], config: Config) -> SurveyMap:
    """All points where the smoothed poses put them, and what the map says."""
    positions = np.concatenate([poses[:, :3, 3] for poses in found.poses])
    builder = MapBuilder(config.map, origin_m=np.round(np.median(positions, axis=0)))
    for poses, piece in zip(found.poses, pieces, strict=True):
        for keyframe, points_lidar in piece:
            builder.insert(points_lidar, poses[keyframe])
    flown_m = np.concatenate([trajectory.positions_m for trajectory in found.trajectories])
    return survey_map(builder, flown_m)


def _body_trajectories(readers: Mapping[str, FlightReader], found: Reconstruction) -> dict[str, Trajectory]:
    return {
        name: trajectory.compose(right=se3.inverse(reader.calibration.T_body_lidar), child="body")
        for (name, reader), trajectory in zip(readers.items(), found.trajectories, strict=True)
    }


def _day(readers: Mapping[str, FlightReader]) -> date:
    first_ns = min(reader.first_ns for reader in readers.values())
    return datetime.fromtimestamp(first_ns * 1e-9, tz=UTC).date()


def _result(
    out: Path,
    readers: Mapping[str, FlightReader],
    flown: Mapping[str, Flown],
    found: Reconstruction,
    product: SurveyMap,
    seconds: float,
) -> ReconstructResult:
    complete = product.coverage.complete_share
    return ReconstructResult(
        out=out,
        flights=len(readers),
        sweeps=sum(len(flight.steps) for flight in flown.values()),
        keyframes=sum(len(flight.keyframes) for flight in flown.values()),
        path_m=sum(float(trajectory.path_m[-1]) for trajectory in found.trajectories),
        loops=len(found.loops),
        refused=sum(not fix.trusted for fixes in found.fixes for fix in fixes),
        degenerate_m=sum(
            degenerate_m(flight, trajectory)
            for flight, trajectory in zip(flown.values(), found.trajectories, strict=True)
        ),
        points=len(product.cloud),
        roadways_m=product.roadways.length_m,
        intersections=sum(degree >= 3 for degree in product.roadways.degrees),
        complete=complete if np.isfinite(complete) else None,
        control=None if found.control is None else control_rmse(found.control),
        seconds=seconds,
        real_time_factor=sum(reader.duration_s for reader in readers.values()) / seconds,
    )
