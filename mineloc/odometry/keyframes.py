"""Which sweeps become nodes of the pose graph (paper A, eq. 8-9; METHOD 1.3)."""

from __future__ import annotations

import math

import numpy as np

from mineloc import se3
from mineloc.config import KeyframeConfig
from mineloc.data import F64


class KeyframeSelector:
    """Decides, sweep by sweep: the first one, then each that has moved or turned far enough from the last keyframe.

    Args:
        config: `distance_m` (ε_t) and `angle_deg` (ε_θ).

    Attributes:
        index: of the last keyframe, -1 before the first.
        T_before_last: (4, 4) pose of the last keyframe in the frame of the one before, None before the second.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self._distance_m = config.distance_m
        self._angle_rad = math.radians(config.angle_deg)
        self._stamp_ns: int | None = None
        self._T_odom_last: F64 = np.eye(4)
        self.index = -1
        self.T_before_last: F64 | None = None

    def consider(self, stamp_ns: int, T_odom_lidar: F64) -> bool:
        """Whether this pose becomes a keyframe; if so it is the last one from now on.

        Args:
            stamp_ns: time of the pose.
            T_odom_lidar: (4, 4).

        Raises:
            ValueError: the time is not after the last keyframe's.
        """
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            raise ValueError(f"pose at {stamp_ns} ns is not after the keyframe at {self._stamp_ns} ns")
        moved = se3.inverse(self._T_odom_last) @ T_odom_lidar
        if self._stamp_ns is not None and not self._far(moved):
            return False
        self.T_before_last = None if self._stamp_ns is None else moved
        self.index += 1
        self._stamp_ns = stamp_ns
        self._T_odom_last = T_odom_lidar.copy()
        return True

    def _far(self, moved: F64) -> bool:
        distance_m = float(np.linalg.norm(moved[:3, 3]))  # A(9)
        return distance_m > self._distance_m or float(se3.angle_rad(moved)) > self._angle_rad
