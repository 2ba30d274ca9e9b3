"""A map folder: what one reconstruction leaves on the disk, and all that later stages and viewers read.

The table in DESIGN.md ("A map folder") is the contract. The map frame is metres, z up; with control points it is the
mine grid less `grid_origin_m` of the manifest, and the files for others (LAZ, PCD, DXF, CSV) are in the grid itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from mineloc.data import F64, MapCloud, Trajectory
from mineloc.errors import FormatError
from mineloc.io.clouds import (
    read_ply,
    read_roadways,
    write_dxf,
    write_intersections_csv,
    write_laz,
    write_pcd,
    write_ply,
    write_roadways,
)
from mineloc.io.trajectories import read_tum, write_tum
from mineloc.mapping.survey_map import SurveyMap
from mineloc.roadways.mapped import MappedRoadways
from mineloc.stages.map_tables import MAP_FIXES, MAP_KEYFRAMES
from mineloc.stages.run_tables import checked

SCHEMA = "mineloc.map/1"


@dataclass(frozen=True, slots=True, eq=False)
class MapFolder:
    """One opened map. Cheap but for `cloud`, which is read when asked for.

    Attributes:
        path: the folder.
        trajectories: `T_map_body` of each flight, by name.
        keyframes, fixes: tables `MAP_KEYFRAMES`, `MAP_FIXES`.
        roadways: centre-lines with widths and heights, map frame.
        manifest: origin, flights, loops, control, configuration.
    """

    path: Path
    trajectories: Mapping[str, Trajectory]
    keyframes: pl.DataFrame
    fixes: pl.DataFrame
    roadways: MappedRoadways
    manifest: Mapping[str, Any]

    @staticmethod
    def is_map(path: Path) -> bool:
        """Whether a folder says of itself that it is a map."""
        try:
            manifest = json.loads((path / "manifest.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        return isinstance(manifest, dict) and str(manifest.get("schema", "")).startswith("mineloc.map/")

    @staticmethod
    def open(path: Path) -> MapFolder:
        """Read a map folder.

        Raises:
            FormatError: not a map folder, a file is missing or damaged.
        """
        manifest = _manifest(path)
        names = [flight["name"] for flight in manifest["flights"]]
        return MapFolder(
            path=path,
            trajectories={name: read_tum(path / "trajectories" / f"{name}.tum") for name in names},
            keyframes=_table(path / "keyframes.parquet", MAP_KEYFRAMES),
            fixes=_table(path / "fixes.parquet", MAP_FIXES),
            roadways=read_roadways(path / "roadways.json"),
            manifest=manifest,
        )

    @property
    def grid_origin_m(self) -> F64:
        """(3,) of the map frame in the mine grid; zero where there is no grid."""
        return np.array(self.manifest["frame"]["grid_origin_m"], dtype=np.float64)

    def cloud(self) -> MapCloud:
        """The points of the map.

        Raises:
            FormatError: missing or damaged.
        """
        return read_ply(self.path / "map.ply")


def write_map_folder(
    folder: Path,
    *,
    product: SurveyMap,
    grid_origin_m: F64,
    trajectories: Mapping[str, Trajectory],
    keyframes: pl.DataFrame,
    fixes: pl.DataFrame,
    coverage: pl.DataFrame,
    flown: date | None,
    timing: Mapping[str, Any],
    manifest: Mapping[str, Any],
) -> None:
    """Write a map into an existing empty folder (the temporary of `output.new_folder`).

    Args:
        product: the map, in the map frame.
        grid_origin_m: (3,) of the map frame in the mine grid.
        flown: day of the first flight, for files that must have one.
    """
    (folder / "trajectories").mkdir()
    for k, (name, trajectory) in enumerate(trajectories.items()):
        write_tum(folder / "trajectories" / f"{name}.tum", trajectory)
        if k == 0:
            write_tum(folder / "trajectory.tum", trajectory)
    checked(keyframes, MAP_KEYFRAMES, "keyframes").write_parquet(folder / "keyframes.parquet", compression="zstd")
    checked(fixes, MAP_FIXES, "fixes").write_parquet(folder / "fixes.parquet", compression="zstd")
    coverage.write_parquet(folder / "coverage.parquet", compression="zstd")
    write_ply(folder / "map.ply", product.cloud)
    write_roadways(folder / "roadways.json", product.roadways)
    # what leaves the house is in the mine grid where there is one
    grid: Any = {"origin_m": grid_origin_m, "frame": "grid" if manifest["frame"]["is_grid"] else "map"}
    write_pcd(folder / "map.pcd", product.cloud, **grid)
    write_laz(folder / "map.laz", product.cloud, **grid, flown=flown)
    write_dxf(folder / "roadways.dxf", product.roadways, **grid)
    write_intersections_csv(folder / "intersections.csv", product.roadways, **grid)
    for name, content in (("manifest.json", {**manifest, "schema": SCHEMA}), ("timing.json", timing)):
        text = json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"
        (folder / name).write_text(text, encoding="utf-8")


def _manifest(path: Path) -> dict[str, Any]:
    if not MapFolder.is_map(path):
        raise FormatError(path, "is not a map folder", expected="a folder of reconstruct", todo="check the path")
    manifest: dict[str, Any] = json.loads((path / "manifest.json").read_text(encoding="utf-8"))
    if manifest["schema"] != SCHEMA:
        raise FormatError(
            path, f"schema {manifest['schema']!r}", expected=repr(SCHEMA), todo="reconstruct again with this version"
        )
    return manifest


def _table(path: Path, schema: pl.Schema) -> pl.DataFrame:
    try:
        table = pl.read_parquet(path)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise FormatError(
            path, f"cannot be read ({error})", expected="a complete map folder", todo="reconstruct again"
        ) from error
    if table.schema != schema:
        raise FormatError(path, "other columns", expected="a map of this version", todo="reconstruct again")
    return table
