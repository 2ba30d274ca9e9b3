"""From runs to maps."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from mineloc.config.section import Section


class LoopsConfig(Section):
    """Loop closures: candidates, registration, what makes one believed."""


class FusionConfig(Section):
    """Fusion of depth images with LiDAR ranges (METHOD 6.1)."""


class ControlConfig(Section):
    """Surveyed control points: how they are seen and how they enter the graph."""

    axes: Literal["z_up", "y_up"] = Field(default="z_up", description="of the file of targets")
    gate_m: float = Field(default=0.3, gt=0, description="a sighting farther from its target is a gross error")
    drift: float = Field(
        default=0.002, ge=0, description="what odometry may add to the gate before loops and control correct it, a way"
    )
    min_separation_m: float = Field(default=5.0, gt=0, description="of two targets that fix the heading of the map")
    origin_step_m: float = Field(default=1000.0, gt=0, description="the local origin is a multiple of it")
    anchor_m: float = Field(default=10.0, gt=0, description="the first position, where control points decide")
    anchor_yaw_deg: float = Field(default=10.0, gt=0, description="the first heading, where control points decide")
    between: float = Field(
        default=0.01, ge=0, description="error of the way from a keyframe to the sweep of a sighting, a way"
    )
    between_deg: float = Field(default=0.05, ge=0, description="error of the turn on that way")
    outlier_sigmas: float = Field(default=5.0, gt=0, description="a target farther off is told as an outlier")
    tolerance_m: float = Field(default=0.1, gt=0, description="RMSE in space that the check points must keep")
    min_tag_margin: float = Field(default=30.0, ge=0, description="decision margin of an AprilTag")
    tag_corner_px: float = Field(default=0.3, gt=0, description="error of a tag's corner in the image, one axis")


class MapConfig(Section):
    """The map as a survey product."""
