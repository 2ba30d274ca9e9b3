"""LinK3D keypoints and Scan Context: paper B's additions to LOAM (METHOD part 2, 4.2, 4.3)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mineloc.config.section import Section


class Link3dConfig(Section):
    """LinK3D: keypoints, descriptors, matching, and what the front end makes of them (METHOD part 2, 4.3)."""

    isolated_gap_m: float = Field(
        default=0.5, gt=0, description="a point so far from both its neighbours on the ring is an outlier"
    )
    isolated_gap_ratio: float = Field(default=0.05, ge=0, description="the gap grows by so much a metre of range")
    smoothness: Literal["sum", "mean"] = Field(
        default="sum", description="sum: the authors' code; mean: paper B's eq. 1, a tenth of it (METHOD D14)"
    )
    gate: Literal["adaptive", "fixed"] = Field(
        default="adaptive", description="fixed: as published, too high for 16 beams in a roadway (METHOD 4.3)"
    )
    fixed_gate_m2: float = Field(default=10.0, gt=0, description="lower gate of edge points, of the sum")
    upper_gate_m2: float = Field(default=20000.0, gt=0, description="upper gate of edge points, of the sum")
    gate_percentile: float = Field(default=95.0, gt=0, lt=100, description="adaptive gate: the sweep's own smoothness")
    gate_noise_multiple: float = Field(
        default=3.0, ge=0, description="adaptive gate: never below so many times what range noise alone makes"
    )
    range_sigma_m: float = Field(default=0.03, gt=0)
    reject_unreliable: bool = False
    sectors: int = Field(default=120, ge=3, description="parts of the horizon in which edge points are clustered")
    sector_min_points: int = Field(default=6, ge=1)
    cluster_range_m: float = Field(default=0.4, gt=0, description="horizontal range from the cluster's mean")
    cluster_xy_m: float = Field(default=0.3, gt=0, description="x and y from the cluster's mean")
    cluster_min_points: int = Field(default=4, ge=1, description="before merging; published: 10")
    merge_range_m: float = Field(default=0.6, gt=0, description="clusters with nearer means are one")
    merge_xy_m: float = Field(default=0.8, gt=0, description="clusters with nearer means are one")
    min_points: int = Field(default=8, ge=1, description="of a keypoint; published: 12, in effect 10")
    min_rings: int = Field(default=4, ge=1, description="of a keypoint")
    descriptor_sectors: int = Field(default=180, ge=4, description="dimensions")
    main_directions: int = Field(default=3, ge=1, description="nearest keypoints that a descriptor is built towards")
    min_keypoints: int = Field(default=5, ge=2, description="a sweep with fewer has no descriptors")
    distance_step_m: float = Field(default=0.1, gt=0, description="distances are rounded to it")
    tolerance_m: float = Field(default=0.2, gt=0, description="two distances so near are equal")
    min_score: int = Field(default=3, ge=1, description="equal dimensions of a match; 6 for 64 beams")
    min_matches: int = Field(default=5, ge=3, description="with fewer a sweep falls back to LOAM alone")
    inlier_m: float = Field(default=0.5, gt=0, description="RANSAC")
    trials: int = Field(default=64, ge=1, description="RANSAC")
    seed: int = Field(default=0, ge=0, description="RANSAC")
    start_gate_m: float = Field(default=0.2, gt=0, description="RANSAC's motion counts if so near to the prediction")
    start_gate_deg: float = Field(default=2.0, gt=0, description="and so little turned against it")
    start_weight: float = Field(
        default=0.1, ge=0, le=1, description="share of it in the start: the prediction is several times surer"
    )
    constraint_gate_m: float = Field(default=0.1, gt=0, description="matched edge points farther apart hold nothing")


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
