"""Whether inertial samples can be what they say: metres a second squared and radians a second."""

from __future__ import annotations

import numpy as np

from mineloc.data import F64
from mineloc.io.health import HealthFinding
from mineloc.io.stream_statistics import Sampler

_GRAVITY_MPS2 = 9.80665
# At rest, hovering or in gentle flight the median is gravity; outside of this something else was measured.
_PLAUSIBLE_MPS2 = (7.0, 13.0)
_PLAUSIBLE_G = (_PLAUSIBLE_MPS2[0] / _GRAVITY_MPS2, _PLAUSIBLE_MPS2[1] / _GRAVITY_MPS2)
# No drone turns faster than this half of the time, or faster than its gyroscope measures (2000 deg/s).
_SWIFT_MEDIAN_RADPS = 2.5
_SWIFTEST_RADPS = 35.0
_QUIET_RADPS = 0.02
_QUIET_MPS2 = 0.15
_FEW = 20


class ImuMonitor:
    """Watches the sizes of acceleration and angular rate."""

    def __init__(self) -> None:
        self.samples = 0
        self._accel_mps2 = Sampler()
        self._gyro_radps = Sampler()

    def take(self, gyro_radps: F64, accel_mps2: F64) -> None:
        """Look at (n, 3) samples, finite."""
        self.samples += len(gyro_radps)
        self._gyro_radps.add(np.linalg.norm(gyro_radps, axis=1))
        self._accel_mps2.add(np.linalg.norm(accel_mps2, axis=1))

    @property
    def is_quiet(self) -> bool:
        """Whether neither turns nor vibration were felt in 95 % of the samples."""
        spread = self._accel_mps2.quantile(0.95) - self._accel_mps2.quantile(0.05)
        return self.samples > _FEW and self._gyro_radps.quantile(0.95) < _QUIET_RADPS and spread < _QUIET_MPS2

    def findings(self, topic: str) -> list[HealthFinding]:
        """Unit mistakes and dead sensors."""
        return self._accel_findings(topic) + self._gyro_findings(topic) if self.samples >= _FEW else []

    def _accel_findings(self, topic: str) -> list[HealthFinding]:
        median = self._accel_mps2.median
        if _PLAUSIBLE_MPS2[0] <= median <= _PLAUSIBLE_MPS2[1]:
            return []
        if _PLAUSIBLE_G[0] <= median <= _PLAUSIBLE_G[1]:
            name, what = "imu_accel_in_g", 'multiples of gravity: set accel_unit = "g" in [imu] of a sequence file'
        elif median == 0.0:
            name, what = "imu_accel_dead", "no acceleration at all"
        else:
            name, what = "imu_accel_implausible", f"expected about {_GRAVITY_MPS2:.2f} m/s2 in gentle flight"
        return [HealthFinding(name, "error", self.samples, f"median acceleration on {topic} is {median:.3g}: {what}")]

    def _gyro_findings(self, topic: str) -> list[HealthFinding]:
        median, most = self._gyro_radps.median, self._gyro_radps.quantile(0.999)
        if self._gyro_radps.largest == 0.0:
            return [HealthFinding("imu_gyro_dead", "error", self.samples, f"no angular rate at all on {topic}")]
        if median <= _SWIFT_MEDIAN_RADPS and most <= _SWIFTEST_RADPS:
            return []
        detail = (
            f"angular rates on {topic} have a median of {median:.3g} and reach {most:.3g}: degrees a second? "
            'set gyro_unit = "degps" in [imu] of a sequence file'
        )
        return [HealthFinding("imu_gyro_in_degps", "error", self.samples, detail)]
