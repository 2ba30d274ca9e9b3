"""Where flights come from."""

from __future__ import annotations

from typing import Literal, cast

from pydantic import Field, ValidationInfo, field_validator

from mineloc.config.section import Section


class IngestConfig(Section):
    """How a recording becomes a canonical flight."""

    compression: Literal["zstd", "lz4", "none"] = "lz4"
    chunk_bytes: int = Field(
        default=1 << 20, ge=1 << 14, le=1 << 20, description="uncompressed size of a chunk, at most 1 MiB"
    )
    gap_factor: float = Field(default=1.8, gt=1, description="a pause longer than this many periods is a gap")


class SimulateConfig(Section):
    """A flight that never took place: tour, drone, sensors and their errors."""

    length_m: float = Field(default=1000.0, gt=0, description="path length of the flight")
    speed_mps: float = Field(default=2.5, gt=0, le=15, description="on straight roadways; slower in bends")
    accel_mps2: float = Field(default=1.5, gt=0, le=10)
    yaw_rate_degps: float = Field(default=60.0, gt=0, le=360)
    hover_s: float = Field(default=4.0, ge=1, description="at rest before the start and after the end")
    clearance_m: float = Field(default=0.7, gt=0, description="wanted distance to walls; half of it is the least")
    sway_m: float = Field(default=0.15, ge=0, description="standard deviation of the wander off the line")
    vibration_mps2: float = Field(default=0.5, ge=0, description="root mean square an axis")
    vibration_degps: float = Field(default=1.5, ge=0, description="root mean square an axis")
    seed: int = Field(default=0, ge=0)
    sensor: Literal["vlp16", "rs16", "hdl32e", "os0"] = "vlp16"
    lidar_hz: float = Field(default=10.0, ge=2, le=20, description="revolutions a second")
    grazing_noise: float = Field(
        default=0.0009, ge=0, description="growth of the range noise: metres a metre and tan(incidence)"
    )
    loss: float = Field(default=0.005, ge=0, lt=1, description="share of shots lost by chance")
    dust: float = Field(default=0.0, ge=0, lt=1, description="share of shots that would meet dust in open space")
    dust_depth_m: float = Field(default=1.5, gt=0, description="mean depth at which dust returns")
    sweep_loss: float = Field(default=0.0, ge=0, lt=1, description="share of sweeps missing, in runs of three")
    machine: bool = Field(default=False, description="a loader drives ahead of the drone")
    roadway_width_m: float = Field(default=4.0, ge=1.5, le=30, description="of plans that do not tell (DXF)")
    roadway_height_m: float = Field(default=3.2, ge=1.8, le=30, description="of plans that do not tell (DXF)")
    closed: tuple[tuple[float, float, float, float], ...] = Field(
        default=(),
        description="walls since the mine was mapped: [x_m, y_m, z_m, bearing_deg], in its frame and in a roadway, and "
        "the bearing of that roadway, counter-clockwise from x",
    )
    widened: tuple[tuple[float, float, float, float, float], ...] = Field(
        default=(),
        description="places widened since: [x_m, y_m, z_m, radius_m, by_m]: what is within radius_m moves away by by_m",
    )
    imu_hz: float = Field(default=200.0, ge=50, le=1000)
    gyro_noise_degps_rthz: float = Field(default=0.007, ge=0)
    gyro_bias_degps: float = Field(default=0.2, ge=0)
    gyro_walk_degps2_rthz: float = Field(default=0.0005, ge=0)
    accel_noise_mps2_rthz: float = Field(default=0.002, ge=0)
    accel_bias_mps2: float = Field(default=0.03, ge=0)
    accel_walk_mps3_rthz: float = Field(default=0.0002, ge=0)
    target_every_m: float = Field(
        default=0.0, ge=0, description="no longer way without a surveyed target near by; 0: there are none"
    )
    target_sigma_m: float = Field(default=0.005, gt=0, le=1, description="of the survey, one axis")
    pick_sigma_m: float = Field(default=0.01, gt=0, le=1, description="of a target picked in a sweep, one axis")
    grid_e_m: float = Field(default=0.0, description="easting of the map's origin in the mine grid")
    grid_n_m: float = Field(default=0.0, description="northing of the map's origin in the mine grid")
    grid_z_m: float = Field(default=0.0, description="height of the map's origin in the mine grid")
    grid_yaw_deg: float = Field(default=0.0, description="of the map's x axis in the mine grid, from east to north")
    tags: bool = Field(default=False, description="targets are AprilTags, and a grey camera sees them")
    tag_size_m: float = Field(default=0.3, ge=0.05, le=2, description="edge of a tag's black square")
    camera: bool = Field(default=False, description="the drone carries a depth camera (D435) that looks ahead")
    camera_size: Literal["848x480", "424x240"] = "424x240"
    camera_hz: float = Field(default=5.0, gt=0, le=90, description="of depth images, and of grey ones with tags")
    depth_subpixel_px: float = Field(default=0.08, ge=0, le=2, description="white noise of the disparity")
    depth_correlated_px: float = Field(default=0.05, ge=0, le=2, description="noise of the disparity in patches")
    depth_bias_px: float = Field(
        default=0.15, ge=0, le=2, description="smooth error of the disparity, the same all flight long, RMS"
    )
    depth_range_m: float = Field(default=8.0, gt=0, description="half of the pixels are lost at this depth")
    depth_holes: float = Field(default=0.01, ge=0, lt=1, description="share of pixels lost by chance")

    @field_validator("closed", "widened", mode="before")
    @classmethod
    def _lists_of_places(cls, value: object, info: ValidationInfo) -> object:
        """Say what the numbers are: one list for one place is the likely slip, and no schema tells what is missing."""
        names = ["x_m", "y_m", "z_m", *(["bearing_deg"] if info.field_name == "closed" else ["radius_m", "by_m"])]
        if not isinstance(value, list | tuple) or not all(
            isinstance(place, list | tuple) and len(cast("list[object]", place)) == len(names)
            for place in cast("list[object]", value)
        ):
            raise ValueError(f"a list of [{', '.join(names)}], in double brackets even for one place")
        return cast("object", value)

    @field_validator("widened")
    @classmethod
    def _gently_widened(
        cls, value: tuple[tuple[float, float, float, float, float], ...]
    ) -> tuple[tuple[float, float, float, float, float], ...]:
        """More than a quarter of the radius, and the rock would fold over."""
        if not all(0 < by_m <= radius_m / 4 for *_, radius_m, by_m in value):
            raise ValueError("by_m over 0 and at most a quarter of radius_m")
        return value
