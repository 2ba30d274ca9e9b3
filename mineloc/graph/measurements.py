"""What only the graph needs to know: a seen point whose place in the map is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.data import F64, Fix


@dataclass(frozen=True, slots=True, eq=False)
class PointFix:
    """A point seen from a keyframe and known in the map: paper A's intersection factor, A(22).

    Attributes:
        keyframe: index.
        point_map: (3,) where it is.
        point_lidar: (3,) where it was seen, `t_l`.
        covariance: (3, 3) of the difference in the map frame, metres² (METHOD D4, D7: what is uncertain about the
            sighting is in here).
    """

    keyframe: int
    point_map: F64
    point_lidar: F64
    covariance: F64

    def __post_init__(self) -> None:
        if self.point_map.shape != (3,) or self.point_lidar.shape != (3,) or self.covariance.shape != (3, 3):
            raise ValueError("point_map and point_lidar must be (3,), covariance (3, 3)")

    @staticmethod
    def of(fix: Fix) -> PointFix:
        """Only the place of what a fix recognised; without a point the lidar itself is the point.

        The sighting is where registration puts the point, and its covariance is the projection of the registration's
        (METHOD D8, D20): what paper A's eq. 29-31 mean.

        Raises:
            ValueError: the fix has no pose or no covariance.
        """
        if fix.T_map_lidar is None or fix.covariance is None:
            raise ValueError("a fix without pose or covariance")
        point = fix.T_map_lidar[:3, 3] if fix.point_map is None else fix.point_map
        seen = se3.apply(se3.inverse(fix.T_map_lidar), point[None])[0]
        J = point_jacobian(fix.T_map_lidar, seen)
        covariance = J @ fix.covariance @ J.T
        return PointFix(fix.keyframe, point, seen, 0.5 * (covariance + covariance.T))


def point_jacobian(T_map_lidar: F64, point_lidar: F64) -> F64:
    """(3, 6) of a point's place in the map by the pose, `[rotation, translation]`, right perturbation (METHOD D3)."""
    return T_map_lidar[:3, :3] @ np.hstack([-se3.hat(point_lidar), np.eye(3)])
