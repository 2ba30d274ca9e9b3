"""The configuration: frozen sections with units in the key names; unknown keys are errors at every depth.

A TOML file holds any subset of the sections; `--set section.key=value` overrides one key. The canonical JSON of the
result is part of every stage's key in the store.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

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
    """The mineloc front end."""

    use_imu: bool = True


class LoamConfig(Section):
    """The LOAM front end as published (METHOD 4.1, A-LOAM, VLP-16 launch values)."""


class GraphConfig(Section):
    """The pose factor graph."""


class EvaluateConfig(Section):
    """Comparison with a reference."""

    max_time_difference_s: float = Field(default=0.01, gt=0)


class ReportConfig(Section):
    """The accuracy report."""

    title: str = "Localization accuracy report"


class ViewConfig(Section):
    """The Rerun recording."""

    sweep_stride: int = Field(default=5, ge=1, description="every n-th sweep is shown")


class Config(Section):
    """All sections. Each stage depends only on the sections that it names."""

    ingest: IngestConfig = IngestConfig()
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
    for text in overrides:
        _override(raw, text)
    return validate(Config, raw, where=str(path) if path is not None else "--set")


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
