"""From runs to maps."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, PositiveFloat

from mineloc.config.section import Section


class LoopsConfig(Section):
    """Loop closures: candidates, registration, what makes one believed."""

    every_m: float = Field(default=5.0, gt=0, description="candidates are sought once in so long a way")
    min_path_m: float = Field(default=30.0, gt=0, description="a place seen within so short a way is not seen again")
    max_radius_m: float = Field(default=12.0, gt=0, description="candidates by position are at most so far away")
    max_candidates: int = Field(default=3, ge=1, description="of one search that are registered")
    submap_keyframes: int = Field(default=5, ge=0, description="on either side of a submap's root")
    submap_voxel_m: float = Field(default=0.3, gt=0)
    submap_reach_m: float = Field(default=20.0, gt=0)
    normal_radius_m: float = Field(default=1.0, gt=0)
    icp_distances_m: tuple[PositiveFloat, ...] = Field(
        default=(2.0, 0.8, 0.3), min_length=1, description="of matches, one ICP after the other; the last is an inlier"
    )
    icp_kernel_m: float = Field(default=0.1, gt=0, description="Tukey's kernel")
    features_from_m: float = Field(
        default=0.7, ge=0, description="predictions less certain than this start from ISS and FPFH"
    )
    iss_salient_m: float = Field(default=1.2, gt=0)
    iss_suppression_m: float = Field(default=0.8, gt=0)
    fpfh_radius_m: float = Field(default=2.0, gt=0)
    features_distance_m: float = Field(default=0.6, gt=0, description="RANSAC's inlier distance")
    min_overlap: float = Field(default=0.6, gt=0, le=1, description="share of either submap that the other confirms")
    max_residual_m: float = Field(default=0.06, gt=0)
    min_inliers: int = Field(default=300, ge=6)
    min_eigenvalue: float = Field(
        default=0.008, ge=0, description="of the translation block an inlier: below it a direction is open"
    )
    gate_sigmas: float = Field(default=3.0, gt=0, description="a closure's distance from what odometry predicts")
    gate_floor_m: float = Field(default=0.3, ge=0)
    gate_floor_deg: float = Field(default=1.0, ge=0)
    support: int = Field(default=2, ge=1, description="closures that must agree with one another")
    support_within_m: float = Field(default=30.0, gt=0, description="of the way, on both visits")
    join_votes: int = Field(default=4, ge=2, description="places that join two flights without control points")
    join_m: float = Field(default=3.0, gt=0, description="odometry may have drifted so far between two such places")
    join_deg: float = Field(default=3.0, gt=0, description="odometry may have turned so far between two such places")
    sigma_m: float = Field(default=0.02, gt=0, description="floor of a closure's own error")
    sigma_deg: float = Field(default=0.05, gt=0, description="floor of a closure's own error")


class FusionConfig(Section):
    """Fusion of depth images with LiDAR ranges (METHOD 6.1). Pixels are those of the images."""

    every_m: float = Field(default=1.0, gt=0, description="way between images that are fused")
    baseline_m: float = Field(default=0.05, gt=0, description="of the stereo pair")
    white_px: float = Field(default=0.08, gt=0, description="noise of the disparity, a pixel for itself")
    patchy_px: float = Field(default=0.07, gt=0, description="noise of the disparity in patches, as a first guess")
    patch_range_px: float = Field(default=12.0, gt=0, description="range of its exponential covariance, first guess")
    drift_px: float = Field(default=0.5, gt=0, description="prior of the drift: disparity error at the image's centre")
    drift_slope_px: float = Field(default=0.3, ge=0, description="prior of its change from the centre to the border")
    lidar_sigma_m: float = Field(default=0.02, gt=0)
    relief_m: float = Field(default=0.012, ge=0, description="relief of the rock that smoothing takes away, one sigma")
    window_px: int = Field(default=4, ge=1, le=12, description="half of the window of the affine smoothing")
    edge_sigmas: float = Field(default=4.0, gt=0, description="neighbours farther off are beyond an edge")
    edge_slope: float = Field(default=0.03, ge=0, description="relative change of depth a pixel that is no edge")
    neighbours: int = Field(default=12, ge=3, le=32)
    stride_px: int = Field(default=4, ge=1, description="lattice on which the residual is kriged")
    gap_px: float = Field(
        default=14.0, gt=0, description="LiDAR alone fills holes of the camera so far from its points"
    )
    max_sigma_m: float = Field(default=0.05, gt=0, description="worse pixels do not enter the map")
    variogram_lags: int = Field(default=12, ge=4)
    variogram_reach_px: float = Field(default=60.0, gt=4)
    variogram_share: float = Field(default=0.1, gt=0, le=1, description="weight of a new image in the variogram")


class ControlConfig(Section):
    """Surveyed control points: how they are seen and how they enter the graph."""

    axes: Literal["z_up", "y_up"] = Field(default="z_up", description="of the file of targets")
    gate_m: float = Field(default=0.3, gt=0, description="a sighting farther from its target is a gross error")
    drift: float = Field(
        default=0.002, ge=0, description="share of the way that odometry may be off by before anything corrects it"
    )
    min_separation_m: float = Field(default=5.0, gt=0, description="of two targets that fix the heading of the map")
    origin_step_m: float = Field(default=1000.0, gt=0, description="the local origin is a multiple of it")
    anchor_m: float = Field(default=10.0, gt=0, description="the first position, where control points decide")
    anchor_yaw_deg: float = Field(default=10.0, gt=0, description="the first heading, where control points decide")
    gravity_sigma_deg: float = Field(
        default=20.0, gt=0, description="of a keyframe's measured up, where control points see the tilt better"
    )
    between: float = Field(
        default=0.01, ge=0, description="share of the way from a keyframe to a sighting that odometry is off by"
    )
    between_deg: float = Field(default=0.05, ge=0, description="error of the turn on that way")
    outlier_sigmas: float = Field(default=5.0, gt=0, description="a target farther off is told as an outlier")
    tolerance_m: float = Field(default=0.1, gt=0, description="RMSE in space that the check points must keep")
    min_tag_margin: float = Field(default=30.0, ge=0, description="decision margin of an AprilTag")
    tag_corner_px: float = Field(default=0.3, gt=0, description="error of a tag's corner in the image, one axis")
    tag_views: int = Field(default=5, ge=1, description="of one pass that become observations, the best ones")


class MapConfig(Section):
    """The map as a survey product."""

    voxel_m: float = Field(default=0.1, ge=0.02, le=0.5, description="one point a voxel of surface")
    piece_voxel_m: float = Field(default=0.08, gt=0, description="one point a voxel and keyframe waits for the map")
    max_range_m: float = Field(default=20.0, gt=0, description="farther points do not enter the map")
    range_spread_pm2: float = Field(
        default=0.02, ge=0, description="growth of the range noise along a roadway, a square metre of range"
    )
    view_every_m: float = Field(default=1.0, gt=0, description="so far apart are the views that show what moved away")
    view_reach_m: float = Field(default=12.0, gt=0, description="what moved is seen through from so near")
    cell_m: float = Field(default=0.2, ge=0.1, le=1.0, description="grid on which free space is sought")
    headroom_m: float = Field(default=1.5, gt=0, description="least height of a roadway")
    piece_m: float = Field(default=20.0, gt=0, description="length of roadway that coverage is told for")
    lonely_support: int = Field(default=2, ge=0, description="neighbours that a point wants which was seen once only")
