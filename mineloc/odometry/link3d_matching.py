"""Which keypoints of two sweeps are the same, and which of their edge points (METHOD 2.3, 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit
from mineloc.config import Link3dConfig
from mineloc.data import F32, I64, U16
from mineloc.odometry.link3d_descriptors import describe
from mineloc.odometry.link3d_edges import EdgePoints
from mineloc.odometry.link3d_keypoints import Keypoints, aggregate

I32 = NDArray[np.int32]

_ROUNDING_M = 1e-3
"""Distances are float32 multiples of a step: 0.2 m more is not exactly 0.2 m more."""


@dataclass(frozen=True, slots=True, eq=False)
class KeypointSweep:
    """A sweep as LinK3D sees it, all at one time.

    Attributes:
        edges: the edge points.
        keypoints: their clusters.
        descriptors: (k, dimensions), see `describe`.
    """

    edges: EdgePoints
    keypoints: Keypoints
    descriptors: F32

    @staticmethod
    def of(edges: EdgePoints, config: Link3dConfig) -> KeypointSweep:
        """Keypoints and descriptors of deskewed edge points (see `edge_points`)."""
        keypoints = aggregate(edges, config)
        return KeypointSweep(edges, keypoints, describe(keypoints.points_lidar, config))


def match_keypoints(a: F32, b: F32, *, tolerance_m: float, min_score: int) -> I64:
    """One-to-one matches of descriptors.

    Every row of `a` chooses the best of `b`; where several chose the same one, the best score has it, and none where
    the best scores are equal: nothing tells which of them is right.

    Args:
        a: (n, dimensions).
        b: (m, dimensions).
        tolerance_m: largest difference of distances that are equal.
        min_score: fewest equal dimensions.

    Returns:
        (k, 2) pairs of rows, by the row of `a`.
    """
    if not len(a) or not len(b):
        return np.zeros((0, 2), np.int64)
    scores = equal_dimensions(a, b, tolerance_m + _ROUNDING_M)
    chosen = np.argmax(scores, axis=1)
    score = scores[np.arange(len(a)), chosen]
    best = np.zeros(len(b), np.int32)
    np.maximum.at(best, chosen, score)
    is_best = score == best[chosen]
    rivals = np.bincount(chosen[is_best], minlength=len(b))
    rows = np.flatnonzero(is_best & (rivals[chosen] == 1) & (score >= min_score))
    return np.stack([rows, chosen[rows]], axis=1)


@njit(cache=True, nogil=True)
def equal_dimensions(a: F32, b: F32, tolerance_m: float) -> I32:
    """(n, m) number of dimensions that are not 0 in both and differ by at most the tolerance."""
    out = np.zeros((a.shape[0], b.shape[0]), np.int32)
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            if a[i, k] == 0.0:
                continue
            for j in range(b.shape[0]):
                if b[j, k] != 0.0 and abs(a[i, k] - b[j, k]) <= tolerance_m:
                    out[i, j] += 1
    return out


def equal_dimensions_plainly(a: F32, b: F32, tolerance_m: float) -> I32:
    """`equal_dimensions` in plain numpy."""
    both = (a[:, None] != 0) & (b[None] != 0)
    return (both & (np.abs(a[:, None] - b[None]) <= tolerance_m)).sum(axis=2).astype(np.int32)


def match_edges(a: KeypointSweep, b: KeypointSweep, pairs: I64) -> I64:
    """Edge points of matched keypoints, ring by ring: the sharpest of a ring with the sharpest of the same ring.

    Args:
        a, b: two sweeps of one sensor.
        pairs: (k, 2) matched keypoints, one-to-one.

    Returns:
        (e, 2) indices of edge points.
    """
    partner = np.full(len(a.keypoints), -1, np.int64)
    partner[pairs[:, 0]] = pairs[:, 1]
    rings = 1 + max(int(_ring(s).max(initial=0)) for s in (a, b))
    place_a = partner[a.keypoints.of_edge[a.keypoints.sharpest]] * rings + _ring(a)[a.keypoints.sharpest]
    place_b = b.keypoints.of_edge[b.keypoints.sharpest] * rings + _ring(b)[b.keypoints.sharpest]
    _, at_a, at_b = np.intersect1d(place_a, place_b, assume_unique=False, return_indices=True)
    return np.stack([a.keypoints.sharpest[at_a], b.keypoints.sharpest[at_b]], axis=1)


def _ring(sweep: KeypointSweep) -> U16:
    assert sweep.edges.sweep.ring is not None
    return sweep.edges.sweep.ring
