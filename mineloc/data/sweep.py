"""What sensors measured: sweeps and inertial samples."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import replace as _replace

import numpy as np

from mineloc.data.arrays import F32, F64, I64, U16, Bool
from mineloc.data.checks import freeze, need


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
        need(self.points_lidar.ndim == 2 and self.points_lidar.shape[1] == 3, "points_lidar must be (n, 3)")
        need(self.points_lidar.dtype == np.float32, "points_lidar must be float32")
        for name in ("offsets_ns", "ring", "intensity"):
            value = getattr(self, name)
            need(value is None or value.shape == (n,), f"{name} must have one value a point")
        if self.offsets_ns is not None:
            need(self.offsets_ns.dtype == np.int64, "offsets_ns must be int64")
            need(n == 0 or int(self.offsets_ns.min()) >= 0, "offsets_ns must be >= 0: stamp_ns is the first point")
        freeze(self)

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
        need(self.stamps_ns.dtype == np.int64, "stamps_ns must be int64")
        need(self.gyro_radps.shape == (n, 3) and self.accel_mps2.shape == (n, 3), "gyro and accel must be (n, 3)")
        need(n < 2 or bool((np.diff(self.stamps_ns) > 0).all()), "stamps_ns must increase strictly")
        freeze(self)

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
