"""AprilTags: geometry by itself, and found in pictures of a simulated roadway."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc import se3
from mineloc.config import ControlConfig
from mineloc.data import Calibration, CameraModel, ControlPoint, GreyImage
from mineloc.mapping.tags import (
    TagDetector,
    TagSighting,
    best_of_passes,
    centre_covariance,
    observation_of,
    observe_tags,
    place_tag,
)
from mineloc.sim.scene import Scene
from mineloc.sim.tag_camera import TagView, tag_modules
from mineloc.sim.targets import Target

CAMERA = CameraModel(848, 480, 424.0, 424.0, 423.5, 239.5)
CONFIG = ControlConfig()
SIZE_M = 0.3
BOX = np.array([[x, y, z] for x in (-1.0, 9.0) for y in (-2.5, 2.5) for z in (-1.5, 1.7)])
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([[(a, b, c), (a, c, d)] for a, b, c, d in SIDES]).reshape(-1, 3)
# x ahead, y left, z up, as the optical frame sees it
OPTICAL = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])


def _corners(T_camera_tag: np.ndarray) -> np.ndarray:
    p = se3.apply(T_camera_tag, SIZE_M / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]]))
    return p[:, :2] / p[:, 2:] * [CAMERA.fx_px, CAMERA.fy_px] + [CAMERA.cx_px, CAMERA.cy_px]


def _pose(away_m: float, tilt: tuple[float, float, float], off: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    T = se3.exp(np.array([*tilt, 0, 0, 0]))
    T[:3, 3] = [off[0] * away_m, off[1] * away_m, away_m]
    return T


@settings(max_examples=60, deadline=None)
@given(
    away=st.floats(0.5, 8.0),
    tilt=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0)),
    off=st.tuples(st.floats(-0.8, 0.8), st.floats(-0.4, 0.4)),
)
def test_exact_corners_give_the_exact_pose(
    away: float, tilt: tuple[float, float, float], off: tuple[float, float]
) -> None:
    T = _pose(away, (0, 0, tilt[2]), off) @ se3.exp(np.array([tilt[0], tilt[1], 0, 0, 0, 0]))
    if (T[:3, 2] @ T[:3, 3]) / np.linalg.norm(T[:3, 3]) < 0.25:  # seen from the edge or from behind
        return
    found = place_tag(_corners(T), SIZE_M, CAMERA)
    assert found is not None
    assert found[1] < 1e-3
    # four decimals of a pixel are half a millimetre of range at 8 m
    assert np.linalg.norm(found[0][:3, 3] - T[:3, 3]) < 1e-3 * away


def test_the_stated_covariance_is_that_of_noisy_corners() -> None:
    rng = np.random.default_rng(0)
    for away, tilt in ((2.0, (0.2, 0.6, 0.1)), (4.0, (0.1, -0.7, 0.0)), (3.0, (0.5, 0.3, 1.0))):
        T = _pose(away, tilt, (0.3, -0.1))
        covariance = centre_covariance(T, SIZE_M, CAMERA, sigma_px=0.3)
        off = []
        for _ in range(80):
            found = place_tag(_corners(T) + rng.normal(size=(4, 2)) * 0.3, SIZE_M, CAMERA)
            assert found is not None
            off.append(found[0][:3, 3] - T[:3, 3])
        off = np.array(off)
        chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off.T).T)
        assert 0.75 < chi2.mean() / 3 < 1.3
        # METHOD: 1-3 cm at 2 m, nearly all of it along the line of sight
        along = off @ T[:3, 3] / np.linalg.norm(T[:3, 3])
        assert 0.3 * away**2 / 4 < along.std() / 0.01 < 3 * away**2 / 4
        assert np.sqrt((off**2).sum(axis=1).mean() - along.var()) < 0.2 * along.std() + 0.002


def test_of_two_poses_the_better_one_is_taken() -> None:
    """A tag seen nearly straight on: starting from the wrong one of two tilts must not matter."""
    T = _pose(1.5, (0.0, 0.5, 0.0), (0.2, 0.1))
    found = place_tag(_corners(T), SIZE_M, CAMERA)
    assert found is not None
    assert se3.angle_rad(se3.inverse(T) @ found[0]) < 1e-3


@pytest.mark.parametrize(
    "corners",
    [
        np.zeros((4, 2)),
        np.array([[10.0, 10], [20, 20], [30, 30], [40, 40]]),
        np.full((4, 2), 100.0) + np.array([[0, 0], [0, 1e-9], [0, 0], [1e-9, 0]]),
    ],
)
def test_corners_of_no_square_are_no_pose(corners: np.ndarray) -> None:
    found = place_tag(corners, SIZE_M, CAMERA)
    assert found is None or found[1] > 2.0 or not np.isfinite(found[0]).all()


def test_modules_are_a_black_square_with_its_code_in_a_white_border() -> None:
    seven = tag_modules(7)
    assert seven.shape == (10, 10)
    assert seven[[0, 9], :].all()
    assert seven[:, [0, 9]].all()
    assert not seven[[1, 8], 1:9].any()
    assert not seven[1:9, [1, 8]].any()
    # codes of the family differ in 11 bits at least, turned as you like
    for other in (0, 100, 586):
        for turn in range(4):
            assert (np.rot90(tag_modules(other), turn) != seven).sum() >= 11


def _view(*places: tuple[float, float, float], lean: float = 0.9, ids: tuple[int, ...] = (5, 17, 300)) -> TagView:
    """A straight roadway 5 m wide along x with tags beside it."""
    targets = []
    for (x, y, z), tag in zip(places, ids, strict=False):
        into = np.array([np.cos(lean * np.sign(y)), np.sin(lean * np.sign(y)), 0.0])
        down = np.array([0, 0, -1.0])
        R = np.column_stack([np.cross(down, into), down, into])
        targets.append(Target(f"T{tag}", se3.from_rt(R, [x, y, z]), tag))
    return TagView(Scene(BOX, FACES, threads=1), CAMERA, targets, SIZE_M)


def _camera(x: float, yaw: float = 0.0) -> np.ndarray:
    turn = se3.exp(np.array([0, 0, yaw, 0, 0, 0.0]))
    return se3.from_rt(turn[:3, :3] @ OPTICAL, [x, 0.1, 0.2])


@pytest.fixture(scope="module")
def detector() -> TagDetector:
    return TagDetector(CONFIG)


def _seen(
    view: TagView, T: np.ndarray, detector: TagDetector, *, seed: int = 0, stamp_ns: int = 0
) -> list[TagSighting]:
    image = GreyImage(stamp_ns, view.picture(T, np.random.default_rng(seed)), CAMERA)
    return detector.detect(image, {target.tag_id: SIZE_M for target in view.targets if target.tag_id is not None})


def test_tags_in_pictures_are_placed_to_millimetres(detector: TagDetector) -> None:
    view = _view((3.2, 1.8, 0.3), (3.4, -1.7, -0.2), (4.8, 1.4, 0.1))
    errors: dict[bool, list[float]] = {True: [], False: []}
    pixels = []
    for k in range(6):
        T = _camera(0.05 + 0.15 * k, yaw=0.05 * (-1) ** k)
        found = {s.tag_id: s for s in _seen(view, T, detector, seed=k)}
        for target in view.targets:
            sighting = found[target.tag_id]  # type: ignore[index]
            if sighting.T_camera_tag is None:
                continue
            truth = se3.inverse(T) @ target.T_map_board
            off = np.linalg.norm(sighting.T_camera_tag[:3, 3] - truth[:3, 3])
            errors[bool(np.linalg.norm(truth[:3, 3]) < 4.0)].append(float(off))
            pixels.append((sighting.corners_px - _corners(truth)).mean(axis=0))
            assert se3.angle_rad(se3.inverse(truth) @ sighting.T_camera_tag) < np.radians(6)
            assert off < 3 * sighting.sigma_m
    # a picture without blur of motion, a lens without error: far better than METHOD's 1-3 cm of a real camera
    assert len(errors[True]) >= 11
    assert len(errors[False]) >= 2
    assert 2e-4 < np.mean(errors[True]) < 5e-3
    assert 5e-4 < np.mean(errors[False]) < 2e-2
    # half a pixel would be seen: the detector's pixels begin at their corner, ours at their centre
    assert np.abs(np.mean(pixels, axis=0)).max() < 0.05


def test_low_margins_unknown_tags_and_wrong_bits_are_refused(detector: TagDetector) -> None:
    view = _view((3.0, 1.8, 0.3), (6.8, -1.5, 0.0))
    picture = GreyImage(9, view.picture(_camera(0.0), np.random.default_rng(0)), CAMERA)
    (near, far) = detector.detect(picture, {5: SIZE_M, 17: SIZE_M})
    assert (near.tag_id, near.reason, near.stamp_ns) == (5, "", 9)
    assert far.T_camera_tag is None
    assert far.reason.startswith("decision margin")
    assert far.sigma_m == np.inf
    with pytest.raises(ValueError, match="refused"):
        observation_of(far, "T17", np.eye(4))
    (only, _) = detector.detect(picture, {17: SIZE_M})
    assert only.reason == "tag 5 is not surveyed"
    black = GreyImage(0, np.zeros((480, 848), np.uint8), CAMERA)
    noise = GreyImage(0, np.random.default_rng(1).integers(0, 255, (480, 848)).astype(np.uint8), CAMERA)
    assert [s.reason for image in (black, noise) for s in detector.detect(image, {}) if not s.reason] == []


def test_what_is_hidden_or_turned_away_is_not_seen(detector: TagDetector) -> None:
    behind = _view((3.0, 2.9, 0.3))  # in the rock
    assert _seen(behind, _camera(0.0), detector) == []
    turned = _view((3.0, 1.8, 0.3), lean=0.9 + np.pi)
    assert _seen(turned, _camera(0.0), detector) == []
    assert not turned.sees_tag(_camera(0.0)[None]).any()
    shown = _view((3.0, 1.8, 0.3))
    assert shown.sees_tag(np.stack([_camera(0.0), _camera(3.5), _camera(0.0, yaw=np.pi)])).tolist() == [
        True,
        False,
        False,
    ]


def test_observations_are_the_best_of_each_pass_in_the_lidar_s_frame() -> None:
    view = _view((3.0, 1.8, 0.3))
    calibration = Calibration(
        T_body_lidar=se3.exp(np.array([0.1, -0.2, 1.0, 0.05, 0, 0.12])),
        T_body_camera=se3.from_rt(OPTICAL, [0.1, 0.02, -0.03]),
    )
    points = [
        ControlPoint("A", np.array([10.0, 0, 0]), 0.005, 0.005, "control", 5, SIZE_M),
        ControlPoint("B", np.array([20.0, 0, 0]), 0.005, 0.005, "control"),
    ]
    images, truth = [], {}
    for k in range(6):
        x, stamp_ns = 0.25 * (k % 3), k * 200_000_000 + (k // 3) * 5_000_000_000
        T_map_body = se3.exp(np.array([0, 0, 0, x, 0.05, 0.1]))
        T = T_map_body @ calibration.T_body_camera
        images.append(GreyImage(stamp_ns, view.picture(T, np.random.default_rng(k)), CAMERA))
        truth[stamp_ns] = se3.inverse(T_map_body @ calibration.T_body_lidar) @ view.targets[0].T_map_board
    few = CONFIG.model_copy(update={"tag_views": 2})
    seen = observe_tags(iter(images), points, calibration, few, flight="one")
    assert (seen.images, seen.used, seen.refused) == (6, 6, 0)
    # the nearest two of either pass
    assert [o.stamp_ns for o in seen.observations] == [images[k].stamp_ns for k in (1, 2, 4, 5)]
    for observation in seen.observations:
        assert (observation.target, observation.flight) == ("A", "one")
        there = truth[observation.stamp_ns][:3, 3]
        off = observation.point_lidar - there
        assert np.linalg.norm(off) < 0.006
        # the long axis of the covariance lies along the line of sight from the camera
        eye = (se3.inverse(calibration.T_body_lidar) @ calibration.T_body_camera)[:3, 3]
        long = np.linalg.eigh(observation.covariance_lidar)[1][:, 2]
        assert abs(long @ (there - eye)) / np.linalg.norm(there - eye) > 0.98
    assert observe_tags(images, points[1:], calibration, few).images == 0
    with pytest.raises(ValueError, match="T_body_camera"):
        observe_tags(images, points, Calibration(), few)


def test_passes_are_told_apart_by_their_gaps() -> None:
    def sighting(at_s: float, sigma: float) -> TagSighting:
        return TagSighting(1, int(at_s * 1e9), 50.0, np.zeros((4, 2)), np.eye(4), np.eye(3) * sigma**2, 0.1, "")

    ones = [sighting(s, 0.01 + 0.001 * k) for k, s in enumerate([0.0, 1.0, 2.5, 9.0, 9.1])]
    assert [s.stamp_ns for s in best_of_passes(ones, each=2)] == [0, 10**9, 9 * 10**9, 9_100_000_000]
    assert [s.stamp_ns for s in best_of_passes(ones[::-1], each=1)] == [0, 9 * 10**9]
    assert best_of_passes([], each=3) == []
    with pytest.raises(ValueError, match="pose or a reason"):
        replace(ones[0], reason="but")
