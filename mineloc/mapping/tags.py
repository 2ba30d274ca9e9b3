"""AprilTags as survey targets: found in grey images, placed by their corners, handed on as observations.

A tag's centre is known across the line of sight to a fraction of a pixel and along it only by its apparent size, so
its covariance is long along the ray (METHOD 8: 1-3 cm at 2 m).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mineloc import se3
from mineloc.config import ControlConfig
from mineloc.data import F64, Calibration, CameraModel, ControlPoint, GreyImage, Observation
from mineloc.data.checks import freeze, need

FAMILY = "tag36h11"

_STEPS = 20
_NEAREST_M = 0.05
_MOST_RESIDUAL_PX = 2.0
_PASS_NS = 2_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class TagSighting:
    """One tag in one image.

    Attributes:
        tag_id: of the family tag36h11.
        stamp_ns: of the image.
        margin: decision margin of the detector; small ones are guesses.
        corners_px: (4, 2) from the lower left one counter-clockwise as the tag is read; pixel centres are whole.
        T_camera_tag: (4, 4) x right, y down, z into the tag; None when refused.
        covariance_camera: (3, 3) of its centre, metres²; None when refused.
        residual_px: root mean square of the corners' distances to their projection.
        reason: why it is refused; empty when it may be used.
    """

    tag_id: int
    stamp_ns: int
    margin: float
    corners_px: F64
    T_camera_tag: F64 | None
    covariance_camera: F64 | None
    residual_px: float
    reason: str

    def __post_init__(self) -> None:
        need((self.T_camera_tag is None) == bool(self.reason), "a sighting has a pose or a reason")
        freeze(self)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the centre, all axes together; infinite when refused."""
        return float("inf") if self.covariance_camera is None else float(np.sqrt(np.trace(self.covariance_camera)))


class TagDetector:
    """Finds tags. Holds the library's detector, which takes a moment to make.

    Args:
        config: margins and the error of a corner.
    """

    def __init__(self, config: ControlConfig) -> None:
        # one shared library of its own; who has no tags does not load it
        from pyapriltags import Detector

        self._config = config
        self._detector: Any = Detector(families=FAMILY, quad_decimate=1.0)

    def detect(self, image: GreyImage, sizes_m: Mapping[int, float]) -> list[TagSighting]:
        """All tags in an image, by id; those that cannot be used with the reason.

        Args:
            image: of a camera without distortion.
            sizes_m: edge of the black square by tag; others are told and refused.
        """
        found = self._detector.detect(np.ascontiguousarray(image.pixels))
        out = [self._sighting(one, image, sizes_m) for one in found]
        return sorted(out, key=lambda sighting: (sighting.tag_id, -sighting.margin))

    def _sighting(self, found: Any, image: GreyImage, sizes_m: Mapping[int, float]) -> TagSighting:
        tag_id, margin = int(found.tag_id), float(found.decision_margin)
        # the library counts from the corner of the first pixel, a camera model from its centre
        corners = np.array(found.corners, dtype=np.float64) - 0.5
        reason = self._refusal(tag_id, margin, int(found.hamming), sizes_m)
        placed = None if reason else place_tag(corners, sizes_m[tag_id], image.camera)
        if not reason and (placed is None or placed[1] > _MOST_RESIDUAL_PX):
            placed, reason = None, "its corners are those of no square"
        if placed is None:
            return TagSighting(tag_id, image.stamp_ns, margin, corners, None, None, float("nan"), reason)
        T, residual_px = placed
        covariance = centre_covariance(T, sizes_m[tag_id], image.camera, sigma_px=self._config.tag_corner_px)
        return TagSighting(tag_id, image.stamp_ns, margin, corners, T, covariance, residual_px, "")

    def _refusal(self, tag_id: int, margin: float, hamming: int, sizes_m: Mapping[int, float]) -> str:
        if tag_id not in sizes_m:
            return f"tag {tag_id} is not surveyed"
        if hamming > 0:
            return f"{hamming} of its bits are wrong"
        if margin < self._config.min_tag_margin:
            return f"decision margin {margin:.0f}, at least {self._config.min_tag_margin:g} needed"
        return ""


@dataclass(frozen=True, slots=True, eq=False)
class TagObservations:
    """What a flight's images say of the survey.

    Attributes:
        observations: the best of each pass, in order of time.
        images: looked at.
        used, refused: sightings that could have been an observation, and that could not.
    """

    observations: tuple[Observation, ...]
    images: int
    used: int
    refused: int


def observe_tags(
    images: Iterable[GreyImage],
    points: Sequence[ControlPoint],
    calibration: Calibration,
    config: ControlConfig,
    *,
    flight: str = "",
) -> TagObservations:
    """Observations of all surveyed tags in a flight's images.

    Neighbouring images err alike (light, calibration, the drone's pose), so of every pass only the best few count.

    Args:
        images: in order of time.
        points: the survey; those without a tag are ignored.
        calibration: with `T_body_camera`.
        config: `min_tag_margin`, `tag_corner_px`, `tag_views`.
        flight: its name.

    Raises:
        ValueError: the calibration does not know the camera.
    """
    need(calibration.T_body_camera is not None, "tags need T_body_camera")
    assert calibration.T_body_camera is not None
    T_lidar_camera = se3.inverse(calibration.T_body_lidar) @ calibration.T_body_camera
    sizes = {p.tag_id: p.tag_size_m for p in points if p.tag_id is not None and p.tag_size_m is not None}
    names = {p.tag_id: p.name for p in points if p.tag_id is not None}
    if not sizes:
        return TagObservations((), 0, 0, 0)
    detector = TagDetector(config)
    count, refused = 0, 0
    by_tag: dict[int, list[TagSighting]] = {}
    for image in images:
        count += 1
        for sighting in detector.detect(image, sizes):
            refused += bool(sighting.reason)
            if not sighting.reason:
                by_tag.setdefault(sighting.tag_id, []).append(sighting)
    chosen = [(names[tag], one) for tag, ones in by_tag.items() for one in best_of_passes(ones, each=config.tag_views)]
    chosen.sort(key=lambda pair: (pair[1].stamp_ns, pair[0]))
    observations = tuple(observation_of(one, name, T_lidar_camera, flight=flight) for name, one in chosen)
    return TagObservations(observations, count, sum(map(len, by_tag.values())), refused)


def observation_of(sighting: TagSighting, target: str, T_lidar_camera: F64, *, flight: str = "") -> Observation:
    """A sighting as an observation in the lidar frame.

    Raises:
        ValueError: it was refused.
    """
    if sighting.T_camera_tag is None or sighting.covariance_camera is None:
        raise ValueError(f"a refused sighting is no observation: {sighting.reason}")
    r = T_lidar_camera[:3, :3]
    point = se3.apply(T_lidar_camera, sighting.T_camera_tag[None, :3, 3])[0]
    return Observation(target, flight, sighting.stamp_ns, point, r @ sighting.covariance_camera @ r.T)


def best_of_passes(sightings: Sequence[TagSighting], *, each: int) -> list[TagSighting]:
    """The `each` most certain ones of every pass (no gap over 2 s), in order of time."""
    ordered = sorted(sightings, key=lambda s: s.stamp_ns)
    stamps = np.array([s.stamp_ns for s in ordered], np.int64)
    breaks = np.flatnonzero(np.diff(stamps) > _PASS_NS) + 1
    out: list[TagSighting] = []
    for begin, end in zip([0, *breaks.tolist()], [*breaks.tolist(), len(ordered)], strict=True):
        best = sorted(ordered[begin:end], key=lambda s: s.sigma_m)[:each]
        out += sorted(best, key=lambda s: s.stamp_ns)
    return out


def place_tag(corners_px: F64, size_m: float, camera: CameraModel) -> tuple[F64, float] | None:
    """Pose of a tag by least squares over its corners' reprojection, and the root mean square that is left, px.

    A tag seen nearly straight on has two poses that fit almost as well; both are tried. None where neither is before
    the camera.

    Args:
        corners_px: (4, 2), in the order of `TagSighting`.
        size_m: edge of the black square.
        camera: without distortion.
    """
    start = _from_homography(corners_px, size_m, camera)
    if start is None:
        return None
    T, residual_px = _refined(start, corners_px, size_m, camera)
    other, other_px = _refined(_mirrored(start), corners_px, size_m, camera)
    if other_px < residual_px:
        T, residual_px = other, other_px
    return (T, residual_px) if np.isfinite(residual_px) else None


def centre_covariance(T_camera_tag: F64, size_m: float, camera: CameraModel, *, sigma_px: float) -> F64:
    """(3, 3) covariance of the centre in the camera frame when every corner errs by `sigma_px` each way."""
    _, jacobian = _projected(T_camera_tag, size_m, camera)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * sigma_px**2
    r = T_camera_tag[:3, :3]
    return r @ covariance[3:, 3:] @ r.T


def _corners(size_m: float) -> F64:
    return size_m / 2.0 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], np.float64)


def _projected(T: F64, size_m: float, camera: CameraModel) -> tuple[F64, F64]:
    """(4, 2) pixels of the corners, and (8, 6) their derivatives by a right perturbation `[rotation, translation]`."""
    corners = _corners(size_m)
    x, y, z = se3.apply(T, corners).T
    pixels = np.stack([camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px], axis=1)
    by_point = np.zeros((4, 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx_px / z, -camera.fx_px * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy_px / z, -camera.fy_px * y / z**2
    moved = T[:3, :3] @ np.concatenate([-se3.hat(corners), np.broadcast_to(np.eye(3), (4, 3, 3))], axis=2)
    return pixels, (by_point @ moved).reshape(8, 6)


def _refined(T: F64, corners_px: F64, size_m: float, camera: CameraModel) -> tuple[F64, float]:
    """Levenberg's steps from T; an infinite residual when the tag comes to lie behind the camera."""
    damping = 1e-3
    pixels, jacobian = _projected(T, size_m, camera)
    error = (pixels - corners_px).ravel()
    for _ in range(_STEPS):
        normal = jacobian.T @ jacobian
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), jacobian.T @ error)
        moved = se3.rigid(T @ se3.exp(step))
        if se3.apply(moved, _corners(size_m))[:, 2].min() <= _NEAREST_M:
            return T, float("inf")
        pixels, ahead = _projected(moved, size_m, camera)
        after = (pixels - corners_px).ravel()
        gain = float(error @ error - after @ after)
        if gain > 0.0:
            T, error, jacobian, damping = moved, after, ahead, damping / 10.0
        else:
            damping *= 10.0
        if abs(gain) < 1e-10:
            break
    return T, float(np.sqrt(error @ error / 4.0))


def _from_homography(corners_px: F64, size_m: float, camera: CameraModel) -> F64 | None:
    """(4, 4) a first pose: the plane's homography, made a rotation."""
    x, y = _corners(size_m)[:, :2].T
    u = (corners_px[:, 0] - camera.cx_px) / camera.fx_px
    v = (corners_px[:, 1] - camera.cy_px) / camera.fy_px
    o, z = np.ones(4), np.zeros(4)
    system = np.concatenate(
        [np.stack([x, y, o, z, z, z, -u * x, -u * y], 1), np.stack([z, z, z, x, y, o, -v * x, -v * y], 1)]
    )
    try:
        h = np.append(np.linalg.solve(system, np.concatenate([u, v])), 1.0).reshape(3, 3)
    except np.linalg.LinAlgError:
        return None
    scale = (np.linalg.norm(h[:, 0]) + np.linalg.norm(h[:, 1])) / 2.0
    if not (np.isfinite(h).all() and scale > 1e-9):
        return None
    a, b, t = (h / scale).T
    left, _, right = np.linalg.svd(np.column_stack([a, b, np.cross(a, b)]))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return se3.from_rt(rotation, t)


def _mirrored(T: F64) -> F64:
    """The other pose of a nearly flat view: tilted as much to the other side of the line of sight."""
    sight = T[:3, 3] / np.linalg.norm(T[:3, 3])
    normal = T[:3, 2]
    other = 2.0 * (sight @ normal) * sight - normal
    out = T.copy()
    out[:3, :3] = se3.rotation_between(normal, other) @ T[:3, :3]
    return out
