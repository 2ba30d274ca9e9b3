"""A map folder as what is known before a flight."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mineloc.config import Config
from mineloc.data import Trajectory
from mineloc.errors import ConfigError
from mineloc.io.flight import FlightReader
from mineloc.localize.map_tracking import Prior, Start
from mineloc.localize.prior_map import PriorMap
from mineloc.sim.targets import GRID_FILE
from mineloc.stages.map_folder import MapFolder


@dataclass(frozen=True, slots=True, eq=False)
class KnownMap:
    """A map, ready for flights.

    Attributes:
        prior: for methods.
        survey: the folder.
    """

    prior: Prior
    survey: MapFolder

    @staticmethod
    def open(path: Path, config: Config) -> KnownMap:
        """Read a map folder.

        Raises:
            FormatError: not a map folder, or damaged.
            ConfigError: nothing says where the flight begins.
        """
        survey = MapFolder.open(path)
        start = Start.of(config.prior_map, survey.grid_origin_m)
        if start is None:
            raise ConfigError(
                "prior_map.start_m",
                "is not set",
                expected="where the drone begins, in the frame of the map",
                todo="set it, and prior_map.start_yaw_deg",
            )
        return KnownMap(Prior(PriorMap(survey.cloud(), config.prior_map, config.odometry), start), survey)

    def reference_of(self, reader: FlightReader) -> Trajectory | None:
        """The flight's reference in the frame of the map; None when it has none, or its frame is not known."""
        reference = reader.reference()
        if reference is None or not self.survey.manifest["frame"]["is_grid"]:
            return reference
        if GRID_FILE not in reader.attachment_names:
            return reference
        T_grid_map = np.array(json.loads(reader.attachment(GRID_FILE))["T_grid_map"])
        T_grid_map[:3, 3] -= self.survey.grid_origin_m
        return reference.compose(left=T_grid_map)

    @property
    def facts(self) -> Mapping[str, Any]:
        """For the manifest of a run."""
        content = (self.survey.path / "manifest.json").read_bytes()
        return {"manifest_sha256": hashlib.sha256(content).hexdigest(), "frame": dict(self.survey.manifest["frame"])}
