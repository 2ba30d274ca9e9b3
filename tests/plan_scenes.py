"""Roadways as walls in a plan, and what a 16-beam LiDAR sees between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from map_clouds import cloud_of

from mineloc import se3
from mineloc.data import F32, F64, Keyframe, MapCloud, RelativePose
from mineloc.roadways.centre_lines import centre_lines
from mineloc.roadways.mapped import MappedRoadway, MappedRoadways
from mineloc.roadways.sheet import Sheet, link

HEIGHT_M, SENSOR_M = 3.0, 1.5
CELL_M = 0.2


class Plan:
    """Roadways that leave the origin: a place is open if it is within half a width of one of their lines.

    Args:
        bearings_deg: of the roadways.
        length_m: of each.
        width_m: of each.
        rough_m: amplitude of waves in the walls.
    """

    def __init__(
        self, bearings_deg: Sequence[float], *, length_m: float = 30.0, width_m: float = 4.0, rough_m: float = 0.1
    ) -> None:
        angles = np.radians(np.array(bearings_deg, dtype=np.float64))
        self._ahead = np.column_stack([np.cos(angles), np.sin(angles)])
        self._length, self._half, self._rough = length_m, 0.5 * width_m, rough_m

    def is_open(self, places: F64) -> np.ndarray:
        """(n,) of (n, 2) places."""
        along = places @ self._ahead.T
        left = np.column_stack([-self._ahead[:, 1], self._ahead[:, 0]])
        across = np.abs(places @ left.T)
        waves = self._rough * np.sin(1.7 * along + 2.3 * np.arange(len(self._ahead)))
        return ((along > -0.5 * self._half) & (along < self._length) & (across < self._half + waves)).any(axis=1)

    def sweep(self, at: F64, yaw_rad: float, rng: np.random.Generator) -> F32:
        """(n, 3) levelled points around the sensor at `at` (2,), x along the heading."""
        azimuth = np.radians(np.arange(0, 360, 1.5))
        ranges = np.arange(0.2, 20.0, 0.1)
        points: list[F64] = []
        direction = np.column_stack([np.cos(azimuth + yaw_rad), np.sin(azimuth + yaw_rad)])
        places = at + ranges[None, :, None] * direction[:, None, :]
        closed = ~self.is_open(places.reshape(-1, 2)).reshape(len(azimuth), len(ranges))
        wall = np.where(closed.any(axis=1), ranges[closed.argmax(axis=1)], np.inf)
        for elevation in np.radians(np.arange(-15, 16, 2.0)):
            rise = np.tan(elevation)
            ceiling = (HEIGHT_M - SENSOR_M) / rise if rise > 0 else (-SENSOR_M / rise if rise < 0 else np.inf)
            r = np.minimum(wall, ceiling)
            seen = np.isfinite(r)
            r = r[seen] + rng.normal(0, 0.02, int(seen.sum()))
            points.append(np.column_stack([r * np.cos(azimuth[seen]), r * np.sin(azimuth[seen]), r * rise]))
        return np.concatenate(points).astype(np.float32)


class TwoIntersections(Plan):
    """A T at the origin and a crossing 30 m east of it."""

    def __init__(self) -> None:
        self._one = Plan((0, 90, 180), length_m=22.0)
        self._other = Plan((0, 90, 180, 270), length_m=22.0, width_m=3.4)

    def is_open(self, places: F64) -> np.ndarray:
        """(n,) of (n, 2) places."""
        return self._one.is_open(places) | self._other.is_open(places - np.array([30.0, 0.0]))


def sheet_of(is_open: np.ndarray, origin_m: np.ndarray) -> Sheet:
    """Cells of one level, 3 m high."""
    row, column = np.nonzero(is_open)
    floor = np.zeros(len(row))
    links = link(column, row, floor, floor + 3.0, 1.2)
    return Sheet(CELL_M, origin_m, column, row, floor, floor + 3.0, links)


def drawn() -> Sheet:
    """The free space of `TwoIntersections`."""
    axis = np.arange(-25, 60, CELL_M)
    x, y = np.meshgrid(axis, axis)
    places = np.column_stack([x.ravel(), y.ravel()])
    return sheet_of(TwoIntersections().is_open(places).reshape(x.shape), np.array([-25.0, -25.0]))


def walls_of(sheet: Sheet) -> MapCloud:
    """The foot of the walls, drawn up."""
    edge = (sheet.links < 0).any(axis=1)
    foot = sheet.floor_points_m(np.flatnonzero(edge))
    return cloud_of(np.concatenate([foot + np.array([0, 0, z]) for z in np.arange(0.1, 3, 0.3)]))


def mapped(sheet: Sheet) -> MappedRoadways:
    graph = centre_lines(sheet, rooms_overlap=True)
    roads = tuple(
        MappedRoadway(road.a, road.b, road.line_m, *(np.full(len(road.line_m), v) for v in (2.0, 2.0, 3.0)))
        for road in graph.roadways
    )
    return MappedRoadways(graph.nodes_m, roads, 1.2)


def surveyed() -> MapCloud:
    """What a mapping flight sees along all roadways of `TwoIntersections`: a point a cell of 0.1 m."""
    rng = np.random.default_rng(0)
    plan = TwoIntersections()
    ways = [(x, 0.0) for x in np.arange(-18, 48, 1.5)] + [(0.0, y) for y in np.arange(1.5, 18, 1.5)]
    ways += [(30.0, y) for y in np.arange(-18, 18, 1.5)]
    parts = [plan.sweep(np.array(at), 0.0, rng) + np.array([*at, SENSOR_M]) for at in ways]
    points = np.concatenate(parts)
    points = points[np.unique(np.floor(points * 10), axis=0, return_index=True)[1]]
    return cloud_of(points)


def flown(plan: Plan, start_m: float, end_m: float, *, seed: int = 3) -> tuple[list[Keyframe], F64]:
    """Keyframes a metre apart along x, odometry in another frame than the map; and their true poses."""
    rng = np.random.default_rng(seed)
    step = 1.0 if end_m > start_m else -1.0
    heading = 0.0 if step > 0 else np.pi
    truth = np.array([se3.exp(np.array([0, 0, heading, 0, 0, 0]))] * int(abs(end_m - start_m)))
    truth[:, 0, 3] = start_m + step * np.arange(len(truth))
    truth[:, 2, 3] = SENSOR_M
    T_odom_map = se3.exp(np.array([0, 0, 1.1, 40.0, -7.0, 3.0]))
    return [Keyframe(k, k, T_odom_map @ T, plan.sweep(T[:2, 3], heading, rng)) for k, T in enumerate(truth)], truth


def edges_of(keyframes: Sequence[Keyframe]) -> list[RelativePose | None]:
    """What exact odometry says of its own exactness: a tenth of a degree and a centimetre a keyframe."""
    information = np.diag([np.radians(0.1) ** -2] * 3 + [0.01**-2] * 3)
    edges: list[RelativePose | None] = [None]
    for before, here in pairwise(keyframes):
        T = se3.inverse(before.T_odom_lidar) @ here.T_odom_lidar
        edges.append(RelativePose(before.index, here.index, T, information))
    return edges
