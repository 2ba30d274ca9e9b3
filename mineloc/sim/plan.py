"""Mine plans: centre-lines with widths and heights, rooms and pillars, from TOML or from code; their roadway graph.

name = "north panel"
[roughness]
wall_m = 0.08                                       # standard deviation of the walls
[[roadway]]
points_m = [[0, 0, 0], [60, 0, 0.5], [90, 20, 1]]   # on the floor
width_m = 4.5
height_m = 3.5
[[roadway]]
points_m = [[60, 0, 0.5], [60, 40, 0.5]]            # begins on the other: an intersection
[[room]]
centre_m = [60, 50, 0.5]                            # widens the second; where one flies, roadways alone say
length_m = 24
width_m = 16
[[pillar]]
centre_m = [55, 47, 0.5]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mineloc.config import Section, read_toml, validate
from mineloc.roadways.graph import Roadway, RoadwayGraph

F64 = NDArray[np.float64]


class RoughnessPlan(Section):
    """How uneven the rock is: standard deviation of the wall about its profile, and over which lengths."""

    wall_m: float = Field(default=0.10, ge=0, le=0.5)
    longest_m: float = Field(default=2.0, gt=0.3, le=20)
    shortest_m: float = Field(default=0.5, gt=0.3, le=20)
    fine_m: float = Field(default=0.025, ge=0, le=0.2, description="at the resolution of the mesh")
    floor: float = Field(default=0.4, ge=0, le=1, description="share of it that floors show")

    @model_validator(mode="after")
    def _ordered(self) -> RoughnessPlan:
        if self.shortest_m > self.longest_m:
            raise ValueError("shortest_m must not exceed longest_m")
        return self


class RoadwayPlan(Section):
    """One centre-line on the floor."""

    points_m: tuple[tuple[float, float, float], ...] = Field(min_length=2)
    width_m: float = Field(default=4.0, ge=1.5, le=30)
    height_m: float = Field(default=3.2, ge=1.8, le=30)
    arch: float = Field(default=0.35, ge=0, lt=1, description="share of the height that the arched roof takes")
    closed: bool = False

    @property
    def line_m(self) -> F64:
        """(n, 3) centre-line; closed ones come back to their first point."""
        points = np.array(self.points_m, dtype=np.float64)
        return np.concatenate([points, points[:1]]) if self.closed else points


class BoxPlan(Section):
    """An upright box on the floor."""

    centre_m: tuple[float, float, float]
    length_m: float = Field(ge=0.3, le=200)
    width_m: float = Field(ge=0.3, le=200)
    height_m: float = Field(default=4.0, ge=0.3, le=30)
    heading_deg: float = Field(default=0.0, ge=-360, le=360, description="of the length, counter-clockwise from x")


class RoomPlan(BoxPlan):
    """Free space with a flat roof: a hall, an engine room, a niche in a wall. Where one flies, roadways alone say."""


class PillarPlan(BoxPlan):
    """What was left standing in free space; one lower than the roof is a bench or a machine."""

    length_m: float = Field(default=0.8, ge=0.3, le=200)
    width_m: float = Field(default=0.8, ge=0.3, le=200)
    height_m: float = Field(default=30.0, ge=0.3, le=30)


class MinePlan(Section):
    """A mine as somebody draws it: roadways meet where their lines cross or end on one another."""

    name: str = "plan"
    seed: int = Field(default=0, ge=0, description="of the roughness")
    cell_m: float = Field(default=0.2, ge=0.1, le=0.5, description="resolution of the surface")
    roughness: RoughnessPlan = RoughnessPlan()
    roadway: tuple[RoadwayPlan, ...] = Field(min_length=1)
    room: tuple[RoomPlan, ...] = ()
    pillar: tuple[PillarPlan, ...] = ()


def read_plan(path: Path) -> MinePlan:
    """A plan from a TOML file.

    Raises:
        ConfigError: not TOML, unknown keys, values that do not fit.
    """
    return validate(MinePlan, read_toml(path), where=str(path))


@dataclass(slots=True, eq=False)
class _Cuts:
    """Where a line is cut: along it, in metres."""

    line_m: F64
    along_m: F64
    at_m: list[float] = field(default_factory=list)


def plan_graph(plan: MinePlan, *, level_gap_m: float = 1.0) -> RoadwayGraph:
    """The roadway graph of a plan.

    Lines meet where they cross in plan within `level_gap_m` of height, and where one ends within half a width of
    another; nearer than half a width, meeting points are one node.

    Args:
        plan: the mine.
        level_gap_m: lines farther apart in height pass over one another.
    """
    cuts = [_cuts(road.line_m) for road in plan.roadway]
    for i, first in enumerate(plan.roadway):
        for j in range(i, len(plan.roadway)):
            reach = min(first.width_m, plan.roadway[j].width_m) / 2
            _meet(cuts[i], cuts[j], reach, level_gap_m, same=i == j)
    nodes: list[F64] = []
    roads: list[Roadway] = []
    for road, cut in zip(plan.roadway, cuts, strict=True):
        for piece in _pieces(cut, road.width_m / 2):
            ends = [_node(nodes, piece[k], road.width_m / 2, level_gap_m) for k in (0, -1)]
            line = np.concatenate([nodes[ends[0]][None], piece[1:-1], nodes[ends[1]][None]])
            roads.append(Roadway(ends[0], ends[1], line))
    return RoadwayGraph(np.array(nodes), tuple(roads))


def _cuts(line_m: F64) -> _Cuts:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    return _Cuts(line_m, along)


def _meet(first: _Cuts, second: _Cuts, reach_m: float, level_gap_m: float, *, same: bool) -> None:
    """Note where two lines cross, and where an end of one lies on the other."""
    for a in range(len(first.line_m) - 1):
        for b in range(a + 2 if same else 0, len(second.line_m) - 1):
            found = _crossing(first.line_m[a : a + 2], second.line_m[b : b + 2], level_gap_m)
            if found is not None:
                first.at_m.append(float(first.along_m[a] + found[0] * (first.along_m[a + 1] - first.along_m[a])))
                second.at_m.append(float(second.along_m[b] + found[1] * (second.along_m[b + 1] - second.along_m[b])))
    if not same:
        for one, other in ((first, second), (second, first)):
            for end in (one.line_m[0], one.line_m[-1]):
                at = _foot(end, other, reach_m, level_gap_m)
                if at is not None:
                    other.at_m.append(at)


def _crossing(p: F64, q: F64, level_gap_m: float) -> tuple[float, float] | None:
    """Shares of two segments (2, 3) at which they cross in plan, None if they do not or lie on different levels."""
    u, v, w = p[1] - p[0], q[1] - q[0], q[0] - p[0]
    det = u[0] * v[1] - u[1] * v[0]
    if abs(det) < 1e-9:
        return None
    s = (w[0] * v[1] - w[1] * v[0]) / det
    t = (w[0] * u[1] - w[1] * u[0]) / det
    if not (0 <= s <= 1 and 0 <= t <= 1):
        return None
    return (s, t) if abs((p[0] + s * u)[2] - (q[0] + t * v)[2]) <= level_gap_m else None


def _foot(point_m: F64, line: _Cuts, reach_m: float, level_gap_m: float) -> float | None:
    """Where along a line a point lies within reach of it."""
    start, step = line.line_m[:-1], np.diff(line.line_m, axis=0)
    u = np.clip(((point_m - start)[:, :2] * step[:, :2]).sum(1) / np.maximum((step[:, :2] ** 2).sum(1), 1e-12), 0, 1)
    off = point_m - (start + u[:, None] * step)
    distance = np.where(np.abs(off[:, 2]) <= level_gap_m, np.hypot(off[:, 0], off[:, 1]), np.inf)
    k = int(distance.argmin())
    return float(line.along_m[k] + u[k] * (line.along_m[k + 1] - line.along_m[k])) if distance[k] <= reach_m else None


def _pieces(cut: _Cuts, shortest_m: float) -> list[F64]:
    """The line cut at all noted places; cuts nearer than `shortest_m` to the one before are the same place."""
    length = float(cut.along_m[-1])
    places = [0.0]
    for at in [*sorted(cut.at_m), length]:
        if at - places[-1] >= shortest_m:
            places.append(at)
    if len(places) == 1 or length - places[-1] > 0:
        places = [*(places[:-1] if len(places) > 1 else places), length]
    return [_between(cut, a, b) for a, b in pairwise(places)]


def _between(cut: _Cuts, a: float, b: float) -> F64:
    inner = cut.along_m[(cut.along_m > a) & (cut.along_m < b)]
    at = np.concatenate([[a], inner, [b]])
    return np.stack([np.interp(at, cut.along_m, cut.line_m[:, axis]) for axis in range(3)], axis=1)


def _node(nodes: list[F64], point_m: F64, reach_m: float, level_gap_m: float) -> int:
    """The node at a point: one that is there already, or a new one."""
    for index, node in enumerate(nodes):
        off = node - point_m
        if np.hypot(off[0], off[1]) <= reach_m and abs(off[2]) <= level_gap_m:
            return index
    nodes.append(point_m.copy())
    return len(nodes) - 1


def roadway(
    points_m: Sequence[tuple[float, float, float]],
    *,
    width_m: float = 4.0,
    height_m: float = 3.2,
    arch: float = 0.35,
    closed: bool = False,
) -> RoadwayPlan:
    """One roadway, shorter to write."""
    return RoadwayPlan(points_m=tuple(points_m), width_m=width_m, height_m=height_m, arch=arch, closed=closed)
