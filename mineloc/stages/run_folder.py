"""A run folder: what one localization leaves on the disk, and all that evaluation, report and viewer read.

The table in DESIGN.md ("A run folder") is the contract; the schemas are in
`run_tables`. What is unknown is null, never NaN.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import polars as pl

from mineloc.data import F64, Trajectory
from mineloc.errors import FormatError
from mineloc.io.trajectories import read_tum, write_tum
from mineloc.stages.run_tables import FIXES, INTERSECTIONS, KEYFRAMES, POINTS, SWEEPS, checked, poses_of

SCHEMA = "mineloc.run/1"

MANIFEST_KEYS = frozenset(
    {"mineloc_version", "method", "front_end", "flight", "health", "calibration", "configuration", "coverage", "counts"}
)
TIMING_KEYS = frozenset({"modules", "sweeps_per_s", "real_time_factor"})


@dataclass(frozen=True, slots=True, eq=False)
class RunFolder:
    """One opened run. Cheap but for `points`, which are read when asked for.

    Attributes:
        path: the folder.
        smoothed, online: `T_map_body`, at most one pose a sweep; `online` as known at that time.
        reference: `T_map_body` to compare with, None if the flight has none.
        sweeps, keyframes, fixes: tables with the schemas `SWEEPS`, `KEYFRAMES`, `FIXES`.
        timing: `modules` {name: {total_s, p50_ms, p95_ms, max_ms}}, `sweeps_per_s`, `real_time_factor`.
        manifest: see `MANIFEST_KEYS`; `flight` holds `name`, `sha256` and `info`.
    """

    path: Path
    smoothed: Trajectory
    online: Trajectory
    reference: Trajectory | None
    sweeps: pl.DataFrame
    keyframes: pl.DataFrame
    fixes: pl.DataFrame
    timing: Mapping[str, Any]
    manifest: Mapping[str, Any]

    @staticmethod
    def open(path: Path) -> RunFolder:
        """Read a run folder.

        Raises:
            FormatError: not a folder, a file is missing, damaged, or has other columns.
        """
        path = Path(path)
        if not (path / "manifest.json").is_file():
            raise FormatError(
                path, "is not a run folder", expected="a folder with manifest.json", todo="give a folder of `localize`"
            )
        manifest = _read_json(path / "manifest.json", MANIFEST_KEYS)
        if manifest.get("schema") != SCHEMA:
            raise FormatError(
                path / "manifest.json",
                f"schema {manifest.get('schema')!r}",
                expected=repr(SCHEMA),
                todo="localize again with this version",
            )
        reference = path / "reference.tum"
        return RunFolder(
            path=path,
            smoothed=read_tum(_present(path / "trajectory.tum")),
            online=read_tum(_present(path / "trajectory_online.tum")),
            reference=read_tum(reference) if reference.exists() else None,
            sweeps=_read_table(path / "sweeps.parquet", SWEEPS),
            keyframes=_read_table(path / "keyframes.parquet", KEYFRAMES),
            fixes=_read_table(path / "fixes.parquet", FIXES),
            timing=_read_json(path / "timing.json", TIMING_KEYS),
            manifest=manifest,
        )

    def points(self) -> pl.DataFrame:
        """The decimated keyframe points (`POINTS`), each in the lidar frame of its keyframe.

        Raises:
            FormatError: as `open`.
        """
        return _read_table(self.path / "points.parquet", POINTS)

    def intersections(self) -> pl.DataFrame | None:
        """Those of the database that the run was given (`INTERSECTIONS`); None without one.

        Raises:
            FormatError: as `open`.
        """
        path = self.path / "intersections.parquet"
        return _read_table(path, INTERSECTIONS) if path.exists() else None

    @property
    def T_body_lidar(self) -> F64:
        """(4, 4) of the flight's calibration."""
        return np.array(self.manifest["calibration"]["T_body_lidar"], dtype=np.float64)

    @property
    def keyframe_poses(self) -> F64:
        """(k, 4, 4) smoothed `T_map_lidar` of the keyframes."""
        return poses_of(self.keyframes)


def write_run_folder(
    folder: Path,
    *,
    smoothed: Trajectory,
    online: Trajectory,
    reference: Trajectory | None,
    sweeps: pl.DataFrame,
    keyframes: pl.DataFrame,
    points: pl.DataFrame,
    fixes: pl.DataFrame,
    timing: Mapping[str, Any],
    manifest: Mapping[str, Any],
    intersections: pl.DataFrame | None = None,
) -> None:
    """Write a run into an existing empty folder (the temporary of `output.new_folder`).

    NaN in a table becomes null; `schema` is added to the manifest.

    Raises:
        ValueError: columns, types, keys or stamps do not fit the contract.
    """
    tables = {
        "sweeps": checked(sweeps, SWEEPS, "sweeps"),
        "keyframes": checked(keyframes, KEYFRAMES, "keyframes"),
        "points": checked(points, POINTS, "points"),
        "fixes": checked(fixes, FIXES, "fixes"),
    }
    if intersections is not None:
        tables["intersections"] = checked(intersections, INTERSECTIONS, "intersections")
    _check_keys(manifest, MANIFEST_KEYS, "manifest")
    _check_keys(timing, TIMING_KEYS, "timing")
    _check_together(smoothed, online, tables)
    texts = {
        "manifest.json": _to_json({**manifest, "schema": SCHEMA}),
        "timing.json": _to_json(timing),
    }
    write_tum(folder / "trajectory.tum", smoothed)
    write_tum(folder / "trajectory_online.tum", online)
    if reference is not None:
        write_tum(folder / "reference.tum", reference)
    for name, table in tables.items():
        table.write_parquet(folder / f"{name}.parquet", compression="zstd")
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def _check_together(smoothed: Trajectory, online: Trajectory, tables: Mapping[str, pl.DataFrame]) -> None:
    stamps = tables["sweeps"]["stamp_ns"].to_numpy()
    if len(smoothed) == 0 or len(online) == 0:
        raise ValueError("a run has at least one pose")
    if bool((np.diff(stamps) <= 0).any()):
        raise ValueError("sweeps: stamp_ns must increase strictly")
    for name, trajectory in (("smoothed", smoothed), ("online", online)):
        if not bool(np.isin(trajectory.stamps_ns, stamps).all()):
            raise ValueError(f"{name}: every pose needs a row in sweeps with its stamp_ns")
    index = tables["keyframes"]["index"].to_numpy()
    if bool((np.diff(index) <= 0).any()):
        raise ValueError("keyframes: index must increase strictly")
    for name in ("points", "fixes"):
        if not bool(np.isin(tables[name]["keyframe"].to_numpy(), index).all()):
            raise ValueError(f"{name}: a keyframe that is not in keyframes")


def _check_keys(mapping: Mapping[str, Any], keys: frozenset[str], name: str) -> None:
    missing = sorted(keys - set(mapping))
    if missing:
        raise ValueError(f"{name}: missing keys {missing}")


def _to_json(mapping: Mapping[str, Any]) -> str:
    return json.dumps(mapping, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def _present(path: Path) -> Path:
    if not path.is_file():
        raise FormatError(path, "is missing", expected="a complete run folder", todo="localize again")
    return path


T = TypeVar("T")


def _parsed(path: Path, parse: Callable[[Path], T]) -> T:
    try:
        return parse(_present(path))
    except (OSError, ValueError, pl.exceptions.PolarsError) as error:
        raise FormatError(
            path, f"cannot be read ({error})", expected="a complete run folder", todo="localize again"
        ) from error


def _read_json(path: Path, keys: frozenset[str]) -> dict[str, Any]:
    value = _parsed(path, lambda p: json.loads(p.read_text(encoding="utf-8")))
    if not isinstance(value, dict):
        raise FormatError(path, f"holds a {type(value).__name__}", expected="a JSON object", todo="localize again")
    mapping = cast("dict[str, Any]", value)
    missing = sorted(keys - set(mapping))
    if missing:
        raise FormatError(path, f"lacks {', '.join(missing)}", expected="a run of this version", todo="localize again")
    return mapping


def _read_table(path: Path, schema: pl.Schema) -> pl.DataFrame:
    table = _parsed(path, pl.read_parquet)
    if table.schema != schema:
        wrong = sorted(set(schema.items()) ^ set(table.schema.items()), key=str)
        raise FormatError(
            path, f"other columns ({', '.join(f'{c} {t}' for c, t in wrong)})", expected="a run of this version"
        )
    return table
