"""Surveyed targets on the walls along a simulated flight, and what somebody would pick of them in its sweeps.

The mine has a grid of its own: `T_grid_map` turns and moves the simulator's map into it. Its truth goes with the
flight, so that an estimate in the grid can be compared with a reference in the map.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc import se3
from mineloc.config import SimulateConfig
from mineloc.data import ControlPoint, Observation
from mineloc.sim.flight import START_NS, SimulatedFlight
from mineloc.sim.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

GRID_FILE = "grid.json"

NEAREST_M, FARTHEST_M = 0.8, 8.0
STEP_M = 0.5
PASSES, PICKS = 3, 3
FIRST_M = 3.0
CHECK_EVERY = 3
TAG_IDS = 587
_STEP_S = 0.1
_GRAZING = 0.2  # cosine of the incidence below which nobody would pick
_STEEP = 0.5  # and below which nobody would fix a target
_PASS_S = 2.0
_LEAN = 0.8  # tangent of the angle between a tag's board and the wall
_MOUNT_M = 0.02
_LAYING, _SURVEY, _PICKS = range(20, 23)  # random streams


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A target on a wall.

    Attributes:
        name: in the survey.
        T_map_board: (4, 4) of its board: x right and y down as seen from in front, z into it; the origin is its centre.
        tag_id: of its AprilTag, None for a plain target.
    """

    name: str
    T_map_board: F64
    tag_id: int | None = None

    @property
    def position_map(self) -> F64:
        """(3,) its centre."""
        return self.T_map_board[:3, 3]


@dataclass(frozen=True, slots=True, eq=False)
class TargetSurvey:
    """What a surveyor measured and what somebody picked.

    Attributes:
        targets: where they truly are.
        points: the survey in the mine grid; every third is a check point.
        observations: of the nearest passes.
        T_grid_map: (4, 4) the truth.
    """

    targets: tuple[Target, ...]
    points: tuple[ControlPoint, ...]
    observations: tuple[Observation, ...]
    T_grid_map: F64


def grid_of(config: SimulateConfig) -> F64:
    """(4, 4) `T_grid_map` of a flight's mine."""
    T_grid_map = se3.exp(np.array([0.0, 0.0, np.deg2rad(config.grid_yaw_deg), 0.0, 0.0, 0.0]))
    T_grid_map[:3, 3] = (config.grid_e_m, config.grid_n_m, config.grid_z_m)
    return T_grid_map


def grid_json(config: SimulateConfig) -> bytes | None:
    """The truth of the grid as a file: {"T_grid_map": (4, 4)}; None where no target and no option speaks of one."""
    T_grid_map = grid_of(config)
    if not config.target_every_m and np.array_equal(T_grid_map, np.eye(4)):
        return None
    return json.dumps({"T_grid_map": T_grid_map.tolist()}).encode()


def survey_of(flight: SimulatedFlight) -> TargetSurvey | None:
    """Targets, survey and picks of a flight; None when its configuration wants no targets."""
    config = flight.config
    if not config.target_every_m:
        return None
    T_grid_map = grid_of(config)
    targets = lay_targets(flight)
    points = _surveyed(targets, T_grid_map, flight)
    return TargetSurvey(targets, points, tuple(_picked(targets, flight)), T_grid_map)


def lay_targets(flight: SimulatedFlight) -> tuple[Target, ...]:
    """Targets on the walls, left and right in turn, so that one is near at least every `target_every_m` of the way."""
    config = flight.config
    rng = np.random.default_rng(np.random.SeedSequence((config.seed, _LAYING)))
    out: list[Target] = []
    begin = FIRST_M - config.target_every_m
    last_m = begin
    for at_m, position, ahead in _stations(flight):
        if any(np.linalg.norm(target.position_map - position) < FARTHEST_M for target in out):
            last_m = at_m
        if at_m - last_m < config.target_every_m:
            continue
        side = 1.0 if len(out) % 2 else -1.0
        # a tag is seen by a camera that looks ahead, so its board leans towards those who come, off the wall
        offset_m, lean = (0.5 * config.tag_size_m, _LEAN) if config.tags else (_MOUNT_M, 0.0)
        for turn in (side, -side):
            board = _on_wall(flight.mine.scene, position, ahead, rng, side=turn, offset_m=offset_m, lean=lean)
            if board is not None:
                tag = (len(out) + 37 * config.seed) % TAG_IDS if config.tags else None
                out.append(Target(f"{flight.info.flight}-T{len(out) + 1:02d}", board, tag))
                last_m = at_m
                break
    return tuple(out)


def in_sight(position_map: F64, facing_map: F64, T_map_lidar: F64, flight: SimulatedFlight) -> Bool:
    """(n,) whether a target can be picked from (n, 4, 4) places of the lidar: near, in its field, not hidden."""
    lidar = flight.lidar
    away = position_map - T_map_lidar[:, :3, 3]
    distance = np.linalg.norm(away, axis=1)
    out = (distance > NEAREST_M) & (distance < FARTHEST_M)
    direction = away / np.maximum(distance, 1e-9)[:, None]
    out &= -(direction @ facing_map) > _GRAZING
    up = np.einsum("ni,ni->n", T_map_lidar[:, :3, 2], direction)
    out &= (up > np.sin(lidar.elevation_rad.min())) & (up < np.sin(lidar.elevation_rad.max()))
    rows = np.flatnonzero(out)
    if len(rows):
        free = flight.mine.scene.ranges_m(T_map_lidar[rows, :3, 3], direction[rows])
        out[rows] = free > distance[rows] - _MOUNT_M / 2
    return out


def _stations(flight: SimulatedFlight) -> list[tuple[float, F64, F64]]:
    """Way flown, place and heading every half metre."""
    poses = flight.motion.pose(np.arange(0.0, flight.motion.end_s, _STEP_S))
    positions = poses[:, :3, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    rows = np.unique(np.searchsorted(way, np.arange(0.0, way[-1], STEP_M)))
    ahead = poses[:, :3, 0] * [1.0, 1.0, 0.0]
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    return [(float(way[k]), positions[k], ahead[k]) for k in rows]


def _on_wall(
    scene: Scene, place: F64, ahead: F64, rng: np.random.Generator, *, side: float, offset_m: float, lean: float
) -> F64 | None:
    """(4, 4) a board on the wall to the left (`side` 1) or right (−1); None where there is no wall to take one."""
    across = side * np.array([-ahead[1], ahead[0], 0.0])
    direction = across + rng.uniform(0.0, 0.4) * ahead + rng.uniform(-0.05, 0.15) * np.array([0.0, 0.0, 1.0])
    direction /= np.linalg.norm(direction)
    local = np.concatenate([place - scene.origin_m, direction]).astype(np.float32)[None]
    hit = scene.cast(local)
    distance, normal = float(hit.range_m[0]), hit.normals[0].astype(np.float64)
    normal *= -np.sign(normal @ direction)
    if not NEAREST_M < distance < FARTHEST_M / 2 or -(normal @ direction) < _STEEP:
        return None
    facing = normal - lean * ahead
    facing[2] = 0.0
    if np.linalg.norm(facing) < _STEEP:
        return None
    into = -facing / np.linalg.norm(facing)
    down = np.array([0.0, 0.0, -1.0])
    rotation = np.column_stack([np.cross(down, into), down, into])
    return se3.from_rt(rotation, place + distance * direction + offset_m * normal)


def _surveyed(targets: Sequence[Target], T_grid_map: F64, flight: SimulatedFlight) -> tuple[ControlPoint, ...]:
    config = flight.config
    rng = np.random.default_rng(np.random.SeedSequence((config.seed, _SURVEY)))
    return tuple(
        ControlPoint(
            name=target.name,
            position_grid=se3.apply(T_grid_map, target.position_map[None])[0]
            + rng.normal(size=3) * config.target_sigma_m,
            sigma_m=config.target_sigma_m,
            sigma_z_m=config.target_sigma_m,
            role="check" if k % CHECK_EVERY == CHECK_EVERY - 1 else "control",
            tag_id=target.tag_id,
            tag_size_m=None if target.tag_id is None else config.tag_size_m,
        )
        for k, target in enumerate(targets)
    )


def _picked(targets: Sequence[Target], flight: SimulatedFlight) -> list[Observation]:
    """Three picks of each of the three nearest passes, in sweeps that see the target."""
    config = flight.config
    rng = np.random.default_rng(np.random.SeedSequence((config.seed, _PICKS)))
    period_ns = round(1e9 / config.lidar_hz)
    # the first and last sweeps are left alone: odometry may not have a pose on both sides of them
    stamps = START_NS + np.arange(2, flight.sweeps - 2, dtype=np.int64) * period_ns
    stamps = stamps[~flight.lost[2 : flight.sweeps - 2]]
    T_map_lidar = flight.pose(stamps) @ flight.calibration.T_body_lidar
    out: list[Observation] = []
    for target in targets:
        seen = np.flatnonzero(in_sight(target.position_map, -target.T_map_board[:3, 2], T_map_lidar, flight))
        for row in _chosen(seen, stamps, np.linalg.norm(T_map_lidar[:, :3, 3] - target.position_map, axis=1)):
            there = se3.apply(se3.inverse(T_map_lidar[row]), target.position_map[None])[0]
            point = there + rng.normal(size=3) * config.pick_sigma_m
            out.append(
                Observation.picked(
                    target.name, flight.info.flight, int(stamps[row]), point, sigma_m=config.pick_sigma_m
                )
            )
    return out


def _chosen(seen: I64, stamps_ns: I64, distance_m: F64) -> list[int]:
    """Rows spread over the nearest passes."""
    if not len(seen):
        return []
    breaks = np.flatnonzero(np.diff(stamps_ns[seen]) > _PASS_S * 1e9) + 1
    passes = sorted(np.split(seen, breaks), key=lambda one: float(distance_m[one].min()))
    rows = [
        one[np.unique(np.linspace(0, len(one) - 1, PICKS + 2).round().astype(int)[1:-1])] for one in passes[:PASSES]
    ]
    return sorted(int(row) for row in np.concatenate(rows))
