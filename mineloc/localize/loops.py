"""Loop closures: a keyframe that sees a place seen before, found, registered, and believed only when others agree.

Candidates come from Scan Context (paper B, 2.4) or from where the drone is known to be; each is registered submap to
submap, starting from what odometry and closures before it predict, or from features where that is too vague; and each
must fit, hold in every direction, lie where the prediction allows, and agree with another closure close by. A false
loop is worse than no loop: what is refused says why.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, Fix, Keyframe, RelativePose
from mineloc.graph.relative_uncertainty import Prediction, RelativeUncertainty
from mineloc.localize.keyframe_clouds import context_of, levelled, submap_around
from mineloc.localize.loop_judgement import Judgement, judge_loop
from mineloc.localize.visits import Visit, Visits
from mineloc.mapping.coarse_match import match_coarsely
from mineloc.mapping.submap_registration import SubmapRegistration, register_submaps
from mineloc.mapping.submaps import Submap
from mineloc.places.context_search import ContextIndex

_BETWEEN_FLIGHTS_M = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Keyframe `j` may see what keyframe `i` saw.

    Attributes:
        T_i_j: (4, 4) where registration may start; None: where the prediction says.
        source: "place", "position" or "intersection".
        scores: of the search.
    """

    i: int
    j: int
    source: str
    T_i_j: F64 | None = None
    scores: dict[str, float] = field(default_factory=dict)


@dataclass(slots=True, eq=False)
class _Examined:
    """A candidate with its judgement; `agreeing` counts the closures that agree with it, itself included."""

    candidate: Candidate
    judgement: Judgement
    agreeing: int = 1
    accepted: bool = False
    contradicted: bool = False


class LoopCloser:
    """Watches a flight go by and says where it meets itself.

    Args:
        config: sections `loops`, `scan_context`, `graph`, `intersections`.
        by_place: candidates by Scan Context.
        by_position: candidates by the estimated position.
        by_intersection: candidates by intersections that were seen before (paper A without a map).

    Attributes:
        loops: accepted so far, in the order of acceptance.
    """

    def __init__(self, config: Config, *, by_place: bool, by_position: bool, by_intersection: bool = False) -> None:
        self._config, self._loops_config = config, config.loops
        self._by_position = by_position
        self._contexts = ContextIndex(config.scan_context) if by_place else None
        self._visits = Visits(config.intersections) if by_intersection else None
        self._waiting: list[Visit] = []
        self._uncertainty = RelativeUncertainty(config.graph)
        self._keyframes: list[Keyframe] = []
        self._poses: list[F64] = []
        self._starts: list[int] = []  # keyframes with which a flight begins
        self._path_m: list[float] = []
        self._searched_m = 0.0
        self._examined: list[_Examined] = []
        self.loops: list[RelativePose] = []

    def __len__(self) -> int:
        return len(self._keyframes)

    def add(self, keyframe: Keyframe, relative: RelativePose | None, T_map_lidar: F64) -> list[RelativePose]:
        """Take the next keyframe; what was closed by it.

        A search looks at the keyframe some way back: its submap reaches both ways.

        Args:
            keyframe: with points.
            relative: the edge that leads to it, None for the first of a flight.
            T_map_lidar: (4, 4) the best estimate now.
        """
        if relative is None:
            self._starts.append(len(self))
        # flights are farther apart than any way after which a place counts as seen again
        step_m = _BETWEEN_FLIGHTS_M if relative is None else float(np.linalg.norm(relative.T_i_j[:3, 3]))
        self._path_m.append((self._path_m[-1] if self._path_m else 0.0) + step_m)
        self._keyframes.append(keyframe)
        self._poses.append(T_map_lidar)
        self._uncertainty.add(keyframe.T_odom_lidar, relative)
        if self._contexts is not None:
            context = context_of(keyframe, T_map_lidar, self._config.scan_context)
            self._contexts.add(context, path_m=self._path_m[-1])
        found = self._revisited(keyframe)
        j = len(self._keyframes) - 1 - self._loops_config.submap_keyframes
        if j < 0 or self._path_m[j] < self._searched_m + self._loops_config.every_m:
            return found
        self._searched_m = self._path_m[j]
        return [*found, *self.search(j)]

    def pose(self, index: int) -> F64:
        """(4, 4) `T_map_lidar` of a keyframe as it is believed now."""
        return self._poses[index]

    def follow(self, poses: F64) -> None:
        """Better poses (n, 4, 4) `T_map_lidar` of all keyframes so far."""
        self._poses = list(poses)

    def revisit(self, poses: F64) -> list[RelativePose]:
        """Search the whole flight once more from better poses, where nothing was closed; what was closed now.

        Args:
            poses: (n, 4, 4) `T_map_lidar` of all keyframes.
        """
        self.follow(poses)
        closed = np.array([self._path_m[k] for loop in self.loops for k in (loop.i, loop.j)])
        found: list[RelativePose] = []
        last_m = -np.inf
        for j, at_m in enumerate(self._path_m):
            is_due = at_m >= last_m + self._loops_config.every_m
            if is_due and not (len(closed) and np.abs(closed - at_m).min() < self._loops_config.every_m):
                found += self.search(j)
                last_m = at_m
        return found

    def search(self, j: int) -> list[RelativePose]:
        """Candidates for one keyframe, examined; all closures that are accepted because of it."""
        return self._closed(self._candidates(j))

    def _revisited(self, keyframe: Keyframe) -> list[RelativePose]:
        """Closures by intersections: of each visit that is over, once its submaps are complete."""
        if self._visits is None:
            return []
        visit = self._visits.follow(keyframe)
        if visit is not None:
            self._waiting.append(visit)
        complete = len(self._keyframes) - 1 - self._loops_config.submap_keyframes
        ready = [one for one in self._waiting if one.keyframes[-1] <= complete]
        self._waiting = [one for one in self._waiting if one.keyframes[-1] > complete]
        return [loop for one in ready for root in one.roots for loop in self._closed(self._seen_before(one, root))]

    def _seen_before(self, visit: Visit, root: int) -> Iterator[Candidate]:
        """One keyframe of a visit against those of earlier visits that look alike."""
        assert self._visits is not None
        to_root = se3.inverse(self._keyframes[visit.keyframe].T_odom_lidar) @ self._keyframes[root].T_odom_lidar
        for seen in self._visits.like(visit):
            i = seen.earlier.keyframe
            if self._path_m[root] - self._path_m[i] >= self._loops_config.min_path_m:
                T_i_j = se3.rigid(seen.T_earlier_here @ to_root)
                yield Candidate(i, root, "intersection", T_i_j, {"similarity": seen.similarity})

    def _closed(self, candidates: Iterable[Candidate]) -> list[RelativePose]:
        accepted: list[RelativePose] = []
        registered = 0
        closed: set[int] = set()
        for candidate in candidates:
            if registered == self._loops_config.max_candidates:
                break
            # earlier passes of one flight are closed with each other: a second closure says nothing new
            flight = self._first_of_flight(candidate.i)
            if flight in closed:
                continue
            examined = _Examined(candidate, self._examine(candidate))
            self._examined.append(examined)
            registered += examined.judgement.T_i_j is not None
            if examined.judgement.loop is not None:
                closed.add(flight)
                accepted += self._supported(examined, examined.judgement.loop)
        for loop in accepted:
            self._uncertainty.close(loop)
        self.loops += accepted
        return accepted

    def fixes(self, poses: F64) -> tuple[Fix, ...]:
        """Every candidate as a fix, accepted or refused.

        Args:
            poses: (n, 4, 4) `T_map_lidar` of all keyframes, in which closures are told.
        """
        return tuple(self._fix(examined, poses) for examined in self._examined)

    def keep_consistent(self) -> list[RelativePose]:
        """Drop the closures that contradict others by odometry, the one with most contradictions first; what stays."""
        kept = list(self.loops)
        agree = self._uncertainty.agreement(kept)
        left = np.ones(len(kept), np.bool_)
        while left.any():
            contradicted = (~(agree & agree.T) & left).sum(axis=1) * left
            worst = int(contradicted.argmax())
            if contradicted[worst] == 0:
                break
            left[worst] = False
        self.loops = [loop for loop, stays in zip(kept, left, strict=True) if stays]
        for examined in self._examined:
            if examined.accepted and all(examined.judgement.loop is not loop for loop in self.loops):
                examined.accepted, examined.contradicted = False, True
        return self.loops

    def _candidates(self, j: int) -> Iterator[Candidate]:
        """By place, then by position; no two of one stretch."""
        taken: list[float] = []
        within_m = self._loops_config.every_m
        for candidate in [*self._places(j), *self._positions(j)]:
            at_m = self._path_m[candidate.i]
            if all(abs(at_m - m) > within_m for m in taken):
                taken.append(at_m)
                yield candidate

    def _places(self, j: int) -> list[Candidate]:
        if self._contexts is None:
            return []
        found: list[Candidate] = []
        for match in self._contexts.candidates(j):
            T_i_j = levelled(self._poses[match.index])
            turn = se3.exp(np.array([0.0, 0.0, match.yaw_rad, 0.0, 0.0, 0.0]))
            T_i_j = se3.inverse(T_i_j) @ turn @ levelled(self._poses[j])
            found.append(Candidate(match.index, j, "place", T_i_j, {"context_distance": match.distance}))
        return found

    def _positions(self, j: int) -> list[Candidate]:
        """The nearest keyframe of every earlier pass within reach, the nearest pass first."""
        if not self._by_position:
            return []
        positions = np.array([T[:3, 3] for T in self._poses])
        distance = np.linalg.norm(positions - positions[j], axis=1)
        apart = np.abs(np.array(self._path_m) - self._path_m[j]) >= self._loops_config.min_path_m
        near = np.flatnonzero((distance < self._loops_config.max_radius_m) & apart & (np.arange(len(distance)) < j))
        passes = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1) if len(near) else []
        nearest = sorted((int(one[distance[one].argmin()]) for one in passes), key=lambda i: distance[i])
        return [Candidate(i, j, "position", None, {"distance_m": float(distance[i])}) for i in nearest]

    def _examine(self, candidate: Candidate) -> Judgement:
        """Register the candidate and judge the result."""
        expected = self._uncertainty.between(candidate.i, candidate.j)
        apart_m = float(np.linalg.norm(expected.T_i_j[:3, 3]))
        reach_m = self._loops_config.max_radius_m + self._loops_config.gate_sigmas * expected.sigma_m
        if apart_m > reach_m:
            reason = f"{apart_m:.0f} m apart by odometry, at most {reach_m:.0f} m allowed"
            return Judgement(None, reason, None, {**candidate.scores, "expected_sigma_m": expected.sigma_m})
        source, target = self._submap(candidate.j), self._submap(candidate.i)
        registration, start = self._register(candidate, expected, source, target)
        scores = {**candidate.scores, "start": float(start), "expected_sigma_m": expected.sigma_m}
        return judge_loop(candidate.i, candidate.j, registration, expected, self._loops_config, scores)

    def _register(
        self, candidate: Candidate, expected: Prediction, source: Submap, target: Submap
    ) -> tuple[SubmapRegistration | None, int]:
        """From the prediction where it is good; else from features, then from the recognised place; the best fit."""
        c = self._loops_config
        if min(len(source), len(target)) < c.min_inliers:
            return None, 0
        starts = [expected.T_i_j]
        if expected.sigma_m > c.features_from_m:
            coarse = match_coarsely(
                source,
                target,
                salient_m=c.iss_salient_m,
                suppression_m=c.iss_suppression_m,
                feature_m=c.fpfh_radius_m,
                distance_m=c.features_distance_m,
            )
            # a feature match counts only where odometry allows it (METHOD 6.2)
            if coarse is not None and _allowed(coarse.T_target_source, expected, c.gate_sigmas, c.icp_distances_m[0]):
                starts.insert(0, coarse.T_target_source)
            if candidate.T_i_j is not None:
                starts.insert(len(starts) - 1, candidate.T_i_j)
        best: SubmapRegistration | None = None
        which = 0
        # a good prediction needs no wide search
        wide = 0 if expected.sigma_m > 0.25 * c.icp_distances_m[0] else min(1, len(c.icp_distances_m) - 1)
        for k, start in enumerate(starts):
            distances_m = c.icp_distances_m[wide:]
            found = register_submaps(source, target, start, distances_m=distances_m, kernel_m=c.icp_kernel_m)
            if best is None or found.overlap > best.overlap:
                best, which = found, k
            if best.overlap >= c.min_overlap and best.residual_m <= c.max_residual_m:
                break
        return best, which

    def _submap(self, root: int) -> Submap:
        """Around a keyframe, of its own flight alone: odometry does not lead from one flight to the next."""
        first = self._first_of_flight(root)
        end = min((start for start in self._starts if start > root), default=len(self))
        return submap_around(self._keyframes[first:end], root - first, self._loops_config)

    def _first_of_flight(self, index: int) -> int:
        return max(start for start in self._starts if start <= index)

    def _supported(self, examined: _Examined, loop: RelativePose) -> list[RelativePose]:
        """Count who agrees with a new closure; all that have enough agreement now and were not accepted before."""
        around = [other for other in self._examined[:-1] if self._is_near(other.judgement.loop, loop)]
        loops = [other.judgement.loop for other in around if other.judgement.loop is not None]
        for other, agrees in zip(around, self._uncertainty.consistent(loop, loops), strict=True):
            examined.agreeing += int(agrees)
            other.agreeing += int(agrees)
        accepted: list[RelativePose] = []
        for one in (examined, *around):
            if not one.accepted and one.agreeing >= self._loops_config.support and one.judgement.loop is not None:
                one.accepted = True
                accepted.append(one.judgement.loop)
        return accepted

    def _is_near(self, other: RelativePose | None, loop: RelativePose) -> bool:
        """Whether two closures are of the same two passes: close on both, but not the same keyframe."""
        if other is None or other.j == loop.j:
            return False
        within_m = self._loops_config.support_within_m
        return all(
            abs(self._path_m[a] - self._path_m[b]) <= within_m for a, b in ((other.i, loop.i), (other.j, loop.j))
        )

    def _fix(self, examined: _Examined, poses: F64) -> Fix:
        judgement, candidate = examined.judgement, examined.candidate
        keyframe = self._keyframes[candidate.j]
        reason = judgement.reason
        if examined.contradicted:
            reason = "contradicts other closures by odometry"
        elif not reason and not examined.accepted:
            reason = f"{examined.agreeing} closures agree, at least {self._loops_config.support} needed"
        T = None if judgement.T_i_j is None else se3.rigid(poses[candidate.i] @ judgement.T_i_j)
        covariance = None
        if judgement.loop is not None:
            covariance = np.asarray(np.linalg.inv(judgement.loop.information), dtype=np.float64)
        return Fix(
            stamp_ns=keyframe.stamp_ns,
            keyframe=candidate.j,
            T_map_lidar=T,
            covariance=covariance,
            trusted=not reason,
            reason=reason,
            target=f"keyframe {candidate.i}",
            scores={**judgement.scores, "agreeing": float(examined.agreeing)},
        )


def _allowed(T_i_j: F64, expected: Prediction, sigmas: float, floor_m: float) -> bool:
    apart_m = float(np.linalg.norm(T_i_j[:3, 3] - expected.T_i_j[:3, 3]))
    return apart_m <= floor_m + sigmas * expected.sigma_m
