"""What the depth camera adds to the pieces of a map, in front of one wall."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mineloc import se3
from mineloc.config import FusionConfig
from mineloc.data import Calibration, CameraModel, DepthImage, Keyframe, OdometryStep
from mineloc.stages.camera_pieces import CameraPieces
from mineloc.stages.map_pieces import MapPieces

CAMERA = CameraModel(120, 80, 70.0, 70.0, 59.5, 39.5)
# optical axes seen from the body: z ahead is x, x right is -y, y down is -z
T_BODY_CAMERA = se3.from_rt(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [0.1, 0.0, -0.1])
CALIBRATION = Calibration(T_body_camera=T_BODY_CAMERA)
WALL_M = 4.0


def pose_at(t_ns: int) -> np.ndarray:
    """Towards the wall with 2 m/s."""
    return se3.from_rt(np.eye(3), [2.0 * t_ns * 1e-9, 0.0, 0.0])


def image_at(t_ns: int) -> DepthImage:
    distance = WALL_M - (pose_at(t_ns) @ T_BODY_CAMERA)[0, 3]
    return DepthImage(t_ns, np.full((80, 120), distance, np.float32), CAMERA)


def steps(*, trusted: bool = True) -> Iterator[OdometryStep]:
    y, z = np.meshgrid(np.linspace(-3, 3, 80), np.linspace(-1, 1, 16))
    for k in range(11):
        T = pose_at(k * 10**8)
        wall = np.column_stack([np.full(y.size, WALL_M), y.ravel(), z.ravel()])
        points = se3.apply(se3.inverse(T), wall).astype(np.float32)
        keyframe = Keyframe(k // 5, k * 10**8, T, points) if k % 5 == 0 else None
        reason = "" if trusted else "lost"
        yield OdometryStep(k * 10**8, T, trusted, reason, keyframe, points_lidar=points)


def gathered(path: Path, images: list[DepthImage], *, trusted: bool = True) -> tuple[CameraPieces, np.ndarray]:
    pieces = MapPieces(path / "points", voxel_m=0.05, max_range_m=20.0)
    camera = CameraPieces(iter(images), CALIBRATION, FusionConfig(), pieces)
    for step in steps(trusted=trusted):
        pieces.watch(step)
        camera.watch(step)
    pieces.close()
    placed = [se3.apply(pose_at(5 * keyframe * 10**8), points) for keyframe, points in pieces]
    return camera, np.concatenate([np.zeros((0, 3)), *placed])


def test_the_cameras_points_lie_on_the_wall_between_the_sweeps(tmp_path: Path) -> None:
    images = [image_at(t) for t in range(130_000_000, 1_000_000_000, 200_000_000)]
    camera, points = gathered(tmp_path, images)
    _, alone = gathered(tmp_path, [])
    assert camera.fused == 2  # one a metre, at 2 m/s for a second
    assert len(points) > 3 * len(alone)
    assert np.abs(points[:, 0] - WALL_M).max() < 0.02
    # above and below the rows of the LiDAR too
    assert np.abs(points[:, 2]).max() > 1.2 > np.abs(alone[:, 2]).max()


def test_images_before_after_and_of_doubtful_sweeps_are_left_out(tmp_path: Path) -> None:
    camera, points = gathered(tmp_path, [image_at(-50_000_000), image_at(2_000_000_000)])
    _, alone = gathered(tmp_path, [])
    assert camera.fused == 0
    assert len(points) == len(alone)
    assert gathered(tmp_path, [image_at(130_000_000)], trusted=False)[0].fused == 0


def test_a_camera_without_a_place_is_a_callers_mistake(tmp_path: Path) -> None:
    pieces = MapPieces(tmp_path / "points", voxel_m=0.05, max_range_m=20.0)
    with pytest.raises(ValueError, match="camera"):
        CameraPieces(iter([]), Calibration(), FusionConfig(), pieces)
    pieces.close()


def test_pieces_keep_what_belongs_to_a_keyframe_and_thin_what_hovers(tmp_path: Path) -> None:
    pieces = MapPieces(tmp_path / "points", voxel_m=0.5, max_range_m=5.0)
    near, far = np.zeros((1, 3), np.float32), np.full((1, 3), 9.0, np.float32)
    key = Keyframe(0, 0, np.eye(4), near)
    pieces.watch(OdometryStep(0, np.eye(4), trusted=True, keyframe=key, points_lidar=np.concatenate([near, far])))
    for k in range(1, 5):
        pieces.watch(OdometryStep(k, np.eye(4), trusted=True, points_lidar=near))
    pieces.watch(OdometryStep(6, np.eye(4), trusted=False, reason="lost", points_lidar=near + np.float32(1)))
    pieces.close()
    found = list(pieces)
    assert [keyframe for keyframe, _ in found] == [0]
    assert found[0][1].tolist() == [[0.0, 0.0, 0.0]]
