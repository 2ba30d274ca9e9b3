"""What is known before a flight: a map folder, a database of its intersections, or both."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from mineloc.config import Config
from mineloc.data import F64, IntersectionDatabase, Trajectory
from mineloc.errors import ConfigError
from mineloc.io.flight import FlightReader
from mineloc.io.intersection_database import read_database
from mineloc.localize.map_tracking import Prior, Start
from mineloc.localize.prior_map import PriorMap
from mineloc.sim.targets import GRID_FILE
from mineloc.stages.map_folder import MapFolder
from mineloc.stages.run_tables import intersections_table


@dataclass(frozen=True, slots=True, eq=False)
class KnownMap:
    """A map, ready for flights.

    Attributes:
        prior: for methods.
        grid_origin_m: (3,) of its frame in the mine grid.
        is_grid: whether it stands in the mine grid.
        map_sha256: of the manifest of the map; of a merged database alone, of all its maps together.
    """

    prior: Prior
    grid_origin_m: F64
    is_grid: bool
    map_sha256: str

    @staticmethod
    def open(prior_map: Path | None, database: Path | None, config: Config) -> KnownMap | None:
        """Read a map folder, a database of intersections, or both; None without either.

        Raises:
            FormatError: not a map folder or no database, or damaged.
            ConfigError: they are of two maps.
        """
        survey = None if prior_map is None else MapFolder.open(prior_map)
        known = None if database is None else read_database(database)
        if survey is not None:
            digest = hashlib.sha256((survey.path / "manifest.json").read_bytes()).hexdigest()
            if known is not None and digest not in known.lineage.maps:
                raise ConfigError(
                    str(database),
                    "is of another map",
                    expected=f"the database of {prior_map}",
                    todo="make it of this map",
                )
            origin, is_grid = survey.grid_origin_m, bool(survey.manifest["frame"]["is_grid"])
            # a merged database stands in the frame of one of its maps, which need not be this one
            known = None if known is None else known.in_frame_at(origin)
        elif known is not None:
            digest, origin, is_grid = known.map_sha256, known.grid_origin_m, known.is_grid
        else:
            return None
        return KnownMap(_prior(survey, known, config, origin), origin, is_grid, digest)

    def reference_of(self, reader: FlightReader) -> Trajectory | None:
        """The flight's reference in the frame of the map; None when it has none, or its frame is not known."""
        reference = reader.reference()
        if reference is None or not self.is_grid or GRID_FILE not in reader.attachment_names:
            return reference
        T_grid_map = np.array(json.loads(reader.attachment(GRID_FILE))["T_grid_map"])
        T_grid_map[:3, 3] -= self.grid_origin_m
        return reference.compose(left=T_grid_map)

    @property
    def intersections(self) -> pl.DataFrame | None:
        """For a run folder; None without a database."""
        database = self.prior.database
        return None if database is None else intersections_table(database.intersections)

    @property
    def facts(self) -> Mapping[str, Any]:
        """For the manifest of a run."""
        return {
            "manifest_sha256": self.map_sha256,
            "grid_origin_m": self.grid_origin_m.tolist(),
            "is_grid": self.is_grid,
        }


def _prior(
    survey: MapFolder | None, database: IntersectionDatabase | None, config: Config, grid_origin_m: F64
) -> Prior:
    """Without a start the database finds the flight; a method with neither says what it needs."""
    start = Start.of(config.prior_map, grid_origin_m)
    patches = None if survey is None else PriorMap(survey.cloud(), config.prior_map, config.odometry)
    return Prior(start, patches, database)
