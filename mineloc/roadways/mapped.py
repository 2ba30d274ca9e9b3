"""Roadways as a survey tells them: centre-lines on the floor with width and height along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc.data.checks import freeze, need
from mineloc.roadways.graph import Roadway, RoadwayGraph

F64 = NDArray[np.float64]
STEEP = 0.08
"""Rise over length from which a roadway leads from one level to another rather than lies on one (1 in 12)."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedRoadway:
    """One roadway between two nodes.

    Attributes:
        a, b: indices of its end nodes.
        line_m: (n, 3) centre-line on the floor from a to b, map frame.
        left_m, right_m: (n,) clear distance from the line to the walls at the height of `MappedRoadways`, NaN where no
            wall was seen: where another roadway opens.
        height_m: (n,) floor to roof, NaN where unknown.
    """

    a: int
    b: int
    line_m: F64
    left_m: F64
    right_m: F64
    height_m: F64

    def __post_init__(self) -> None:
        n = len(self.line_m)
        need(n >= 2 and self.line_m.shape == (n, 3), "line_m must be (n, 3), n >= 2")
        for name in ("left_m", "right_m", "height_m"):
            need(getattr(self, name).shape == (n,), f"{name} must have one value a point of the line")
        freeze(self)

    @property
    def along_m(self) -> F64:
        """(n,) distance along the line."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.line_m, axis=0), axis=1))])

    @property
    def length_m(self) -> float:
        """Length of the centre-line."""
        return float(self.along_m[-1])

    @property
    def width_m(self) -> F64:
        """(n,) wall to wall."""
        return self.left_m + self.right_m

    @property
    def is_steep(self) -> bool:
        """Whether it is a ramp between levels."""
        return abs(float(self.line_m[-1, 2] - self.line_m[0, 2])) > STEEP * self.length_m


@dataclass(frozen=True, slots=True, eq=False)
class MappedRoadways:
    """Nodes and the roadways between them.

    Attributes:
        nodes_m: (k, 3) positions on the floor, map frame.
        roadways: the edges.
        width_height_m: above the floor at which widths are told.
    """

    nodes_m: F64
    roadways: tuple[MappedRoadway, ...]
    width_height_m: float

    def __post_init__(self) -> None:
        need(self.nodes_m.ndim == 2 and self.nodes_m.shape[1] == 3, "nodes_m must be (k, 3)")
        freeze(self)

    @property
    def graph(self) -> RoadwayGraph:
        """The lines alone."""
        return RoadwayGraph(self.nodes_m, tuple(Roadway(road.a, road.b, road.line_m) for road in self.roadways))

    @property
    def degrees(self) -> list[int]:
        """For each node how many roadways end there: 3 and more are intersections, 1 is an end."""
        return [len(roads) for roads in self.graph.at_node()]

    @property
    def intersections(self) -> list[int]:
        """Nodes where at least three roadways meet."""
        return self.graph.intersections

    @property
    def length_m(self) -> float:
        """Total length."""
        return sum(road.length_m for road in self.roadways)

    def levels(self, *, apart_m: float = 4.0) -> list[int | None]:
        """For each roadway the level it lies on, counted from below; None for ramps between levels.

        Args:
            apart_m: floors with so much between them and nothing level in between are levels apart.
        """
        mean = np.array([float(road.line_m[:, 2].mean()) for road in self.roadways])
        flat = [k for k, road in enumerate(self.roadways) if not road.is_steep]
        out: list[int | None] = [None] * len(self.roadways)
        level, last = 0, None
        for k in sorted(flat, key=lambda k: mean[k]):
            if last is not None and mean[k] - last > apart_m:
                level += 1
            out[k], last = level, float(mean[k])
        return out
