"""What `mineloc view` does: make a recording of whatever is named, then keep it, picture it, or open a window."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from mineloc.config import Config
from mineloc.errors import FormatError
from mineloc.io.intersection_database import is_database
from mineloc.progress import Progress, quiet
from mineloc.stages.map_folder import MapFolder
from mineloc.view.flight import record_flight
from mineloc.view.intersections import record_database
from mineloc.view.recorder import TIMELINE
from mineloc.view.run import record_run
from mineloc.view.survey_map import record_map
from mineloc.view.viewer import open_viewer, screenshot


def show(
    what: Path,
    *,
    flight: Path | None = None,
    database: Path | None = None,
    save: Path | None = None,
    picture: Path | None = None,
    overwrite: bool = False,
    config: Config,
    progress: Progress = quiet,
) -> list[Path]:
    """Record and show; a window opens only when neither `save` nor `picture` is wanted.

    Args:
        what: a run folder, a map folder, a canonical flight or a database of intersections (.mcap), or a recording
            (.rrd).
        flight: the flight of a run, for its sweeps.
        database: of intersections, of a run, for what it recognised.
        save: where to keep the recording.
        picture: where to write a picture of it, half way through the flight.
        overwrite: replace `save` and `picture`.
        config: sections `view` and `evaluate`.
        progress: told the sweeps that are done.

    Returns:
        The files that were written.

    Raises:
        FormatError: none of these kinds.
        MinelocError: what recording and viewer say.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = save or Path(folder) / "view.rrd"
        beside = {"flight": flight, "database": database}
        recording = _recording(what, out, beside, overwrite=overwrite, config=config, progress=progress)
        if picture is not None:
            screenshot(recording, picture, at_ns=_middle_ns(recording), overwrite=overwrite)
        if save is None and picture is None:
            open_viewer(recording)
    return [path for path in (save, picture) if path is not None]


def _recording(
    what: Path, out: Path, beside: Mapping[str, Path | None], *, overwrite: bool, config: Config, progress: Progress
) -> Path:
    if what.is_dir() and not MapFolder.is_map(what):
        return record_run(what, out, **beside, config=config, overwrite=overwrite, progress=progress)
    if not what.exists():
        raise FormatError(what, "no such file or folder", todo="check the path")
    for name, path in beside.items():
        if path is not None:
            raise FormatError(
                what, "is no run folder", expected=f"a run folder with --{name}", todo=f"leave out --{name}"
            )
    if what.is_dir():
        return record_map(what, out, config=config.view, overwrite=overwrite)
    if what.suffix == ".mcap" and is_database(what):
        return record_database(what, out, config=config.view, overwrite=overwrite)
    if what.suffix == ".mcap":
        return record_flight(what, out, config=config, overwrite=overwrite, progress=progress)
    if what.suffix == ".rrd":
        return what
    raise FormatError(what, "cannot be shown", expected="a run or map folder, a flight (.mcap) or a recording (.rrd)")


def _middle_ns(recording: Path) -> int | None:
    """Half way between the first and the last time of a recording; None when it is not one of ours."""
    times: list[int] = []
    for chunk in RrdReader(recording).stream():
        if TIMELINE in chunk.timeline_names and chunk.num_rows:
            stamps = np.asarray(chunk.to_record_batch().column(TIMELINE)).astype(np.int64)
            times += [int(stamps.min()), int(stamps.max())]
    return (min(times) + max(times)) // 2 if times else None
