"""Where the sensors sit, from `/tf_static`, if its frames can be recognised."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any, cast

import numpy as np

from mineloc import se3
from mineloc.data import F64, Calibration

# In the order in which they are believed to be the drone itself.
_BODIES = ("body", "base_link", "base", "drone", "uav", "base_footprint")


class StaticFrames:
    """The tree of frames that never move against each other."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, F64]] = {}

    @property
    def empty(self) -> bool:
        """Whether nothing is known."""
        return not self._edges

    def add(self, message: object) -> None:
        """Take a decoded tf2_msgs/TFMessage; transforms that are not rigid are left out."""
        for transform in cast("Iterable[Any]", cast("Any", message).transforms):
            t, q = transform.transform.translation, transform.transform.rotation
            xyzw = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
            xyz = np.array([t.x, t.y, t.z], dtype=np.float64)
            if not (np.isfinite(xyz).all() and abs(np.linalg.norm(xyzw) - 1.0) < 1e-2):
                continue
            parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            T_parent_child = se3.from_xyzw(xyz, xyzw)
            self._edges.setdefault(parent, {})[child] = T_parent_child
            self._edges.setdefault(child, {})[parent] = se3.inverse(T_parent_child)

    def between(self, parent: str, child: str) -> F64 | None:
        """`T_parent_child` along the tree, None if nothing connects them."""
        reached = {parent: np.eye(4)}
        ahead = deque([parent])
        while ahead:
            at = ahead.popleft()
            if at == child:
                return reached[at]
            for following, T_at_following in self._edges.get(at, {}).items():
                if following not in reached:
                    reached[following] = reached[at] @ T_at_following
                    ahead.append(following)
        return None

    def calibration(self, lidar_frame: str, imu_frame: str, camera_frame: str = "") -> tuple[Calibration, str] | None:
        """Mountings of the sensors, and which frame counts as the body; None if no frame is known.

        Without a frame that is a drone's, `body` is the LiDAR. LiDAR and IMU that the tree does not reach sit at
        `body`; a camera must be placed against the LiDAR to be placed at all.

        Args:
            lidar_frame, imu_frame, camera_frame: `header.frame_id` of the sensors' messages, empty if there is no such
                sensor.
        """
        for body in _BODIES:
            T_body_lidar = self.between(body, lidar_frame) if lidar_frame else None
            T_body_imu = self.between(body, imu_frame) if imu_frame else None
            if T_body_lidar is not None or T_body_imu is not None:
                known = [np.eye(4) if T is None else T for T in (T_body_lidar, T_body_imu)]
                with_camera = camera_frame and (T_body_lidar is not None or not lidar_frame)
                return Calibration(known[0], known[1], self.between(body, camera_frame) if with_camera else None), body
        if not lidar_frame:
            return None
        T_lidar_imu = self.between(lidar_frame, imu_frame) if imu_frame else None
        T_lidar_camera = self.between(lidar_frame, camera_frame) if camera_frame else None
        if T_lidar_imu is None and T_lidar_camera is None:
            return None
        return Calibration(np.eye(4), np.eye(4) if T_lidar_imu is None else T_lidar_imu, T_lidar_camera), lidar_frame


def frame_name(name: object) -> str:
    """A frame without the slash that ROS 1 put before it."""
    return str(name).lstrip("/")
