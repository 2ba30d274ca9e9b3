"""Errors at surveyed tags, one a passage: paper A's second experiment (section 4.2; METHOD 1.11 and 8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mineloc.data import F64, I64
from mineloc.data.checks import need

GAP_S = 5.0
"""A tag out of sight for longer is passed anew when it is seen again."""


@dataclass(frozen=True, slots=True)
class Passage:
    """One pass by one tag.

    Attributes:
        tag: its name.
        stamp_ns: of the first sighting.
        sightings: how many there were.
        dx_m, dy_m, dz_m: mean estimated position minus surveyed position.
        error_m: length of that.
    """

    tag: str
    stamp_ns: int
    sightings: int
    dx_m: float
    dy_m: float
    dz_m: float
    error_m: float


@dataclass(frozen=True, slots=True)
class TagPassages:
    """All passages of a flight in order of time.

    Attributes:
        passages: each with its error.
        fixed_by: the tag whose first passage fixes the frame and therefore has no error; empty: the frame was known.
        mean_m, max_m: of the errors, the fixing passage left out; None without another one.
    """

    passages: tuple[Passage, ...]
    fixed_by: str
    mean_m: float | None
    max_m: float | None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def tag_passages(
    names: Sequence[str],
    surveyed: F64,
    target: I64,
    stamps_ns: I64,
    estimated: F64,
    *,
    fixed_by: str = "",
    gap_s: float = GAP_S,
) -> TagPassages:
    """Group sightings of tags to passages and tell the error of each.

    Args:
        names: of the m tags.
        surveyed: (m, 3) positions, z up.
        target: (n,) which tag was seen.
        stamps_ns: (n,) when.
        estimated: (n, 3) where the estimate puts it: T_est(t) · T_lidar_camera · T_camera_tag.
        fixed_by: a tag whose first passage is laid on the survey (paper A: tag 0); its heading is left alone.
        gap_s: a tag out of sight for longer begins another passage.

    Raises:
        ValueError: lengths differ, or the fixing tag was not seen.
    """
    need(surveyed.shape == (len(names), 3), "surveyed must be (m, 3)")
    need(estimated.shape == (len(target), 3) == (len(stamps_ns), 3), "one time and position a sighting")
    groups: list[tuple[int, I64]] = []
    for k in range(len(names)):
        rows = np.flatnonzero(target == k)
        rows = rows[np.argsort(stamps_ns[rows], kind="stable")]
        breaks = np.flatnonzero(np.diff(stamps_ns[rows]) > gap_s * 1e9) + 1
        groups += [(k, one) for one in np.split(rows, breaks) if len(one)]
    groups.sort(key=lambda group: (int(stamps_ns[group[1][0]]), group[0]))
    off = np.array([estimated[rows].mean(axis=0) - surveyed[k] for k, rows in groups]).reshape(-1, 3)
    fixing = next((i for i, (k, _) in enumerate(groups) if names[k] == fixed_by), None)
    need(not fixed_by or fixing is not None, f"tag {fixed_by!r} was not seen")
    if fixing is not None:
        off = off - off[fixing]
    errors = np.linalg.norm(off, axis=1)
    counted = np.delete(errors, fixing) if fixing is not None else errors
    passages = tuple(
        Passage(
            tag=names[k],
            stamp_ns=int(stamps_ns[rows[0]]),
            sightings=len(rows),
            dx_m=float(d[0]),
            dy_m=float(d[1]),
            dz_m=float(d[2]),
            error_m=float(e),
        )
        for (k, rows), d, e in zip(groups, off, errors, strict=True)
    )
    mean, most = (float(counted.mean()), float(counted.max())) if len(counted) else (None, None)
    return TagPassages(passages, fixed_by, mean, most)
