"""Intersections for other programs and for people: CSV whose names may be edited and taken back, GeoJSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast, get_args

from mineloc.data import Intersection, IntersectionDatabase
from mineloc.data.intersections import IntersectionKind
from mineloc.errors import FormatError
from mineloc.output import new_file

_COLUMNS = ("id", "name", "kind", "x_m", "y_m", "z_m", "degree", "branches_deg", "quality", "neighbours")


def write_csv(path: Path, database: IntersectionDatabase, *, overwrite: bool = False) -> None:
    """A row an intersection: positions in the mine grid where there is one, bearings counter-clockwise from x.

    Raises:
        OutputError: `path` exists or cannot be written.
    """
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(_COLUMNS)
    for one in database.intersections:
        branches = " ".join(repr(math.degrees(b)) for b in one.contour.branches_rad.tolist())
        ways = " ".join(f"{id}:{length_m!r}" for id, length_m in one.neighbours)
        at = [repr(value) for value in _grid(database, one)]
        rows.writerow([one.id, one.name, one.kind, *at, one.degree, branches, repr(one.quality), ways])
    with new_file(path, overwrite=overwrite) as temp:
        temp.write_bytes(text.getvalue().encode())


def write_geojson(path: Path, database: IntersectionDatabase, *, overwrite: bool = False) -> None:
    """A feature collection in metres of the mine grid where there is one: points, and lines between neighbours.

    Raises:
        OutputError: `path` exists or cannot be written.
    """
    points = {one.id: _grid(database, one) for one in database.intersections}
    features = [
        _feature(
            "Point",
            points[one.id],
            id=one.id,
            name=one.name,
            kind=one.kind,
            degree=one.degree,
            branches_deg=[math.degrees(b) for b in one.contour.branches_rad.tolist()],
            quality=one.quality,
        )
        for one in database.intersections
    ]
    # two intersections may be joined by several ways
    ways = {
        (min(one.id, other), max(one.id, other), length_m)
        for one in database.intersections
        for other, length_m in one.neighbours
        if other in points
    }
    features += [
        _feature("LineString", [points[a], points[b]], ids=[a, b], length_m=way_m) for a, b, way_m in sorted(ways)
    ]
    collection = {"type": "FeatureCollection", "is_grid": database.is_grid, "features": features}
    with new_file(path, overwrite=overwrite) as temp:
        temp.write_text(json.dumps(collection, indent=1, allow_nan=False), encoding="utf-8")


def read_names(path: Path) -> dict[int, tuple[str, IntersectionKind]]:
    """Name and kind by id, of a CSV of `write_csv` that a person has edited; other columns may be gone.

    Raises:
        FormatError: missing, no CSV, without a column that is needed, or with an id or kind that cannot be.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_bytes().decode("utf-8-sig"), newline=""), strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FormatError(path, f"cannot be read ({error})", expected="a CSV of intersections") from error
    names: dict[int, tuple[str, IntersectionKind]] = {}
    for line, row in enumerate(rows, start=2):
        missing = [column for column in ("id", "name", "kind") if row.get(column) is None]
        if missing:
            raise FormatError(path, f"row {line} has no {', '.join(missing)}", expected="columns id, name, kind")
        try:
            id = int(row["id"])
        except ValueError as error:
            raise FormatError(path, f"row {line} has id {row['id']!r}", expected="a whole number") from error
        if id in names:
            raise FormatError(path, f"row {line} repeats id {id}", expected="every id once")
        if row["kind"] not in get_args(IntersectionKind):
            kinds = ", ".join(get_args(IntersectionKind))
            raise FormatError(path, f"row {line} has kind {row['kind']!r}", expected=f"one of {kinds}")
        names[id] = row["name"], cast("IntersectionKind", row["kind"])
    if not names:
        raise FormatError(path, "has no rows", expected="a row an intersection")
    return names


def with_names(
    database: IntersectionDatabase, names: Mapping[int, tuple[str, IntersectionKind]], *, where: Path
) -> IntersectionDatabase:
    """The database with names and kinds taken over; who is not named keeps theirs.

    Args:
        database: to take them.
        names: of `read_names`.
        where: the file that they are from, for the error.

    Raises:
        FormatError: an id that the database does not have.
    """
    unknown = sorted(set(names) - {one.id for one in database.intersections})
    if unknown:
        listed = ", ".join(map(str, unknown))
        raise FormatError(where, f"names unknown ids {listed}", expected="ids of the database")
    renamed = (
        replace(one, name=names[one.id][0], kind=names[one.id][1]) if one.id in names else one
        for one in database.intersections
    )
    return replace(database, intersections=tuple(renamed))


def _grid(database: IntersectionDatabase, one: Intersection) -> list[float]:
    return cast("list[float]", (one.point_map + database.grid_origin_m).tolist())


def _feature(shape: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": {"type": shape, "coordinates": coordinates},
        "properties": properties,
    }
