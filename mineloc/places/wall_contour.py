"""The plane wall contour vector, PWCV: walls around an invariant point; how alike two are (METHOD 5.1 (6))."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mineloc.compiled import njit
from mineloc.config import IntersectionsConfig
from mineloc.data import F32, F64, U8, Bool, Sight, WallContour
from mineloc.places.free_grid import FreeGrid

_STEP_M = 0.1
_PEAKS, _PEAK_BINS = 4, 10
"""At most so many turns, at least so many bins apart."""


class Likeness(NamedTuple):
    """How alike two contours are under the best turn.

    Attributes:
        similarity: in [0, 1]; 0 when too few directions are known in both.
        yaw_rad: turn of the second's frame that takes its bearings to the first's, in (-π, π].
    """

    similarity: float
    yaw_rad: float


def wall_contour(grid: FreeGrid, point_m: F64, branches_rad: F64, config: IntersectionsConfig) -> WallContour:
    """March a ray a bin from the point to the first wall.

    Args:
        grid: free space; cells that were not seen end a ray as unknown.
        point_m: (2,) in the grid's frame.
        branches_rad: (b,) bearings of the roadways that meet.
        config: `contour_radius_m`, `contour_bins`.
    """
    n, radius = config.contour_bins, config.contour_radius_m
    bearings = 2 * np.pi * np.arange(n) / n
    steps = np.arange(_STEP_M, radius + 0.5 * _STEP_M, _STEP_M)
    places = point_m + steps[None, :, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)[:, None, :]
    rows, columns = grid.cells_of(places.reshape(-1, 2))
    inside = (rows >= 0) & (columns >= 0) & (rows < grid.sight.shape[0]) & (columns < grid.sight.shape[1])
    met = np.full(len(rows), Sight.UNKNOWN, np.uint8)
    met[inside] = grid.sight[rows[inside], columns[inside]]
    met = met.reshape(n, len(steps))
    ends = met != Sight.OPEN
    first = np.where(ends.any(axis=1), ends.argmax(axis=1), len(steps) - 1)
    sight = met[np.arange(n), first]
    distance = np.where(sight == Sight.WALL, steps[first] / radius, 0.0).astype(np.float32)
    return WallContour(distance, sight, radius, np.sort(branches_rad % (2 * np.pi)))


def contour_likeness(a: WallContour, b: WallContour, config: IntersectionsConfig) -> Likeness:
    """Similarity of two contours over all turns; METHOD's S(k) with a parabola through its peak.

    Raises:
        ValueError: other numbers of bins, or another radius.
    """
    curve = likeness_curve(a, b, config)
    return _at(curve, int(curve.argmax()))


def likeness_near(
    a: WallContour, b: WallContour, yaw_rad: float, *, within_rad: float, config: IntersectionsConfig
) -> Likeness:
    """The best turn of b near a given one.

    Raises:
        ValueError: as `likeness_curve`.
    """
    curve = likeness_curve(a, b, config)
    turns = 2 * np.pi * np.arange(len(curve)) / len(curve)
    away = np.abs((turns - yaw_rad + np.pi) % (2 * np.pi) - np.pi)
    return _at(curve, int(np.where(away <= within_rad, curve, -1.0).argmax()))


def peaks_of(curve: F64, may_be: Bool, config: IntersectionsConfig) -> list[Likeness]:
    """The best turn and others nearly as good, the best first: an X looks the same from four sides.

    Args:
        curve: (n,) similarity by turn.
        may_be: (n,) turns that are asked for.
        config: `peak_drop`.
    """
    is_peak = (curve >= np.roll(curve, 1)) & (curve > np.roll(curve, -1)) & may_be & (curve > 0)
    ranked = np.flatnonzero(is_peak)
    if not len(ranked):
        return []
    ranked = ranked[np.argsort(-curve[ranked], kind="stable")]
    ranked = ranked[curve[ranked] >= curve[ranked[0]] - config.peak_drop]
    kept: list[int] = []
    for k in ranked.tolist():
        if all(min(abs(k - other), len(curve) - abs(k - other)) > _PEAK_BINS for other in kept):
            kept.append(k)
    return [_at(curve, k) for k in kept[:_PEAKS]]


def _at(curve: F64, k: int) -> Likeness:
    """The likeness at a bin, the turn refined by a parabola."""
    n = len(curve)
    left, here, right = curve[k - 1], curve[k], curve[(k + 1) % n]
    bend = left - 2 * here + right
    offset = 0.5 * (left - right) / bend if bend < -1e-12 else 0.0
    yaw = 2 * np.pi * (k + offset) / n
    return Likeness(float(here), float((yaw + np.pi) % (2 * np.pi) - np.pi))


def likeness_curve(a: WallContour, b: WallContour, config: IntersectionsConfig) -> F64:
    """(n,) S(k): bin i of b is compared with bin i + k of a.

    Raises:
        ValueError: other numbers of bins, or another radius.
    """
    if len(a.distance) != len(b.distance) or a.radius_m != b.radius_m:
        raise ValueError("contours of other sizes")
    kernel = kernel_table(a.radius_m, config)
    everywhere = np.ones(len(a.distance), np.bool_)
    return curve_where(a.distance, a.sight, b.distance, b.sight, everywhere, kernel, config.contour_known)


def kernel_table(radius_m: float, config: IntersectionsConfig) -> F64:
    """(1024,) likeness of two walls by the difference of their distances over the radius, from 0 to 1."""
    return np.exp(-np.square(radius_m / config.contour_sigma_m * np.linspace(0.0, 1.0, 1024)))


@njit(cache=True, nogil=True)
def curve_where(a: F32, sight_a: U8, b: F32, sight_b: U8, wanted: Bool, kernel: F64, least: float) -> F64:
    """(n,) the likeness curve at the turns that are wanted, else 0; `kernel` as `kernel_table` has it."""
    n = len(a)
    out = np.zeros(n)
    for k in range(n):
        if not wanted[k]:
            continue
        known, total = 0, 0.0
        for i in range(n):
            j = i + k
            if j >= n:
                j -= n
            if sight_a[j] == 0 or sight_b[i] == 0:
                continue
            known += 1
            if sight_a[j] == 1 and sight_b[i] == 1:
                total += kernel[int(abs(a[j] - b[i]) * 1023.0)]
            elif sight_a[j] == sight_b[i]:
                total += 1.0
        if known >= least * n:
            out[k] = total / known
    return out


def likeness_curve_plainly(a: WallContour, b: WallContour, config: IntersectionsConfig) -> F64:
    """`likeness_curve` in plain numpy: what the kernel is held to."""
    n = len(a.distance)
    out = np.zeros(n)
    for k in range(n):
        da, sa = np.roll(a.distance, -k), np.roll(a.sight, -k)
        known = (sa != Sight.UNKNOWN) & (b.sight != Sight.UNKNOWN)
        walls = (sa == Sight.WALL) & (b.sight == Sight.WALL)
        off_m = (da - b.distance) * a.radius_m
        score = np.where(walls, np.exp(-((off_m / config.contour_sigma_m) ** 2)), (sa == b.sight) & ~walls)
        if known.sum() >= config.contour_known * n:
            out[k] = score[known].mean()
    return out


def branches_fit(a_rad: F64, b_rad: F64, yaw_rad: float, *, within_rad: float) -> bool:
    """Whether all branches of the one that has fewer lie near branches of the other, once b is turned by the yaw.

    Degrees may differ by one: a branch may not have been seen yet.
    """
    if abs(len(a_rad) - len(b_rad)) > 1:
        return False
    turned = b_rad + yaw_rad
    few, many = (a_rad, turned) if len(a_rad) <= len(turned) else (turned, a_rad)
    if not len(few):
        return True
    apart = np.abs((few[:, None] - many[None, :] + np.pi) % (2 * np.pi) - np.pi)
    return bool((apart.min(axis=1) < within_rad).all())
