"""What estimation hands on: keyframes, measured motions, answers of front ends and recognitions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mineloc.data.arrays import F32, F64
from mineloc.data.checks import freeze, is_rigid, need


@dataclass(frozen=True, slots=True, eq=False)
class Degeneracy:
    """How well one registration holds its pose, from its information matrix (METHOD 7.3).

    Attributes:
        score: smallest over largest eigenvalue of the translation block an inlier, in [0, 1].
        weak_directions: (k, 3) unit vectors in the lidar frame along which translation is weakly observed; k may be 0.
        blurred_directions: (k, 3) the same where a shift hardly changes how well the points fit: what holds them there
            is no larger than the noise, and the way flown may be too long or too short.
    """

    score: float
    weak_directions: F64
    blurred_directions: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def is_degenerate(self) -> bool:
        """Whether any direction is weak or blurred."""
        return len(self.weak_directions) + len(self.blurred_directions) > 0


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A node of the pose graph (paper A, eq. 8-9).

    Attributes:
        index: 0, 1, 2 … in the order of flight.
        stamp_ns: the time for which the pose is true and to which the points are deskewed.
        T_odom_lidar: (4, 4) pose by odometry alone.
        points_lidar: (n, 3) float32 deskewed, downsampled points.
        up_lidar: (3,) measured direction of "up" in lidar coordinates, None without an IMU.
    """

    index: int
    stamp_ns: int
    T_odom_lidar: F64
    points_lidar: F32
    up_lidar: F64 | None = None

    def __post_init__(self) -> None:
        need(is_rigid(self.T_odom_lidar), "T_odom_lidar must be a rigid transform")
        freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """A measured motion between keyframes: pose of keyframe j in the frame of keyframe i (METHOD D1).

    Attributes:
        i, j: keyframe indices, i < j for odometry.
        T_i_j: (4, 4).
        information: (6, 6) inverse covariance, `[rotation, translation]`, right (body j) perturbation (METHOD D2, D3).
    """

    i: int
    j: int
    T_i_j: F64
    information: F64

    def __post_init__(self) -> None:
        need(is_rigid(self.T_i_j), "T_i_j must be a rigid transform")
        need(self.information.shape == (6, 6), "information must be (6, 6)")
        need(bool(np.isfinite(self.information).all()), "information must be finite")
        freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class OdometryStep:
    """What a front end says after one sweep.

    Attributes:
        stamp_ns: the time for which `T_odom_lidar` is true.
        T_odom_lidar: (4, 4).
        trusted: False when the pose rests on the motion prior alone.
        reason: why not trusted, empty otherwise.
        keyframe, relative_pose: set when this sweep became a keyframe (`relative_pose` leads from the one before).
        degeneracy: None when no registration took place.
        inlier_ratio: share of the registered points that found a match.
        residual_m: root mean square of the matched residuals.
        points_used: number of points that went into the registration.
        points_lidar: (n, 3) float32 points of the sweep as if all were measured at `stamp_ns`, thinned; None when
            nobody wants them any more.
    """

    stamp_ns: int
    T_odom_lidar: F64
    trusted: bool
    reason: str = ""
    keyframe: Keyframe | None = None
    relative_pose: RelativePose | None = None
    degeneracy: Degeneracy | None = None
    inlier_ratio: float = float("nan")
    residual_m: float = float("nan")
    points_used: int = 0
    points_lidar: F32 | None = None

    def __post_init__(self) -> None:
        need(self.trusted or bool(self.reason), "an untrusted step must say why")
        freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """The answer for one recognition or registration to a map, accepted or refused.

    Attributes:
        stamp_ns: time of the keyframe.
        keyframe: its index.
        T_map_lidar: (4, 4), None when refused before a pose existed.
        covariance: (6, 6) `[rotation, translation]`, right perturbation; None without a pose.
        trusted: whether it may enter the graph.
        reason: the step that refused and its number; empty when trusted.
        target: what was recognised (name of the intersection), empty when none.
        scores: every number that the decision used, by name.
        point_map: (3,) the known point that was recognised, an intersection's invariant point; None without one.
    """

    stamp_ns: int
    keyframe: int
    T_map_lidar: F64 | None
    covariance: F64 | None
    trusted: bool
    reason: str = ""
    target: str = ""
    scores: Mapping[str, float] = field(default_factory=dict)
    point_map: F64 | None = None

    def __post_init__(self) -> None:
        need(self.trusted or bool(self.reason), "a refused fix must say why")
        need(not self.trusted or self.T_map_lidar is not None, "a trusted fix needs a pose")
        freeze(self)
