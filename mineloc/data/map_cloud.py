"""The map as a cloud: one point for each piece of surface, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from dataclasses import replace as _replace
from enum import IntEnum

import numpy as np

from mineloc.data.arrays import F32, F64, I32, I64, U8, Bool
from mineloc.data.checks import freeze, need


class SurfaceKind(IntEnum):
    """What a piece of surface is."""

    OTHER = 0
    FLOOR = 1
    WALL = 2
    ROOF = 3


@dataclass(frozen=True, slots=True, eq=False)
class MapCloud:
    """Points of the surface of a mine. float32 does not hold a mine grid, so they are told from an origin near by.

    Attributes:
        origin_m: (3,) float64, in `frame`.
        points_m: (n, 3) float32 relative to `origin_m`.
        normals: (n, 3) float32 unit normals, into the open.
        counts: (n,) int32 measured points that are averaged.
        visits: (n,) int32 keyframes that saw it.
        thickness_m: (n,) float32 standard deviation of those points across the surface.
        near_m: (n,) float32 least distance from which it was seen.
        surface: (n,) uint8 `SurfaceKind`.
        voxel_m: there is about one point in so much of the surface.
        frame: name of the frame, z up.
    """

    origin_m: F64
    points_m: F32
    normals: F32
    counts: I32
    visits: I32
    thickness_m: F32
    near_m: F32
    surface: U8
    voxel_m: float
    frame: str = "map"

    def __post_init__(self) -> None:
        n = len(self.points_m)
        need(self.origin_m.shape == (3,) and self.origin_m.dtype == np.float64, "origin_m must be (3,) float64")
        for name in ("points_m", "normals"):
            value = getattr(self, name)
            need(value.shape == (n, 3) and value.dtype == np.float32, f"{name} must be (n, 3) float32")
        for f in fields(self)[3:8]:
            need(getattr(self, f.name).shape == (n,), f"{f.name} must have one value a point")
        need(self.surface.dtype == np.uint8, "surface must be uint8")
        need(bool(np.isfinite(self.points_m).all()), "points_m must be finite")
        freeze(self)

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def points_map(self) -> F64:
        """(n, 3) float64 points in `frame`, the origin put back."""
        return self.points_m + self.origin_m

    def keep(self, mask: Bool | I64) -> MapCloud:
        """Only the masked (or indexed) points; all that is known of them goes along."""
        names = [f.name for f in fields(self)[1:8]]
        return _replace(self, **{name: getattr(self, name)[mask] for name in names})

    def of_kind(self, kind: SurfaceKind) -> MapCloud:
        """Only floor, walls, roof or the rest."""
        return self.keep(self.surface == kind)

    def classified(self, surface: U8) -> MapCloud:
        """The same points with other kinds."""
        return _replace(self, surface=surface)
