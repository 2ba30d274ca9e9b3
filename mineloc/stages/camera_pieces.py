"""The depth camera's share of a map: images fused with the LiDAR along the flight, added to the pieces of the map."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mineloc import se3
from mineloc.config import FusionConfig
from mineloc.data import F64, Calibration, DepthImage, OdometryStep
from mineloc.mapping.depth_fusion import DepthFusion
from mineloc.stages.map_pieces import MapPieces


class CameraPieces:
    """Watches a flight beside its `MapPieces` and adds what the camera saw, an image every `every_m`.

    Args:
        images: of the flight, in order of time.
        calibration: with a camera.
        config: fusion.
        pieces: where points go; told of each step before this.
    """

    def __init__(
        self, images: Iterator[DepthImage], calibration: Calibration, config: FusionConfig, pieces: MapPieces
    ) -> None:
        if calibration.T_body_camera is None:
            raise ValueError("a calibration without a camera")
        self._images, self._config, self._pieces = images, config, pieces
        self._T_lidar_camera: F64 = se3.inverse(calibration.T_body_lidar) @ calibration.T_body_camera
        self._fusion: DepthFusion | None = None
        self._next = next(images, None)
        self._before: OdometryStep | None = None
        self._last_m: F64 | None = None
        self.fused = 0

    def watch(self, step: OdometryStep) -> None:
        """Take the images that were exposed since the step before."""
        before, self._before = self._before, step
        while self._next is not None and self._next.stamp_ns <= step.stamp_ns:
            if before is not None and self._next.stamp_ns >= before.stamp_ns and step.trusted:
                self._take(self._next, before, step)
            self._next = next(self._images, None)

    def _take(self, image: DepthImage, before: OdometryStep, step: OdometryStep) -> None:
        stamps = np.array([before.stamp_ns, step.stamp_ns])
        poses = np.stack([before.T_odom_lidar, step.T_odom_lidar])
        T_odom_lidar = se3.interpolate(stamps, poses, np.array([image.stamp_ns]))[0]
        position = T_odom_lidar[:3, 3]
        near = self._last_m is not None and float(np.linalg.norm(position - self._last_m)) < self._config.every_m
        if near or step.points_lidar is None:
            return
        self._last_m = position
        if self._fusion is None or self._fusion.camera != image.camera:
            self._fusion = DepthFusion(self._config, image.camera)
        T_then_now = se3.inverse(T_odom_lidar) @ step.T_odom_lidar
        found = self._fusion.fuse(
            image, step.points_lidar, T_camera_lidar=se3.inverse(self._T_lidar_camera) @ T_then_now
        )
        points, _ = found.points(max_sigma_m=self._config.max_sigma_m)
        points_lidar = se3.apply(self._T_lidar_camera, points).astype(np.float32)
        self._pieces.add(points_lidar, T_odom_lidar)
        self.fused += 1
