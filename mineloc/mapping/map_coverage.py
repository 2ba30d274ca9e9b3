"""How much of the roadways a map shows, and how densely: shadows and holes, a piece of roadway at a time.

At each place of a centre-line the section is cut into rays from its middle. A ray is seen if a point of the map lies
in its direction, within the place's share of the length and not beyond where the wall must be.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mineloc.compiled import njit, prange
from mineloc.data import F32, F64, I32, I64, Bool, MapCloud
from mineloc.data.checks import freeze
from mineloc.mapping.free_space import WIDE
from mineloc.mapping.roadway_profiles import lefts
from mineloc.roadways.mapped import MappedRoadway, MappedRoadways

RAYS = 72
SEEN = 0.5
"""A floor, wall or roof counts as seen at a place when so much of it is."""
USUAL_HALF_WIDTH_M, USUAL_HEIGHT_M = 2.0, 3.0
OPEN_SIDE = 1.6
"""A wall so many times farther away than usual along its roadway is that of another one: none is expected."""
BEYOND, BEYOND_M = 1.3, 0.3
"""Points are looked for up to here: so many times the expected distance and so much more."""
FLOOR, LEFT, RIGHT, ROOF = range(4)
_BOX_M = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What is seen of pieces of roadway, n of them; shares are of the rays that should meet the side.

    Attributes:
        roadway: (n,) number of the roadway.
        begin_m, end_m: (n,) along its line.
        seen: (n, 4) share of floor, left wall, right wall and roof; NaN where another roadway opens all along.
        complete: (n,) share of the length at which at least half of each side is seen.
        points_pm2: (n,) points of the map on a square metre of the floor, walls and roof that should be there, those of
            a box as wide and high as the roadway.
        measured_pm2: (n,) measured points on a square metre.
        thickness_m: (n,) root mean square of the standard deviation across the surface; NaN without points.
    """

    roadway: I64
    begin_m: F64
    end_m: F64
    seen: F64
    complete: F64
    points_pm2: F64
    measured_pm2: F64
    thickness_m: F64

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def complete_share(self) -> float:
        """Share of the length of all roadways at which floor, walls and roof are seen; NaN without any."""
        length = self.end_m - self.begin_m
        return float((self.complete * length).sum() / length.sum()) if len(length) else float("nan")


class Stations(NamedTuple):
    """Places on the centre-lines, m of them, each with its share of the length.

    Attributes:
        place_m: (m, 3) on the floor.
        left_of: (m, 2).
        length_m: (m,) of line that it stands for.
        reach_m: (m, 3) expected distance to the left wall, the right wall and from floor to roof.
        asked: (m, 2) whether walls are expected left and right.
        piece: (m,) number of the piece.
    """

    place_m: F64
    left_of: F64
    length_m: F64
    reach_m: F64
    asked: Bool
    piece: I64


def coverage(cloud: MapCloud, roadways: MappedRoadways, *, piece_m: float = 20.0) -> Coverage:
    """What a map shows of its roadways.

    Args:
        cloud: the map.
        roadways: found in the same map.
        piece_m: nominal length of a piece; each roadway is cut into equal ones.
    """
    pieces: list[tuple[int, float, float]] = []
    parts: list[Stations] = []
    for number, road in enumerate(roadways.roadways):
        count = max(1, round(road.length_m / piece_m))
        parts.append(_stations(road, count, len(pieces)))
        ends = np.linspace(0.0, road.length_m, count + 1)
        pieces += [(number, float(a), float(b)) for a, b in pairwise(ends)]
    if not parts:
        none = np.zeros(0)
        return Coverage(np.zeros(0, np.int64), none, none, np.zeros((0, 4)), none, none, none, none)
    stations = Stations(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    rays, sums = _look(cloud, stations)
    table = np.array(pieces)
    return _in_pieces(table, stations, _seen(rays, stations), sums)


def _stations(road: MappedRoadway, count: int, first_piece: int) -> Stations:
    along = road.along_m
    border = np.concatenate([[0.0], (along[1:] + along[:-1]) / 2, along[-1:]])
    usual = [_median(road.left_m, USUAL_HALF_WIDTH_M), _median(road.right_m, USUAL_HALF_WIDTH_M)]
    walls = np.column_stack([road.left_m, road.right_m])
    asked = walls <= OPEN_SIDE * np.array(usual)
    walls = np.where(asked, walls, usual)
    height = np.where(np.isnan(road.height_m), _median(road.height_m, USUAL_HEIGHT_M), road.height_m)
    piece = np.minimum((along / max(along[-1], 1e-9) * count).astype(np.int64), count - 1)
    reach = np.column_stack([walls, height])
    return Stations(road.line_m, lefts(road.line_m), np.diff(border), reach, asked, first_piece + piece)


def _median(values: F64, otherwise: float) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else otherwise


def _seen(rays: I32, stations: Stations) -> F64:
    """(m, 4) share of each side's rays that are seen, NaN where no wall is expected."""
    angle = (np.arange(RAYS) + 0.5) * 2 * np.pi / RAYS - np.pi
    ahead, up = np.cos(angle), np.sin(angle)
    left, right, half = stations.reach_m[:, 0], stations.reach_m[:, 1], stations.reach_m[:, 2] / 2
    to_wall = np.where(ahead > 0, left[:, None], right[:, None]) / np.abs(ahead)
    is_wall = to_wall < half[:, None] / np.abs(up)
    sides = np.stack([~is_wall & (up < 0), is_wall & (ahead > 0), is_wall & (ahead < 0), ~is_wall & (up > 0)], axis=1)
    share = (sides & (rays > 0)[:, None, :]).sum(axis=2) / np.maximum(sides.sum(axis=2), 1)
    share[:, LEFT : RIGHT + 1][~stations.asked] = np.nan
    return share


def _in_pieces(table: F64, stations: Stations, seen: F64, sums: F64) -> Coverage:
    n = len(table)

    def total(values: F64) -> F64:
        return np.bincount(stations.piece, values, n).astype(np.float64)

    shares: list[F64] = []
    for side in range(4):
        known = ~np.isnan(seen[:, side])
        length = total(stations.length_m * known)
        share = total(stations.length_m * np.where(known, seen[:, side], 0.0))
        shares.append(np.divide(share, length, out=np.full(n, np.nan), where=length > 0))
    complete = np.where(np.isnan(seen), 1.0, seen >= SEEN).all(axis=1)
    points, measured, squared = (total(column) for column in sums.T)
    width = stations.reach_m[:, 0] + stations.reach_m[:, 1]
    around = 2 * width + stations.reach_m[:, 2] * stations.asked.sum(axis=1)
    area = np.maximum(total(stations.length_m * around), 1e-9)
    return Coverage(
        table[:, 0].astype(np.int64),
        table[:, 1],
        table[:, 2],
        np.stack(shares, axis=1),
        total(stations.length_m * complete) / np.maximum(total(stations.length_m), 1e-9),
        points / area,
        measured / area,
        np.sqrt(np.divide(squared, points, out=np.full(n, np.nan), where=points > 0)),
    )


def _look(cloud: MapCloud, stations: Stations) -> tuple[I32, F64]:
    """(m, RAYS) points in each ray; (m, 3) sums of points, measured points and squared thickness."""
    corner = cloud.points_m[:, :2].min(axis=0, initial=np.inf) if len(cloud) else np.zeros(2, np.float32)
    box = np.floor((cloud.points_m[:, :2] - corner) / _BOX_M).astype(np.int64)
    number = box[:, 1] * WIDE + box[:, 0]
    order = np.argsort(number, kind="stable")
    known: F64 = np.column_stack([np.ones(len(cloud)), cloud.counts, cloud.thickness_m**2]).astype(np.float64)
    places = stations.place_m - cloud.origin_m
    return _count(
        places, stations.left_of, stations.length_m, stations.reach_m, cloud.points_m[order], known[order],
        number[order], corner.astype(np.float64),
    )  # fmt: skip


@njit(cache=True, parallel=True)
def _count(
    places: F64, left_of: F64, length: F64, reach: F64, points: F32, known: F64, number: I64, corner: F64
) -> tuple[I32, F64]:
    rays = np.zeros((len(places), RAYS), np.int32)
    sums = np.zeros((len(places), known.shape[1]))
    for i in prange(len(places)):
        x, y, z = places[i, 0], places[i, 1], places[i, 2] + reach[i, 2] / 2
        lx, ly = left_of[i, 0], left_of[i, 1]
        left, right, half = reach[i, 0] * BEYOND, reach[i, 1] * BEYOND, reach[i, 2] / 2 * BEYOND
        far = max(left, right) + BEYOND_M
        first = max(int(np.floor((x - far - corner[0]) / _BOX_M)), 0)
        last = int(np.floor((x + far - corner[0]) / _BOX_M))
        low, high = int(np.floor((y - far - corner[1]) / _BOX_M)), int(np.floor((y + far - corner[1]) / _BOX_M))
        for row in range(max(low, 0), high + 1):
            k = np.searchsorted(number, row * WIDE + first)
            while k < len(number) and number[k] <= row * WIDE + last:
                dx, dy, up = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
                across = dx * lx + dy * ly
                within = abs(dx * ly - dy * lx) <= length[i] / 2 and abs(up) < half + BEYOND_M
                if within and -right - BEYOND_M < across < left + BEYOND_M:
                    turn = (np.arctan2(up, across) + np.pi) / (2 * np.pi)
                    rays[i, min(int(turn * RAYS), RAYS - 1)] += 1
                    for c in range(known.shape[1]):
                        sums[i, c] += known[k, c]
                k += 1
    return rays, sums
