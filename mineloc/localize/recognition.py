"""Recognition of intersections in flight: the nine steps of paper A (METHOD 1.6), each with its reason to stop."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, I64, Fix, Intersection, IntersectionDatabase, Keyframe, MapCloud
from mineloc.localize.junction_watch import JunctionWatch, Look
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.prior_map import MapRegistration, PriorMap
from mineloc.places.contour_matrix import contour_matrix, matrix_likeness
from mineloc.places.contour_search import ContourIndex, ContourMatch
from mineloc.places.wall_contour import likeness_near

_MAPS = 8
"""Stored clouds that are kept ready for registration."""
_TURN_RAD = np.radians(10.0)
"""The heading of a drone whose pose is known is known so well."""


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """An intersection that may be the one that is seen, and where the level frame would be then."""

    known: Intersection
    similarity: float
    T_map_level: F64
    yaw_rad: float
    matrix: float = 0.0


@dataclass(slots=True, eq=False)
class _At:
    """What one keyframe brought so far: for whoever judges it, and for the fix that comes of it."""

    keyframe: Keyframe
    known: PoseFilter | None
    scores: dict[str, float] = field(default_factory=dict[str, float])


class Recognizer:
    """Watches keyframes go by and says which intersection of a database they see.

    Args:
        config: sections `intersections`, `prior_map`, `odometry`.
        database: of the mine.
    """

    def __init__(self, config: Config, database: IntersectionDatabase) -> None:
        self._all, self._config, self._database = config, config.intersections, database
        self._watch = JunctionWatch(config.intersections)
        self._index = ContourIndex([one.contour for one in database.intersections], config.intersections)
        self._points = np.array([one.point_map for one in database.intersections]).reshape(-1, 3)
        self._same: dict[int, int] = {}
        self._maps: OrderedDict[int, PriorMap] = OrderedDict()

    def follow(self, keyframe: Keyframe, known: PoseFilter) -> Fix:
        """Take the next keyframe of a flight whose pose is known; the fix tells what was recognised, or why nothing.

        Args:
            keyframe: with points; odometry levels it.
            known: where it is, as far as that is known.
        """
        return self._recognised(_At(keyframe, known))[0]

    def follow_lost(self, keyframe: Keyframe) -> list[Fix]:
        """Take the next keyframe of a flight that may be anywhere: every intersection that it may see, verified.

        One fix is refused when none is accepted. More than one accepted: they look alike, and only the way from one
        intersection to the next can tell.

        Args:
            keyframe: with points; odometry levels it.
        """
        return self._recognised(_At(keyframe, None))

    def _recognised(self, at: _At) -> list[Fix]:
        """The nine steps."""
        look = self._watch.look(at.keyframe)  # steps 1 and 2
        if look is None:
            return [self._stop(at, f"no intersection within {self._config.recognise_m:g} m (step 2)")]
        candidates, reason = self._candidates(look, at)  # steps 3 and 4
        if candidates and (len(candidates) > 1 or at.known is None):  # step 5
            candidates, reason = self._told_apart(candidates, look, at)  # step 6
        if not candidates:
            return [self._stop(at, reason)]
        steady = self._steady(candidates, at)  # step 7
        if not steady:  # step 8
            reason = f"{at.scores['same']:.0f} keyframes agree, at least {self._needed(at)} needed (step 8)"
            return [_refused(at, reason, target=candidates[0].known.name)]
        return self._all_verified(steady, look, at)  # step 9

    def _steady(self, candidates: Sequence[_Candidate], at: _At) -> list[_Candidate]:
        """Those that as many keyframes in a row have seen as are needed; these begin anew."""
        ids = {one.known.id for one in candidates}
        self._same = {id: self._same.get(id, 0) + 1 for id in sorted(ids)}
        at.scores["same"] = float(max(self._same.values()))
        steady = [one for one in candidates if self._same[one.known.id] >= self._needed(at)]
        for one in steady:
            self._same[one.known.id] = 0
        return steady

    def _needed(self, at: _At) -> int:
        return self._config.same_needed if at.known is None else self._config.same_needed_known

    def _candidates(self, look: Look, at: _At) -> tuple[list[_Candidate], str]:
        """Intersections whose contour is like this one and that may be here, the most alike first; or why none."""
        at.scores |= {"branches": float(len(look.junction.branches)), "walls": float(look.contour.walls)}
        threshold, among, reason = self._database.contour_threshold, None, ""
        if at.known is not None:
            threshold = min(threshold, self._config.threshold_known)
            among, reason = self._near(look, at.known)
        found = self._index.matches(look.contour, among)
        at.scores["similarity"] = found[0].similarity if found else 0.0
        alike = [self._placed(one, look) for one in found if one.similarity >= threshold]
        here = alike
        if at.known is not None:
            here = [one for one in alike if self._may_be(one.T_map_level @ look.T_level_lidar, at.known)]
            here = here or self._expected(look, at.known, threshold)
        at.scores["candidates"] = float(len(here))
        if here:
            return here, ""
        if alike:
            return [], f"the pose rules out all {len(alike)} that look alike (step 4)"
        return [], reason or f"similarity {at.scores['similarity']:.2f}, at least {threshold:.2f} needed (step 4)"

    def _placed(self, match: ContourMatch, look: Look) -> _Candidate:
        known = self._database.intersections[match.row]
        T = se3.exp(np.array([0.0, 0.0, match.yaw_rad, 0.0, 0.0, 0.0]))
        T[:3, 3] = known.point_map - T[:3, :3] @ look.point_level
        return _Candidate(known, match.similarity, T, match.yaw_rad)

    def _expected(self, look: Look, known: PoseFilter, threshold: float) -> list[_Candidate]:
        """Intersections that look as they should where the pose puts them, the most alike first.

        The point of a junction seen in part lies elsewhere than that of the whole, and so do its branches: around the
        point where it must be, the walls that are seen are in place.
        """
        T_map_level = known.T_map_lidar @ se3.inverse(look.T_level_lidar)
        points = se3.apply(se3.inverse(T_map_level), self._points)
        near = np.flatnonzero(np.linalg.norm(points, axis=1) < self._config.recognise_m)
        yaw = float(np.arctan2(T_map_level[1, 0], T_map_level[0, 0]))
        found: list[_Candidate] = []
        for row in near.tolist():
            one = self._database.intersections[row]
            seen = self._watch.contour_at(points[row, :2], one.contour.branches_rad - yaw)
            match = likeness_near(one.contour, seen, yaw, within_rad=_TURN_RAD, config=self._config)
            if match.similarity >= threshold:
                found.append(_Candidate(one, match.similarity, T_map_level, match.yaw_rad))
        return sorted(found, key=lambda one: -one.similarity)

    def _near(self, look: Look, known: PoseFilter) -> tuple[I64, str]:
        """Indices of the intersections that may lie where the junction is seen; why none when there is none."""
        c = self._all.prior_map
        seen = se3.apply(known.T_map_lidar, look.point_lidar[None])[0]
        turn, shift = known.covariance[:3, :3], known.covariance[3:, 3:]
        arm = float(np.linalg.norm(look.point_lidar))
        sigma = np.sqrt(np.trace(shift) + np.trace(turn) * arm**2 + c.seen_floor_m**2)
        away = np.linalg.norm(self._points - seen, axis=1)
        near = np.flatnonzero(away < c.max_moved_sigmas * sigma)
        if len(near):
            return near, ""
        nearest = f"{away.min():.0f} m from the nearest known one" if len(away) else "the database is empty"
        return near, f"seen {nearest}, at most {c.max_moved_sigmas * sigma:.0f} m allowed (step 4)"

    def _may_be(self, T_map_lidar: F64, known: PoseFilter) -> bool:
        """Before registration: an invariant point is known to some decimetres, its turn to some degrees."""
        c = self._all.prior_map
        away = known.sigmas_away(T_map_lidar, floor_m=c.seen_floor_m, floor_deg=c.seen_floor_deg)
        return away <= c.max_moved_sigmas

    def _told_apart(self, candidates: list[_Candidate], look: Look, at: _At) -> tuple[list[_Candidate], str]:
        """The candidates by how their matrices fit; of a flight whose pose is known one alone, or why none."""
        matrix = contour_matrix(self._watch.stacked(), look.junction.point_m, look.floor_m, self._config)
        ranked = sorted(
            (
                _Candidate(
                    one.known, one.similarity, one.T_map_level, one.yaw_rad,
                    matrix_likeness(one.known.matrix, matrix, one.yaw_rad, self._config),
                )
                for one in candidates[: self._config.max_candidates]
            ),
            key=lambda one: -one.matrix,
        )  # fmt: skip
        best = ranked[0]
        second = max((one.matrix for one in ranked if one.known.id != best.known.id), default=0.0)
        at.scores |= {"matrix": best.matrix, "matrix_second": second}
        if at.known is None:
            return ranked, ""
        if second and best.matrix - second < self._config.matrix_margin:
            apart = f"{best.matrix:.2f} and {second:.2f}, {self._config.matrix_margin:g} apart needed"
            return [], f"{len(candidates)} candidates are too much alike: {apart} (step 6)"
        return [best], ""

    def _all_verified(self, candidates: Sequence[_Candidate], look: Look, at: _At) -> list[Fix]:
        fixes = [self._verified(one, look, at) for one in candidates]
        trusted = [fix for fix in fixes if fix.trusted]
        if not trusted:
            return fixes[:1]
        # two turns of one intersection may end at the same pose
        kept: list[Fix] = []
        for fix in sorted(trusted, key=lambda one: -one.scores["inlier_ratio"]):
            if all(_apart_m(fix, other) > self._config.apart_m for other in kept):
                kept.append(fix)
        return kept

    def _verified(self, best: _Candidate, look: Look, at: _At) -> Fix:
        """Register all keyframes of the window to the stored cloud."""
        c = self._config
        T_lidar_level = se3.inverse(look.T_level_lidar)
        points = self._watch.stacked()
        around = se3.apply(best.T_map_level, points)[:, :2] - best.known.point_map[:2]
        near = np.linalg.norm(around, axis=1) < c.verify_radius_m
        points_lidar = se3.apply(T_lidar_level, points[near]).astype(np.float32)
        expected = best.T_map_level @ look.T_level_lidar
        turn, shift = np.radians(3.0), 0.5
        found = self._map_of(best.known).register(points_lidar, expected, np.diag([turn**2] * 3 + [shift**2] * 3))
        reason = self._doubt(found)
        # a partly seen intersection says less (METHOD D4)
        completeness = best.known.contour.walls / max(look.contour.walls, 1)
        noise = float(np.clip(completeness, 1.0, c.completeness_limit))
        return Fix(
            stamp_ns=at.keyframe.stamp_ns,
            keyframe=at.keyframe.index,
            T_map_lidar=found.T_map_lidar,
            covariance=noise * found.covariance,
            trusted=not reason,
            reason=reason,
            target=best.known.name,
            point_map=best.known.point_map,
            scores={
                **at.scores,
                "id": float(best.known.id),
                "matched_similarity": best.similarity,
                "completeness": 1.0 / max(completeness, 1e-9),
                "inlier_ratio": found.inlier_ratio,
                "residual_m": found.residual_m,
                "moved_m": found.moved_m,
            },
        )

    def _doubt(self, found: MapRegistration) -> str:
        c = self._config
        if found.inlier_ratio < c.verify_inlier_ratio:
            return f"inlier ratio {found.inlier_ratio:.2f}, at least {c.verify_inlier_ratio} needed (step 9)"
        if not found.residual_m <= c.verify_residual_m:
            return f"residual {found.residual_m:.3f} m, at most {c.verify_residual_m} m allowed (step 9)"
        # METHOD 5.1 (8): the translation must be held in every direction
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(found.covariance[3:, 3:])[-1]))
        if sigma_m > c.verify_sigma_m:
            return f"position known to {sigma_m:.2f} m in one direction, {c.verify_sigma_m} m needed (step 9)"
        return ""

    def _map_of(self, known: Intersection) -> PriorMap:
        """The stored cloud as patches; of the few that were needed last."""
        if known.id not in self._maps:
            self._maps[known.id] = PriorMap(_cloud_of(known), self._all.prior_map, self._all.odometry)
        self._maps.move_to_end(known.id)
        while len(self._maps) > _MAPS:
            self._maps.popitem(last=False)
        return self._maps[known.id]

    def _stop(self, at: _At, reason: str) -> Fix:
        """Refused before an intersection had a name: those before it no longer count."""
        self._same = {}
        return _refused(at, reason)


def _refused(at: _At, reason: str, *, target: str = "") -> Fix:
    stamp_ns, index = at.keyframe.stamp_ns, at.keyframe.index
    return Fix(stamp_ns, index, None, None, trusted=False, reason=reason, target=target, scores=dict(at.scores))


def _apart_m(one: Fix, other: Fix) -> float:
    assert one.T_map_lidar is not None
    assert other.T_map_lidar is not None
    turn = float(se3.angle_rad(se3.inverse(one.T_map_lidar) @ other.T_map_lidar))
    return float(np.linalg.norm(one.T_map_lidar[:3, 3] - other.T_map_lidar[:3, 3])) + 3.0 * turn


def _cloud_of(known: Intersection) -> MapCloud:
    """The stored cloud as a map of its own."""
    n = len(known.points_m)
    one = np.ones(n, np.int32)
    return MapCloud(
        origin_m=known.point_map,
        points_m=known.points_m,
        normals=known.normals,
        counts=one,
        visits=one,
        thickness_m=np.zeros(n, np.float32),
        near_m=np.zeros(n, np.float32),
        surface=np.zeros(n, np.uint8),
        voxel_m=0.1,
    )
