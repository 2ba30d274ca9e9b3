"""The methods by name (METHOD 0): which front end, which absolute information."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mineloc.config import Config
from mineloc.data import Calibration
from mineloc.errors import ConfigError
from mineloc.localize.localization import FlightData, Localization
from mineloc.localize.relative import RelativeMethod
from mineloc.odometry.front_end import FrontEnd
from mineloc.odometry.loam import LoamFrontEnd
from mineloc.odometry.mineloc_front_end import MinelocFrontEnd
from mineloc.progress import Progress, quiet


def _mineloc(config: Config, calibration: Calibration) -> FrontEnd:
    return MinelocFrontEnd(config.odometry, config.keyframe, calibration)


def _loam(config: Config, calibration: Calibration) -> FrontEnd:
    del calibration  # LOAM uses no IMU
    return LoamFrontEnd(config.loam, config.keyframe)


@dataclass(frozen=True, slots=True)
class Method:
    """One row of the table of methods.

    Attributes:
        front_end: its name, as the result row tells it.
        make_front_end: from configuration and calibration.
        summary: one line for people.
    """

    front_end: str
    make_front_end: Callable[[Config, Calibration], FrontEnd]
    summary: str

    def run(self, flight: FlightData, config: Config, *, progress: Progress = quiet) -> Localization:
        """Localize a flight.

        Raises:
            FlightError: fewer than two sweeps, no points, time going backwards.
        """
        front_end = self.make_front_end(config, flight.calibration)
        return RelativeMethod(config, front_end).run(flight, progress)


METHODS: dict[str, Method] = {
    "odometry": Method("mineloc", _mineloc, "the mineloc front end and gravity, no absolute information"),
    "loam": Method("loam", _loam, "LOAM as published, the baseline of both papers"),
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
