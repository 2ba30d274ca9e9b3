"""Poses over time, where the sensors sit, and who flew what."""

from __future__ import annotations

from dataclasses import dataclass, field
from dataclasses import replace as _replace

import numpy as np

from mineloc import se3
from mineloc.data.arrays import F64, I64
from mineloc.data.checks import freeze, is_rigid, need


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time: `poses[i]` is `T_parent_child` at `stamps_ns[i]`.

    Attributes:
        stamps_ns: (n,) int64, strictly increasing. Files without times use 0, 1, 2 …: see `timed`.
        poses: (n, 4, 4) float64 rigid transforms.
        parent, child: frame names.
        timed: False when the stamps are only a count (KITTI).
    """

    stamps_ns: I64
    poses: F64
    parent: str = "map"
    child: str = "body"
    timed: bool = True

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        need(self.stamps_ns.dtype == np.int64, "stamps_ns must be int64")
        need(self.poses.shape == (n, 4, 4), "poses must be (n, 4, 4)")
        need(n < 2 or bool((np.diff(self.stamps_ns) > 0).all()), "stamps_ns must increase strictly")
        need(is_rigid(self.poses), "poses must be finite rigid transforms")
        freeze(self)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions_m(self) -> F64:
        """(n, 3) positions of `child` in `parent`."""
        return self.poses[:, :3, 3]

    @property
    def path_m(self) -> F64:
        """(n,) distance travelled up to each pose, metres."""
        steps = np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])[: len(self)]

    def at(self, stamps_ns: I64) -> F64:
        """(m, 4, 4) poses interpolated at other times within the span."""
        return se3.interpolate(self.stamps_ns, self.poses, stamps_ns)

    def compose(self, *, left: F64 | None = None, right: F64 | None = None, child: str | None = None) -> Trajectory:
        """`left @ pose @ right` for every pose: a change of the parent or the child frame."""
        poses = self.poses if left is None else left @ self.poses
        poses = poses if right is None else poses @ right
        return _replace(self, poses=poses, child=self.child if child is None else child)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Where the sensors sit on the drone. Identity where a recording says nothing: then `body` is the LiDAR.

    Attributes:
        T_body_lidar, T_body_imu: (4, 4).
        T_body_camera: (4, 4) of the optical frame (x right, y down, z ahead); None without a camera.
    """

    T_body_lidar: F64 = field(default_factory=lambda: np.eye(4))
    T_body_imu: F64 = field(default_factory=lambda: np.eye(4))
    T_body_camera: F64 | None = None

    def __post_init__(self) -> None:
        need(is_rigid(self.T_body_lidar) and is_rigid(self.T_body_imu), "calibration must be rigid transforms")
        need(self.T_body_camera is None or is_rigid(self.T_body_camera), "calibration must be rigid transforms")
        freeze(self)

    @property
    def T_lidar_imu(self) -> F64:
        """Takes IMU coordinates to LiDAR coordinates."""
        return se3.inverse(self.T_body_lidar) @ self.T_body_imu


@dataclass(frozen=True, slots=True)
class FlightInfo:
    """Who flew what, where and when: the `mineloc.flight` metadata of a flight file. Empty text means unknown."""

    flight: str = ""
    site: str = ""
    level: str = ""
    drone: str = ""
    lidar: str = ""
    imu: str = ""
    operator: str = ""
    start_utc: str = ""
    calibration: str = ""
    source: str = ""
