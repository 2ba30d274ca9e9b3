"""A run as a Rerun recording."""

from __future__ import annotations

import hashlib
import json
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from mineloc.config import Config
from mineloc.data import F64
from mineloc.output import new_file
from mineloc.progress import Progress, quiet
from mineloc.stages.run_folder import RunFolder
from mineloc.view import placed
from mineloc.view.about import about_run
from mineloc.view.curves import ranges, run_curves
from mineloc.view.decisions import DEGENERATE, HELD, UNTRUSTED, run_decisions, run_states
from mineloc.view.evidence import recognised
from mineloc.view.layout import flight_layout
from mineloc.view.recognitions import read_known, record_recognitions
from mineloc.view.recorder import GREEN, ORANGE, SKY, VERMILION, WHITE, YELLOW, Rgb, RunRecorder
from mineloc.view.scene import Scene

_STATES: dict[str, Rgb] = {HELD: (0, 90, 65), DEGENERATE: ORANGE, UNTRUSTED: VERMILION}
_LEVELS = 16


def record_run(
    run: Path,
    out: Path,
    *,
    flight: Path | None = None,
    database: Path | None = None,
    config: Config,
    overwrite: bool = False,
    progress: Progress = quiet,
) -> Path:
    """Write the recording of a run folder.

    Args:
        run: folder of `localize`.
        out: `.rrd` to write.
        flight: the flight of the run: its sweeps are shown; without it the keyframes' points are.
        database: of intersections, that the run was localized with: what it recognised is shown beside what it knew.
        config: sections `view` and `evaluate`.
        overwrite: replace `out`.
        progress: told the sweeps that are done.

    Raises:
        FormatError: not a run folder, a flight of another time, or not the database of the run.
        IngestError: not a canonical flight, or damaged.
        OutputError: `out` exists or cannot be written.
    """
    scene = Scene.of(RunFolder.open(run), config.evaluate)
    places = [] if database is None else recognised(scene.run, read_known(database, scene.run))
    clouds = placed.keyframe_clouds(scene.run, scene.T_frame_map)
    origin = placed.local_origin(scene.smoothed.positions_m)
    mine = placed.mine_cloud(clouds, config.view, origin)
    curves = run_curves(scene)
    low, high = placed.corners(scene.smoothed.positions_m - origin)
    layout = flight_layout(
        low,
        high,
        first_ns=int(scene.smoothed.stamps_ns[0]),
        last_ns=int(scene.smoothed.stamps_ns[-1]),
        curves=ranges(curves),
        log=True,
        recognitions=bool(places),
    )
    with (
        new_file(out, overwrite=overwrite) as temp,
        RunRecorder(
            temp, recording_id=_identity(scene.run), name=_title(scene.run), origin_m=origin, layout=layout
        ) as r,
    ):
        r.document("about", about_run(scene, origin))
        record_mine(r, mine)
        _record_trajectories(r, scene)
        _record_graph(r, scene)
        for curve in curves:
            r.curve(curve.entity, curve.stamps_ns, curve.values, name=curve.name, color=curve.color)
        r.decisions("log", run_decisions(scene.run, scene.smoothed))
        if places:
            record_recognitions(r, places)
        r.states("states/registration", run_states(scene.run.sweeps), colors=_STATES)
        if flight is None or len(scene.lidar) < 2:
            shown = iter(placed.thinned(clouds, config.view))
        else:
            shown = placed.flight_clouds(flight, scene.lidar, config.view, progress=progress)
        r.sweeps("map/sweep", shown, color=YELLOW, radius_m=0.06)
    return out


def record_mine(recorder: RunRecorder, mine: F64) -> None:
    """The points of the mine, grey by height: colour is kept for what is said about the flight."""
    if len(mine):
        low, high = np.percentile(mine[:, 2], [2, 98])
        height = np.clip((mine[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)
        grey = np.round(70 + 110 * height).astype(np.uint8)
        recorder.cloud("map/mine", mine, colors=np.stack([grey, grey, grey], axis=1), radius_m=0.03)


def _identity(run: RunFolder) -> str:
    canonical = json.dumps(run.manifest, sort_keys=True).encode()
    return f"{run.manifest['flight']['sha256'][:12]}-{hashlib.sha256(canonical).hexdigest()[:12]}"


def _title(run: RunFolder) -> str:
    return f"{run.manifest['flight']['name']}, {run.manifest['method']}"


def _record_trajectories(recorder: RunRecorder, scene: Scene) -> None:
    reference, smoothed, compared = scene.run.reference, scene.smoothed, scene.comparisons.get("smoothed")
    recorder.moving("map/body", smoothed.stamps_ns, smoothed.poses, axis_m=1.5)
    if reference is not None and len(reference) > 1 and compared is not None:
        recorder.lines("map/reference", [reference.positions_m], colors=WHITE)
    if len(scene.online) > 1:
        recorder.lines("map/online", [scene.online.positions_m], colors=ORANGE)
    if len(smoothed) < 2:
        return
    if compared is None:
        recorder.lines("map/smoothed", [smoothed.positions_m], colors=SKY, width_px=4.0)
        return
    error, start = compared.shown, smoothed.stamps_ns[0]
    value = np.interp(smoothed.stamps_ns - start, error.stamps_ns - start, error.error_m)
    strips, colors = _colored_strips(smoothed.positions_m, value)
    recorder.lines("map/smoothed", strips, colors=colors, width_px=4.0)


def _colored_strips(positions: F64, value: F64) -> tuple[list[F64], list[Rgb]]:
    """The line cut where its colour changes; the dark end of viridis would vanish on the dark background."""
    top = max(float(value.max()), 1e-3)
    level = np.minimum((value / top * _LEVELS).astype(int), _LEVELS - 1)
    samples = mpl.colormaps["viridis"](np.linspace(0.25, 1.0, _LEVELS))[:, :3]
    palette: NDArray[np.uint8] = np.round(255 * samples).astype(np.uint8)
    cuts = np.concatenate([[0], np.flatnonzero(np.diff(level)) + 1, [len(level)]])
    strips: list[F64] = []
    colors: list[Rgb] = []
    for start, end in pairwise(cuts):
        strip = positions[start : end + 1]
        if len(strip) > 1:
            red, green, blue = palette[level[start]].tolist()
            strips.append(strip)
            colors.append((red, green, blue))
    return strips, colors


def _record_graph(recorder: RunRecorder, scene: Scene) -> None:
    """Keyframes, the edges between them (vermilion where registration was degenerate), accepted fixes."""
    position = (scene.T_frame_map @ scene.run.keyframe_poses)[:, :3, 3]
    if not len(position):
        return
    recorder.cloud("map/graph/keyframes", position, colors=GREEN, radius_m=0.12)
    if len(position) > 1:
        sweeps = scene.run.sweeps
        weak_ns = sweeps.filter(sweeps["is_degenerate"])["stamp_ns"].to_numpy()
        weak = np.diff(np.searchsorted(weak_ns, scene.run.keyframes["stamp_ns"].to_numpy())) > 0
        edges = list(np.stack([position[:-1], position[1:]], axis=1))
        recorder.lines("map/graph/edges", edges, colors=[VERMILION if w else GREEN for w in weak], width_px=1.0)
    accepted = scene.run.fixes.filter(scene.run.fixes["trusted"])
    if len(accepted):
        fixes = accepted.select("x_m", "y_m", "z_m").to_numpy() @ scene.T_frame_map[:3, :3].T
        recorder.cloud("map/graph/fixes", fixes + scene.T_frame_map[:3, 3], colors=ORANGE, radius_m=0.25)
