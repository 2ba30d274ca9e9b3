"""The nouns: what the rooms hand to each other. Frozen, checked at birth, arrays read-only.

Frames: `map` (gravity-levelled, z up), `odom` (`map` before any correction), `body` (the drone; what trajectories
place), `imu`, `lidar`, `camera`. Times are integer nanoseconds since the epoch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from dataclasses import replace as _replace

import numpy as np
from numpy.typing import NDArray

from mineloc import se3

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U16 = NDArray[np.uint16]
Bool = NDArray[np.bool_]


def _freeze(obj: object) -> None:
    for f in fields(obj):  # type: ignore[arg-type]
        value = getattr(obj, f.name)
        if isinstance(value, np.ndarray):
            view = value.view()
            view.flags.writeable = False
            object.__setattr__(obj, f.name, view)


def _need(ok: bool, what: str) -> None:
    if not ok:
        raise ValueError(what)


def _is_rigid(T: F64) -> bool:
    r = T[..., :3, :3]
    return bool(
        np.isfinite(T).all()
        and np.abs(r @ np.swapaxes(r, -1, -2) - np.eye(3)).max(initial=0.0) < 1e-6
        and (np.linalg.det(r) > 0).all()
    )


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """The points of one LiDAR revolution, in the order in which they were fired.

    Attributes:
        stamp_ns: time of the first point.
        points_lidar: (n, 3) float32, metres, finite.
        offsets_ns: (n,) int64 ≥ 0 after `stamp_ns`; None declares "no point times" (an instant sweep).
        ring: (n,) uint16, beams counted by rising elevation; None if unknown.
        intensity: (n,) float32; None if unknown.
        period_ns: nominal duration of a revolution.
    """

    stamp_ns: int
    points_lidar: F32
    offsets_ns: I64 | None = None
    ring: U16 | None = None
    intensity: F32 | None = None
    period_ns: int = 100_000_000

    def __post_init__(self) -> None:
        n = len(self.points_lidar)
        _need(self.points_lidar.ndim == 2 and self.points_lidar.shape[1] == 3, "points_lidar must be (n, 3)")
        _need(self.points_lidar.dtype == np.float32, "points_lidar must be float32")
        for name in ("offsets_ns", "ring", "intensity"):
            value = getattr(self, name)
            _need(value is None or value.shape == (n,), f"{name} must have one value a point")
        if self.offsets_ns is not None:
            _need(self.offsets_ns.dtype == np.int64, "offsets_ns must be int64")
            _need(n == 0 or int(self.offsets_ns.min()) >= 0, "offsets_ns must be >= 0: stamp_ns is the first point")
        _freeze(self)

    def __len__(self) -> int:
        return len(self.points_lidar)

    @property
    def has_point_times(self) -> bool:
        """Whether the points carry their own times (else the sweep counts as instant)."""
        return self.offsets_ns is not None

    @property
    def end_ns(self) -> int:
        """Time of the last point; `stamp_ns` for an instant or empty sweep."""
        if self.offsets_ns is None or not len(self):
            return self.stamp_ns
        return self.stamp_ns + int(self.offsets_ns.max())

    def keep(self, mask: Bool | I64) -> Sweep:
        """The sweep with only the masked (or indexed) points; all per-point fields go along, `stamp_ns` stays."""
        pick = {
            name: value[mask]
            for name in ("offsets_ns", "ring", "intensity")
            if (value := getattr(self, name)) is not None
        }
        return _replace(self, points_lidar=self.points_lidar[mask], **pick)


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Inertial samples in the `imu` frame: angular rate and specific force (+g upwards at rest).

    Attributes:
        stamps_ns: (n,) int64, strictly increasing.
        gyro_radps: (n, 3) float64.
        accel_mps2: (n, 3) float64.
    """

    stamps_ns: I64
    gyro_radps: F64
    accel_mps2: F64

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        _need(self.stamps_ns.dtype == np.int64, "stamps_ns must be int64")
        _need(self.gyro_radps.shape == (n, 3) and self.accel_mps2.shape == (n, 3), "gyro and accel must be (n, 3)")
        _need(n < 2 or bool((np.diff(self.stamps_ns) > 0).all()), "stamps_ns must increase strictly")
        _freeze(self)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @staticmethod
    def empty() -> ImuSamples:
        """No samples: a flight without an IMU."""
        return ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))

    def between(self, start_ns: int, end_ns: int) -> ImuSamples:
        """The samples with `start_ns <= t < end_ns`."""
        a, b = np.searchsorted(self.stamps_ns, [start_ns, end_ns])
        return ImuSamples(self.stamps_ns[a:b], self.gyro_radps[a:b], self.accel_mps2[a:b])


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time: `poses[i]` is `T_parent_child` at `stamps_ns[i]`.

    Attributes:
        stamps_ns: (n,) int64, strictly increasing. Files without times use 0, 1, 2 …: see `timed`.
        poses: (n, 4, 4) float64 rigid transforms.
        parent, child: frame names.
        timed: False when the stamps are only a count (KITTI).
    """

    stamps_ns: I64
    poses: F64
    parent: str = "map"
    child: str = "body"
    timed: bool = True

    def __post_init__(self) -> None:
        n = len(self.stamps_ns)
        _need(self.stamps_ns.dtype == np.int64, "stamps_ns must be int64")
        _need(self.poses.shape == (n, 4, 4), "poses must be (n, 4, 4)")
        _need(n < 2 or bool((np.diff(self.stamps_ns) > 0).all()), "stamps_ns must increase strictly")
        _need(_is_rigid(self.poses), "poses must be finite rigid transforms")
        _freeze(self)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions_m(self) -> F64:
        """(n, 3) positions of `child` in `parent`."""
        return self.poses[:, :3, 3]

    @property
    def path_m(self) -> F64:
        """(n,) distance travelled up to each pose, metres."""
        steps = np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])[: len(self)]

    def at(self, stamps_ns: I64) -> F64:
        """(m, 4, 4) poses interpolated at other times within the span."""
        return se3.interpolate(self.stamps_ns, self.poses, stamps_ns)

    def compose(self, *, left: F64 | None = None, right: F64 | None = None, child: str | None = None) -> Trajectory:
        """`left @ pose @ right` for every pose: a change of the parent or the child frame."""
        poses = self.poses if left is None else left @ self.poses
        poses = poses if right is None else poses @ right
        return _replace(self, poses=poses, child=self.child if child is None else child)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Where the sensors sit on the drone. Identity where a recording says nothing: then `body` is the LiDAR."""

    T_body_lidar: F64 = field(default_factory=lambda: np.eye(4))
    T_body_imu: F64 = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        _need(_is_rigid(self.T_body_lidar) and _is_rigid(self.T_body_imu), "calibration must be rigid transforms")
        _freeze(self)

    @property
    def T_lidar_imu(self) -> F64:
        """Takes IMU coordinates to LiDAR coordinates."""
        return se3.inverse(self.T_body_lidar) @ self.T_body_imu


@dataclass(frozen=True, slots=True)
class FlightInfo:
    """Who flew what, where and when: the `mineloc.flight` metadata of a flight file. Empty text means unknown."""

    flight: str = ""
    site: str = ""
    level: str = ""
    drone: str = ""
    lidar: str = ""
    imu: str = ""
    operator: str = ""
    start_utc: str = ""
    calibration: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Degeneracy:
    """How well one registration holds its pose, from its information matrix (METHOD 7.3).

    Attributes:
        score: smallest over largest eigenvalue of the translation block an inlier, in [0, 1].
        weak_directions: (k, 3) unit vectors in the lidar frame along which translation is weakly observed; k may be 0.
    """

    score: float
    weak_directions: F64

    @property
    def is_degenerate(self) -> bool:
        """Whether any direction is weak."""
        return len(self.weak_directions) > 0


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
        _need(_is_rigid(self.T_odom_lidar), "T_odom_lidar must be a rigid transform")
        _freeze(self)


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
        _need(_is_rigid(self.T_i_j), "T_i_j must be a rigid transform")
        _need(self.information.shape == (6, 6), "information must be (6, 6)")
        _need(bool(np.isfinite(self.information).all()), "information must be finite")
        _freeze(self)


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

    def __post_init__(self) -> None:
        _need(self.trusted or bool(self.reason), "an untrusted step must say why")
        _freeze(self)


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
        target: what was recognised (intersection id), empty when none.
        scores: every number that the decision used, by name.
    """

    stamp_ns: int
    keyframe: int
    T_map_lidar: F64 | None
    covariance: F64 | None
    trusted: bool
    reason: str = ""
    target: str = ""
    scores: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _need(self.trusted or bool(self.reason), "a refused fix must say why")
        _need(not self.trusted or self.T_map_lidar is not None, "a trusted fix needs a pose")
        _freeze(self)
