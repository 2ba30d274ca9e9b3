"""A database of intersections as a Rerun recording: their clouds, names, branches and contours; how alike they are."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from mineloc.config import ViewConfig
from mineloc.data import F64, Intersection, IntersectionDatabase, Sight
from mineloc.io.intersection_database import read_database
from mineloc.output import new_file
from mineloc.view import placed
from mineloc.view.about import about_database
from mineloc.view.layout import database_layout
from mineloc.view.recorder import GREEN, ORANGE, SKY, YELLOW, RunRecorder

_BRANCH_M = 3.0
_NAME_ABOVE_M = 2.5


def record_database(path: Path, out: Path, *, config: ViewConfig, overwrite: bool = False) -> Path:
    """Write the recording of a database file.

    Args:
        path: of `database`.
        out: `.rrd` to write.
        config: `map_points` limits the points shown.
        overwrite: replace `out`.

    Raises:
        FormatError: not a database of intersections, or damaged.
        OutputError: `out` exists or cannot be written.
    """
    known = read_database(path)
    points = np.array([one.point_map for one in known.intersections]).reshape(-1, 3)
    origin = placed.local_origin(points) if len(points) else np.zeros(3)
    low, high = placed.corners(points - origin) if len(points) else (np.zeros(3), np.ones(3))
    identity = "intersections-" + hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    with (
        new_file(out, overwrite=overwrite) as temp,
        RunRecorder(
            temp, recording_id=identity, name=path.stem, origin_m=origin, layout=database_layout(low, high)
        ) as recorder,
    ):
        recorder.document("about", about_database(known, origin))
        if len(known):
            _record_places(recorder, known, config.map_points)
            recorder.shares("similarity/contours", known.contour_similarity)
            recorder.shares("similarity/matrices", known.matrix_similarity)
    return out


def _record_places(recorder: RunRecorder, known: IntersectionDatabase, most: int) -> None:
    """Each kind of thing an entity of its own, so that it can be taken off."""
    clouds = [one.points_m.astype(np.float64) + one.point_map for one in known.intersections]
    cloud = np.concatenate(clouds)
    if len(cloud):
        shown = cloud[:: max(1, -(-len(cloud) // most))]
        recorder.cloud("map/clouds", shown, colors=(130, 150, 170), radius_m=0.05)
    recorder.names(
        "map/names",
        np.array([one.point_map for one in known.intersections]) + np.array([0.0, 0.0, _NAME_ABOVE_M]),
        [f"{one.id}: {one.name} ({one.kind})" for one in known.intersections],
        color=ORANGE,
    )
    for entity, strips, color in (
        ("branches", [line for one in known.intersections for line in _branches(one)], YELLOW),
        ("contours", [line for one in known.intersections for line in _contour(one)], GREEN),
        ("neighbours", _neighbours(known), SKY),
    ):
        if strips:
            recorder.lines(f"map/{entity}", strips, colors=color, width_px=3.0)


def _branches(one: Intersection) -> list[F64]:
    return [
        one.point_map + _BRANCH_M * np.array([[0.0, 0.0, 0.0], [np.cos(b), np.sin(b), 0.0]])
        for b in one.contour.branches_rad
    ]


def _contour(one: Intersection) -> list[F64]:
    """The walls of the PWCV around the point, a line a run of bins: gaps are branches or unknown."""
    n = len(one.contour.distance)
    bearing = 2 * np.pi * np.arange(n) / n
    reach_m = one.contour.radius_m * one.contour.distance.astype(np.float64)
    ring = one.point_map + reach_m[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(n)])
    bins = np.flatnonzero(one.contour.sight == Sight.WALL)
    runs = np.split(bins, np.flatnonzero(np.diff(bins) > 1) + 1)
    return [ring[run] for run in runs if len(run) > 1]


def _neighbours(known: IntersectionDatabase) -> list[F64]:
    points = {one.id: one.point_map for one in known.intersections}
    pairs = {
        (min(one.id, other), max(one.id, other))
        for one in known.intersections
        for other, _ in one.neighbours
        if other in points
    }
    return [np.array([points[a], points[b]]) for a, b in sorted(pairs)]
