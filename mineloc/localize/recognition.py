"""Recognition of intersections in flight: the nine steps of paper A (METHOD 1.6), each with its reason to stop."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F32, F64, Fix, Intersection, IntersectionDatabase, Keyframe, MapCloud, WallContour
from mineloc.localize.keyframe_clouds import levelled
from mineloc.localize.prior_map import MapRegistration, PriorMap
from mineloc.places.branches import Junction, find_junctions
from mineloc.places.contour_matrix import contour_matrix, matrix_likeness
from mineloc.places.free_grid import FreeGrid, free_grid
from mineloc.places.wall_contour import branches_fit, likeness_peaks, wall_contour

IsPossible = Callable[[F64], bool]
"""Whether the drone may be at a pose (4, 4) `T_map_lidar`: what is known of its position decides."""


_FLOOR_M = 2.5
"""Points so near an invariant point tell where the floor is there."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One keyframe of the window: its levelled points, and where its level frame is in odometry."""

    cloud_level: F32
    T_odom_level: F64


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    known: Intersection
    similarity: float
    T_map_level: F64
    yaw_rad: float


class Recognizer:
    """Watches keyframes go by and says which intersection of a database they see.

    Args:
        config: sections `intersections`, `prior_map`, `odometry`.
        database: of the mine.
    """

    def __init__(self, config: Config, database: IntersectionDatabase) -> None:
        self._all, self._config, self._database = config, config.intersections, database
        self._window: deque[_Seen] = deque(maxlen=config.intersections.window_keyframes)
        self._same_id, self._same = -1, 0
        self._maps: dict[int, PriorMap] = {}

    def follow(self, keyframe: Keyframe, is_possible: IsPossible) -> Fix:
        """Take the next keyframe; the fix tells what was recognised, or at which step recognition stopped.

        Args:
            keyframe: with points; odometry levels it.
            is_possible: from what is known of the position.
        """
        scores: dict[str, float] = {}
        here = self._prepared(keyframe)  # step 1
        junction, grid = self._junction(here)  # step 2
        if junction is None:
            return self._refused(keyframe, "no intersection within reach (step 2)", scores)
        scores["branches"] = float(len(junction.branches))
        contour = wall_contour(grid, junction.point_m, junction.branches_rad, self._config)  # step 3
        candidates = self._candidates(contour, junction, here, keyframe, is_possible, scores)  # step 4
        if not candidates:
            needed = self._database.contour_threshold
            reason = f"similarity {scores['similarity']:.2f}, at least {needed:.2f} needed (step 4)"
            return self._refused(keyframe, reason, scores)
        best = candidates[0] if len(candidates) == 1 else self._told_apart(candidates, junction, here, scores)  # 5, 6
        if best is None:
            return self._refused(keyframe, f"{len(candidates)} candidates are too much alike (step 6)", scores)
        self._same = self._same + 1 if best.known.id == self._same_id else 1  # step 7
        self._same_id = best.known.id
        scores["same"] = float(self._same)
        if self._same < self._config.same_needed:  # step 8
            reason = f"{self._same} keyframes agree, at least {self._config.same_needed} needed (step 8)"
            return self._refused(keyframe, reason, scores, target=best.known)
        self._same = 0
        return self._verified(best, keyframe, here, scores)  # step 9

    def _prepared(self, keyframe: Keyframe) -> _Seen:
        level = levelled(keyframe.T_odom_lidar)
        cloud = se3.apply(level, keyframe.points_lidar).astype(np.float32)
        seen = _Seen(cloud, se3.rigid(keyframe.T_odom_lidar @ se3.inverse(level)))
        self._window.append(seen)
        return seen

    def _junction(self, here: _Seen) -> tuple[Junction | None, FreeGrid]:
        back = se3.inverse(here.T_odom_level)
        grid = free_grid(
            [seen.cloud_level for seen in self._window],
            np.array([back @ seen.T_odom_level for seen in self._window]),
            self._config,
        )
        found = find_junctions(grid, self._config)
        near = [one for one in found if np.linalg.norm(one.point_m) < self._config.recognise_m]
        nearest = min(near, key=lambda one: float(np.linalg.norm(one.point_m)), default=None)
        return nearest, grid

    def _candidates(
        self,
        contour: WallContour,
        junction: Junction,
        here: _Seen,
        keyframe: Keyframe,
        is_possible: IsPossible,
        scores: dict[str, float],
    ) -> list[_Candidate]:
        """Intersections whose contour is like this one and that may be here, the most alike first."""
        floor_m = self._floor_under(junction, here)
        T_level_lidar = se3.inverse(here.T_odom_level) @ keyframe.T_odom_lidar
        within = np.radians(self._config.branch_match_deg)
        found: list[_Candidate] = []
        likest = 0.0
        for known in self._database.intersections:
            for similarity, yaw in likeness_peaks(known.contour, contour, self._config):
                if not branches_fit(known.contour.branches_rad, contour.branches_rad, yaw, within_rad=within):
                    continue
                T = se3.exp(np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0]))
                T[:3, 3] = known.point_map - T[:3, :3] @ np.array([*junction.point_m, floor_m])
                if not is_possible(T @ T_level_lidar):
                    continue
                likest = max(likest, similarity)
                if similarity >= self._database.contour_threshold:
                    found.append(_Candidate(known, similarity, T, yaw))
        scores["similarity"] = likest
        scores["candidates"] = float(len(found))
        return sorted(found, key=lambda one: -one.similarity)

    def _told_apart(
        self, candidates: list[_Candidate], junction: Junction, here: _Seen, scores: dict[str, float]
    ) -> _Candidate | None:
        """The candidate whose matrix fits best; None when another intersection fits nearly as well."""
        points = self._stacked(here)
        matrix = contour_matrix(points, junction.point_m, self._floor_under(junction, here), self._config)
        ranked = sorted(
            ((matrix_likeness(one.known.matrix, matrix, one.yaw_rad, self._config), one) for one in candidates),
            key=lambda pair: -pair[0],
        )
        best = ranked[0]
        others = [likeness for likeness, one in ranked if one.known.id != best[1].known.id]
        scores["matrix"] = best[0]
        scores["matrix_second"] = others[0] if others else 0.0
        return best[1] if not others or best[0] - others[0] >= self._config.matrix_margin else None

    def _verified(self, best: _Candidate, keyframe: Keyframe, here: _Seen, scores: dict[str, float]) -> Fix:
        """Register all keyframes of the window to the stored cloud."""
        T_lidar_level = se3.inverse(keyframe.T_odom_lidar) @ here.T_odom_level
        points = self._stacked(here)
        at = se3.apply(best.T_map_level, points)
        near = np.linalg.norm(at[:, :2] - best.known.point_map[:2], axis=1) < self._config.verify_radius_m
        points_lidar = se3.apply(T_lidar_level, points[near]).astype(np.float32)
        expected = best.T_map_level @ se3.inverse(T_lidar_level)
        turn, shift = np.radians(3.0), 0.5
        found = self._map_of(best.known).register(points_lidar, expected, np.diag([turn**2] * 3 + [shift**2] * 3))
        scores |= {"inlier_ratio": found.inlier_ratio, "residual_m": found.residual_m, "moved_m": found.moved_m}
        reason = self._doubt(found)
        return Fix(
            stamp_ns=keyframe.stamp_ns,
            keyframe=keyframe.index,
            T_map_lidar=found.T_map_lidar,
            covariance=found.covariance,
            trusted=not reason,
            reason=reason,
            target=best.known.name,
            scores=scores,
        )

    def _doubt(self, found: MapRegistration) -> str:
        c = self._config
        if found.inlier_ratio < c.verify_inlier_ratio:
            return f"inlier ratio {found.inlier_ratio:.2f}, at least {c.verify_inlier_ratio} needed (step 9)"
        if not found.residual_m <= c.verify_residual_m:
            return f"residual {found.residual_m:.3f} m, at most {c.verify_residual_m} m allowed (step 9)"
        return ""

    def _stacked(self, here: _Seen) -> F64:
        """(n, 3) points of the window in the level frame of the newest keyframe (paper A, eq. 20)."""
        back = se3.inverse(here.T_odom_level)
        return np.concatenate([se3.apply(back @ seen.T_odom_level, seen.cloud_level) for seen in self._window])

    def _floor_under(self, junction: Junction, here: _Seen) -> float:
        """Height of the floor at the invariant point, in the level frame."""
        points = self._stacked(here)
        near = np.linalg.norm(points[:, :2] - junction.point_m, axis=1) < _FLOOR_M
        return float(np.percentile(points[near, 2], 5.0)) if near.any() else float(np.percentile(points[:, 2], 5.0))

    def _map_of(self, known: Intersection) -> PriorMap:
        if known.id not in self._maps:
            n = len(known.points_m)
            one = np.ones(n, np.int32)
            cloud = MapCloud(
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
            self._maps[known.id] = PriorMap(cloud, self._all.prior_map, self._all.odometry)
        return self._maps[known.id]

    def _refused(
        self, keyframe: Keyframe, reason: str, scores: dict[str, float], *, target: Intersection | None = None
    ) -> Fix:
        if target is None:
            self._same_id, self._same = -1, 0
        name = "" if target is None else target.name
        stamp_ns, index = keyframe.stamp_ns, keyframe.index
        return Fix(stamp_ns, index, None, None, trusted=False, reason=reason, target=name, scores=scores)
