"""Spinning LiDARs with their real geometry: who fires when, where to, and from where (METHOD 9.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mineloc.errors import ConfigError

F64 = NDArray[np.float64]
U16 = NDArray[np.uint16]

SensorName = Literal["vlp16", "rs16", "hdl32e", "os0"]


@dataclass(frozen=True, slots=True, eq=False)
class LidarModel:
    """One spinning LiDAR. All turn clockwise seen from above; lasers are listed in the order in which they fire.

    Attributes:
        name: as in the flight's information, for example "VLP-16".
        elevation_rad: (n,) of each laser.
        azimuth_rad: (n,) offset of each laser against the rotor, counter-clockwise positive.
        height_m: (n,) of the point where the beam leaves the rotation axis (or the circle of `radius_m`).
        radius_m: horizontal distance of the beam's origin from the axis, in the direction of the rotor.
        fire_s: (n,) time of each laser after the start of its firing.
        firing_s: time from one firing to the next at 10 Hz; None: `columns` firings a revolution.
        columns: firings a revolution where the encoder triggers them, 0 where a clock does.
        min_range_m, max_range_m: what the sensor reports at most.
        quantum_m: step of the reported range.
        sigma_m: standard deviation of the range at normal incidence.
        range_10_percent_m: distance at which half of the shots on a 10 % reflector at normal incidence return.
    """

    name: str
    elevation_rad: F64
    azimuth_rad: F64
    height_m: F64
    radius_m: float
    fire_s: F64
    firing_s: float | None
    columns: int
    min_range_m: float
    max_range_m: float
    quantum_m: float
    sigma_m: float
    range_10_percent_m: float

    @property
    def lasers(self) -> int:
        """Number of lasers."""
        return len(self.elevation_rad)

    @property
    def ring(self) -> U16:
        """(n,) ring of each laser in firing order: its rank by rising elevation."""
        order = np.argsort(self.elevation_rad, kind="stable")
        ring = np.empty(self.lasers, np.uint16)
        ring[order] = np.arange(self.lasers, dtype=np.uint16)
        return ring

    def firing_period_s(self, rate_hz: float) -> float:
        """Time between firings when the rotor turns `rate_hz` times a second."""
        return 1.0 / (rate_hz * self.columns) if self.firing_s is None else self.firing_s


def lidar_model(name: str) -> LidarModel:
    """The model of a sensor by its short name.

    Raises:
        ConfigError: unknown name.
    """
    makers = {"vlp16": _vlp16, "rs16": _rs16, "hdl32e": _hdl32e, "os0": _os0}
    if name not in makers:
        raise ConfigError(
            "--sensor", repr(name), expected=f"one of {', '.join(makers)}", todo="choose one of these sensors"
        )
    return makers[name]()


def _vlp16() -> LidarModel:
    """VLP-16 manual, p. 54: interleaved firing, the vertical offset falls with the elevation."""
    elevation = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], float)
    height_mm = np.array([11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2])
    return LidarModel(
        name="VLP-16",
        elevation_rad=np.deg2rad(elevation),
        azimuth_rad=np.zeros(16),
        height_m=height_mm * 1e-3,
        radius_m=0.0,
        fire_s=_steps(16, 2.304e-6),
        firing_s=55.296e-6,
        columns=0,
        min_range_m=0.5,
        max_range_m=100.0,
        quantum_m=0.002,
        sigma_m=0.02,
        range_10_percent_m=60.0,
    )


def _hdl32e() -> LidarModel:
    """HDL-32E: the lower half of the fan and the upper half take turns; 1.152 µs a laser, 46.08 µs a firing."""
    low = -30.67 + np.arange(16) * 4.0 / 3.0
    elevation = np.stack([low, low + 16 * 4.0 / 3.0], axis=1).ravel()
    return LidarModel(
        name="HDL-32E",
        elevation_rad=np.deg2rad(elevation),
        azimuth_rad=np.zeros(32),
        height_m=np.zeros(32),
        radius_m=0.0,
        fire_s=_steps(32, 1.152e-6),
        firing_s=46.08e-6,
        columns=0,
        min_range_m=0.9,
        max_range_m=100.0,
        quantum_m=0.002,
        sigma_m=0.02,
        range_10_percent_m=70.0,
    )


def _rs16() -> LidarModel:
    """RS-LiDAR-16: channels 1-8 rise from -15° to -1°, 9-16 fall from 15° to 1°; the lens is 38 mm off the axis."""
    elevation = np.concatenate([np.arange(-15.0, 0.0, 2.0), np.arange(15.0, 0.0, -2.0)])
    return LidarModel(
        name="RS-LiDAR-16",
        elevation_rad=np.deg2rad(elevation),
        azimuth_rad=np.zeros(16),
        height_m=np.zeros(16),
        radius_m=0.038,
        fire_s=_steps(16, 2.8e-6),
        firing_s=55.5e-6,
        columns=0,
        min_range_m=0.4,
        max_range_m=150.0,
        quantum_m=0.005,
        sigma_m=0.02,
        range_10_percent_m=80.0,
    )


def _os0() -> LidarModel:
    """OS0-64: ±45°, 1024 columns a revolution fired at once, beams staggered in groups of four, origin 27.67 mm out."""
    elevation = np.linspace(45.0, -45.0, 64)
    stagger = np.tile([3.16, 1.05, -1.05, -3.16], 16)
    return LidarModel(
        name="OS0-64",
        elevation_rad=np.deg2rad(elevation),
        azimuth_rad=np.deg2rad(stagger),
        height_m=np.zeros(64),
        radius_m=0.02767,
        fire_s=np.zeros(64),
        firing_s=None,
        columns=1024,
        min_range_m=0.3,
        max_range_m=75.0,
        quantum_m=0.001,
        sigma_m=0.02,
        range_10_percent_m=35.0,
    )


def _steps(count: int, step_s: float) -> F64:
    return np.linspace(0.0, (count - 1) * step_s, count)
