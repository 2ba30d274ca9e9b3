"""The stage that makes the semantic knowledge database of a map: a map folder in, one file of its intersections out."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from mineloc.config import Config
from mineloc.data import IntersectionDatabase
from mineloc.errors import MapError
from mineloc.io.intersection_database import read_database, write_database
from mineloc.io.intersection_files import read_names, with_names, write_csv, write_geojson
from mineloc.mapping.free_space import free_sheet_of_map
from mineloc.places.database import database_of
from mineloc.places.segmentation import intersections_of
from mineloc.stages.map_folder import MapFolder


@dataclass(frozen=True, slots=True)
class DatabaseResult:
    """What `database` left.

    Attributes:
        out: the file.
        kinds: number of intersections by kind.
        threshold: contour similarity of a candidate.
        twins: pairs that descriptors do not tell apart.
        seconds: of the work.
    """

    out: Path
    kinds: dict[str, int]
    threshold: float
    twins: tuple[tuple[int, int], ...]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {**asdict(self), "out": str(self.out)}

    def summary(self) -> str:
        """A line or two for people."""
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(self.kinds.items()))
        text = f"{self.out}: {sum(self.kinds.values())} intersections ({kinds}), threshold {self.threshold:.2f}"
        if self.twins:
            pairs = ", ".join(f"{a} and {b}" for a, b in self.twins)
            text += f"\ntwins, told apart by their neighbours and the way flown alone: {pairs}"
        return text


def database(prior_map: Path, out: Path, *, config: Config | None = None) -> DatabaseResult:
    """Find and describe all intersections of a map.

    Args:
        prior_map: a map folder.
        out: the database file.
        config: sections `intersections` and `map`.

    Raises:
        FormatError: not a map folder, or damaged.
        MapError: the map has no intersection.
        OutputError: `out` exists or cannot be written.
    """
    started = perf_counter()
    config = config or Config()
    survey = MapFolder.open(prior_map)
    cloud = survey.cloud()
    flown = np.concatenate([trajectory.positions_m for trajectory in survey.trajectories.values()])
    # the grid of the drone and that of the map are one: contours are compared
    sheet = free_sheet_of_map(cloud, flown, cell_m=config.intersections.cell_m, headroom_m=config.map.headroom_m)
    found = intersections_of(sheet, cloud, survey.roadways, config.intersections)
    if not found:
        raise MapError(
            prior_map, "no intersection in the map", expected="a mine in which roadways meet", todo="map more of it"
        )
    known = database_of(
        found,
        config.intersections,
        grid_origin_m=survey.grid_origin_m,
        is_grid=bool(survey.manifest["frame"]["is_grid"]),
        map_sha256=hashlib.sha256((survey.path / "manifest.json").read_bytes()).hexdigest(),
    )
    write_database(out, known)
    return _result(out, known, started)


def rename(source: Path, names: Path, out: Path) -> DatabaseResult:
    """A database with the names and kinds that a person has put into its CSV.

    Args:
        source: the database as it is.
        names: its CSV (of `export`), edited.
        out: the database file to write.

    Raises:
        FormatError: no database, or a CSV that does not fit it.
        OutputError: `out` exists or cannot be written.
    """
    started = perf_counter()
    known = with_names(read_database(source), read_names(names), where=names)
    write_database(out, known)
    return _result(out, known, started)


def export(source: Path, *, csv: Path | None = None, geojson: Path | None = None) -> None:
    """A database for spreadsheets and for maps.

    Raises:
        FormatError: no database, or damaged.
        OutputError: a file exists or cannot be written.
    """
    known = read_database(source)
    if csv is not None:
        write_csv(csv, known)
    if geojson is not None:
        write_geojson(geojson, known)


def _result(out: Path, known: IntersectionDatabase, started: float) -> DatabaseResult:
    return DatabaseResult(
        out=out,
        kinds=dict(Counter(one.kind for one in known.intersections)),
        threshold=known.contour_threshold,
        twins=known.twins,
        seconds=perf_counter() - started,
    )
