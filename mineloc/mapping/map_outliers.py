"""Which points of a map are rock: not what beams went through, not what stands alone and was seen once."""

from __future__ import annotations

import numpy as np

from mineloc.compiled import njit, prange
from mineloc.config import MapConfig
from mineloc.data import I32, I64, Bool
from mineloc.mapping.seen_through import Views, seen_through
from mineloc.mapping.surface_thinning import BESIDE, CHUNKS, ThinSurface

SEEN_MORE_OFTEN = 12
"""Nothing that moves is seen so often at one place; what is, is not asked for views through it."""
LEAST_VIEWS = 2


def believed(surface: ThinSurface, keys: I64, views: Views, config: MapConfig) -> Bool:
    """(n,) points to keep.

    Args:
        surface: points.
        keys: (n,) packed coordinates of their voxels, sorted.
        views: what was seen from where.
        config: how far views reach, how many neighbours a point wants that only one visit saw.
    """
    kept = np.ones(len(keys), np.bool_)
    asked = np.flatnonzero(surface.visits < SEEN_MORE_OFTEN)
    often = np.maximum(surface.visits[asked] // 2, LEAST_VIEWS).astype(np.int32)
    kept[asked] = ~seen_through(surface.points_m[asked], often, views, reach_m=config.view_reach_m)
    solid = kept & (surface.visits >= 2)
    lonely = kept & ~solid
    support = count_beside(keys, keys[solid])
    kept[lonely & (support < config.lonely_support)] = False
    return kept


@njit(cache=True, parallel=True)
def count_beside(keys: I64, others: I64) -> I32:
    """(n,) how many of the 26 voxels around each are among others; both (n,) and (m,) sorted."""
    n, m = len(keys), len(others)
    out = np.zeros(n, np.int32)
    for chunk in prange(CHUNKS):
        begin, end = n * chunk // CHUNKS, n * (chunk + 1) // CHUNKS
        at = np.zeros(9, np.int64)
        if begin < end:
            for k in range(9):
                at[k] = np.searchsorted(others, keys[begin] + BESIDE[k] - 1)
        for i in range(begin, end):
            for k in range(9):
                low = keys[i] + BESIDE[k] - 1
                j = at[k]
                while j < m and others[j] < low:
                    j += 1
                at[k] = j
                while j < m and others[j] <= low + 2:
                    out[i] += others[j] != keys[i]
                    j += 1
    return out
