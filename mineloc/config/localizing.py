"""Localization in a prior map."""

from __future__ import annotations

from pydantic import Field

from mineloc.config.section import Section


class PriorMapConfig(Section):
    """Registration of keyframes to a prior map, and where a flight begins in it."""

    start_m: tuple[float, float, float] | None = Field(
        default=None, description="where the drone begins, in the mine grid (without a grid: the map's frame)"
    )
    start_yaw_deg: float = Field(default=0.0, description="its heading there, counter-clockwise from the x axis")
    start_sigma_m: float = Field(default=0.5, gt=0)
    start_sigma_deg: float = Field(default=3.0, gt=0)
    patch_min_points: float = Field(default=4.0, ge=3, description="points of the map that make a patch")
    rounds: int = Field(default=10, ge=1)
    expected_inflation: float = Field(
        default=25.0, ge=1, description="of the covariance of where a keyframe is expected"
    )
    expected_m: float = Field(default=0.1, gt=0, description="added to that")
    expected_deg: float = Field(default=0.3, gt=0, description="added to that")
    min_matches: int = Field(default=100, ge=6)
    min_inlier_ratio: float = Field(
        default=0.6, gt=0, le=1, description="of a keyframe's points; fewer: odometry alone"
    )
    max_residual_m: float = Field(default=0.08, gt=0)
    max_moved_sigmas: float = Field(default=4.0, gt=0, description="away from where odometry expects it")
    moved_floor_m: float = Field(default=0.15, gt=0)
    moved_floor_deg: float = Field(default=0.5, gt=0)
    lost_after: int = Field(
        default=50, ge=1, description="keyframes that do not fit the map; then intersections find the flight anew"
    )
    seen_floor_m: float = Field(default=1.0, gt=0, description="added to the prediction before registration")
    seen_floor_deg: float = Field(default=5.0, gt=0, description="added to the prediction before registration")
    correlation: float = Field(default=20.0, ge=1, description="so many residuals share one error")
    sigma_m: float = Field(default=0.05, gt=0, description="floor of a fix's error; that of the map stays for metres")
    sigma_deg: float = Field(default=0.15, gt=0, description="floor of a fix's error; that of the map stays for metres")
