"""What a map folder says of itself: where it comes from, how it was made, what is doubtful, how well it fits."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mineloc import __version__
from mineloc.config import Config
from mineloc.data import Trajectory
from mineloc.io.flight import FlightReader
from mineloc.localize.flown import Flown
from mineloc.localize.localization import Clock
from mineloc.localize.reconstruction import Reconstruction
from mineloc.mapping.control import verdict_of
from mineloc.mapping.survey_map import SurveyMap

SECTIONS = {
    "sweep", "keyframe", "odometry", "loam", "link3d", "scan_context", "loops", "graph", "fusion", "control", "map",
}  # fmt: skip
"""Of the configuration that a map depends on."""


def manifest_of(
    readers: Mapping[str, FlightReader],
    method: str,
    front_end: str,
    config: Config,
    flown: Mapping[str, Flown],
    found: Reconstruction,
    product: SurveyMap,
) -> dict[str, Any]:
    """The manifest, JSON values."""
    return {
        "mineloc_version": __version__,
        "method": method,
        "front_end": front_end,
        "flights": [
            {
                "name": name,
                "sha256": _sha256(reader.path),
                "info": asdict(reader.info),
                "sweeps": len(flown[name].steps),
                "recorded_sweeps": reader.sweep_count,
                "keyframes": len(flown[name].keyframes),
                "path_m": float(trajectory.path_m[-1]),
                "untrusted": sum(not step.trusted for step in flown[name].steps),
                "degenerate_m": degenerate_m(flown[name], trajectory),
                "counts": dict(flown[name].counts),
            }
            for (name, reader), trajectory in zip(readers.items(), found.trajectories, strict=True)
        ],
        "frame": {
            "unit": "m",
            "up": "z",
            "grid_origin_m": found.origin_m.tolist(),
            "is_grid": found.control is not None,
        },
        "loops": {"accepted": len(found.loops), "refused": sum(not f.trusted for own in found.fixes for f in own)},
        "graph": [fit.to_dict() for fit in found.solution.fits],
        "control": None if found.control is None else _control(found, config),
        "map": {
            "points": len(product.cloud),
            "voxel_m": product.cloud.voxel_m,
            "roadways_m": product.roadways.length_m,
            "intersections": sum(degree >= 3 for degree in product.roadways.degrees),
            "complete_share": _finite(product.coverage.complete_share),
            "thickness_m": _finite(float(np.median(product.cloud.thickness_m))) if len(product.cloud) else None,
        },
        "configuration": json.loads(config.model_dump_json(include=SECTIONS)),
    }


def timing_of(flown: Mapping[str, Flown], clock: Clock, seconds: float, real_time_factor: float) -> dict[str, Any]:
    """Seconds by module, all flights together."""
    modules: dict[str, float] = {}
    for spent in (*(flight.clock.seconds for flight in flown.values()), clock.seconds):
        for name, values in spent.items():
            modules[name] = modules.get(name, 0.0) + sum(values)
    return {"modules": dict(sorted(modules.items())), "seconds": seconds, "real_time_factor": real_time_factor}


def degenerate_m(flight: Flown, trajectory: Trajectory) -> float:
    """Length of the way on which a direction was weakly observed."""
    weak = np.array([step.degeneracy is not None and step.degeneracy.is_degenerate for step in flight.steps])
    return float(np.diff(trajectory.path_m)[weak[1:]].sum())


def _control(found: Reconstruction, config: Config) -> dict[str, Any]:
    assert found.control is not None
    return {
        **found.control.to_dict(),
        "verdict": verdict_of(found.control, tolerance_m=config.control.tolerance_m).to_dict(),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
