"""Where roadways meet: branches counted on rings around the widest place, and their meeting point (METHOD 5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from scipy.ndimage import label

from mineloc.compiled import njit
from mineloc.config import IntersectionsConfig
from mineloc.data import F64, I32, I64, Bool
from mineloc.places.clearance import Clearance, clearance_of, flood
from mineloc.places.free_grid import FreeGrid

_BEARINGS = 180
_WIDEST = 3.2
"""An arc wider than so many clearances is no branch but a hall."""
_PEAK_M, _PEAKS_APART_M = 0.9, 0.8
"""The clearance is largest within so far of a peak; nearer peaks are one place."""
_LEAST = 3
"""Branches that make a junction."""
_AGAIN_M = 0.4
"""The rings are laid around the invariant point once more if it lies so far from the clearance maximum."""


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """A roadway that leaves an intersection.

    Attributes:
        bearing_rad: away from the intersection, counter-clockwise from x, in [0, 2π).
        point_m: (2,) on its centre line.
        width_m: mean chord of its arcs.
    """

    bearing_rad: float
    point_m: F64
    width_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Junction:
    """A place where at least three roadways meet.

    Attributes:
        point_m: (2,) geometric invariant point, in the grid's frame.
        covariance_m2: (2, 2) of it, from the spread of the centre lines.
        clearance_m: distance from the widest place to the nearest wall.
        branches: by rising bearing.
    """

    point_m: F64
    covariance_m2: F64
    clearance_m: float
    branches: tuple[Branch, ...]

    @property
    def branches_rad(self) -> F64:
        """(b,) rising bearings."""
        return np.array([branch.bearing_rad for branch in self.branches])


class _Arc(NamedTuple):
    """An open arc of a ring: its middle by bearing and place, its chord, half its angle."""

    bearing_rad: float
    point_m: F64
    chord_m: float
    half_rad: float


def find_junctions(grid: FreeGrid, config: IntersectionsConfig, *, at_m: F64 | None = None) -> list[Junction]:
    """All junctions near a place, the widest first.

    Args:
        grid: free space.
        config: `search_m`, `ring_m`, `ring_width_m`, `min_branch_m`, `max_turn_deg`, `apart_m`, `centre_weight`.
        at_m: (2,) where the drone is; the middle of the grid without it.
    """
    here = np.zeros(2) if at_m is None else at_m
    at = (here - grid.origin_m) / grid.cell_m
    seen = clearance_of(
        grid.is_open,
        (float(at[1]), float(at[0])),
        window=2 * round(_PEAK_M / grid.cell_m) + 1,
        least=0.5 * config.min_branch_m / grid.cell_m,
        within=config.search_m / grid.cell_m,
    )
    found: list[Junction] = []
    for place, room_m in _widest(grid, seen):
        junction = _junction_at(grid, seen.free, place, room_m, config)
        if junction is not None:
            apart = max(config.apart_m, 1.2 * junction.clearance_m)
            if all(np.linalg.norm(junction.point_m - other.point_m) > apart for other in found):
                found.append(junction)
    return found


def _parts(mask: Bool) -> tuple[I32, int]:
    """Connected parts, numbered from 1 on, and how many there are."""
    numbered, count = cast("tuple[I32, int]", label(mask))
    return numbered, count


def _widest(grid: FreeGrid, seen: Clearance) -> list[tuple[F64, float]]:
    """Peaks of the clearance as (2,) places with their clearance in metres, the largest first; no two close by."""
    rows, columns = seen.peaks[:, 0], seen.peaks[:, 1]
    room = seen.cells[rows, columns] * grid.cell_m
    places = grid.origin_m + grid.cell_m * np.column_stack([columns, rows])
    kept: list[tuple[F64, float]] = []
    for k in np.argsort(-room, kind="stable"):
        if all(np.hypot(*(places[k] - other)) > _PEAKS_APART_M for other, _ in kept):
            kept.append((places[k], float(room[k])))
    return kept


def _junction_at(grid: FreeGrid, free: Bool, place: F64, room: float, config: IntersectionsConfig) -> Junction | None:
    branches = branches_around(grid, free, place, room, config)
    if len(branches) < _LEAST:
        return None
    point, covariance = invariant_point(branches, place, config)
    if np.linalg.norm(point - place) > _AGAIN_M:
        again = branches_around(grid, free, point, room, config)
        if len(again) >= len(branches):
            branches = again
            point, covariance = invariant_point(branches, place, config)
    if np.linalg.norm(point - place) > 2.0 * room + 1.0:
        return None  # the lines are nearly parallel: they meet somewhere in the rock
    return Junction(point, covariance, room, branches)


def branches_around(
    grid: FreeGrid, free: Bool, centre_m: F64, clearance_m: float, config: IntersectionsConfig
) -> tuple[Branch, ...]:
    """Arcs of free space that persist over all rings, as branches by rising bearing.

    Args:
        free: (rows, columns) that hang together with the drone's place.
        centre_m: (2,) of the rings.
        clearance_m: free distance there; the rings lie beyond it.
    """
    widest = _WIDEST * clearance_m + 1.0
    outer = _arcs(grid, free, centre_m, clearance_m + config.ring_m[-1], config)
    if sum(arc.chord_m < widest for arc in outer) < _LEAST:
        return ()  # a branch is an arc of the outermost ring: the others need not be looked at
    rings = [_arcs(grid, free, centre_m, clearance_m + beyond, config) for beyond in config.ring_m[:-1]]
    rings.append(outer)
    branches = [
        _branch(chain, centre_m)
        for arc in rings[-1]
        if arc.chord_m < widest
        for chain in [_inwards(arc, rings[-2::-1], np.radians(config.max_turn_deg))]
        if chain is not None
    ]
    # two arcs may run into one: the wider chain stays
    kept: list[Branch] = []
    apart = 0.5 * np.radians(config.max_turn_deg)
    for branch in sorted(branches, key=lambda one: -one.width_m):
        if all(_between(branch.bearing_rad, other.bearing_rad) > apart for other in kept):
            kept.append(branch)
    return tuple(sorted(kept, key=lambda one: one.bearing_rad))


def _inwards(arc: _Arc, rings: list[list[_Arc]], turn_rad: float) -> list[_Arc] | None:
    """The arc with those behind it on the rings towards the centre; None where it does not lead there.

    Branches that leave side by side are one arc on the inner rings: what counts there is that the arc lies within it.
    """
    chain = [arc]
    for arcs in rings:
        behind = [other for other in arcs if _between(arc.bearing_rad, other.bearing_rad) < other.half_rad + turn_rad]
        if not behind:
            return None
        nearest = min(behind, key=lambda other: _between(arc.bearing_rad, other.bearing_rad))
        if _between(nearest.bearing_rad, arc.bearing_rad) < turn_rad:
            chain.insert(0, nearest)
    return chain


def _arcs(grid: FreeGrid, free: Bool, centre_m: F64, radius_m: float, config: IntersectionsConfig) -> list[_Arc]:
    """The open arcs of one ring that are wide enough and reached from its centre."""
    at = (centre_m - grid.origin_m) / grid.cell_m
    width = 0.5 * config.ring_width_m / grid.cell_m
    filled = ring(free, at[1], at[0], radius_m / grid.cell_m, width, _BEARINGS)
    step_m = 2 * np.pi * radius_m / _BEARINGS
    out: list[_Arc] = []
    # cells are coarser than bearings near the centre: small gaps are none
    for first, last in runs_on(filled, max(1, round(1.5 * grid.cell_m / step_m))).tolist():
        half = np.pi * (last - first) / _BEARINGS
        chord = 2.0 * radius_m * float(np.sin(min(half, 0.5 * np.pi)))
        if chord >= config.min_branch_m:
            angle = float(np.pi * (first + last) / _BEARINGS)
            point = centre_m + radius_m * np.array([np.cos(angle), np.sin(angle)])
            out.append(_Arc(angle % (2 * np.pi), point, chord, half))
    return out


@njit(cache=True, nogil=True)
def ring(free: Bool, row: float, column: float, radius: float, half_width: float, bearings: int) -> Bool:
    """(bearings,) where a ring, in cells, is open and reached from its centre within it."""
    reach = radius + half_width
    low_r, high_r = max(int(np.floor(row - reach)), 0), min(int(np.ceil(row + reach)) + 1, free.shape[0])
    low_c, high_c = max(int(np.floor(column - reach)), 0), min(int(np.ceil(column + reach)) + 1, free.shape[1])
    filled = np.zeros(bearings, np.bool_)
    if low_r >= high_r or low_c >= high_c:
        return filled
    disc = np.zeros((high_r - low_r, high_c - low_c), np.bool_)
    start_r, start_c, nearest = -1, -1, np.inf
    for r in range(low_r, high_r):
        for c in range(low_c, high_c):
            away = (r - row) ** 2 + (c - column) ** 2
            if free[r, c] and away <= reach * reach:
                disc[r - low_r, c - low_c] = True
                if away < nearest:
                    start_r, start_c, nearest = r - low_r, c - low_c, away
    if start_r < 0:
        return filled
    inside = np.zeros_like(disc)
    flood(disc, start_r, start_c, inside)
    for r in range(low_r, high_r):
        for c in range(low_c, high_c):
            if not inside[r - low_r, c - low_c]:
                continue
            away = np.sqrt((r - row) ** 2 + (c - column) ** 2)
            if abs(away - radius) <= half_width:
                turn = np.arctan2(r - row, c - column) / (2 * np.pi)
                filled[int((turn - np.floor(turn)) * bearings) % bearings] = True
    return filled


def ring_plainly(free: Bool, row: float, column: float, radius: float, half_width: float, bearings: int) -> Bool:
    """`ring` in scipy: what the kernel is held to."""
    r, c = np.mgrid[: free.shape[0], : free.shape[1]]
    away = np.hypot(r - row, c - column)
    parts, _ = _parts(free & (away <= radius + half_width))
    middle = np.unravel_index(np.where(parts > 0, away, np.inf).argmin(), away.shape)
    ring = (parts == parts[middle]) & (parts > 0) & (np.abs(away - radius) <= half_width)
    bearing = np.arctan2(r[ring] - row, c[ring] - column)
    filled = np.zeros(bearings, np.bool_)
    filled[(bearing % (2 * np.pi) * (bearings / (2 * np.pi))).astype(np.int64) % bearings] = True
    return filled


@njit(cache=True, nogil=True)
def runs_on(filled: Bool, gap: int) -> I64:
    """(k, 2) first bin and end of the runs on a ring, gaps of at most `gap` bins closed.

    The end lies beyond the ring's where a run goes around; a ring that is full, or empty, has none.
    """
    n = len(filled)
    none = np.zeros((0, 2), np.int64)
    # begin behind the longest gap: no run goes over it
    start, longest, run = -1, 0, 0
    for i in range(2 * n):
        if filled[i % n]:
            if run > longest:
                start, longest = i % n, run
            run = 0
        else:
            run += 1
    if start < 0 or longest <= gap or longest >= n:
        return none
    out = np.empty((n, 2), np.int64)
    count, last = 0, -1
    for i in range(start, start + n):
        if not filled[i % n]:
            continue
        if last < 0 or i - last > gap + 1:
            out[count, 0] = i
            count += 1
        out[count - 1, 1] = i + 1
        last = i
    return out[:count].copy()


def runs_plainly(filled: Bool, gap: int) -> I64:
    """`runs_on` in plain numpy: what the kernel is held to; the runs in another order."""
    where = np.flatnonzero(filled)
    if not len(where):
        return np.zeros((0, 2), np.int64)
    n = len(filled)
    ahead = np.diff(np.append(where, where[0] + n))
    if (ahead <= gap + 1).all():
        return np.zeros((0, 2), np.int64)
    ends = np.flatnonzero(ahead > gap + 1)
    firsts = where[(ends + 1) % len(where)]
    lasts = where[np.roll(ends, -1)]
    return np.column_stack([firsts, np.where(lasts < firsts, lasts + n, lasts) + 1])


def _branch(chain: list[_Arc], centre_m: F64) -> Branch:
    points = np.array([arc.point_m for arc in chain])
    middle = points.mean(axis=0)
    along = points[-1] - points[0]
    away = middle - centre_m
    # of nearby points the direction is noise: the way out from the centre steadies it
    direction = 0.5 * away / max(float(np.linalg.norm(away)), 1e-9)
    if len(chain) > 1:
        direction = direction + along / max(float(np.linalg.norm(along)), 1e-9)
    bearing = float(np.arctan2(direction[1], direction[0])) % (2 * np.pi)
    return Branch(bearing, middle, float(np.mean([arc.chord_m for arc in chain])))


def invariant_point(branches: tuple[Branch, ...], widest_m: F64, config: IntersectionsConfig) -> tuple[F64, F64]:
    """The least-squares meeting point of the centre lines, drawn a little to the widest place; (2,) and (2, 2).

    METHOD 5.1 (5): [Σ(I - u uᵀ) + w I] x = Σ(I - u uᵀ) m + w x_D.
    """
    A: F64 = config.centre_weight * np.eye(2)
    b: F64 = config.centre_weight * widest_m
    for branch in branches:
        u = np.array([np.cos(branch.bearing_rad), np.sin(branch.bearing_rad)])
        across = np.eye(2) - np.outer(u, u)
        A, b = A + across, b + across @ branch.point_m
    point = np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    away = [_across(branch, point) for branch in branches]
    variance = max(float(np.mean(np.square(away))), (0.5 * 0.2) ** 2)
    return point, np.asarray(variance * np.linalg.inv(A), dtype=np.float64)


def _across(branch: Branch, point: F64) -> float:
    u = np.array([np.cos(branch.bearing_rad), np.sin(branch.bearing_rad)])
    d = point - branch.point_m
    return float(u[0] * d[1] - u[1] * d[0])


def _between(a: float, b: float) -> float:
    """Angle between two bearings, in [0, π]."""
    return float(abs((a - b + np.pi) % (2 * np.pi) - np.pi))
