"""A grey camera on the drone: walls in its own light, AprilTags on their boards, blur and noise.

It sees what matters to a tag detector: edges in perspective, coarse rock around them, light that falls off, pixels with
noise. It has a global shutter and no motion blur.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mineloc import se3
from mineloc.data import CameraModel, GreyImage
from mineloc.sim.flight import START_NS, SimulatedFlight
from mineloc.sim.scene import Scene
from mineloc.sim.targets import Target, TargetSurvey

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

TAG_FAMILY = "tag36h11"
FARTHEST_M = 7.0
"""Boards farther away are not looked at."""

_NEAREST_M = 0.3
_GRAZING = 0.2  # cosine of the angle under which a board is not looked at
_COARSE = 2  # one ray for so many pixels each way: rock is smooth, boards are drawn apart
_SAMPLES = 4  # of a pixel each way, where boards are drawn
_ROCK, _BLACK, _WHITE = 0.35, 0.06, 0.85  # albedos
_PATCH_M = 0.06  # of rock of one albedo
_LIGHT_M = 2.5  # the lamp's light is down to half here
_EXPOSURE = 520.0  # grey of a white surface at the lamp
_BLUR_PX = 0.6
_NOISE = 3.0
_PIXELS = 23  # random stream


@dataclass(frozen=True, slots=True, eq=False)
class TagView:
    """What a camera looks at.

    Attributes:
        scene: the mine.
        camera: geometry.
        targets: with tags; others are not drawn.
        tag_size_m: edge of the black squares.
    """

    scene: Scene
    camera: CameraModel
    targets: Sequence[Target]
    tag_size_m: float

    @property
    def board_m(self) -> float:
        """Edge of a board: the black square has a white border one module wide."""
        return self.tag_size_m * 10.0 / 8.0

    def sees_tag(self, T_map_camera: F64) -> Bool:
        """(n,) whether the middle of a tag is in the picture from (n, 4, 4) poses."""
        out = np.zeros(len(T_map_camera), np.bool_)
        back = se3.inverse(T_map_camera)
        camera = self.camera
        for target in self.targets:
            seen = np.einsum("nij,j->ni", back[:, :3, :3], target.position_map) + back[:, :3, 3]
            away, (x, y, z) = np.linalg.norm(seen, axis=1), seen.T
            ahead = (z > _NEAREST_M) & (away < FARTHEST_M) & ~out
            z = np.where(ahead, z, 1.0)
            u, v = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
            sight = target.position_map - T_map_camera[:, :3, 3]
            ahead &= sight @ target.T_map_board[:3, 2] > _GRAZING * away
            ahead &= (u > 0) & (u < camera.width_px) & (v > 0) & (v < camera.height_px)
            rows = np.flatnonzero(ahead)
            if len(rows):
                free_m = self.scene.ranges_m(T_map_camera[rows, :3, 3], sight[rows] / away[rows, None])
                out[rows] = free_m > away[rows]
        return out

    def picture(self, T_map_camera: F64, rng: np.random.Generator) -> U8:
        """(height, width) grey picture from (4, 4).

        Args:
            T_map_camera: optical frame: x right, y down, z ahead.
            rng: pixel noise.
        """
        bright, depth_m = self._rock(T_map_camera)
        for target in self.targets:
            if target.tag_id is not None:
                self._draw(target, target.tag_id, T_map_camera, bright, depth_m)
        blurred = gaussian_filter((_EXPOSURE * bright).astype(np.float32), _BLUR_PX, mode="nearest")
        noise = rng.standard_normal(blurred.shape, np.float32) * np.float32(_NOISE)
        return np.clip(blurred + noise, 0, 255).round().astype(np.uint8)

    def _rays(self, u: F64, v: F64) -> F64:
        """(…, 3) directions in the camera frame with z = 1 through pixels; pixel centres are whole numbers."""
        camera = self.camera
        x, y = (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px
        return np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1)

    def _rock(self, T_map_camera: F64) -> tuple[F64, F64]:
        """(height, width) reflected light and depth along the optical axis."""
        camera = self.camera
        middle = (_COARSE - 1) / 2.0
        u = np.arange(0.0, camera.width_px, _COARSE) + middle
        v = np.arange(0.0, camera.height_px, _COARSE) + middle
        rays = self._rays(u[None, :], v[:, None])
        length = np.linalg.norm(rays, axis=-1)
        direction = (rays / length[..., None]).reshape(-1, 3) @ T_map_camera[:3, :3].T
        eye = T_map_camera[:3, 3] - self.scene.origin_m
        hits = self.scene.cast(
            np.concatenate([np.broadcast_to(eye, direction.shape), direction], axis=1).astype(np.float32)
        )
        away = np.minimum(hits.range_m.astype(np.float64), 1e3)
        cosine = np.abs(np.einsum("ni,ni->n", direction, hits.normals))
        albedo = _ROCK * (0.6 + 0.8 * _speckle(eye + direction * away[:, None]))
        light = np.where(np.isfinite(hits.range_m), albedo * cosine * _lit(away), 0.0)
        bright, depth = light.reshape(length.shape), away.reshape(length.shape) / length
        shape = (camera.height_px, camera.width_px)
        return _finer(bright, shape), _finer(depth, shape)

    def _draw(self, target: Target, tag_id: int, T_map_camera: F64, bright: F64, depth_m: F64) -> None:
        """Blend one board into the picture where nothing is before it."""
        T_camera_board = se3.inverse(T_map_camera) @ target.T_map_board
        half = self.board_m / 2.0
        corners = se3.apply(T_camera_board, half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]))
        if corners[:, 2].min() < 0.2 or np.linalg.norm(T_camera_board[:3, 3]) > FARTHEST_M:
            return
        camera = self.camera
        pixels = corners[:, :2] / corners[:, 2:] * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
        first = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
        last = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, [camera.width_px, camera.height_px])
        if (last <= first).any() or T_camera_board[2, 2] <= 0.0:
            return
        within = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
        u = (np.arange(first[0], last[0])[:, None] + within).ravel()
        v = (np.arange(first[1], last[1])[:, None] + within).ravel()
        rays = self._rays(u[None, :], v[:, None])
        normal, centre = T_camera_board[:3, 2], T_camera_board[:3, 3]
        away = (normal @ centre) / (rays @ normal)
        on_board = (rays * away[..., None] - centre) @ T_camera_board[:3, :2]
        module = np.floor((on_board / half + 1.0) / 2.0 * 10.0).astype(int)
        inside = ((module >= 0) & (module < 10)).all(axis=-1) & (away > 0)
        bits = tag_modules(tag_id)[np.clip(module[..., 1], 0, 9), np.clip(module[..., 0], 0, 9)]
        distance = away * np.linalg.norm(rays, axis=-1)
        cosine = away * np.abs(rays @ normal) / np.maximum(distance, 1e-9)
        light = np.where(bits, _WHITE, _BLACK) * cosine * _lit(distance)
        part = np.s_[first[1] : last[1], first[0] : last[0]]
        inside &= away < np.repeat(np.repeat(depth_m[part], _SAMPLES, axis=0), _SAMPLES, axis=1)
        covered, seen = _pooled(inside.astype(float)), _pooled(np.where(inside, light, 0.0))
        bright[part] = (1.0 - covered) * bright[part] + seen


class TagCamera:
    """Takes the pictures of a simulated flight that a tag is in; the same whenever they are asked for.

    Args:
        flight: who flies.
        survey: its targets.
        camera: geometry.
        T_body_camera: (4, 4) of the optical frame.
        rate_hz: of the camera.
    """

    def __init__(
        self, flight: SimulatedFlight, survey: TargetSurvey, camera: CameraModel, T_body_camera: F64, *, rate_hz: float
    ) -> None:
        self._seed = flight.config.seed
        self._view = TagView(flight.mine.scene, camera, survey.targets, flight.config.tag_size_m)
        stamps = START_NS + (np.arange(1, int(flight.motion.end_s * rate_hz)) * 1e9 / rate_hz).round().astype(np.int64)
        poses = flight.pose(stamps) @ T_body_camera
        rows = np.flatnonzero(self._view.sees_tag(poses))
        self.stamps_ns: I64 = stamps[rows]
        self._poses: F64 = poses[rows]

    def between(self, begin_ns: int, end_ns: int) -> Iterator[GreyImage]:
        """The pictures taken in `[begin_ns, end_ns)`, in order of time."""
        for k in range(*np.searchsorted(self.stamps_ns, [begin_ns, end_ns]).tolist()):
            rng = np.random.default_rng(np.random.SeedSequence((self._seed, _PIXELS, k)))
            yield GreyImage(int(self.stamps_ns[k]), self._view.picture(self._poses[k], rng), self._view.camera)


@lru_cache(maxsize=64)
def tag_modules(tag_id: int) -> Bool:
    """(10, 10) modules of a tag with its white border, row by row from the top; True is white."""
    # the library knows the codes; loading it takes a moment that few need
    from pyapriltags import Detector

    detector = Detector(families=TAG_FAMILY)  # frees the codes when it goes
    family = detector.tag_families[TAG_FAMILY].contents
    border = (family.total_width - family.width_at_border) // 2
    out = np.ones((family.total_width, family.total_width), np.bool_)
    out[border:-border, border:-border] = False
    code = int(family.codes[tag_id])
    for bit in range(family.nbits):
        row, column = family.bit_y[bit] + border, family.bit_x[bit] + border
        out[row, column] = code >> (family.nbits - 1 - bit) & 1
    return out


def _lit(away_m: F64) -> F64:
    return 1.0 / (1.0 + (away_m / _LIGHT_M) ** 2)


def _speckle(points_m: F64) -> F64:
    """(n,) numbers in [0, 1) that depend on the patch of rock alone."""
    cell = np.floor(points_m / _PATCH_M).astype(np.int64).astype(np.uint64)
    mixed = cell[:, 0] * np.uint64(73856093) ^ cell[:, 1] * np.uint64(19349663) ^ cell[:, 2] * np.uint64(83492791)
    mixed = (mixed ^ (mixed >> np.uint64(13))) * np.uint64(0x9E3779B97F4A7C15)
    return (mixed >> np.uint64(40)).astype(np.float64) / 2.0**24


def _finer(values: F64, shape: tuple[int, int]) -> F64:
    """Coarse pixels blown up."""
    return np.repeat(np.repeat(values, _COARSE, axis=0), _COARSE, axis=1)[: shape[0], : shape[1]]


def _pooled(samples: F64) -> F64:
    """Means over the samples of each pixel."""
    h, w = samples.shape
    return samples.reshape(h // _SAMPLES, _SAMPLES, w // _SAMPLES, _SAMPLES).mean(axis=(1, 3))
