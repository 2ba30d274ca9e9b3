"""Surveyed targets and what was seen of them, from files or from the flights themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mineloc.config import ControlConfig
from mineloc.data import ControlPoint, Observation
from mineloc.errors import ConfigError
from mineloc.io.control_points import merged_control_points, read_control_points, read_flight_survey, read_observations
from mineloc.io.flight import FlightReader
from mineloc.localize.reconstruction import Survey
from mineloc.mapping.control import ControlTable
from mineloc.mapping.tags import observe_tags


def gathered_survey(
    readers: Mapping[str, FlightReader], control: Path | None, observations: Path | None, config: ControlConfig
) -> Survey | None:
    """Targets and observations; None when there are no targets.

    Args:
        readers: by the names of the flights; what is attached to them counts where no file is given.
        control: CSV of targets.
        observations: CSV of observations.
        config: axes of the file of targets.

    Raises:
        ConfigError: observations without targets, targets that nothing was seen of.
        FormatError: a file or an attachment is not what it claims, or two of them contradict each other.
    """
    attached = {name: read_flight_survey(reader) for name, reader in readers.items()}
    points: tuple[ControlPoint, ...]
    if control is not None:
        points = read_control_points(control, axes=config.axes)
    else:
        points = merged_control_points([(str(readers[name].path), own) for name, (own, _) in attached.items()])
    if not points:
        if observations is not None:
            raise ConfigError(
                observations, "observations without targets", expected="--control", todo="give the surveyed targets"
            )
        return None
    if observations is not None:
        seen: tuple[Observation, ...] = read_observations(observations, points)
    else:
        known = {point.name for point in points}
        seen = tuple(one for _, own in attached.values() for one in own if one.target in known)
    seen += _seen_tags(readers, points, config)
    if not seen:
        raise ConfigError(
            control or "control points",
            "no target was observed",
            expected="observations of at least two targets",
            todo="give --observations, or leave the control points out (--no-control)",
        )
    return Survey(points, seen)


def _seen_tags(
    readers: Mapping[str, FlightReader], points: Sequence[ControlPoint], config: ControlConfig
) -> tuple[Observation, ...]:
    """What the grey images of the flights say of AprilTags among the targets."""
    if all(point.tag_id is None for point in points):
        return ()
    out: list[Observation] = []
    for name, reader in readers.items():
        if reader.grey_count and reader.calibration.T_body_camera is not None:
            found = observe_tags(reader.grey_images(), points, reader.calibration, config, flight=name)
            out += found.observations
    return tuple(out)


def control_rmse(table: ControlTable) -> dict[str, float | None]:
    """RMSE in space of control and check points, metres."""
    return {
        "control_m": None if table.control is None else table.control.rmse_3d_m,
        "check_m": None if table.check is None else table.check.rmse_3d_m,
    }
