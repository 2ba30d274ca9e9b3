"""What is known of the intersections of a mine: the records of the semantic knowledge database (paper A, 1.9)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import numpy as np

from mineloc.data.arrays import F32, F64, U8
from mineloc.data.checks import freeze, need

IntersectionKind = Literal["T", "Y", "X", "other", "bay"]


class Sight(IntEnum):
    """What a direction shows from the invariant point."""

    UNKNOWN = 0
    WALL = 1
    OPEN = 2


@dataclass(frozen=True, slots=True, eq=False)
class WallContour:
    """The plane wall contour vector (PWCV): walls around an invariant point, seen from above (METHOD 5.1 (6)).

    Bin b looks along the bearing `2π b / n`, counter-clockwise from the x axis of the frame that it is told in.

    Attributes:
        distance: (n,) float32 distance of the wall over `radius_m`, in (0, 1]; 0 where the bin is no wall.
        sight: (n,) uint8 `Sight`.
        radius_m: reach.
        branches_rad: (b,) bearings of the roadways that meet, rising, in [0, 2π).
    """

    distance: F32
    sight: U8
    radius_m: float
    branches_rad: F64

    def __post_init__(self) -> None:
        n = len(self.distance)
        need(self.distance.shape == (n,) and self.distance.dtype == np.float32, "distance must be (n,) float32")
        need(self.sight.shape == (n,) and self.sight.dtype == np.uint8, "sight must be (n,) uint8")
        need(bool(np.all((self.distance > 0) == (self.sight == Sight.WALL))), "walls alone have a distance")
        need(self.branches_rad.ndim == 1, "branches_rad must be (b,)")
        freeze(self)

    @property
    def walls(self) -> int:
        """Bins that see a wall: k_c of paper A."""
        return int((self.sight == Sight.WALL).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Intersection:
    """One intersection of a map.

    Attributes:
        id: number in its database.
        name: for people, who may change it.
        kind: shape of the branches; `bay` is a widening with fewer than three.
        point_map: (3,) the geometric invariant point, on the floor.
        covariance_m2: (3, 3) of that point.
        contour: PWCV around it, in map axes.
        matrix: (rows, n) float32 CWC: wall distance over radius by height above the floor and bearing; 0 where no wall
            was seen (METHOD 5.1 (7)).
        points_m: (m, 3) float32 dense cloud, relative to `point_map`, in map axes.
        normals: (m, 3) float32 of it, into the open.
        neighbours: ids of the next intersections along roadways, and the lengths of the ways there.
        quality: share of virtual views of it that recognise it as itself.
    """

    id: int
    name: str
    kind: IntersectionKind
    point_map: F64
    covariance_m2: F64
    contour: WallContour
    matrix: F32
    points_m: F32
    normals: F32
    neighbours: tuple[tuple[int, float], ...]
    quality: float

    def __post_init__(self) -> None:
        need(self.point_map.shape == (3,), "point_map must be (3,)")
        need(self.covariance_m2.shape == (3, 3), "covariance_m2 must be (3, 3)")
        need(self.matrix.ndim == 2 and self.matrix.dtype == np.float32, "matrix must be (rows, n) float32")
        for name in ("points_m", "normals"):
            value = getattr(self, name)
            need(value.shape == (len(self.points_m), 3) and value.dtype == np.float32, f"{name} must be (m, 3) float32")
        freeze(self)

    @property
    def degree(self) -> int:
        """How many roadways meet."""
        return len(self.contour.branches_rad)


@dataclass(frozen=True, slots=True)
class Lineage:
    """Where a database comes from.

    Attributes:
        version: 1 for the first of a mine, rising from parent to child.
        parents: sha256 of the database files that it follows; none for the first.
        next_id: above every id that it or a parent ever used; ids of what is gone are not given again.
        maps: sha256 of the manifests of the maps that its intersections were found in, rising.
    """

    version: int
    parents: tuple[str, ...]
    next_id: int
    maps: tuple[str, ...]

    def __post_init__(self) -> None:
        need(self.version >= 1, "version must be positive")
        need((self.version == 1) == (not self.parents), "the first version alone has no parents")
        need(bool(self.maps) and list(self.maps) == sorted(set(self.maps)), "maps must rise")

    @staticmethod
    def first(map_sha256: str, ids: Iterable[int]) -> Lineage:
        """Of a database that follows none, with those ids."""
        return Lineage(1, (), max(ids, default=-1) + 1, (map_sha256,))


@dataclass(frozen=True, slots=True, eq=False)
class IntersectionDatabase:
    """All intersections of a map, or of several maps in one grid.

    Attributes:
        intersections: by rising id.
        grid_origin_m: (3,) of the map frame in the mine grid; zero without a grid.
        is_grid: whether the map stands in the mine grid.
        lineage: version, parents and maps.
        contour_similarity, matrix_similarity: (k, k) between the intersections, the best turn each (paper A, Fig. 16).
        contour_threshold: similarity above which two contours may be one place; follows from the matrix.
        twins: pairs of ids that contour and matrix cannot tell apart.
    """

    intersections: tuple[Intersection, ...]
    grid_origin_m: F64
    is_grid: bool
    lineage: Lineage
    contour_similarity: F64
    matrix_similarity: F64
    contour_threshold: float
    twins: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        k = len(self.intersections)
        ids = [one.id for one in self.intersections]
        need(ids == sorted(set(ids)), "ids must rise")
        need(not ids or 0 <= ids[0] <= ids[-1] < self.lineage.next_id, "ids must be below next_id")
        for name in ("contour_similarity", "matrix_similarity"):
            need(getattr(self, name).shape == (k, k), f"{name} must be (k, k)")
        freeze(self)

    def __len__(self) -> int:
        return len(self.intersections)

    @property
    def map_sha256(self) -> str:
        """Of the manifest of its map; of several maps, a name for all of them together."""
        maps = self.lineage.maps
        return maps[0] if len(maps) == 1 else hashlib.sha256("+".join(maps).encode()).hexdigest()

    def in_frame_at(self, grid_origin_m: F64) -> IntersectionDatabase:
        """The same places in a frame with another origin in the mine grid; both frames have the grid's axes.

        Args:
            grid_origin_m: (3,) of that frame.

        Raises:
            ValueError: the origin is another one, and the database is not in the mine grid.
        """
        shift = self.grid_origin_m - grid_origin_m
        if not shift.any():
            return self
        if not self.is_grid:
            raise ValueError("a database that is not in the mine grid")
        there = tuple(replace(one, point_map=one.point_map + shift) for one in self.intersections)
        return replace(self, intersections=there, grid_origin_m=grid_origin_m)

    def by_id(self, id: int) -> Intersection:
        """The intersection with that id.

        Raises:
            KeyError: there is none.
        """
        for one in self.intersections:
            if one.id == id:
                return one
        raise KeyError(id)
