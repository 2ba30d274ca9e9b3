"""Trajectories on disk: TUM and KITTI text, and one door for whatever a user names.

TUM is `t x y z qx qy qz qw` a line, seconds and metres; KITTI is the upper 3x4 of the pose, row by row, without times.
Stamps go between decimal text and integer nanoseconds without passing through a float: seconds since the epoch in
float64 keep only 0.2 µs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal

import numpy as np

from mineloc import se3
from mineloc.data import F64, Trajectory
from mineloc.errors import FormatError
from mineloc.io.distinct_poses import DistinctPoses, first_of_each_time
from mineloc.io.flight_layout import POSE
from mineloc.io.flight_reader import FlightReader
from mineloc.io.pose_topics import is_flight, read_pose_topic
from mineloc.output import new_file

Kind = Literal["tum", "kitti", "mcap"]

_TUM = "t x y z qx qy qz qw"
_KITTI = "12 numbers, the upper 3x4 of a pose row by row"
_PLAIN_SECONDS = re.compile(r"([+-]?)(\d{1,10})(?:\.(\d{0,9}))?\Z")
_MAX_SECONDS = 9_223_372_036  # int64 nanoseconds
_RIGID = 1e-6  # what `Trajectory` accepts; closer rotations keep the digits of the file
_REPAIRABLE = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class LoadedTrajectory:
    """A trajectory and where it came from.

    Attributes:
        trajectory: what was read.
        source: the file, with `:/topic` for a recording.
        kind: the format that it turned out to be.
        duplicates: poses that were there twice, same time and same pose; kept once.
        conflicts: other poses for a time that already had one; the first is kept.
        positions_only: a laser tracker's file with all quaternions 0; the orientations stand as identity and mean
            nothing.
    """

    trajectory: Trajectory
    source: str
    kind: Kind
    duplicates: int = 0
    conflicts: int = 0
    positions_only: bool = False


def read_trajectory(spec: str | Path) -> Trajectory:
    """The trajectory in a TUM or KITTI file, or in an MCAP (`file.mcap` or `file.mcap:/topic`).

    Of a flight it is the reference, of another recording the only topic with poses, unless a topic is named.

    Raises:
        MinelocError: see `load_trajectory`.
    """
    return load_trajectory(spec).trajectory


def load_trajectory(spec: str | Path) -> LoadedTrajectory:
    """`read_trajectory` with the provenance.

    Raises:
        FormatError: no such file, none of the formats, an unreadable line (told by its number), time going backwards,
            several or no pose topics in a recording, a flight without reference.
        IngestError, FlightError: a damaged flight.
    """
    path, topic = _split_topic(str(spec))
    if path.is_dir():
        raise FormatError(path, "is a folder", expected="a trajectory file", todo="name the file in it")
    if topic is None and path.suffix == ".mcap" and is_flight(path):
        return _load_reference(path)
    if topic is not None or path.suffix == ".mcap":
        found = read_pose_topic(path, topic)
        return LoadedTrajectory(found.trajectory, f"{path}:{found.topic}", "mcap", found.duplicates, found.conflicts)
    if path.suffix in (".bag", ".db3"):
        raise FormatError(
            path, "is a recording", expected="TUM, KITTI or MCAP", todo="make a flight of it first: mineloc ingest"
        )
    rows = _pose_rows(path)
    number, first = rows[0]
    if len(first) == 8:
        distinct = _parse_tum(path, rows)
        facts = distinct.duplicates, distinct.conflicts, _without_turns(distinct.values)
        return LoadedTrajectory(_trajectory(distinct), str(path), "tum", *facts)
    if len(first) == 12:
        return LoadedTrajectory(_parse_kitti(path, rows), str(path), "kitti")
    raise FormatError(
        _line(path, number),
        f"{len(first)} values",
        expected=f"8 (TUM: {_TUM}) or 12 (KITTI)",
        todo="convert the file to TUM",
    )


def read_tum(path: Path) -> Trajectory:
    """A TUM file. Comments (`#`) and blank lines are skipped, quaternions normalised, repeated lines kept once.

    Quaternions that are 0 in all lines are a laser tracker's, which knows positions only: identity.

    Raises:
        FormatError: no such file, no poses, or a line that is not a pose, with its number.
    """
    return _trajectory(_parse_tum(path, _pose_rows(path)))


def write_tum(path: Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write a TUM file, whole or not at all; stamps to the nanosecond, positions to the nanometre.

    Raises:
        OutputError: `path` exists (unless `overwrite`) or cannot be written.
        ValueError: the trajectory has no times.
    """
    if not trajectory.timed:
        raise ValueError("TUM needs times: this trajectory only counts its poses; write KITTI")
    position, xyzw = se3.to_xyzw(trajectory.poses) if len(trajectory) else (np.zeros((0, 3)), np.zeros((0, 4)))
    with new_file(path, overwrite=overwrite) as temp, temp.open("w", encoding="ascii", newline="\n") as f:
        f.write(f"# {_TUM}\n")
        for stamp, p, q in zip(trajectory.stamps_ns.tolist(), position.tolist(), xyzw.tolist(), strict=True):
            f.write(f"{_seconds_text(stamp)} {p[0]:.9f} {p[1]:.9f} {p[2]:.9f} ")
            f.write(f"{q[0]:.12f} {q[1]:.12f} {q[2]:.12f} {q[3]:.12f}\n")


def read_kitti(path: Path) -> Trajectory:
    """A KITTI file: poses without times (`timed=False`, stamps count 0, 1, 2 …).

    Rotations that are rigid to 1e-6 keep the digits of the file; coarser ones are made rigid (nearest rotation).

    Raises:
        FormatError: no such file, no poses, or a line that is not a pose, with its number.
    """
    return _parse_kitti(path, _pose_rows(path))


def write_kitti(path: Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write a KITTI file, whole or not at all. The times are lost: the format has none.

    Raises:
        OutputError: `path` exists (unless `overwrite`) or cannot be written.
    """
    with new_file(path, overwrite=overwrite) as temp, temp.open("w", encoding="ascii", newline="\n") as f:
        for row in trajectory.poses[:, :3, :].reshape(-1, 12).tolist():
            f.write(" ".join(f"{value:.12e}" for value in row) + "\n")


def _load_reference(path: Path) -> LoadedTrajectory:
    with FlightReader(path) as flight:
        reference = flight.reference()
    if reference is None or not len(reference):
        raise FormatError(
            path, "the flight has no reference", expected="poses on /pose", todo="name another topic: FILE.mcap:/topic"
        )
    return LoadedTrajectory(reference, f"{path}:{POSE}", "mcap")


def _split_topic(spec: str) -> tuple[Path, str | None]:
    head, colon, topic = spec.rpartition(".mcap:")
    return (Path(head + ".mcap"), topic) if colon and topic else (Path(spec), None)


def _line(path: Path, number: int) -> str:
    return f"{path}, line {number}"


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The lines that carry values, with their numbers, split at white space."""
    try:
        with path.open(encoding="utf-8-sig") as f:
            for number, line in enumerate(f, start=1):
                fields = line.split()
                if fields and not fields[0].startswith("#"):
                    yield number, fields
    except UnicodeDecodeError:
        raise FormatError(path, "is not text", expected="a TUM or KITTI file", todo="check the file") from None
    except OSError as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise FormatError(path, reason, expected="a trajectory file", todo="check the path") from None


def _pose_rows(path: Path) -> list[tuple[int, list[str]]]:
    rows = list(_rows(path))
    if not rows:
        raise FormatError(path, "holds no poses", expected=f"lines of {_TUM}", todo="check what wrote the file")
    return rows


def _trajectory(distinct: DistinctPoses) -> Trajectory:
    values = distinct.values
    if _without_turns(values):
        values = np.column_stack([values[:, :6], np.ones(len(values))])
    return Trajectory(distinct.stamps_ns, se3.from_xyzw(values[:, :3], values[:, 3:]))


def _without_turns(values: F64) -> bool:
    """Whether no line of (n, 7) has a quaternion."""
    return not values[:, 3:].any()


def _numbers(path: Path, rows: list[tuple[int, list[str]]], *, skip: int, count: int, expected: str) -> F64:
    """(n, count) finite values of the columns after the first `skip`."""
    out = np.empty((len(rows), count))
    for k, (number, fields) in enumerate(rows):
        if len(fields) != skip + count:
            raise FormatError(
                _line(path, number), f"{len(fields)} values", expected=expected, todo="correct or remove the line"
            )
        try:
            out[k] = [float(field) for field in fields[skip:]]
        except ValueError:
            raise FormatError(
                _line(path, number), f"not numbers: {' '.join(fields)[:80]!r}", expected=expected
            ) from None
    bad = np.flatnonzero(~np.isfinite(out).all(axis=1))
    if bad.size:
        raise FormatError(
            _line(path, rows[bad[0]][0]),
            f"NaN or infinity ({bad.size} such line{'s' if bad.size > 1 else ''})",
            expected="finite numbers",
            todo="remove the lines: a missing pose is told by its absence",
        )
    return out


def _parse_tum(path: Path, rows: list[tuple[int, list[str]]]) -> DistinctPoses:
    values = _numbers(path, rows, skip=1, count=7, expected=_TUM)
    stamps = np.array([_stamp_ns(path, number, fields[0]) for number, fields in rows], dtype=np.int64)
    norm = np.linalg.norm(values[:, 3:], axis=1)
    bad = np.flatnonzero(np.abs(norm - 1.0) > 0.1) if norm.any() else np.zeros(0, np.int64)
    if bad.size:
        raise FormatError(
            _line(path, rows[bad[0]][0]),
            f"a quaternion of length {norm[bad[0]]:.3g}",
            expected=f"length 1 in {_TUM}",
            todo="check the order of the columns",
        )
    back = np.flatnonzero(np.diff(stamps) < 0) + 1
    if back.size:
        number, fields = rows[back[0]]
        raise FormatError(
            _line(path, number),
            f"time goes backwards ({fields[0]} after {rows[back[0] - 1][1][0]})",
            expected="rising times",
            todo="sort the file or remove the line",
        )
    return first_of_each_time(str(path), stamps, values)


def _parse_kitti(path: Path, rows: list[tuple[int, list[str]]]) -> Trajectory:
    values = _numbers(path, rows, skip=0, count=12, expected=_KITTI)
    upper = values.reshape(-1, 3, 4)
    r = upper[:, :, :3]
    off = np.abs(r @ np.swapaxes(r, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > _REPAIRABLE) | (np.linalg.det(r) <= 0))
    if bad.size:
        raise FormatError(
            _line(path, rows[bad[0]][0]),
            "the 3x3 part is not a rotation",
            expected=_KITTI,
            todo="check the order of the columns",
        )
    coarse = off >= _RIGID
    if coarse.any():
        u, _, vt = np.linalg.svd(r[coarse])
        r = r.copy()
        r[coarse] = u @ vt
    return Trajectory(np.arange(len(rows), dtype=np.int64), se3.from_rt(r, upper[:, :, 3]), timed=False)


def _stamp_ns(path: Path, number: int, text: str) -> int:
    """Nanoseconds of decimal seconds, rounded to nearest where the text says more."""
    plain = _PLAIN_SECONDS.match(text)
    if plain is not None:
        sign, whole, part = plain.groups(default="")
        stamp = int(whole) * 1_000_000_000 + int(part.ljust(9, "0") if part else 0)
        stamp = -stamp if sign == "-" else stamp
    else:
        try:
            value = Decimal(text)
        except InvalidOperation:
            value = Decimal("nan")
        if not value.is_finite():
            raise FormatError(
                _line(path, number), f"time {text[:40]!r}", expected="seconds", todo="correct or remove the line"
            )
        # 1e999999999 is a short text and an endless integer
        stamp = round(value.scaleb(9)) if value.adjusted() < 12 else _MAX_SECONDS * 10**10
    if abs(stamp) > _MAX_SECONDS * 1_000_000_000:
        raise FormatError(
            _line(path, number), f"time {text[:40]} s", expected="seconds", todo="convert nanoseconds to seconds"
        )
    return stamp


def _seconds_text(stamp_ns: int) -> str:
    whole, part = divmod(abs(stamp_ns), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{part:09d}"
