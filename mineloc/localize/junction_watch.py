"""The first two steps of recognition, for all who recognise: keyframes laid over each other, a junction in them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import IntersectionsConfig
from mineloc.data import F32, F64, Keyframe, WallContour
from mineloc.places.branches import Junction, find_junctions
from mineloc.places.free_grid import FreeGrid, PlanView, free_grid, plan_view
from mineloc.places.wall_contour import wall_contour

_FLOOR_M = 2.5
"""Points so near an invariant point tell where the floor is there."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One keyframe of the window: its points in the axes of odometry, its plan, and where it is in odometry."""

    cloud_level: F32
    view: PlanView
    at_m: F64


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """The junction that the newest keyframe and those before it see.

    The level frame has its origin in the lidar and the axes of odometry, which is levelled.

    Attributes:
        junction: the nearest within reach, in the level frame of the newest keyframe.
        contour: PWCV around it, in that frame.
        floor_m: height of the floor at the invariant point, in that frame.
        T_level_lidar: (4, 4) of the newest keyframe.
    """

    junction: Junction
    contour: WallContour
    floor_m: float
    T_level_lidar: F64

    @property
    def point_level(self) -> F64:
        """(3,) geometric invariant point on the floor."""
        return np.array([*self.junction.point_m, self.floor_m])

    @property
    def point_lidar(self) -> F64:
        """(3,) the same in the keyframe's lidar frame: `t_l` of paper A."""
        return se3.apply(se3.inverse(self.T_level_lidar), self.point_level[None])[0]


class JunctionWatch:
    """Watches keyframes go by; says whether the newest sees a junction.

    Args:
        config: of window, grid, branches and contour.
    """

    def __init__(self, config: IntersectionsConfig) -> None:
        self._config = config
        self._window: deque[_Seen] = deque(maxlen=config.window_keyframes)
        self._free: FreeGrid | None = None

    def look(self, keyframe: Keyframe) -> Look | None:
        """Take the next keyframe; None when no junction is within `recognise_m`.

        Args:
            keyframe: with points; odometry levels it.
        """
        c = self._config
        level = se3.from_rt(keyframe.T_odom_lidar[:3, :3], np.zeros(3))
        at_m = keyframe.T_odom_lidar[:3, 3]
        cloud = se3.apply(level, keyframe.points_lidar).astype(np.float32)
        self._window.append(_Seen(cloud, plan_view(cloud, at_m[:2], c), at_m))
        grid = self._free = free_grid([seen.view for seen in self._window], at_m[:2], c)
        near = [one for one in find_junctions(grid, c) if np.linalg.norm(one.point_m) < c.recognise_m]
        if not near:
            return None
        junction = min(near, key=lambda one: float(np.linalg.norm(one.point_m)))
        contour = wall_contour(grid, junction.point_m, junction.branches_rad, c)
        return Look(junction, contour, self._floor_under(junction), level)

    def contour_at(self, point_level: F64, branches_rad: F64) -> WallContour:
        """PWCV around any place, (2,) in the level frame of the newest keyframe.

        Raises:
            ValueError: no keyframe was looked at yet.
        """
        if self._free is None:
            raise ValueError("nothing was seen yet")
        return wall_contour(self._free, point_level, branches_rad, self._config)

    def stacked(self) -> F64:
        """(n, 3) points of the window in the level frame of the newest keyframe (paper A, eq. 20)."""
        here = self._window[-1].at_m
        return np.concatenate([seen.cloud_level + (seen.at_m - here) for seen in self._window])

    def _floor_under(self, junction: Junction) -> float:
        heights: list[F64] = []
        for seen in self._window:
            moved = seen.at_m - self._window[-1].at_m
            away = seen.cloud_level[:, :2] - (junction.point_m - moved[:2]).astype(np.float32)
            near = np.einsum("ij,ij->i", away, away) < _FLOOR_M**2
            heights.append(seen.cloud_level[near, 2] + moved[2])
        found = np.concatenate(heights)
        if not len(found):
            found = self._window[-1].cloud_level[:, 2]
        return float(np.percentile(found, 5.0))
