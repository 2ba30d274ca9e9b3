"""Rings: checked where a cloud has them, recovered where it has not; point times from the angle when asked for.

What is done unasked is conservative. A ring field is kept, counted by rising elevation; a field that is no beam number
(Livox lines) is dropped. A missing ring is recovered from the rows of an organised cloud or from the elevations, only
when the beams stand clearly apart. Times are never invented unless the sequence file says `times = "azimuth"`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U16 = NDArray[np.uint16]

_MAX_BEAMS = 256
_USUAL_BEAMS = (4, 8, 16, 32, 40, 64, 80, 128, _MAX_BEAMS)
# Neighbouring medians may stand this share of the spacing in the wrong order by noise.
_SLACK = 0.05
# Nearer points leave the fan of beams: their lasers sit up to 1.5 cm off the centre.
_FAR_ENOUGH_M = 2.0
_FEWEST_POINTS = 500
# A gap between beams must be this many times wider than the widest gap within one.
_CLEAR_RATIO = 3.0
_NARROWEST_GAP_RAD = np.deg2rad(0.1)


@dataclass(frozen=True, slots=True, eq=False)
class RingRule:
    """How a topic's points get their ring.

    Attributes:
        source: "field", "rows" or "columns" of an organised cloud (all three through `table`), "elevation" (the
            nearest of `elevations_rad`), or "none".
        table: new ring by old one; None leaves it as it is.
        elevations_rad: rising elevations of the beams.
        detail: one line for people.
    """

    source: str
    table: U16 | None = None
    elevations_rad: F64 | None = None
    detail: str = ""


def elevations_rad(points: F32) -> F64:
    """(n,) elevation above the sensor's horizontal plane."""
    p = points.astype(np.float64, copy=False)
    return np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))


def rule_for_numbers(numbers: NDArray[np.int64], points: F32, *, source: str, count: int | None = None) -> RingRule:
    """Whether numbers are beams, and how they must be renamed to rise with the elevation.

    Args:
        numbers: (n,) ring field, row or column of each point.
        points: (n, 3) lidar frame, metres.
        source: for the rule.
        count: number of beams where it is known.

    Returns:
        a rule with source "none" when a number does not stand for one elevation.
    """
    if len(numbers) and not 0 <= int(numbers.min()) <= int(numbers.max()) < _MAX_BEAMS:
        return RingRule("none", detail=f"ring numbers from {numbers.min()} to {numbers.max()} are no beams")
    far = np.linalg.norm(points, axis=1) > _FAR_ENOUGH_M
    if np.count_nonzero(far) >= _FEWEST_POINTS:
        numbers, points = numbers[far], points[far]
    used, medians, spreads = _per_ring(numbers, elevations_rad(points))
    if len(used) < 2:
        return RingRule(source)
    spacing = float(np.ptp(medians)) / (len(used) - 1)
    if float(np.median(spreads)) > max(spacing, _NARROWEST_GAP_RAD):
        return RingRule("none", detail="ring numbers do not stand for elevations")
    if (np.diff(medians) > -_SLACK * spacing).all():
        return RingRule(source)
    return _renamed(used, medians, spacing, source, count)


def _renamed(used: I64, medians: F64, spacing: float, source: str, count: int | None) -> RingRule:
    size = max(int(used[-1]) + 1, count or 0)
    if count is None:
        size = next(n for n in _USUAL_BEAMS if n >= size)
    table = np.arange(size, dtype=np.uint16)
    if (np.diff(medians) < _SLACK * spacing).all():
        return RingRule(source, table[::-1].copy(), detail="rings counted from the top were turned round")
    unused = np.setdiff1d(table, used)
    by_elevation = np.concatenate([used[np.argsort(medians, kind="stable")], unused])
    table[by_elevation] = np.arange(size, dtype=np.uint16)
    return RingRule(source, table, detail="rings numbered in firing order were sorted by elevation")


def _per_ring(numbers: NDArray[np.int64], elevation: F64) -> tuple[I64, F64, F64]:
    """Ring numbers that occur, and the median and the interquartile range of the elevation in each."""
    order = np.lexsort((elevation, numbers))
    if not len(numbers):
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    used, start, count = np.unique(numbers[order], return_index=True, return_counts=True)
    ranked = elevation[order]
    quarter = [ranked[start + (count - 1) * k // 4] for k in (1, 2, 3)]
    return used.astype(np.int64), quarter[1], quarter[2] - quarter[0]


def find_beams(points: F32, *, count: int | None = None) -> F64 | None:
    """Elevations of the beams, from the gaps between the elevations of points; no formula is assumed.

    Args:
        points: (n, 3) lidar frame, metres; of several sweeps.
        count: number of beams where it is known.

    Returns:
        (k,) rising elevations in radians, None when the beams do not stand clearly apart.
    """
    far = np.linalg.norm(points, axis=1) > _FAR_ENOUGH_M
    if np.count_nonzero(far) < _FEWEST_POINTS:
        return None
    elevation = np.sort(elevations_rad(points[far]))
    gaps = np.diff(elevation)
    ranked = np.sort(gaps)[::-1][:_MAX_BEAMS]
    if count is None:
        # between the narrowest gap between beams and the widest within one
        wide = ranked[ranked > _NARROWEST_GAP_RAD]
        if len(wide) < 2 or len(wide) == len(ranked):
            return None
        beams = int(np.argmax(ranked[: len(wide)] / np.maximum(ranked[1 : len(wide) + 1], 1e-9))) + 2
    else:
        beams = count
    if beams < 2 or beams > len(ranked) or ranked[beams - 2] < _CLEAR_RATIO * max(ranked[beams - 1], 1e-9):
        return None
    cuts = np.sort(np.argsort(gaps)[::-1][: beams - 1])
    edges = np.concatenate([[0], cuts + 1, [len(elevation)]])
    if (np.diff(edges) < len(elevation) / beams / 50).any():
        return None
    return np.array([np.median(elevation[a:b]) for a, b in pairwise(edges)])


def rule_for_missing(
    points: Sequence[F32], shapes: Sequence[tuple[int, int]], cells: Sequence[I64], *, count: int | None
) -> RingRule:
    """How to give rings to clouds without a ring field.

    Args:
        points: (n, 3) of each of the first sweeps, returns only.
        shapes: height and width of each message.
        cells: (n,) index of each return in its message.
        count: number of beams where it is known.
    """
    together = np.concatenate(points)
    if not len(together):
        return RingRule("none", detail="no points to find rings from")
    if len(set(shapes)) == 1 and min(shapes[0]) > 1:
        height, width = shapes[0]
        cell = np.concatenate(cells)
        rows = height <= width
        numbers, size = (cell // width, height) if rows else (cell % width, width)
        if size <= _MAX_BEAMS:
            rule = rule_for_numbers(numbers, together, source="rows" if rows else "columns", count=size)
            if rule.source != "none":
                return rule
    beams = find_beams(together, count=count)
    if beams is None:
        return RingRule("none", detail="no ring field, and the beams do not stand clearly apart")
    return RingRule("elevation", None, beams, f"{len(beams)} rings recovered from the elevations")


def apply_rule(
    rule: RingRule, points: F32, field: NDArray[np.generic] | None, cells: I64 | None, shape: tuple[int, int]
) -> U16 | None:
    """The rings of one sweep's points, None without a rule.

    Args:
        points: (n, 3) returns.
        field: (n,) ring field as stored.
        cells: (n,) index of each return in its message, None when none was dropped.
        shape: height and width of the message.
    """
    if rule.source == "none":
        return None
    if rule.source == "elevation":
        beams = rule.elevations_rad
        assert beams is not None
        return np.searchsorted((beams[1:] + beams[:-1]) / 2, elevations_rad(points)).astype(np.uint16)
    if rule.source == "field":
        if field is None:
            return None
        numbers = field.astype(np.uint16, copy=False)
    else:
        index = np.arange(len(points)) if cells is None else cells
        numbers = (index // shape[1] if rule.source == "rows" else index % shape[1]).astype(np.uint16)
    if rule.table is None:
        return numbers
    return rule.table[np.minimum(numbers, len(rule.table) - 1)]


def azimuth_fraction(points: F32) -> F64 | None:
    """The share of a revolution at which each point was measured, from its angle.

    The sense of rotation is that of most steps from point to point. Neighbouring beams may look up to a few degrees
    ahead or behind, so single steps may go back; the revolution as a whole may not.

    Args:
        points: (n, 3) lidar frame, in the order of the message.

    Returns:
        (n,) in [0, 1), None when the points are not in firing order or not of one revolution.
    """
    if len(points) < _FEWEST_POINTS:
        return None
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    step = np.diff(azimuth)
    step -= 2 * np.pi * np.rint(step / (2 * np.pi))
    total = float(step.sum())
    if not np.deg2rad(180) < abs(total) < np.deg2rad(400):
        return None
    turned = np.concatenate([[0.0], np.cumsum(step)]) * np.sign(total)
    behind = np.maximum.accumulate(turned) - turned
    if float(np.quantile(behind, 0.99)) > np.deg2rad(20):
        return None
    turned -= float(np.quantile(turned[: len(turned) // 50], 0.05))
    return np.clip(turned / (2 * np.pi), 0.0, np.nextafter(1.0, 0.0))
