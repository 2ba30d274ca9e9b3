"""All sections together, read from TOML files and overrides."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel, ValidationError

from mineloc.config.estimation import GraphConfig, KeyframeConfig, LoamConfig, OdometryConfig, SweepConfig
from mineloc.config.features import Link3dConfig, ScanContextConfig
from mineloc.config.intersections import IntersectionsConfig
from mineloc.config.localizing import PriorMapConfig
from mineloc.config.mapping import ControlConfig, FusionConfig, LoopsConfig, MapConfig
from mineloc.config.recordings import IngestConfig, SimulateConfig
from mineloc.config.reporting import EvaluateConfig, ReportConfig, ViewConfig
from mineloc.config.section import Section
from mineloc.errors import ConfigError

T = TypeVar("T", bound=Section)


class Config(Section):
    """All sections. Each stage depends only on the sections that it names."""

    ingest: IngestConfig = IngestConfig()
    simulate: SimulateConfig = SimulateConfig()
    sweep: SweepConfig = SweepConfig()
    keyframe: KeyframeConfig = KeyframeConfig()
    odometry: OdometryConfig = OdometryConfig()
    loam: LoamConfig = LoamConfig()
    link3d: Link3dConfig = Link3dConfig()
    scan_context: ScanContextConfig = ScanContextConfig()
    loops: LoopsConfig = LoopsConfig()
    graph: GraphConfig = GraphConfig()
    fusion: FusionConfig = FusionConfig()
    control: ControlConfig = ControlConfig()
    map: MapConfig = MapConfig()
    intersections: IntersectionsConfig = IntersectionsConfig()
    prior_map: PriorMapConfig = PriorMapConfig()
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
