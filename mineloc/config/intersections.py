"""Intersections: found, described and recognised (METHOD part 5)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, PositiveFloat

from mineloc.config.section import Section


class IntersectionsConfig(Section):
    """Free space around the drone, the branches that leave it, and what describes an intersection."""

    cell_m: float = Field(default=0.2, gt=0, description="of the grid of free space")
    half_m: float = Field(default=16.0, gt=0, description="half the edge of the grid")
    window_keyframes: int = Field(default=12, ge=1, description="that are laid over each other")
    range_m: float = Field(default=20.0, gt=0, description="farther points are not looked at")
    wall_band_m: float = Field(default=0.8, gt=0, description="points so far above or below the sensor are wall")
    wall_votes: float = Field(default=0.5, gt=0, description="walls close a cell with this share of its votes")
    search_m: float = Field(default=9.0, gt=0, description="intersections are sought so near the drone")
    ring_m: tuple[PositiveFloat, ...] = Field(
        default=(1.0, 1.6, 2.2), min_length=2, description="rings beyond the clearance on which branches are counted"
    )
    ring_width_m: float = Field(default=0.4, gt=0)
    min_branch_m: float = Field(default=1.2, gt=0, description="least width of a branch")
    max_turn_deg: float = Field(default=22.0, gt=0, description="of a branch's bearing from ring to ring")
    apart_m: float = Field(default=3.0, gt=0, description="two intersections are at least so far apart")
    merge_m: float = Field(default=4.0, gt=0, description="nearer junctions of a map are one (METHOD 5.4)")
    centre_weight: float = Field(default=0.05, gt=0, description="of the clearance maximum in the invariant point")
    contour_radius_m: float = Field(default=8.0, gt=0)
    contour_bins: int = Field(default=180, ge=36)
    contour_sigma_m: float = Field(default=0.55, gt=0, description="of the kernel that compares wall distances")
    contour_known: float = Field(default=0.3, gt=0, le=1, description="least share of bins known in both")
    matrix_rows: int = Field(default=20, ge=1)
    matrix_row_m: float = Field(default=0.25, gt=0)
    matrix_below_m: float = Field(default=0.5, ge=0, description="the first row begins so far below the floor")
    cloud_radius_m: float = Field(default=15.0, gt=0, description="of the dense cloud that is kept")
    cloud_height_m: float = Field(default=6.0, gt=0, description="points so far above or below belong to other levels")
    threshold_floor: float = Field(default=0.5, ge=0, le=1, description="least contour similarity of a candidate")
    threshold_ceiling: float = Field(
        default=0.65, ge=0, le=1, description="no more is asked: an intersection seen again is hardly more like itself"
    )
    threshold_quantile: float = Field(default=0.99, ge=0, le=1, description="of pairs of different intersections")
    twin_matrix: float = Field(default=0.6, ge=0, le=1, description="matrix similarity from which on two are twins")
    branch_match_deg: float = Field(default=20.0, gt=0, description="two bearings so near are those of one branch")
    recognise_m: float = Field(default=7.0, gt=0, description="an intersection is recognised from at most so far away")
    peak_drop: float = Field(default=0.15, ge=0, le=1, description="turns so much less alike are tried too")
    matrix_margin: float = Field(default=0.05, ge=0, le=1, description="by which a matrix must fit better")
    same_needed: int = Field(default=3, ge=1, description="keyframes in a row that see the same intersection")
    threshold_known: float = Field(
        default=0.5, ge=0, le=1, description="least contour similarity where the pose leaves few to choose from"
    )
    same_needed_known: int = Field(default=2, ge=1, description="keyframes in a row where the pose is known")
    max_candidates: int = Field(default=6, ge=1, description="that matrices are compared of")
    completeness_limit: float = Field(
        default=10.0, ge=1, description="by which a partly seen intersection's covariance grows at most (METHOD D4)"
    )
    factor: Literal["pose", "position"] = Field(
        default="pose", description="what a recognition says: the drone's pose, or the place of the point (paper A)"
    )
    found_needed: int = Field(default=2, ge=1, description="intersections by which a flight from anywhere is found")
    sequence_share: float = Field(
        default=0.9, ge=0, le=1, description="of the shortest way between two intersections that must be flown"
    )
    verify_radius_m: float = Field(default=12.0, gt=0, description="points around the intersection that are registered")
    verify_inlier_ratio: float = Field(default=0.7, gt=0, le=1)
    verify_residual_m: float = Field(default=0.06, gt=0)
    verify_sigma_m: float = Field(default=0.3, gt=0, description="of the position in its least certain direction")
