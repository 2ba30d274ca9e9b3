"""A map as a Rerun recording: floor, walls and roof, roadways, flights, loop closures, targets."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mineloc.config import ViewConfig
from mineloc.data import F64, MapCloud, SurfaceKind
from mineloc.output import new_file
from mineloc.stages.map_folder import MapFolder
from mineloc.stages.run_tables import poses_of
from mineloc.view import placed
from mineloc.view.about import about_map
from mineloc.view.layout import map_layout
from mineloc.view.recorder import GREEN, ORANGE, SKY, VERMILION, WHITE, YELLOW, Rgb, RunRecorder

_KINDS: Mapping[SurfaceKind, tuple[str, Rgb]] = {
    SurfaceKind.FLOOR: ("floor", (150, 110, 60)),
    SurfaceKind.WALL: ("walls", (130, 150, 170)),
    SurfaceKind.ROOF: ("roof", (70, 80, 110)),
    SurfaceKind.OTHER: ("other", VERMILION),
}


def record_map(folder: Path, out: Path, *, config: ViewConfig, overwrite: bool = False) -> Path:
    """Write the recording of a map folder.

    Args:
        folder: of `reconstruct`.
        out: `.rrd` to write.
        config: `map_points` limits the points shown.
        overwrite: replace `out`.

    Raises:
        FormatError: not a map folder, or damaged.
        OutputError: `out` exists or cannot be written.
    """
    survey = MapFolder.open(folder)
    cloud = survey.cloud()
    shown = cloud.keep(np.arange(0, len(cloud), max(1, -(-len(cloud) // config.map_points))))
    positions = np.concatenate([trajectory.positions_m for trajectory in survey.trajectories.values()])
    origin = placed.local_origin(positions)
    low, high = placed.corners(positions - origin)
    name = ", ".join(survey.trajectories)
    with (
        new_file(out, overwrite=overwrite) as temp,
        RunRecorder(
            temp, recording_id=_identity(survey.manifest), name=name, origin_m=origin, layout=map_layout(low, high)
        ) as recorder,
    ):
        recorder.document("about", about_map(survey, origin))
        _record_surface(recorder, shown)
        _record_roadways(recorder, survey)
        for trajectory, color in zip(survey.trajectories.values(), _flight_colors(), strict=False):
            recorder.lines("map/flights", [trajectory.positions_m], colors=color, width_px=2.0)
        _record_loops(recorder, survey)
    return out


def _record_surface(recorder: RunRecorder, cloud: MapCloud) -> None:
    """Every kind an entity of its own, so that the roof can be taken off; brighter where it was seen more often."""
    for kind, (name, color) in _KINDS.items():
        part = cloud.of_kind(kind)
        if len(part):
            light = np.clip(0.55 + 0.15 * np.log2(np.maximum(part.visits, 1)), 0.55, 1.3)[:, None]
            colors = np.clip(light * np.array(color), 0, 255).astype(np.uint8)
            radius_m = part.voxel_m / 2
            recorder.cloud(f"map/{name}", part.points_map, colors=colors, radius_m=radius_m)


def _record_roadways(recorder: RunRecorder, survey: MapFolder) -> None:
    roadways = survey.roadways
    if roadways.roadways:
        recorder.lines("map/roadways", [road.line_m for road in roadways.roadways], colors=YELLOW, width_px=3.0)
        degree = np.array(roadways.degrees)
        for name, rows, color in (("intersections", degree >= 3, ORANGE), ("ends", degree == 1, WHITE)):
            if rows.any():
                recorder.cloud(f"map/{name}", roadways.nodes_m[rows], colors=color, radius_m=0.6)


def _record_loops(recorder: RunRecorder, survey: MapFolder) -> None:
    """Accepted closures as lines between their keyframes, of one flight or of two."""
    positions = poses_of(survey.keyframes)[:, :3, 3]
    rows = {key: row for row, key in enumerate(survey.keyframes.select("flight", "index").iter_rows())}
    accepted = survey.fixes.filter(survey.fixes["trusted"])
    strips: list[F64] = []
    for flight, keyframe, target in accepted.select("flight", "keyframe", "target").iter_rows():
        # the target is counted through all flights, as the table is
        strips.append(positions[[int(target.removeprefix("keyframe ")), rows[flight, keyframe]]])
    if strips:
        recorder.lines("map/loops", strips, colors=GREEN, width_px=2.0)


def _flight_colors() -> list[Rgb]:
    return [SKY, WHITE, ORANGE, GREEN] * 8


def _identity(manifest: Mapping[str, Any]) -> str:
    return "map-" + hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()[:16]
