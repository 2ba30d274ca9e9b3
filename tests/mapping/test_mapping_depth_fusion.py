"""Depth fusion on drawn scenes: a camera that errs in disparity, LiDAR rows that do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mineloc.config import FusionConfig
from mineloc.data import CameraModel, DepthImage
from mineloc.mapping.depth_fusion import DepthFusion, FusedDepth
from mineloc.mapping.depth_projection import project
from mineloc.mapping.depth_smoothing import smooth_inverse_depth, smooth_plainly

CAMERA = CameraModel(160, 96, 90.0, 90.0, 79.5, 47.5)
PIXEL = 1.0 / (90.0 * 0.05)
RELIEF_M = FusionConfig().relief_m  # rock is not flat, and the fusion says so
NO_POINTS = np.zeros((0, 3), np.float32)


@dataclass(frozen=True)
class Scene:
    """`truth` (h, w) depth; a camera image of it and the points of LiDAR rows, in the camera's frame."""

    truth: np.ndarray
    image: DepthImage
    points: np.ndarray


def truth_of(kind: str) -> np.ndarray:
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    x, y = (u - CAMERA.cx_px) / CAMERA.fx_px, (v - CAMERA.cy_px) / CAMERA.fy_px
    if kind == "step":
        return np.where(u < 80, 2.0, 4.0).astype(float)
    # a roadway: walls at 2 m, floor and roof at 1.4 m, an end at 6 m
    with np.errstate(divide="ignore"):
        return np.minimum.reduce([2.0 / np.abs(x), 1.4 / np.abs(y), np.full(x.shape, 6.0)])


def scene(kind: str = "roadway", *, seed: int = 0, noise: float = 1.0) -> Scene:
    rng = np.random.default_rng(seed)
    relief = gaussian_filter(rng.standard_normal((CAMERA.height_px, CAMERA.width_px)), 1.5)
    truth = truth_of(kind) + noise * RELIEF_M * relief / relief.std()
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    patches = gaussian_filter(rng.standard_normal(truth.shape), 4)
    error_px = 0.08 * rng.standard_normal(truth.shape) + 0.05 * patches / patches.std()
    error_px += 0.15 * np.cos(u / 60 + 1) * np.cos(v / 50) + 0.1
    inverse = 1 / truth + noise * error_px * PIXEL
    depth = np.where(inverse > 0.05, 1 / inverse, 0.0)
    depth[30:40, 100:112] = 0.0
    rows, columns = np.meshgrid(np.arange(16, 80, 5), np.arange(0, CAMERA.width_px), indexing="ij")
    z = truth[rows, columns]
    ray = np.stack(
        [(columns - CAMERA.cx_px) / CAMERA.fx_px, (rows - CAMERA.cy_px) / CAMERA.fy_px, np.ones(z.shape)], -1
    )
    length = np.linalg.norm(ray, axis=-1)
    points = (ray / length[..., None]) * (z * length + noise * rng.normal(0, 0.02, z.shape))[..., None]
    return Scene(truth, DepthImage(0, depth.astype(np.float32), CAMERA), points.reshape(-1, 3).astype(np.float32))


def fused(what: Scene, points: np.ndarray | None = None) -> FusedDepth:
    return DepthFusion(FusionConfig(), CAMERA).fuse(
        what.image, what.points if points is None else points, T_camera_lidar=np.eye(4)
    )


def rmse(z: np.ndarray, what: Scene, mask: np.ndarray) -> float:
    return float(np.sqrt(np.mean((z - what.truth)[mask] ** 2)))


def test_the_fusion_beats_the_camera_and_says_how_sure_it_is() -> None:
    ratios, errors = [], []
    for seed in range(3):
        what = scene(seed=seed)
        found = fused(what)
        both = (what.image.depth_m > 0) & (found.depth_m > 0)
        ratios.append(rmse(found.depth_m, what, both) / rmse(what.image.depth_m, what, both))
        errors.append(((found.depth_m - what.truth) / found.sigma_m)[both])
        assert both.mean() > 0.98 * (what.image.depth_m > 0).mean()
    assert max(ratios) < 0.5
    e = np.concatenate(errors)
    # the drawn patches are smoother than an exponential covariance: here the fusion is a little too careful
    assert 0.7 < np.sqrt(np.mean(e**2)) < 1.25


def test_without_lidar_the_camera_remains_and_is_less_sure() -> None:
    what = scene()
    alone, both = fused(what, NO_POINTS), fused(what)
    known = what.image.depth_m > 0
    assert (alone.depth_m[known] > 0).all()
    assert np.median(alone.sigma_m[known]) > 2 * np.median(both.sigma_m[known])
    e = ((alone.depth_m - what.truth) / alone.sigma_m)[known]
    # the prior of the drift is wider than this camera's error
    assert 0.1 < np.sqrt(np.mean(e**2)) < 1.5


def test_without_depth_the_lidar_fills_its_neighbourhood() -> None:
    what = scene(noise=0.0)
    blind = DepthImage(0, np.zeros_like(what.image.depth_m), CAMERA)
    found = DepthFusion(FusionConfig(), CAMERA).fuse(blind, what.points, T_camera_lidar=np.eye(4))
    known = found.depth_m > 0
    assert 0.3 < known.mean() < 0.9
    assert np.median(np.abs(found.depth_m - what.truth)[known]) < 0.02
    assert np.isinf(found.sigma_m[~known]).all()


def test_nothing_is_mixed_across_an_edge() -> None:
    what = scene("step", noise=0.3)
    found = fused(what)
    near, far = found.depth_m[:, 60:80], found.depth_m[:, 80:100]
    assert np.abs(near[near > 0] - 2.0).max() < 0.25
    assert np.abs(far[far > 0] - 4.0).max() < 0.8


def test_an_empty_image_and_no_points_give_nothing() -> None:
    blind = DepthImage(0, np.zeros((96, 160), np.float32), CAMERA)
    found = DepthFusion(FusionConfig(), CAMERA).fuse(blind, NO_POINTS, T_camera_lidar=np.eye(4))
    assert not found.depth_m.any()
    assert np.isinf(found.sigma_m).all()
    points, sigma = found.points(max_sigma_m=0.1)
    assert points.shape == (0, 3)
    assert sigma.shape == (0,)


def test_the_order_of_the_points_does_not_matter() -> None:
    what = scene()
    mixed = np.random.default_rng(1).permutation(what.points)
    assert fused(what, mixed).depth_m == pytest.approx(fused(what).depth_m, abs=2e-3)


def test_points_lie_where_their_pixels_look() -> None:
    what = scene(noise=0.0)
    points, _ = fused(what).points(max_sigma_m=0.05)
    again = project(points, np.eye(4), CAMERA)
    assert np.abs(again.places_px - np.rint(again.places_px - 0.5) - 0.5).max() < 1e-2
    assert len(points) > 1000


def test_the_nearest_point_of_a_pixel_hides_the_others() -> None:
    points = np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 2.0], [0.0, 0.0, -1.0], [99.0, 0.0, 1.0]], np.float32)
    camera = CameraModel(3, 3, 10.0, 10.0, 1.0, 1.0)
    found = project(points, np.eye(4), camera)
    assert found.inverse_depth.tolist() == [0.5]
    assert (found.row[0], found.column[0]) == (1, 1)


def test_smoothing_is_the_plain_version_and_bends_no_plane() -> None:
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:20, :24]
    plane = (0.3 + 0.002 * u - 0.001 * v).astype(np.float32)
    law = {"sigma": 0.01, "half_px": 3, "edge_sigmas": 4.0, "edge_slope": 0.03}
    smooth, left = smooth_inverse_depth(plane, **law)
    assert smooth == pytest.approx(plane, abs=1e-5)
    assert left[10, 12] == pytest.approx(1 / 49, rel=1e-3)
    noisy = (plane + rng.normal(0, 0.01, plane.shape)).astype(np.float32)
    noisy[rng.random(plane.shape) < 0.2] = 0.0
    noisy[:, 12:] += np.where(noisy[:, 12:] > 0, 0.3, 0.0).astype(np.float32)
    smooth, left = smooth_inverse_depth(noisy, **law)
    expected, share = smooth_plainly(noisy, **law)
    assert smooth == pytest.approx(expected, abs=2e-4)
    assert left == pytest.approx(share, rel=2e-3)
