"""LinK3D keypoints and Scan Context: paper B's additions to LOAM (METHOD part 2, 4.2, 4.3)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mineloc.config.section import Section


class Link3dConfig(Section):
    """LinK3D keypoints, descriptors and matching."""


class ScanContextConfig(Section):
    """Scan Context descriptors and their search."""

    cell: Literal["max_height", "free_range"] = Field(
        default="max_height", description="what a cell holds: as published, or how far one sees, which tells roadways"
    )
    rings: int = Field(default=20, ge=1)
    sectors: int = Field(default=60, ge=3)
    radius_m: float = Field(default=40.0, gt=0, description="80 outdoors; a roadway is seen no farther")
    lidar_height_m: float = Field(default=2.0, description="added to all heights, so that floors stay above zero")
    candidates: int = Field(default=10, ge=1, description="nearest ring keys whose contexts are compared")
    search_ratio: float = Field(
        default=0.1, ge=0, le=1, description="share of all turns that is tried around that of the sector keys"
    )
    min_shared_columns: float = Field(
        default=0.3, gt=0, le=1, description="share of the columns that must be filled in both contexts"
    )
    max_distance: float = Field(
        default=0.2, ge=0, le=1, description="of two contexts that may be one place; about 0.02 with free_range"
    )
    min_path_m: float = Field(default=30.0, ge=0, description="a place left so short a way ago is not seen again")
