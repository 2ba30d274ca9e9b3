"""Which earlier keyframe was at the place of this one, by Scan Context: two stages (METHOD 2.4, 4.2)."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from mineloc.config import ScanContextConfig
from mineloc.data import F32, F64, I64
from mineloc.places.scan_context import UNLIKE, context_distance, ring_key, yaw_of_shift

_GROWTH = 1.25
"""A tree is planted anew when so many times as many keyframes may be found as are in it."""
_FEWEST_IN_TREE = 50


@dataclass(frozen=True, slots=True)
class ContextMatch:
    """An earlier keyframe that looks like the one asked about.

    Attributes:
        index: of the earlier keyframe, in the order in which they were added.
        distance: of the two contexts, 0 … `max_distance`.
        yaw_rad: rotation about z that takes the levelled lidar coordinates of the keyframe asked about to those of the
            match: p_match ≈ Rz(yaw) p_query + t with a small t. Known to half a sector.
    """

    index: int
    distance: float
    yaw_rad: float


class ContextIndex:
    """All contexts of a flight, and the search among those that lie far enough back along the way.

    Ring keys stand in a KD-tree as far as it goes; those that came later are compared one by one, so every keyframe
    that may be found can be, the newest too. Memory grows by one context and one ring key a keyframe.

    Args:
        config: of the contexts and their search.
    """

    def __init__(self, config: ScanContextConfig) -> None:
        self._config = config
        self._contexts: list[F32] = []
        self._keys: list[F32] = []
        self._paths_m: list[float] = []
        self._tree: KDTree | None = None
        self._in_tree = 0

    def __len__(self) -> int:
        return len(self._contexts)

    def add(self, context: F32, *, path_m: float) -> int:
        """Take a keyframe in.

        Args:
            context: (rings, sectors) of `scan_context`; copied.
            path_m: metres flown up to it.

        Returns:
            Its index: 0, 1, 2 …

        Raises:
            ValueError: the shape is not the configured one, a value is not finite, or the path grows shorter.
        """
        shape = (self._config.rings, self._config.sectors)
        if context.shape != shape:
            raise ValueError(f"a context of shape {context.shape}, not {shape}")
        if not np.isfinite(context).all():
            raise ValueError("a context must be finite")
        if not path_m >= (self._paths_m[-1] if self._paths_m else -np.inf):
            raise ValueError(f"path_m {path_m} after {self._paths_m[-1] if self._paths_m else None}")
        self._contexts.append(np.array(context, np.float32))
        self._keys.append(ring_key(context))
        self._paths_m.append(float(path_m))
        return len(self._contexts) - 1

    def candidates(self, index: int) -> list[ContextMatch]:
        """The earlier keyframes that look like this one, the most similar first.

        Of those at least `min_path_m` back along the way the nearest `candidates` by ring key are compared; those
        within `max_distance` are given. A context without a point has none.

        Args:
            index: of the keyframe asked about, as `add` gave it.

        Raises:
            IndexError: no such keyframe.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"keyframe {index} of {len(self)}")
        query = self._contexts[index]
        if not query.any():
            return []
        found: list[ContextMatch] = []
        for other in self._by_ring_key(index):
            distance, shift = context_distance(query, self._contexts[other], self._config)
            if distance <= self._config.max_distance and distance < UNLIKE:
                found.append(ContextMatch(int(other), distance, yaw_of_shift(shift, self._config.sectors)))
        return sorted(found, key=lambda match: (match.distance, match.index))

    def _by_ring_key(self, index: int) -> I64:
        """Indices of the nearest ring keys among the keyframes far enough back."""
        behind = self._paths_m[index] - self._config.min_path_m
        allowed = min(bisect_right(self._paths_m, behind), index)
        if not allowed:
            return np.zeros(0, np.int64)
        if allowed >= max(_FEWEST_IN_TREE, _GROWTH * self._in_tree):
            self._tree, self._in_tree = KDTree(np.stack(self._keys[:allowed])), allowed
        key, wanted = self._keys[index], self._config.candidates
        start = 0
        distances: list[F64] = []
        indices: list[I64] = []
        if self._tree is not None and self._in_tree <= allowed:
            away, where = self._tree.query(key, k=min(wanted, self._in_tree))
            distances.append(np.atleast_1d(away))
            indices.append(np.atleast_1d(where))
            start = self._in_tree
        if start < allowed:
            distances.append(np.linalg.norm(np.stack(self._keys[start:allowed]).astype(np.float64) - key, axis=1))
            indices.append(np.arange(start, allowed))
        order = np.argsort(np.concatenate(distances), kind="stable")[:wanted]
        return np.concatenate(indices)[order]
