"""The recognised intersections of a run in its recording: what was stored beside what was seen, and the nine steps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mineloc.data import IntersectionDatabase
from mineloc.errors import FormatError
from mineloc.io.intersection_database import read_database
from mineloc.stages.run_folder import RunFolder
from mineloc.view.evidence import Evidence
from mineloc.view.recognition_steps import line_of, page_of
from mineloc.view.recorder import GREEN, YELLOW, RunRecorder

_GREY = (130, 150, 170)


def read_known(path: Path, run: RunFolder) -> IntersectionDatabase:
    """The database that a run was localized with, in the frame of its map.

    Raises:
        FormatError: no database of intersections, or damaged; the run had none or that of another map.
    """
    known, of_run = read_database(path), run.manifest.get("map")
    if not of_run:
        raise FormatError(path, "was not used by the run", expected="a run in a map", todo="leave out --database")
    if of_run["manifest_sha256"] not in (known.map_sha256, *known.lineage.maps):
        raise FormatError(path, "is of another map than the run", todo="give the database that it was localized with")
    try:
        return known.in_frame_at(np.array(of_run["grid_origin_m"], dtype=np.float64))
    except ValueError as error:
        raise FormatError(path, f"does not fit the run: {error}") from None


def record_recognitions(recorder: RunRecorder, found: Sequence[Evidence]) -> None:
    """One entry a passage, shown from its fix until the next one's: scrubbing in time goes from one to the next."""
    recorder.circles("contours/rings", (2.0, 4.0, 6.0, 8.0))
    count: dict[str, int] = {}
    for k, one in enumerate(found):
        name = one.why.name
        count[name] = count.get(name, 0) + 1
        where, part = (one.stamp_ns, found[k + 1].stamp_ns if k + 1 < len(found) else None), str(count[name])
        entity = recorder.path("recognised", name, part)
        recorder.cloud_during(f"{entity}/stored", where, one.stored_m, color=_GREY, radius_m=0.05)
        recorder.cloud_during(f"{entity}/seen", where, one.seen_m, color=YELLOW, radius_m=0.06)
        contour = recorder.path("contours", name, part)
        recorder.plan_during(f"{contour}/stored", where, one.stored, color=GREEN)
        recorder.plan_during(f"{contour}/seen", where, one.seen, color=YELLOW)
        recorder.documents(f"{entity}/steps", [(one.stamp_ns, page_of(one.why))])
    recorder.documents("recognitions/steps", [(one.stamp_ns, page_of(one.why)) for one in found])
    recorder.decisions("recognitions/list", [(one.stamp_ns, "INFO", line_of(one.why)) for one in found])
