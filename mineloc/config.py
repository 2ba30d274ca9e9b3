"""The configuration: frozen sections with units in the key names; unknown keys are errors at every depth.

A TOML file holds any subset of the sections; `--set section.key=value` overrides one key. The canonical JSON of the
result is part of every stage's key in the store.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError

from mineloc.errors import ConfigError


class Section(BaseModel):
    """Base of all sections: frozen, strict about keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


T = TypeVar("T", bound=Section)


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
    imu_hz: float = Field(default=200.0, ge=50, le=1000)
    gyro_noise_degps_rthz: float = Field(default=0.007, ge=0)
    gyro_bias_degps: float = Field(default=0.2, ge=0)
    gyro_walk_degps2_rthz: float = Field(default=0.0005, ge=0)
    accel_noise_mps2_rthz: float = Field(default=0.002, ge=0)
    accel_bias_mps2: float = Field(default=0.03, ge=0)
    accel_walk_mps3_rthz: float = Field(default=0.0002, ge=0)


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
    sweep_voxel_m: float = Field(default=0.3, gt=0, description="one mean point a voxel is registered")
    insert_voxel_m: float = Field(default=0.1, gt=0, description="one mean point a voxel goes into the map")
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
    rounds: int = Field(default=6, ge=1)
    forget_after_m: float = Field(default=150.0, gt=0, description="patches not seen for so long a way are dropped")
    min_matches: int = Field(default=60, ge=6)
    min_inlier_ratio: float = Field(default=0.25, ge=0, le=1)
    weak_ratio: float = Field(default=0.005, ge=0, lt=1, description="eigenvalue ratio below which a direction is weak")
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
    relative_max_m: float = Field(default=3.0, gt=0, description="no motion between keyframes is known less")
    relative_max_deg: float = Field(default=20.0, gt=0, description="no motion between keyframes is known less")
    robust: bool = Field(default=True, description="Cauchy kernel on fixes and loops")
    cauchy_k: float = Field(default=1.0, gt=0, description="in standard deviations of a residual component")
    max_iterations: int = Field(default=100, ge=1)
    relinearize_threshold: float = Field(default=0.01, gt=0, description="metres or radians; causal estimate")


class EvaluateConfig(Section):
    """Comparison with a reference."""

    association: Literal["auto", "nearest", "interpolate"] = Field(
        default="auto", description="auto takes the nearest pose, but interpolates the reference where the rates differ"
    )
    max_time_difference_s: float = Field(default=0.01, gt=0)
    max_reference_gap_s: float = Field(default=0.5, gt=0, description="no interpolation over longer gaps")
    max_gap_s: float = Field(default=1.0, gt=0, description="longer gaps of the estimate are not covered")
    rep_percents: tuple[Annotated[float, Field(gt=0, le=100)], ...] = (20.0, 40.0, 60.0, 80.0, 100.0)
    segment_lengths_m: tuple[PositiveFloat, ...] = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
    segment_step: int = Field(default=10, ge=1, description="a segment starts every so many poses (KITTI)")
    rpe_frames: tuple[PositiveInt, ...] = (1,)
    rpe_lengths_m: tuple[PositiveFloat, ...] = (100.0,)
    rpe_all_pairs: bool = False
    rpe_tolerance: float = Field(default=0.1, gt=0, lt=1)
    shown_alignment: Literal["auto", "none", "origin", "se3"] = Field(
        default="auto", description="under which report and viewer draw: auto is none in a prior map, else origin"
    )


class ReportConfig(Section):
    """The accuracy report."""

    title: str = "Localization accuracy report"


class ViewConfig(Section):
    """The Rerun recording."""

    sweep_stride: int = Field(default=5, ge=1, description="every n-th sweep is shown")
    sweep_points: int = Field(default=1_000_000, ge=1000, description="points of all shown sweeps together, at most")
    map_points: int = Field(default=250_000, ge=1000, description="points of the mine, at most")


class Config(Section):
    """All sections. Each stage depends only on the sections that it names."""

    ingest: IngestConfig = IngestConfig()
    simulate: SimulateConfig = SimulateConfig()
    sweep: SweepConfig = SweepConfig()
    keyframe: KeyframeConfig = KeyframeConfig()
    odometry: OdometryConfig = OdometryConfig()
    loam: LoamConfig = LoamConfig()
    graph: GraphConfig = GraphConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    report: ReportConfig = ReportConfig()
    view: ViewConfig = ViewConfig()


def load_config(path: Path | None = None, overrides: Iterable[str] = ()) -> Config:
    """Defaults, then the TOML file, then `section.key=value` overrides.

    Raises:
        ConfigError: no such file, not TOML, an unknown key, a value that does not fit.
    """
    raw: dict[str, Any] = read_toml(path) if path is not None else {}
    return layered_config([raw], overrides, where=str(path) if path is not None else "--set")


def layered_config(layers: Iterable[Mapping[str, Any]], overrides: Iterable[str] = (), *, where: str) -> Config:
    """Defaults, then sections laid one over the other key by key, then `section.key=value` overrides.

    Raises:
        ConfigError: an unknown key, a value that does not fit.
    """
    raw: dict[str, Any] = {}
    for layer in layers:
        _lay_over(raw, layer)
    for text in overrides:
        _override(raw, text)
    return validate(Config, raw, where=where)


def validate(model: type[T], raw: Mapping[str, Any], *, where: str) -> T:
    """Check a mapping against a section; the first problem becomes one `ConfigError` line."""
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = _known_keys(model, first["loc"][:-1])
            raise ConfigError(
                where, f"unknown key {key}", expected=f"one of {', '.join(known)}", todo="correct the key or remove it"
            ) from None
        raise ConfigError(
            where, f"{key} = {first.get('input')!r}", expected=first["msg"].lower(), todo="correct the value"
        ) from None


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as nested dicts.

    Raises:
        ConfigError: no such file, or not TOML.
    """
    try:
        with path.open("rb") as f:
            return tomllib.load(f)
    except FileNotFoundError:
        raise ConfigError(path, "no such file", expected="a TOML file", todo="check the path") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, IsADirectoryError) as error:
        raise ConfigError(path, f"not TOML ({error})", expected="a TOML file", todo="correct the file") from None


def _lay_over(raw: dict[str, Any], layer: Mapping[str, Any]) -> None:
    for key, value in layer.items():
        below = raw.get(key)
        if isinstance(below, dict) and isinstance(value, dict):
            _lay_over(cast("dict[str, Any]", below), cast("dict[str, Any]", value))
        else:
            raw[key] = deepcopy(value)


def _override(raw: dict[str, Any], text: str) -> None:
    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    if not equals or len(parts) < 2 or not all(parts):
        raise ConfigError(
            "--set", repr(text), expected="section.key=value", todo="for example --set odometry.use_imu=false"
        )
    try:
        parsed = tomllib.loads(f"v = {value}")["v"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    node = raw
    for part in parts[:-1]:
        child = node.setdefault(part, {})
        if not isinstance(child, dict):
            raise ConfigError("--set", repr(text), expected="section.key=value", todo=f"{part} is not a section")
        node = cast("dict[str, Any]", child)
    node[parts[-1]] = parsed


def _known_keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    current: type[BaseModel] = model
    for part in loc:
        info = current.model_fields.get(str(part))
        annotation = info.annotation if info is not None else None
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return sorted(current.model_fields)
        current = annotation
    return sorted(current.model_fields)
