from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mineloc import se3
from mineloc.config import SimulateConfig
from mineloc.data import CameraModel
from mineloc.sim.camera_mount import BASELINE_M, camera_model, camera_mounting, pixel_rays
from mineloc.sim.depth_camera import (
    NEAREST_M,
    STEP_PX,
    DepthCamera,
    DepthErrors,
    DepthView,
    hidden_from_right,
    smooth_field,
)
from mineloc.sim.flight import START_NS, SimulatedFlight
from mineloc.sim.machine import SIZE_M
from mineloc.sim.mine import Mine
from mineloc.sim.scene import Scene

EXACT = DepthErrors(0.0, 0.0, 0.0, 1e3, 0.0)
TYPICAL = DepthErrors(0.08, 0.05, 0.15, 8.0, 0.01)
SMALL = CameraModel(64, 36, 300.0, 310.0, 31.5, 17.5)
# a room around (0, 0, 0), far from the origin of a mine grid: walls at x, y, z
LOW, HIGH = np.array([-3.0, -1.0, -1.2]), np.array([5.0, 2.0, 1.7])
GRID_M = np.array([400_000.0, 5_000_000.0, 300.0])
AHEAD = se3.from_rt(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), GRID_M)


def _box(low: np.ndarray, high: np.ndarray) -> Scene:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Scene(low + corners * (high - low), triangles, threads=1)


@pytest.fixture(scope="module")
def room() -> Scene:
    return _box(LOW + GRID_M, HIGH + GRID_M)


def _camera(scene: Scene, errors: DepthErrors, camera: CameraModel = SMALL, *, seed: int = 0) -> DepthCamera:
    return DepthCamera(scene, camera, errors, np.random.default_rng(seed))


def _wall(z_m: float, camera: CameraModel = SMALL, *, cosine: float = 1.0) -> DepthView:
    """A plane across the optical axis, as if met under one angle everywhere."""
    shape = (camera.height_px, camera.width_px)
    return DepthView(np.full(shape, z_m), np.full(shape, cosine))


def _errors_px(camera: DepthCamera, z_m: float, *, images: int) -> np.ndarray:
    """(images, height, width) errors of the disparity of a wall where both imagers see it, NaN where it is lost."""
    rng = np.random.default_rng(4)
    depth = np.array([camera.measure(_wall(z_m), rng) for _ in range(images)], np.float64)[:, :, 20:]
    depth[depth == 0] = np.nan
    assert np.isnan(depth).mean() < 1e-3
    focal_base = SMALL.fx_px * BASELINE_M
    return focal_base / depth - focal_base / z_m


@pytest.fixture(scope="module")
def flown(tee: Mine) -> SimulatedFlight:
    return SimulatedFlight(tee, SimulateConfig(length_m=25, seed=2, camera=True, hover_s=1))


@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
@settings(max_examples=15, deadline=None)
def test_depth_is_where_rays_leave_the_room(room, tangent):
    """Slab by slab, pixel by pixel: along the optical axis, not along the ray."""
    moved = np.array(tangent) * [1, 1, 1, 0.8, 0.8, 0.8]
    T = AHEAD @ se3.exp(moved)
    view = _camera(room, EXACT).look(T)
    eye = T[:3, 3] - GRID_M
    for v in range(0, 36, 7):
        for u in range(0, 64, 9):
            ray = T[:3, :3] @ [(u - 31.5) / 300.0, (v - 17.5) / 310.0, 1.0]
            ahead = [((HIGH if r > 0 else LOW)[a] - eye[a]) / r for a, r in enumerate(ray) if abs(r) > 1e-9]
            # float32 rays around a scene of some metres
            assert view.depth_m[v, u] == pytest.approx(min(ahead), rel=1e-5)


def test_right_is_right_and_down_is_down(room):
    """The near wall of the room is at y = -1, right of who looks along x; its floor is nearer than its roof."""
    wide = CameraModel(90, 60, 20.0, 20.0, 44.5, 29.5)
    T = se3.from_rt(np.eye(3), GRID_M) @ camera_mounting()
    depth = _camera(room, EXACT, wide).look(T).depth_m
    assert depth[30, -1] < depth[30, 0] < depth[30, 45]
    assert depth[-1, 45] < depth[0, 45] < depth[30, 45]
    assert depth[30, 45] == pytest.approx(5.0 - 0.12, abs=0.15)


def test_geometry_is_that_of_the_sheet():
    camera = camera_model("848x480")
    half = np.rad2deg(np.arctan2(424.0, camera.fx_px)), np.rad2deg(np.arctan2(240.0, camera.fy_px))
    assert 2 * half[0] == pytest.approx(87.0)
    assert 2 * half[1] == pytest.approx(58.0, abs=2.0)
    small = camera_model("424x240")
    assert small.fx_px == pytest.approx(camera.fx_px / 2)
    rays = pixel_rays(small)
    np.testing.assert_allclose(rays[::239, ::423, :2].sum(axis=(0, 1)), 0.0, atol=1e-12)


@pytest.mark.parametrize("z_m", [1.0, 2.0, 4.0])
def test_errors_are_those_of_a_disparity(room, z_m):
    """On a wall: the mean over many images is the bias, the scatter is the noise, and in depth it grows as z²."""
    camera = _camera(room, DepthErrors(0.08, 0.05, 0.15, 1e3, 0.0))
    error = _errors_px(camera, z_m, images=300)
    # the mean of 300 has a deviation of 0.0055 px
    assert np.abs(np.nanmean(error, axis=0) - camera.bias_px[:, 20:]).max() < 0.03
    sigma = np.sqrt(0.08**2 + 0.05**2 + STEP_PX**2 / 12)
    assert np.nanstd(error, axis=0).mean() == pytest.approx(sigma, rel=0.03)
    focal_base = SMALL.fx_px * BASELINE_M
    depth = focal_base / (error - camera.bias_px[:, 20:] + focal_base / z_m)
    assert np.nanstd(depth) == pytest.approx(z_m**2 * sigma / focal_base, rel=0.05)


def test_a_part_of_the_noise_goes_in_patches(room):
    camera = _camera(room, DepthErrors(0.08, 0.05, 0.0, 1e3, 0.0))
    error = _errors_px(camera, 2.0, images=200)
    beside = np.nanmean(error[:, :, :-1] * error[:, :, 1:])
    away = np.nanmean(error[:, :, :-15] * error[:, :, 15:])
    # white noise has none of it; Gaussian patches of 3 px keep exp(-1/36) a pixel farther
    assert beside == pytest.approx(0.05**2 * np.exp(-1 / 36), rel=0.1)
    assert abs(away) < 0.1 * beside


def test_the_bias_is_smooth_and_stays(room):
    one, other = _camera(room, TYPICAL, seed=1), _camera(room, TYPICAL, seed=2)
    assert np.sqrt((one.bias_px**2).mean()) == pytest.approx(0.15)
    assert np.sqrt(((one.bias_px - other.bias_px) ** 2).mean()) > 0.05
    for seed in range(10):
        field = smooth_field(camera_model("424x240"), np.random.default_rng(seed))
        assert np.sqrt((field**2).mean()) == pytest.approx(1.0)
        # no mode has more than three half waves from side to side
        assert all(np.sqrt((np.diff(field, axis=a) ** 2).mean()) < 3 * np.pi / field.shape[a] for a in (0, 1))


def test_depth_is_whole_millimetres_of_whole_steps(room):
    camera = _camera(room, EXACT)
    z = np.linspace(0.5, 9.0, 64 * 36).reshape(36, 64)[:, ::-1]
    depth = camera.measure(DepthView(z, np.ones_like(z)), np.random.default_rng(0)).astype(np.float64)
    known = depth > 0
    assert known.mean() > 0.5
    np.testing.assert_allclose(depth * 1000, np.rint(depth * 1000), atol=1e-3)
    focal_base = SMALL.fx_px * BASELINE_M
    steps = np.rint(focal_base / z / STEP_PX) * STEP_PX
    assert np.abs(depth - focal_base / steps)[known].max() <= 0.0005 + 1e-6


def test_depth_is_lost_far_away_and_near(room):
    wide = CameraModel(256, 200, 300.0, 300.0, 127.5, 99.5)
    camera = _camera(room, DepthErrors(0.0, 0.0, 0.0, 8.0, 0.0), wide)
    rng = np.random.default_rng(1)

    def known(z_m: float, cosine: float = 1.0) -> float:
        seen = [camera.measure(_wall(z_m, wide, cosine=cosine), rng)[:, 80:] > 0 for _ in range(5)]
        return float(np.mean(seen))

    shares = [known(z) for z in (2.0, 6.0, 7.0, 8.0, 9.0, 11.0)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.999
    assert shares[1] > 0.9
    # holes come in patches: some hundred independent ones in five images
    assert shares[3] == pytest.approx(0.5, abs=0.05)
    assert shares[5] < 0.05
    assert known(np.inf) == 0.0
    assert known(NEAREST_M - 0.01) == 0.0
    assert known(NEAREST_M + 0.05) > 0.999
    slanted = [known(2.0, cosine) for cosine in (0.5, 0.2, 0.1, 0.05)]
    assert slanted == sorted(slanted, reverse=True)
    assert slanted[0] > 0.99
    assert slanted[2] == pytest.approx(0.5, abs=0.05)


def test_speckles_are_lost_by_chance(room):
    camera = _camera(room, DepthErrors(0.0, 0.0, 0.0, 1e3, 0.03))
    lost = [camera.measure(_wall(2.0), np.random.default_rng(i))[:, 20:] == 0 for i in range(20)]
    # 32 000 pixels: a deviation of 0.001
    assert np.mean(lost) == pytest.approx(0.03, abs=0.004)
    assert np.abs(np.mean(lost, axis=0) - 0.03).max() < 0.4


def _hidden_plainly(disparity: np.ndarray) -> np.ndarray:
    out = np.zeros(disparity.shape, bool)
    for v, row in enumerate(disparity):
        for u, d in enumerate(row):
            covers = any(w - row[w] < u - d for w in range(u + 1, len(row)))
            out[v, u] = covers or u - d < 0
    return out


@given(hnp.arrays(np.float64, (2, 12), elements=st.floats(0, 6)))
def test_hidden_is_what_something_nearer_covers(disparity):
    np.testing.assert_array_equal(hidden_from_right(disparity), _hidden_plainly(disparity))


def test_a_band_beside_a_near_thing_is_hidden():
    """Left of it, as wide as the disparities differ: the right imager looks past its left edge from the right."""
    disparity = np.full((1, 60), 3.0)
    disparity[0, 30:45] = 10.0
    hidden = np.flatnonzero(hidden_from_right(disparity)[0])
    np.testing.assert_array_equal(hidden, [0, 1, 2, *range(24, 30)])


def test_depth_lies_on_the_walls_of_the_flight(flown, tee):
    """Truth taken to the map by the calibration lies on the mesh, at any time of the flight."""
    T_body_camera = flown.calibration.T_body_camera
    for stamp_ns in (START_NS + 1, START_NS + 4_123_456_789, START_NS + 7_000_000_000):
        truth = flown.true_depth(stamp_ns)
        depth = truth.depth_m[::40, ::40].astype(np.float64)
        points = (pixel_rays(truth.camera)[::40, ::40] * depth[..., None])[depth > 0]
        assert len(points) > 50
        T = flown.pose(np.array([stamp_ns]))[0] @ T_body_camera
        assert np.linalg.norm(se3.apply(T, points) - tee.scene.nearest_m(se3.apply(T, points)), axis=1).max() < 2e-3


def test_camera_and_lidar_see_the_same_walls(flown):
    """The points of a sweep, moved to the time of an image and put into it, have the depth that the image tells."""
    image = flown.depth_image(20)
    truth = flown.true_depth(image.stamp_ns)
    camera, T_body_camera = image.camera, flown.calibration.T_body_camera
    sweep = flown.sweep((image.stamp_ns - START_NS) // 100_000_000)
    T_map_lidar = flown.pose(sweep.stamp_ns + sweep.offsets_ns) @ flown.calibration.T_body_lidar
    points = np.einsum("nij,nj->ni", T_map_lidar[:, :3, :3], sweep.points_lidar.astype(float)) + T_map_lidar[:, :3, 3]
    x, y, z = se3.apply(se3.inverse(flown.pose(np.array([image.stamp_ns]))[0] @ T_body_camera), points).T
    ahead = z > 0.5
    u = np.rint(camera.fx_px * x[ahead] / z[ahead] + camera.cx_px).astype(int)
    v = np.rint(camera.fy_px * y[ahead] / z[ahead] + camera.cy_px).astype(int)
    inside = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    assert inside.sum() > 1000
    z, u, v = z[ahead][inside], u[inside], v[inside]
    off = np.abs(truth.depth_m[v, u] - z)
    # the LiDAR's noise of some centimetres, and half a pixel on a slanted wall
    assert np.median(off) < 0.04
    assert np.quantile(off, 0.9) < 0.15
    known = image.depth_m[v, u] > 0
    near = known & (z < 4.0)
    focal_base = camera.fx_px * BASELINE_M
    px = focal_base / image.depth_m[v, u][near] - focal_base / z[near]
    # noise 0.09 px, bias 0.15 px, the LiDAR's error
    assert near.sum() > 300
    assert np.sqrt(np.mean(np.clip(px, -1, 1) ** 2)) < 0.3


def test_images_are_the_same_however_they_are_asked_for(flown, tee):
    packets = [packet for _, packet in zip(range(6), flown.packets(), strict=False)]
    images = [image for packet in packets for image in packet.depth]
    assert [i.stamp_ns for i in images] == [START_NS + 13_000_000 + k * 200_000_000 for k in range(3)]
    assert [len(p.depth) for p in packets] == [1, 0] * 3
    np.testing.assert_array_equal(images[2].depth_m, flown.depth_image(2).depth_m)
    assert (images[1].depth_m != images[2].depth_m).any()
    # the camera changes nothing else
    blind = SimulatedFlight(tee, flown.config.model_copy(update={"camera": False}))
    for with_camera, without in zip(packets[:2], blind.packets(), strict=False):
        np.testing.assert_array_equal(with_camera.sweep.points_lidar, without.sweep.points_lidar)
        np.testing.assert_array_equal(with_camera.imu.gyro_radps, without.imu.gyro_radps)
        assert without.depth == ()
    assert blind.calibration.T_body_camera is None
    with pytest.raises(ValueError, match="no depth camera"):
        blind.true_depth(START_NS)


def test_a_machine_stands_in_the_way(room):
    camera = _camera(room, EXACT)
    T_map_box = se3.from_rt(np.eye(3), GRID_M + np.array([2.0 + SIZE_M[0] / 2, 0.0, 0.0]))
    clear, blocked = camera.look(AHEAD), camera.look(AHEAD, T_map_box)
    assert clear.depth_m[18, 32] == pytest.approx(5.0, rel=1e-5)
    assert blocked.depth_m[18, 32] == pytest.approx(2.0, rel=1e-5)
