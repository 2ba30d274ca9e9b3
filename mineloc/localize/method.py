"""The methods by name (METHOD 0): which front end, which absolute information."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from mineloc.config import Config
from mineloc.data import Calibration
from mineloc.errors import ConfigError
from mineloc.localize.graph_method import GraphMethod
from mineloc.localize.localization import FlightData, Localization
from mineloc.localize.loops import LoopCloser
from mineloc.localize.map_tracking import MapTracking, Prior
from mineloc.odometry.front_end import FrontEnd
from mineloc.odometry.link3d_front_end import Link3dFrontEnd
from mineloc.odometry.loam import LoamFrontEnd
from mineloc.odometry.mineloc_front_end import MinelocFrontEnd
from mineloc.progress import Progress, quiet


def _mineloc(config: Config, calibration: Calibration) -> FrontEnd:
    return MinelocFrontEnd(config.odometry, config.keyframe, calibration)


def _loam(config: Config, calibration: Calibration) -> FrontEnd:
    del calibration  # LOAM uses no IMU
    return LoamFrontEnd(config.loam, config.keyframe)


def _link3d(config: Config, calibration: Calibration) -> FrontEnd:
    del calibration  # nor does LinK3D
    return Link3dFrontEnd(config.link3d, config.loam, config.keyframe)


@dataclass(frozen=True, slots=True)
class Method:
    """One row of the table of methods.

    Attributes:
        front_end: its name, as the result row tells it.
        make_front_end: from configuration and calibration.
        summary: one line for people.
        loops: where loop closures come from: "place" (Scan Context), "position" (the estimate), "intersection" (one
            that was seen before); several or none.
        tracks: what of a prior map it localizes by.
    """

    front_end: str
    make_front_end: Callable[[Config, Calibration], FrontEnd]
    summary: str
    loops: frozenset[Literal["place", "position", "intersection"]] = frozenset()
    tracks: Literal["map", "intersections"] | None = None

    def closer(self, config: Config) -> LoopCloser | None:
        """What finds the method's loop closures, None for an open-loop method."""
        if not self.loops:
            return None
        return LoopCloser(
            config,
            by_place="place" in self.loops,
            by_position="position" in self.loops,
            by_intersection="intersection" in self.loops,
        )

    def run(
        self, flight: FlightData, config: Config, *, prior: Prior | None = None, progress: Progress = quiet
    ) -> Localization:
        """Localize a flight.

        Args:
            prior: the map, for methods that need one.

        Raises:
            ConfigError: the method needs a map.
            FlightError: fewer than two sweeps, no points, time going backwards.
        """
        front_end = self.make_front_end(config, flight.calibration)
        if self.tracks is not None:
            if prior is None:
                raise ConfigError(
                    "--method",
                    f"the method needs {'a map' if self.tracks == 'map' else 'a database'}",
                    expected="--map MAP/" if self.tracks == "map" else "--database DB.mcap",
                    todo="name one",
                )
            return MapTracking(config, front_end, prior, by=self.tracks).run(flight, progress)
        return GraphMethod(config, front_end, closer=self.closer(config)).run(flight, progress)


METHODS: dict[str, Method] = {
    "odometry": Method("mineloc", _mineloc, "the mineloc front end and gravity, no absolute information"),
    "odometry_loops": Method(
        "mineloc", _mineloc, "the mineloc front end with loop closures", frozenset({"place", "position"})
    ),
    "loam": Method("loam", _loam, "LOAM as published, the baseline of both papers"),
    "loam_scan_context": Method("loam", _loam, "LOAM with Scan Context loop closures", frozenset({"place"})),
    "link3d": Method("link3d", _link3d, "LOAM whose edges LinK3D gathers (paper B), no loop closures"),
    "link3d_scan_context": Method(
        "link3d", _link3d, "paper B: LinK3D and Scan Context loop closures", frozenset({"place"})
    ),
    "intersections": Method(
        "mineloc",
        _mineloc,
        "paper A without a map: an intersection seen again, from any side, closes the loop",
        frozenset({"intersection"}),
    ),
    "map_tracking": Method("mineloc", _mineloc, "every keyframe registered to a prior map", tracks="map"),
    "intersections_map": Method(
        "mineloc", _mineloc, "paper A: the intersections of a database, recognised in flight", tracks="intersections"
    ),
}


def method_named(name: str) -> Method:
    """Look a method up.

    Raises:
        ConfigError: no such method.
    """
    if name not in METHODS:
        raise ConfigError(
            "--method", f"unknown method {name!r}", expected=f"one of {', '.join(METHODS)}", todo="choose one of them"
        )
    return METHODS[name]
