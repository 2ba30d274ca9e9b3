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
from mineloc.places.database_versions import Changes, descriptor_sizes, has_frame_of, merged, renumbered_since
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
        version: of the database, 1 for the first of a mine.
        changes: what became of those of the database before; None where there is none.
        seconds: of the work.
    """

    out: Path
    kinds: dict[str, int]
    threshold: float
    twins: tuple[tuple[int, int], ...]
    version: int
    changes: Changes | None
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
        if self.changes is not None:
            text += f"\nversion {self.version}: {_told(self.changes)}"
        return text


def database(prior_map: Path, out: Path, *, since: Path | None = None, config: Config | None = None) -> DatabaseResult:
    """Find and describe all intersections of a map.

    Args:
        prior_map: a map folder.
        out: the database file.
        since: the database before the mine grew: what stands where it stood keeps its id and its name.
        config: sections `intersections` and `map`.

    Raises:
        FormatError: not a map folder, no database, or damaged.
        MapError: the map has no intersection, or no frame in common with the database before.
        OutputError: `out` exists or cannot be written.
    """
    started = perf_counter()
    config = config or Config()
    survey = MapFolder.open(prior_map)
    # what cannot be followed is refused before the long work
    old = None if since is None else _followed(since, survey)
    known, changes = _found_in(survey, config), None
    if since is not None and old is not None:
        apart_m = config.intersections.apart_m
        known, changes = renumbered_since(old, known, parent=_sha256(since), apart_m=apart_m)
    write_database(out, known)
    return _result(out, known, started, changes)


def merge(one: Path, other: Path, out: Path, *, config: Config | None = None) -> DatabaseResult:
    """Two parts of a mine as one database, in the frame and with the ids of the first.

    Args:
        one: a database whose map stands in the mine grid.
        other: of another part, in the same grid.
        out: the database file to write.
        config: section `intersections`.

    Raises:
        FormatError: no database, or damaged.
        MapError: a map without a grid, or descriptors that cannot be compared.
        OutputError: `out` exists or cannot be written.
    """
    started = perf_counter()
    parts = read_database(one), read_database(other)
    for path, part in zip((one, other), parts, strict=True):
        if not part.is_grid:
            raise MapError(
                path, "is not in the mine grid", expected="two parts in one grid", todo="reconstruct with --control"
            )
    if len(descriptor_sizes(parts[0]) | descriptor_sizes(parts[1])) > 1:
        raise MapError(
            other,
            f"has descriptors of other sizes than {one}",
            expected="the same contour_bins, contour_radius_m and matrix_rows",
            todo="make both with one configuration",
        )
    section = (config or Config()).intersections
    known, changes = merged(*parts, section, parents=(_sha256(one), _sha256(other)))
    write_database(out, known)
    return _result(out, known, started, changes)


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


def _followed(since: Path, survey: MapFolder) -> IntersectionDatabase:
    """The database before.

    Raises:
        FormatError: no database, or damaged.
        MapError: its frame and that of the map have nothing in common.
    """
    old = read_database(since)
    is_grid = bool(survey.manifest["frame"]["is_grid"])
    if not has_frame_of(old, is_grid=is_grid, map_sha256=_manifest_sha256(survey)):
        raise MapError(
            since if is_grid else survey.path,
            "is not in the mine grid, so nothing tells which intersections are the same",
            expected="two maps in one grid",
            todo="reconstruct with --control, or leave --since out",
        )
    return old


def _found_in(survey: MapFolder, config: Config) -> IntersectionDatabase:
    cloud = survey.cloud()
    flown = np.concatenate([trajectory.positions_m for trajectory in survey.trajectories.values()])
    # the grid of the drone and that of the map are one: contours are compared
    sheet = free_sheet_of_map(cloud, flown, cell_m=config.intersections.cell_m, headroom_m=config.map.headroom_m)
    found = intersections_of(sheet, cloud, survey.roadways, config.intersections)
    if not found:
        raise MapError(
            survey.path, "no intersection in the map", expected="a mine in which roadways meet", todo="map more of it"
        )
    return database_of(
        found,
        config.intersections,
        grid_origin_m=survey.grid_origin_m,
        is_grid=bool(survey.manifest["frame"]["is_grid"]),
        map_sha256=_manifest_sha256(survey),
    )


def _manifest_sha256(survey: MapFolder) -> str:
    return _sha256(survey.path / "manifest.json")


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _told(changes: Changes) -> str:
    """For people: how many were kept, which are new and which are gone."""
    text = f"{len(changes.kept)} kept, {len(changes.new)} new"
    text += f" ({', '.join(map(str, changes.new))})" if changes.new else ""
    text += f", {len(changes.retired)} retired"
    if changes.retired:
        # most names end with the id
        names = (name if name.endswith(f" {id}") else f"{name} ({id})" for id, name in changes.retired)
        text += f": {', '.join(names)}"
    if changes.renumbered:
        text += "\nrenumbered: " + ", ".join(f"{was} is {now}" for was, now in changes.renumbered)
    return text


def _result(out: Path, known: IntersectionDatabase, started: float, changes: Changes | None = None) -> DatabaseResult:
    return DatabaseResult(
        out=out,
        kinds=dict(Counter(one.kind for one in known.intersections)),
        threshold=known.contour_threshold,
        twins=known.twins,
        version=known.lineage.version,
        changes=changes,
        seconds=perf_counter() - started,
    )
