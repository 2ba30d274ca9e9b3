"""How far the points of a map lie from the true surface, locally: piece by piece, each laid over the truth first.

A map may be metres off at its far end and still show every wall where it is beside the next. So pieces of 20 m of
roadway are aligned rigidly one by one before distances are taken; what is left is noise, blur and bends within a piece.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from mineloc import se3
from mineloc.data import F64, I64
from mineloc.data.checks import freeze

Nearest = Callable[[F64], F64]
"""Takes (n, 3) points to the (n, 3) nearest points of the true surface."""

ROUNDS = 20
CONVERGED_M = 1e-5
LEAST_POINTS = 50
MOST_POINTS = 4000
"""That an alignment uses of a piece: enough for a tenth of a millimetre."""
KERNEL_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class MapQuality:
    """Distances to the true surface, n pieces.

    Attributes:
        piece: (n,) their numbers.
        points: (n,) counts.
        median_m, p95_m: (n,) of the distances after the piece's own alignment; NaN with fewer than 50 points.
        shift_m, turn_rad: (n,) how far the alignment moved the piece's middle, and turned it.
        share_over: (n,) share of points farther than `over_m` after alignment: what is not there.
        over_m: see above.
        overall_median_m, overall_p95_m: of all points together, after their pieces' alignments.
    """

    piece: I64
    points: I64
    median_m: F64
    p95_m: F64
    shift_m: F64
    turn_rad: F64
    share_over: F64
    over_m: float
    overall_median_m: float
    overall_p95_m: float

    def __post_init__(self) -> None:
        freeze(self)


def map_quality(points_m: F64, piece: I64, nearest: Nearest, *, over_m: float = 0.15) -> MapQuality:
    """Distances of map points to the true surface, piece by piece.

    Args:
        points_m: (n, 3) points of the map in the frame of the truth; an alignment finds home from about a metre.
        piece: (n,) number of the piece that each lies in, negative: in none.
        nearest: the truth.
        over_m: distance that counts as not there.
    """
    numbers = np.unique(piece[piece >= 0])
    table = np.full((len(numbers), 6), np.nan)
    everything: list[F64] = [np.zeros(0)]
    for row, number in enumerate(numbers):
        own = points_m[piece == number]
        table[row, 0] = len(own)
        if len(own) < LEAST_POINTS:
            continue
        T = align_to_surface(own, nearest)
        moved = se3.apply(T, own)
        distance = np.linalg.norm(moved - nearest(moved), axis=1)
        everything.append(distance)
        middle = own.mean(axis=0)
        table[row, 1:] = (
            *np.percentile(distance, [50, 95]),
            np.linalg.norm(se3.apply(T, middle[None])[0] - middle),
            np.linalg.norm(se3.log(T)[:3]),
            (distance > over_m).mean(),
        )
    together = np.concatenate(everything)
    overall = np.percentile(together, [50, 95]) if len(together) else (np.nan, np.nan)
    return MapQuality(
        piece=numbers.astype(np.int64),
        points=table[:, 0].astype(np.int64),
        median_m=table[:, 1],
        p95_m=table[:, 2],
        shift_m=table[:, 3],
        turn_rad=table[:, 4],
        share_over=table[:, 5],
        over_m=over_m,
        overall_median_m=float(overall[0]),
        overall_p95_m=float(overall[1]),
    )


def align_to_surface(points_m: F64, nearest: Nearest) -> F64:
    """(4, 4) rigid motion that lays points on a surface: Gauss-Newton on their distances, along the surface's normal.

    The nearest point of a surface lies along its normal, so the residual is that of point-to-plane ICP (Chen and
    Medioni 1992) without normals being asked for. A Geman-McClure kernel three times as wide as the median keeps what
    is not there from pulling.

    Args:
        points_m: (n, 3); n ≥ 6.
        nearest: the surface.
    """
    some = points_m[:: max(1, len(points_m) // MOST_POINTS)]
    middle = some.mean(axis=0)
    T = np.eye(4)
    for _ in range(ROUNDS):
        moved = se3.apply(T, some - middle)
        off = nearest(moved + middle) - middle - moved
        distance = np.linalg.norm(off, axis=1)
        known = distance > 1e-9
        normal = off[known] / distance[known, None]
        scale = KERNEL_SIGMAS * max(float(np.median(distance)), 1e-6)
        weight = (1.0 + (distance[known] / scale) ** 2) ** -2
        J = np.concatenate([np.cross(moved[known], normal), normal], axis=1)
        H = (J * weight[:, None]).T @ J
        # a straight smooth roadway leaves its own direction open: there the step stays zero
        step = np.linalg.lstsq(H, (J * weight[:, None]).T @ distance[known], rcond=1e-6)[0]
        T = se3.exp(step) @ T
        if np.abs(step).max() < CONVERGED_M:
            break
    back = np.eye(4)
    back[:3, 3] = middle
    return back @ T @ se3.inverse(back)


def pieces_along(points_m: F64, line_m: F64, *, piece_m: float = 20.0, reach_m: float = 8.0) -> I64:
    """(n,) number of the piece of a line that each point is nearest to, -1 beyond reach.

    Args:
        points_m: (n, 3).
        line_m: (k, 3) a trajectory or centre-lines one after the other, points less than a metre apart.
        piece_m: length of a piece.
        reach_m: points farther from the line belong to no piece.
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    distance, at = KDTree(line_m).query(points_m, distance_upper_bound=reach_m)
    piece = np.append((along / piece_m).astype(np.int64), -1)[at]
    return np.where(np.isfinite(distance), piece, -1)
