"""From sweeps to poses."""

from __future__ import annotations

from pydantic import Field

from mineloc.config.section import Section


class SweepConfig(Section):
    """What is dropped from a sweep before anything looks at it."""

    min_range_m: float = Field(default=0.5, ge=0)
    max_range_m: float = Field(default=100.0, gt=0)


class KeyframeConfig(Section):
    """When a sweep becomes a keyframe (paper A, eq. 8-9; METHOD 1.3)."""

    distance_m: float = Field(default=1.0, gt=0)
    angle_deg: float = Field(default=10.0, gt=0)
    voxel_m: float = Field(default=0.2, gt=0, description="downsampling of the points a keyframe keeps")


class OdometryConfig(Section):
    """The mineloc front end. Sigmas are one standard deviation; densities are per root hertz."""

    use_imu: bool = Field(default=True, description="false: constant velocity even if the flight has an IMU")
    settle_s: float = Field(default=1.0, ge=0, description="so much of the IMU's beginning levels the drone")
    fine_voxel_m: float = Field(default=0.3, ge=0.1, description="edge of the map's finer patches")
    coarse_voxel_m: float = Field(
        default=0.9, ge=0.1, description="edge of the patches that stand in for poor fine ones"
    )
    sweep_voxel_m: float = Field(default=0.4, gt=0, description="one mean point a voxel is registered")
    insert_voxel_m: float = Field(default=0.15, gt=0, description="one mean point a voxel goes into the map")
    patch_points: float = Field(default=200.0, ge=10, description="weight that a fine patch keeps; older points fade")
    patch_min_points: float = Field(default=5.0, ge=3)
    patch_growth: float = Field(default=0.2, ge=0, description="share of new points that makes a patch fitted again")
    max_flatness: float = Field(default=0.05, gt=0, lt=0.34, description="a plane's least eigenvalue over their sum")
    min_patch_width_m: float = Field(default=0.05, ge=0, description="a plane spreads so far (1 sigma) both ways")
    min_incidence_cosine: float = Field(
        default=0.15, ge=0, lt=1, description="a plane that nearly holds the beam is a scanning cone, not a wall"
    )
    point_weight: float = Field(default=0.1, ge=0, description="weight of non-planar residuals against planar ones")
    range_sigma_m: float = Field(default=0.02, gt=0)
    angle_sigma_rad: float = Field(default=0.0005, ge=0)
    surface_sigma_m: float = Field(default=0.01, gt=0, description="what no averaging removes")
    kernel_sigmas: float = Field(default=3.0, gt=0, description="Geman-McClure kernel")
    gate_sigmas: float = Field(default=8.0, gt=0)
    information_share: float = Field(
        default=0.1, gt=0, le=1, description="neighbouring residuals share their errors: n count as so many n"
    )
    edge_correlation: float = Field(
        default=1.0, gt=0, description="so many residuals count as one in the noise of a relative pose"
    )
    edge_floor_rad: float = Field(default=1e-4, gt=0, description="no relative pose is better")
    edge_floor_m: float = Field(default=0.002, gt=0, description="no relative pose is better")
    rounds: int = Field(default=6, ge=1)
    forget_after_m: float = Field(default=150.0, gt=0, description="patches not seen for so long a way are dropped")
    min_matches: int = Field(default=60, ge=6)
    min_inlier_ratio: float = Field(default=0.25, ge=0, le=1)
    weak_ratio: float = Field(default=0.005, ge=0, lt=1, description="eigenvalue ratio below which a direction is weak")
    probe_m: float = Field(default=0.1, gt=0, description="shift along the weakest direction that must not fit as well")
    probe_below: float = Field(default=0.1, ge=0, le=1, description="eigenvalue ratio below which keyframes are probed")
    min_contrast: float = Field(default=0.5, ge=0, description="growth of the squared residual by that shift, share")
    angular_radps2: float = Field(default=0.5, gt=0, description="acceleration density, flights without an IMU")
    linear_mps2: float = Field(default=1.0, gt=0, description="acceleration density, flights without an IMU")
    gyro_radps: float = Field(default=2e-4, gt=0, description="noise density of the gyro")
    accel_mps2: float = Field(default=0.03, gt=0, description="noise density of the accelerometer with vibration")
    gyro_walk_radps2: float = Field(default=1e-5, ge=0)
    accel_walk_mps3: float = Field(default=1e-4, ge=0)


class LoamConfig(Section):
    """The LOAM front end as published (METHOD 4.1, A-LOAM, VLP-16 launch values)."""

    curvature_threshold_m2: float = Field(default=0.1, gt=0, description="edges above, planes below; not normalised")
    sectors: int = Field(default=6, ge=1, description="equal parts of a ring that features are picked from")
    sharp_per_sector: int = Field(default=2, ge=1)
    less_sharp_per_sector: int = Field(default=20, ge=1, description="the sharp ones among them")
    flat_per_sector: int = Field(default=4, ge=1)
    less_flat_voxel_m: float = Field(default=0.2, gt=0)
    neighbour_gap_m2: float = Field(default=0.05, gt=0, description="suppression ends at a larger squared gap")
    reject_unreliable: bool = Field(
        default=True, description="leave out occluded points and surfaces along the beam (LOAM; A-LOAM dropped it)"
    )
    huber_m: float = Field(default=0.1, gt=0)
    odometry_rounds: int = Field(default=2, ge=1, description="times that sweep-to-sweep matches are sought")
    odometry_iterations: int = Field(default=4, ge=1)
    odometry_distance_m: float = Field(default=5.0, gt=0)
    odometry_rings: float = Field(default=2.5, ge=1, description="points of a line or plane are at most so far apart")
    odometry_min_matches: int = Field(default=10, ge=6)
    mapping_rounds: int = Field(default=2, ge=1)
    mapping_iterations: int = Field(default=4, ge=1)
    mapping_min_matches: int = Field(default=50, ge=6)
    corner_leaf_m: float = Field(default=0.2, ge=0.1)
    surface_leaf_m: float = Field(default=0.4, ge=0.1)
    neighbour_distance_m: float = Field(default=1.0, gt=0, le=2, description="the fifth neighbour must be nearer")
    line_eigenvalue_ratio: float = Field(default=3.0, ge=1)
    plane_tolerance_m: float = Field(default=0.2, gt=0)
    odometry_min_eigenvalue: float = Field(
        default=0.0, ge=0, description="weaker directions keep the prediction (LOAM: 10); 0 is off, as in A-LOAM"
    )
    mapping_min_eigenvalue: float = Field(default=0.0, ge=0, description="as odometry_min_eigenvalue (LOAM: 100)")
    max_prediction_s: float = Field(
        default=1.0, gt=0, description="the last velocity is believed for so long, then the drone counts as hovering"
    )


class GraphConfig(Section):
    """The pose factor graph."""

    use_gravity: bool = True
    gravity_sigma_deg: float = Field(default=1.0, gt=0, description="of the measured direction of up, one keyframe")
    anchor_m: float = Field(default=0.001, gt=0, description="the first position defines the map")
    anchor_yaw_deg: float = Field(default=0.01, gt=0, description="the first heading defines the map")
    anchor_tilt_deg: float = Field(default=0.5, gt=0, description="of the first levelling")
    joined_m: float = Field(default=3.0, gt=0, description="of a flight's first position where only places joined it")
    joined_deg: float = Field(default=3.0, gt=0, description="of its first attitude then")
    relative_max_m: float = Field(default=3.0, gt=0, description="no motion between keyframes is known less")
    relative_max_deg: float = Field(default=20.0, gt=0, description="no motion between keyframes is known less")
    robust: bool = Field(default=True, description="Cauchy kernel on fixes and loops")
    cauchy_k: float = Field(default=1.0, gt=0, description="in standard deviations of a residual component")
    outvote_probability: float = Field(
        default=0.999, gt=0, lt=1, description="of right recognitions that odometry and the others keep"
    )
    max_iterations: int = Field(default=100, ge=1)
    relinearize_threshold: float = Field(default=0.01, gt=0, description="metres or radians; causal estimate")
