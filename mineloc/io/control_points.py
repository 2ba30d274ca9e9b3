"""Surveyed targets and observations of them, as comma-separated text.

Targets: `name,e_m,n_m,z_m,sigma_m[,sigma_z_m],role[,tag_id,tag_size_m]`, role `control` or `check`, tags of the family
tag36h11. Observations: `target,flight,stamp_ns,x_m,y_m,z_m,sigma_m`, the target in the lidar frame at that time;
`flight` may be empty. The first line names the columns, in any order; lines that begin with `#` are comments.

A file of targets with y up names its coordinates `x_m,y_m,z_m` and is read with `axes="y_up"`; its `sigma_z_m` is
that of the height all the same.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mineloc.data import ControlPoint, Observation
from mineloc.data.control import is_plain, z_up_from_y_up
from mineloc.errors import FormatError
from mineloc.io.flight_reader import FlightReader

Axes = Literal["z_up", "y_up"]

TARGETS_FILE = "control_points.csv"
OBSERVATIONS_FILE = "observations.csv"
MEDIA_TYPE = "text/csv"

TAG_IDS = 587
"""Members of the family tag36h11."""

_COORDINATES: dict[Axes, tuple[str, ...]] = {"z_up": ("e_m", "n_m", "z_m"), "y_up": ("x_m", "y_m", "z_m")}
_ROLES = ("control", "check")
_SEEN = ("x_m", "y_m", "z_m")
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?\Z")
_LARGEST_M = 1e8
_LARGEST_SIGMA_M = 1.0
_FARTHEST_M = 300.0
_INT64 = 2**63 - 1


@dataclass(frozen=True, slots=True)
class _Row:
    """One line, and how to speak about what is wrong with it."""

    where: str
    line: int
    values: Mapping[str, str]

    def error(self, found: str, *, expected: str, todo: str) -> FormatError:
        return FormatError(f"{self.where}, line {self.line}", found, expected=expected, todo=todo)

    def number(self, column: str, *, largest: float = _LARGEST_M) -> float:
        text = self.values[column]
        if not _NUMBER.match(text):
            raise self.error(
                f"{column} = {text[:40]!r}",
                expected="a finite number of metres, such as 7100000.125",
                todo="leave out blanks, units and thousands separators; remove the line if it is not known",
            )
        value = float(text)
        if abs(value) > largest:
            raise self.error(
                f"{column} = {text[:40]}", expected=f"at most {largest:g} m", todo="check the unit and the columns"
            )
        return value

    def sigma(self, column: str) -> float:
        value = self.number(column)
        if not 0.0 < value <= _LARGEST_SIGMA_M:
            raise self.error(
                f"{column} = {self.values[column]}",
                expected=f"metres above 0, at most {_LARGEST_SIGMA_M:g}",
                todo="give one standard deviation in metres, not millimetres",
            )
        return value

    def integer(self, column: str, *, most: int, what: str) -> int:
        text = self.values[column]
        if not (text.isascii() and text.isdigit()) or len(text) > 19 or int(text) > most:
            raise self.error(f"{column} = {text[:40]!r}", expected=what, todo="correct the value")
        return int(text)


def read_control_points(path: Path, *, axes: Axes = "z_up") -> tuple[ControlPoint, ...]:
    """The targets of a file, in its order.

    Raises:
        FormatError: see `parse_control_points`, or no such file.
    """
    return parse_control_points(_content(path), where=str(path), axes=axes)


def read_observations(path: Path, points: Sequence[ControlPoint]) -> tuple[Observation, ...]:
    """The observations of a file, in its order.

    Raises:
        FormatError: see `parse_observations`, or no such file.
    """
    return parse_observations(_content(path), points, where=str(path))


def parse_control_points(content: bytes, *, where: str, axes: Axes = "z_up") -> tuple[ControlPoint, ...]:
    """The targets of a file or an attachment.

    Args:
        content: the file.
        where: its name in error texts.
        axes: `z_up` for easting, northing and height; `y_up` for x, y (up) and z, which become (x, −z, y).

    Raises:
        FormatError: a missing or unknown column, a value that is none, a name, place or tag that is there twice, an
            unknown role, no targets at all; with the number of the line.
    """
    place = _COORDINATES[axes]
    needed = ("name", *place, "sigma_m", "role")
    out: list[ControlPoint] = []
    lines: dict[str, int] = {}
    for row in _rows(content, where, needed=needed, optional=("sigma_z_m", "tag_id", "tag_size_m")):
        point = _control_point(row, place, axes)
        _refuse_twins(row, point, out, lines)
        out.append(point)
        lines[point.name] = row.line
    if not out:
        raise FormatError(where, "holds no targets", expected=f"lines of {','.join(needed)}", todo="add the targets")
    return tuple(out)


def parse_observations(content: bytes, points: Sequence[ControlPoint], *, where: str) -> tuple[Observation, ...]:
    """The observations of a file or an attachment.

    Args:
        content: the file.
        points: the targets that there are.
        where: its name in error texts.

    Raises:
        FormatError: a missing or unknown column, a value that is none, a target that is not surveyed, a point farther
            than a LiDAR sees, an observation that is there twice; with the number of the line.
    """
    known = {point.name for point in points}
    out: list[Observation] = []
    lines: dict[tuple[str, str, int], int] = {}
    for row in _rows(content, where, needed=("target", "flight", "stamp_ns", *_SEEN, "sigma_m"), optional=()):
        observation = _observation(row, known)
        key = (observation.target, observation.flight, observation.stamp_ns)
        if key in lines:
            raise row.error(
                f"{observation.target} at {observation.stamp_ns} is in line {lines[key]} already",
                expected="one observation of a target at a time",
                todo="remove one of the two lines",
            )
        lines[key] = row.line
        out.append(observation)
    return tuple(out)


def read_flight_survey(flight: FlightReader) -> tuple[tuple[ControlPoint, ...], tuple[Observation, ...]]:
    """Targets (z up) and observations that are attached to a flight; empty where there are none.

    Raises:
        FormatError: an attachment is not what its name says.
        IngestError: it is damaged.
    """
    points: tuple[ControlPoint, ...] = ()
    if TARGETS_FILE in flight.attachment_names:
        points = parse_control_points(flight.attachment(TARGETS_FILE), where=f"{flight.path}:{TARGETS_FILE}")
    if OBSERVATIONS_FILE not in flight.attachment_names:
        return points, ()
    where = f"{flight.path}:{OBSERVATIONS_FILE}"
    return points, parse_observations(flight.attachment(OBSERVATIONS_FILE), points, where=where)


def merged_control_points(surveys: Sequence[tuple[str, Sequence[ControlPoint]]]) -> tuple[ControlPoint, ...]:
    """The targets of several surveys, each with the name of its file; what is in two of them must be the same in both.

    Raises:
        FormatError: two targets of one name, or one tag, that differ.
    """
    out: dict[str, ControlPoint] = {}
    source: dict[str, str] = {}
    for where, points in surveys:
        for point in points:
            other = out.get(point.name)
            if other is None:
                other = next((p for p in out.values() if p.tag_id is not None and p.tag_id == point.tag_id), None)
            if other is None:
                out[point.name], source[point.name] = point, where
            elif not _same(point, other):
                raise FormatError(
                    where,
                    f"target {point.name!r} is not as {other.name!r} in {source[other.name]}",
                    expected="one name and tag, one place",
                    todo="rename one of the two or correct it",
                )
    return tuple(out.values())


def control_points_csv(points: Sequence[ControlPoint]) -> bytes:
    """Targets as a file, z up; millimetre and finer digits are kept."""
    columns = ("name", *_COORDINATES["z_up"], "sigma_m", "sigma_z_m", "role", "tag_id", "tag_size_m")
    rows = [
        (
            p.name,
            *p.position_grid.tolist(),
            p.sigma_m,
            p.sigma_z_m,
            p.role,
            "" if p.tag_id is None else p.tag_id,
            "" if p.tag_size_m is None else p.tag_size_m,
        )
        for p in points
    ]
    return _csv(columns, rows)


def observations_csv(observations: Sequence[Observation]) -> bytes:
    """Observations as a file; of a covariance its mean over all directions is kept."""
    columns = ("target", "flight", "stamp_ns", *_SEEN, "sigma_m")
    return _csv(columns, [(o.target, o.flight, o.stamp_ns, *o.point_lidar.tolist(), o.sigma_m) for o in observations])


def _control_point(row: _Row, place: tuple[str, ...], axes: Axes) -> ControlPoint:
    values = row.values
    if not is_plain(values["name"]):
        raise row.error(
            f"name {values['name'][:40]!r}", expected="letters, not beginning with #", todo="give the target a name"
        )
    if values["role"] not in _ROLES:
        raise row.error(
            f"role {values['role'][:40]!r}",
            expected="control or check",
            todo="say control for targets that place the map, check for those kept apart",
        )
    position = np.array([row.number(column) for column in place])
    sigma_m = row.sigma("sigma_m")
    tag_id, size_m = values.get("tag_id", ""), values.get("tag_size_m", "")
    if bool(tag_id) != bool(size_m):
        raise row.error(
            "tag_id without tag_size_m" if tag_id else "tag_size_m without tag_id",
            expected="both or neither",
            todo="add the edge of the tag's black square in metres" if tag_id else "add the number of the tag",
        )
    return ControlPoint(
        name=values["name"],
        position_grid=z_up_from_y_up(position) if axes == "y_up" else position,
        sigma_m=sigma_m,
        sigma_z_m=row.sigma("sigma_z_m") if values.get("sigma_z_m") else sigma_m,
        role=values["role"],
        tag_id=row.integer("tag_id", most=TAG_IDS - 1, what=f"a tag36h11 id, 0 to {TAG_IDS - 1}") if tag_id else None,
        tag_size_m=_tag_size(row) if size_m else None,
    )


def _same(a: ControlPoint, b: ControlPoint) -> bool:
    facts = [(p.name, p.role, p.sigma_m, p.sigma_z_m, p.tag_id, p.tag_size_m, p.position_grid.tolist()) for p in (a, b)]
    return facts[0] == facts[1]


def _tag_size(row: _Row) -> float:
    size_m = row.number("tag_size_m")
    if not 0.01 <= size_m <= 5.0:
        raise row.error(
            f"tag_size_m = {row.values['tag_size_m']}",
            expected="0.01 to 5",
            todo="give the edge of the tag's black square in metres",
        )
    return size_m


def _refuse_twins(row: _Row, point: ControlPoint, others: Sequence[ControlPoint], lines: Mapping[str, int]) -> None:
    for other in others:
        before = f"{other.name} in line {lines[other.name]}"
        if other.name == point.name:
            raise row.error(
                f"target {point.name!r} is in line {lines[other.name]} already",
                expected="every name once",
                todo="rename or remove one of the two",
            )
        if np.array_equal(other.position_grid, point.position_grid):
            raise row.error(
                f"{point.name} is exactly where {before} is",
                expected="one place a target",
                todo="correct the coordinates or remove one of the two",
            )
        if point.tag_id is not None and other.tag_id == point.tag_id:
            raise row.error(
                f"tag {point.tag_id} is that of {before}", expected="every tag once", todo="correct the tag_id"
            )


def _observation(row: _Row, known: set[str]) -> Observation:
    target = row.values["target"]
    if target not in known:
        some = ", ".join(sorted(known)[:8]) + (" …" if len(known) > 8 else "")
        raise row.error(
            f"target {target[:40]!r} is not surveyed", expected=f"one of {some}", todo="correct the name or survey it"
        )
    stamp_ns = row.integer("stamp_ns", most=_INT64, what="whole nanoseconds since the epoch")
    point = np.array([row.number(column) for column in _SEEN])
    away_m = float(np.linalg.norm(point))
    if away_m > _FARTHEST_M:
        raise row.error(
            f"a point {away_m:.0f} m away",
            expected=f"coordinates in the lidar frame, at most {_FARTHEST_M:g} m",
            todo="give the point as the lidar saw it, not in map or grid",
        )
    return Observation.picked(target, row.values["flight"], stamp_ns, point, sigma_m=row.sigma("sigma_m"))


def _rows(content: bytes, where: str, *, needed: tuple[str, ...], optional: tuple[str, ...]) -> Iterator[_Row]:
    """The lines that carry values, as columns by name."""
    columns: list[str] | None = None
    for line, fields in _fields(content, where):
        if columns is None:
            columns = fields
            _check_columns(columns, f"{where}, line {line}", needed=needed, optional=optional)
            continue
        if len(fields) != len(columns):
            raise FormatError(
                f"{where}, line {line}",
                f"{len(fields)} values",
                expected=f"{len(columns)}: {','.join(columns)}",
                todo="correct the line; decimals have a point, not a comma",
            )
        yield _Row(where, line, dict(zip(columns, fields, strict=True)))
    if columns is None:
        raise FormatError(where, "is empty", expected=f"a line {','.join(needed)}", todo="check what wrote the file")


def _fields(content: bytes, where: str) -> Iterator[tuple[int, list[str]]]:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError(
            where, "is not UTF-8 text", expected="comma-separated text", todo="export it as CSV (UTF-8)"
        ) from None
    # line by line: a quote that is never closed must not swallow the rest
    for line, content_line in enumerate(text.splitlines(), start=1):
        if not content_line.strip() or content_line.lstrip().startswith("#"):
            continue
        try:
            fields = next(csv.reader([content_line], strict=True))
        except csv.Error as error:
            raise FormatError(
                f"{where}, line {line}", f"no CSV ({error})", expected="comma-separated values", todo="correct the line"
            ) from None
        yield line, [field.strip() for field in fields]


def _check_columns(columns: list[str], where: str, *, needed: tuple[str, ...], optional: tuple[str, ...]) -> None:
    expected = ",".join(needed) + (f" and if wanted {','.join(optional)}" if optional else "")
    if len(columns) == 1 and re.search(r"[;\t]", columns[0]):
        raise FormatError(where, "columns are not separated by commas", expected=expected, todo="export with commas")
    for column in columns:
        if column not in needed and column not in optional:
            raise FormatError(
                where, f"unknown column {column[:40]!r}", expected=expected, todo="rename or remove the column"
            )
        if columns.count(column) > 1:
            raise FormatError(where, f"column {column} twice", expected=expected, todo="remove one of them")
    missing = [column for column in needed if column not in columns]
    if missing:
        raise FormatError(where, f"no column {missing[0]}", expected=expected, todo="add the column")


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise FormatError(path, reason, expected="a CSV file", todo="check the path") from None


def _csv(columns: tuple[str, ...], rows: Sequence[tuple[object, ...]]) -> bytes:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue().encode()
