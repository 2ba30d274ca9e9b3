"""Outliers of a sweep: points alone on their ring (paper B's preprocessing; METHOD 2.1 leaves the filter open).

Dust, drops and mixed returns at edges stand alone in the air. A ring is fired point after point, so a point of a wall
has a neighbour close by on at least one side; one that is far from both is dropped. Statistical filters need a tree of
all points for the same answer.
"""

from __future__ import annotations

import numpy as np

from mineloc.compiled import njit
from mineloc.data import F32, I64, Bool, Sweep
from mineloc.odometry.loam_features import ring_starts


def without_isolated(by_ring: Sweep, *, gap_m: float, gap_ratio: float) -> Sweep:
    """The sweep without the points that are farther than `gap_m + gap_ratio · range` from both neighbours on the ring.

    Args:
        by_ring: sorted by ring, in the order of firing within a ring.
        gap_m: metres.
        gap_ratio: along a roadway neighbours lie apart in proportion to the range.
    """
    alone = isolated(by_ring.points_lidar, ring_starts(by_ring), gap_m, gap_ratio)
    return by_ring.keep(~alone) if alone.any() else by_ring


@njit(cache=True, nogil=True)
def isolated(points: F32, starts: I64, gap_m: float, gap_ratio: float) -> Bool:
    """Which points are alone: (n,). The ends of a ring have one neighbour; the only point of a ring is alone."""
    out = np.ones(points.shape[0], np.bool_)
    for ring in range(starts.shape[0] - 1):
        for i in range(starts[ring], starts[ring + 1] - 1):
            gap2 = here2 = next2 = 0.0
            for k in range(3):
                a, b = np.float64(points[i, k]), np.float64(points[i + 1, k])
                gap2 += (b - a) ** 2
                here2 += a * a
                next2 += b * b
            # the nearer one's range: dust before a far wall is alone
            if gap2 <= (gap_m + gap_ratio * np.sqrt(min(here2, next2))) ** 2:
                out[i] = False
                out[i + 1] = False
    return out


def isolated_plainly(points: F32, starts: I64, gap_m: float, gap_ratio: float) -> Bool:
    """`isolated` in plain numpy."""
    out = np.ones(len(points), np.bool_)
    for ring in range(len(starts) - 1):
        p = points[starts[ring] : starts[ring + 1]].astype(np.float64)
        gap = np.linalg.norm(np.diff(p, axis=0), axis=1)
        range_m = np.linalg.norm(p, axis=1)
        near = gap <= gap_m + gap_ratio * np.minimum(range_m[:-1], range_m[1:])
        out[starts[ring] : starts[ring + 1]] = ~(np.append(near, False) | np.append(False, near))
    return out
