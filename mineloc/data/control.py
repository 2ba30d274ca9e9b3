"""Survey control: targets whose coordinates in the mine grid are known, and what a flight saw of them.

The frame `grid` is the mine's: easting, northing, height, metres, z up. Its numbers are large (N 7 100 000 m), so it is
float64 everywhere; `local` is the grid less an origin in whole kilometres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mineloc.data.arrays import F64
from mineloc.data.checks import freeze, need

Role = Literal["control", "check"]


@dataclass(frozen=True, slots=True, eq=False)
class ControlPoint:
    """A surveyed target.

    Attributes:
        name: unique within a survey.
        position_grid: (3,) easting, northing, height.
        sigma_m: of easting and of northing, one standard deviation.
        sigma_z_m: of the height.
        role: control points place the map, check points are kept apart to judge it.
        tag_id: of the tag36h11 AprilTag whose centre it is; None without one.
        tag_size_m: edge of the tag's black square; None without a tag.
    """

    name: str
    position_grid: F64
    sigma_m: float
    sigma_z_m: float
    role: Role
    tag_id: int | None = None
    tag_size_m: float | None = None

    def __post_init__(self) -> None:
        need(is_plain(self.name), "a control point has a name of printable characters that does not begin with #")
        need(self.position_grid.shape == (3,), "position_grid must be (3,)")
        need(bool(np.isfinite(self.position_grid).all()), "position_grid must be finite")
        need(0 < self.sigma_m < np.inf and 0 < self.sigma_z_m < np.inf, "sigmas must be positive")
        need((self.tag_id is None) == (self.tag_size_m is None), "a tag has an id and a size")
        freeze(self)

    @property
    def covariance_grid(self) -> F64:
        """(3, 3) of the surveyed position, metres²."""
        return np.diag(np.square([self.sigma_m, self.sigma_m, self.sigma_z_m]))


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """A target seen in flight, by hand in a sweep's points or as an AprilTag.

    Attributes:
        target: name of the control point.
        flight: name of the flight; empty where there is but one.
        stamp_ns: the time at which the lidar was where the coordinates say.
        point_lidar: (3,) the target in the lidar frame of that time.
        covariance_lidar: (3, 3) of the picking or detection alone, metres², in the same frame.
    """

    target: str
    flight: str
    stamp_ns: int
    point_lidar: F64
    covariance_lidar: F64

    def __post_init__(self) -> None:
        need(bool(self.target), "an observation names its target")
        need(self.point_lidar.shape == (3,) and self.covariance_lidar.shape == (3, 3), "a point has three coordinates")
        need(bool(np.isfinite(self.point_lidar).all()), "point_lidar must be finite")
        need(bool(np.linalg.eigvalsh(self.covariance_lidar)[0] > 0), "covariance_lidar must be positive definite")
        freeze(self)

    @staticmethod
    def picked(target: str, flight: str, stamp_ns: int, point_lidar: F64, *, sigma_m: float) -> Observation:
        """An observation that is as good in every direction."""
        return Observation(target, flight, stamp_ns, point_lidar, np.eye(3) * sigma_m**2)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of one coordinate, the mean of all directions."""
        return float(np.sqrt(np.trace(self.covariance_lidar) / 3.0))


def is_plain(name: str) -> bool:
    """Whether a name can stand in a line of a file: printable, no blanks around it, no `#` before it."""
    return bool(name) and name.isprintable() and name == name.strip() and not name.startswith("#")


def z_up_from_y_up(points: F64) -> F64:
    """(n, 3) or (3,) points of a frame with y up in one with z up: (x, −z, y). Paper A, Table II (METHOD 1.11, D9)."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)
