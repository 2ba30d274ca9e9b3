"""From nothing to a pose in the map: a flight that begins anywhere finds itself by intersections (METHOD 7.3).

One intersection may look like another, two with the right way between them hardly ever. So each one that is recognised
begins or supports a hypothesis, which odometry carries on; the flight is found when one hypothesis has seen enough
intersections and no other has seen as many.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from mineloc.config import Config, PriorMapConfig
from mineloc.data import Fix, Keyframe, RelativePose
from mineloc.localize.map_tracker import Tracker, correct_by
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.recognition import Recognizer


@dataclass(slots=True, eq=False)
class _Hypothesis:
    """The flight if one recognition is right.

    Attributes:
        known: where the drone is then.
        fixes: positions in `Relocalizer.fixes` of those that support it, and the fixes themselves.
        seen: intersections that support it; `possible` also those that were refused by a hair.
    """

    known: PoseFilter
    fixes: list[tuple[int, Fix]] = field(default_factory=list[tuple[int, Fix]])
    seen: set[str] = field(default_factory=set[str])
    possible: set[str] = field(default_factory=set[str])


class Relocalizer:
    """Follows a flight that may be anywhere; once it is found, a tracker follows it on.

    Args:
        recognizer: of the mine's intersections.
        config: sections `prior_map`, `intersections`, `graph`.
        track: makes the tracker from where the flight was found.

    Attributes:
        filter: None until the flight is found.
        fixes: of all keyframes; those before are judged when it is found.
    """

    def __init__(self, recognizer: Recognizer, config: Config, track: Callable[[PoseFilter], Tracker]) -> None:
        self._recognizer, self._config, self._track = recognizer, config, track
        self._hypotheses: list[_Hypothesis] = []
        self._before: list[Fix] = []
        self._tracker: Tracker | None = None

    @property
    def filter(self) -> PoseFilter | None:
        """As `Tracker.filter`."""
        return None if self._tracker is None else self._tracker.filter

    @property
    def fixes(self) -> list[Fix]:
        """As `Tracker.fixes`."""
        return self._before if self._tracker is None else [*self._before, *self._tracker.fixes]

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> None:
        """As `Tracker.follow`."""
        if self._tracker is not None:
            self._tracker.follow(keyframe, edge)
            return
        if edge is not None:
            for one in self._hypotheses:
                one.known.carry(edge)
        found = self._recognizer.follow_lost(keyframe)
        place = len(self._before)
        for fix in found:
            if fix.T_map_lidar is not None and fix.covariance is not None:
                self._support(fix, place)
        best = self._decided()
        self._before.append(found[0] if not found[0].trusted else replace(found[0], trusted=False, reason=self._open()))
        if best is not None:
            for at, fix in best.fixes:
                self._before[at] = fix
            self._tracker = self._track(best.known)

    def _support(self, fix: Fix, place: int) -> None:
        """The hypothesis that expects this fix, or a new one."""
        assert fix.T_map_lidar is not None
        assert fix.covariance is not None
        c = self._config.prior_map
        away = [
            one.known.sigmas_away(fix.T_map_lidar, floor_m=c.moved_floor_m, floor_deg=c.moved_floor_deg)
            for one in self._hypotheses
        ]
        nearest = int(np.argmin(away)) if away else -1
        if nearest < 0 or away[nearest] > c.max_moved_sigmas:
            self._hypotheses.append(_Hypothesis(PoseFilter(fix.T_map_lidar, fix.covariance, self._config.graph)))
            nearest = len(self._hypotheses) - 1
        elif fix.trusted:
            correct_by(self._hypotheses[nearest].known, fix, self._config)
        chosen = self._hypotheses[nearest]
        chosen.possible.add(fix.target)
        if fix.trusted:
            chosen.seen.add(fix.target)
            chosen.fixes.append((place, fix))

    def _decided(self) -> _Hypothesis | None:
        """The hypothesis that has seen enough, if no other may have seen as many."""
        ranked = sorted(self._hypotheses, key=lambda one: -len(one.seen))
        if not ranked or len(ranked[0].seen) < self._config.intersections.found_needed:
            return None
        others = [len(one.possible) for one in ranked[1:]]
        return ranked[0] if not others or max(others) < len(ranked[0].seen) else None

    def _open(self) -> str:
        count = sum(bool(one.seen) for one in self._hypotheses)
        most = max((len(one.seen) for one in self._hypotheses), default=0)
        needed = self._config.intersections.found_needed
        return f"{count} places are possible, the likeliest with {most} of {needed} intersections (not found yet)"


class RecoveringTracker:
    """A tracker that is searched for anew when it has long been refused: the map changed, or the pose is wrong.

    Args:
        tracker: follows the flight.
        search: makes a `Relocalizer` of the same mine.
        refused: which fix speaks against the pose; one that merely saw nothing does not.
        config: section `prior_map`: after how many such fixes without a trusted one; gates.

    Attributes:
        was_lost: the flight was found elsewhere: where it was told to begin need not be true.
    """

    def __init__(
        self,
        tracker: Tracker,
        search: Callable[[], Relocalizer],
        refused: Callable[[Fix], bool],
        config: PriorMapConfig,
    ) -> None:
        self._tracker, self._make, self._is_refused, self._config = tracker, search, refused, config
        self._search: Relocalizer | None = None
        self._before: list[Fix] = []
        self._refused = 0
        self.was_lost = False

    @property
    def filter(self) -> PoseFilter | None:
        """As `Tracker.filter`; while the flight is searched for, what the tracker believed goes on."""
        return self._tracker.filter

    @property
    def fixes(self) -> list[Fix]:
        """As `Tracker.fixes`."""
        return [*self._before, *self._tracker.fixes]

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> None:
        """As `Tracker.follow`."""
        self._tracker.follow(keyframe, edge)
        newest = self._tracker.fixes[-1]
        self._refused = 0 if newest.trusted else self._refused + self._is_refused(newest)
        if self._refused < self._config.lost_after:
            self._search = None
            return
        if self._search is None:
            self._search, edge = self._make(), None
        self._search.follow(keyframe, edge)
        found = self._search.filter
        if found is None:
            return
        self.was_lost = self.was_lost or self._is_elsewhere(found)
        # from here on the search is what follows the flight; what the tracker said meanwhile was refused
        own = self._search.fixes
        self._before = [*self._before, *self._tracker.fixes[: len(self._tracker.fixes) - len(own)]]
        self._tracker, self._search, self._refused = self._search, None, 0

    def _is_elsewhere(self, found: PoseFilter) -> bool:
        c, believed = self._config, self._tracker.filter
        assert believed is not None
        away = believed.sigmas_away(found.T_map_lidar, floor_m=c.moved_floor_m, floor_deg=c.moved_floor_deg)
        return away > c.max_moved_sigmas
