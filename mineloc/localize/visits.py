"""Intersections that a flight saw, remembered without a map: one seen again is a loop (paper A; METHOD D17)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import IntersectionsConfig
from mineloc.data import F64, Keyframe
from mineloc.localize.junction_watch import JunctionWatch, Look
from mineloc.places.contour_search import ContourIndex

_APART = 3
"""A closure is sought from the keyframe nearest to the point, and from those so far before and after it."""


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """One passage of an intersection.

    Attributes:
        keyframe: index of the one nearest to the invariant point.
        keyframes: indices of those that saw the junction, rising.
        look: of the nearest one.
    """

    keyframe: int
    keyframes: tuple[int, ...]
    look: Look

    @property
    def roots(self) -> tuple[int, ...]:
        """Keyframes around which a closure is sought: the nearest, one before it and one after it."""
        at = self.keyframes.index(self.keyframe)
        chosen = {at, max(at - _APART, 0), min(at + _APART, len(self.keyframes) - 1)}
        return tuple(self.keyframes[k] for k in sorted(chosen, key=lambda k: abs(k - at)))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A visit that looks like an earlier one.

    Attributes:
        earlier: that one.
        T_earlier_here: (4, 4) between the lidars of the two nearest keyframes, by point and turn.
        similarity: of the contours.
    """

    earlier: Visit
    T_earlier_here: F64
    similarity: float


@dataclass(slots=True, eq=False)
class _Open:
    """A passage that may go on."""

    point_odom: F64
    looks: list[tuple[Keyframe, Look]]


class Visits:
    """Watches a flight go by; tells each passage when it is over, and which earlier ones it resembles.

    Args:
        config: of detection and contours; `threshold_floor` is the least similarity, for nothing was compared before.
    """

    def __init__(self, config: IntersectionsConfig) -> None:
        self._config = config
        self._watch = JunctionWatch(config)
        self._open: _Open | None = None
        self._missed = 0
        self._visits: list[Visit] = []

    def follow(self, keyframe: Keyframe) -> Visit | None:
        """Take the next keyframe; the passage that it ends."""
        look = self._watch.look(keyframe)
        if look is None:
            self._missed += 1
            return self._ended() if self._missed > self._config.same_needed else None
        self._missed = 0
        point = se3.apply(keyframe.T_odom_lidar, look.point_lidar[None])[0]
        if self._open is not None and np.linalg.norm(point - self._open.point_odom) < self._config.apart_m:
            self._open.looks.append((keyframe, look))
            return None
        ended = self._ended()
        self._open = _Open(point, [(keyframe, look)])
        return ended

    def like(self, visit: Visit) -> list[Seen]:
        """Earlier visits that look like one, each under its likeliest turns, the likest first."""
        earlier = [one for one in self._visits if one.keyframe < visit.keyframe]
        index = ContourIndex([one.look.contour for one in earlier], self._config)
        found: list[Seen] = []
        for match in index.matches(visit.look.contour):
            if match.similarity < self._config.threshold_floor:
                break
            known = earlier[match.row].look
            T = se3.exp(np.array([0.0, 0.0, match.yaw_rad, 0.0, 0.0, 0.0]))
            T[:3, 3] = known.point_level - T[:3, :3] @ visit.look.point_level
            T_lidars = se3.inverse(known.T_level_lidar) @ T @ visit.look.T_level_lidar
            found.append(Seen(earlier[match.row], T_lidars, match.similarity))
        return found

    def _ended(self) -> Visit | None:
        """The open passage, if enough keyframes saw it."""
        ended, self._open, self._missed = self._open, None, 0
        if ended is None or len(ended.looks) < self._config.same_needed:
            return None
        nearest = min(ended.looks, key=lambda one: float(np.linalg.norm(one[1].junction.point_m)))
        keyframes = tuple(keyframe.index for keyframe, _ in ended.looks)
        visit = Visit(nearest[0].index, keyframes, nearest[1])
        self._visits.append(visit)
        return visit
