"""The stage that localizes a flight: a canonical flight in, a run folder out."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from mineloc import __version__, se3
from mineloc.config import Config
from mineloc.data import F64, Calibration, OdometryStep
from mineloc.errors import ConfigError
from mineloc.io.flight import FlightReader
from mineloc.localize.localization import FlightData, Localization
from mineloc.localize.method import Method, method_named
from mineloc.output import new_folder
from mineloc.progress import Progress, quiet
from mineloc.stages.known_map import KnownMap
from mineloc.stages.run_folder import write_run_folder
from mineloc.stages.run_tables import fixes_table, pose_columns, sigmas

_SECTIONS = {
    "sweep",
    "keyframe",
    "odometry",
    "loam",
    "link3d",
    "scan_context",
    "loops",
    "graph",
    "prior_map",
    "intersections",
}


@dataclass(frozen=True, slots=True)
class LocalizeResult:
    """What `localize` left.

    Attributes:
        out: the run folder.
        sweeps, keyframes, untrusted, degenerate: counts; `untrusted` sweeps rest on the motion prior alone.
        fixes, fixes_refused: keyframes that the map or a place seen before holds, and those that were refused.
        path_m: length of the smoothed trajectory.
        sweeps_per_s, real_time_factor: of the whole run, reading included.
        in_map: False where the flight never found itself in the map: its poses are in a frame of its own.
        start_off_m: how far from the start that was told it began, where the map refuted that start; else None.
    """

    out: Path
    sweeps: int
    keyframes: int
    untrusted: int
    degenerate: int
    fixes: int
    fixes_refused: int
    path_m: float
    sweeps_per_s: float
    real_time_factor: float
    in_map: bool
    start_off_m: float | None

    def to_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {**asdict(self), "out": str(self.out)}

    def summary(self) -> str:
        """Two lines for people, more where something was recognised or refused."""
        doubt = f"{self.untrusted} sweeps rest on the motion prior alone, {self.degenerate} are weak in a direction"
        tried = self.fixes + self.fixes_refused
        found = f"{self.fixes} of {tried} fixes accepted\n" if tried else ""
        if not self.in_map:
            found += "NOT FOUND in the map: the poses are in a frame of their own, from the start of the flight\n"
        if self.start_off_m is not None:
            found += f"WRONG START: the flight began {self.start_off_m:.1f} m from where prior_map.start_m says\n"
        return (
            f"{self.out}: {self.sweeps} sweeps, {self.keyframes} keyframes, {self.path_m:.1f} m; {doubt}\n"
            f"{found}"
            f"{self.sweeps_per_s:.1f} sweeps/s, {self.real_time_factor:.1f} times real time"
        )


def localize(
    flight: Path,
    out: Path,
    *,
    method: str,
    prior_map: Path | None = None,
    database: Path | None = None,
    config: Config | None = None,
    progress: Progress = quiet,
) -> LocalizeResult:
    """Localize a flight and write the run folder (DESIGN.md, "A run folder").

    Args:
        flight: a canonical flight.
        out: the run folder.
        method: by its name.
        prior_map: a map folder, for methods that need one; poses and reference are then told in its frame.
        database: of its intersections, for methods that need one; the same.
        config: all sections.
        progress: told the sweeps that are done.

    Raises:
        ConfigError: no such method, a method without its map or with one it does not use, a map without a start.
        FormatError: `prior_map` is not a map folder, or `database` no database.
        IngestError: `flight` is not a canonical flight, or damaged.
        FlightError: it holds too little to localize.
        OutputError: `out` exists or cannot be written.
    """
    config = config or Config()
    chosen = method_named(method)
    if chosen.tracks is None and (prior_map is not None or database is not None):
        raise ConfigError(
            "--method", f"{method} uses no map", expected="no --map and no --database", todo="leave them out"
        )
    known = KnownMap.open(prior_map, database, config)
    with new_folder(out) as folder, FlightReader(flight) as reader:

        def counted(done: float, total: float | None, unit: str) -> None:
            progress(done, reader.sweep_count if total is None else total, unit)

        prior = None if known is None else known.prior
        found = chosen.run(FlightData(reader.steps(), reader.calibration), config, prior=prior, progress=counted)
        T_lidar_body = se3.inverse(reader.calibration.T_body_lidar)
        smoothed = found.smoothed.compose(right=T_lidar_body, child="body")
        counts = _counts(found, reader.sweep_count)
        timing = _timing(found, reader.duration_s)
        write_run_folder(
            folder,
            smoothed=smoothed,
            online=found.online.compose(right=T_lidar_body, child="body"),
            reference=reader.reference() if known is None or not found.in_map else known.reference_of(reader),
            sweeps=_sweeps(found),
            keyframes=_keyframes(found),
            points=_points(found),
            fixes=fixes_table(found.fixes),
            intersections=None if known is None else known.intersections,
            timing=timing,
            manifest={
                **_manifest(flight, reader, method, chosen, config, counts),
                "map": None if known is None else {**known.facts, **_in_map(found)},
            },
        )
    return LocalizeResult(
        out=out,
        sweeps=len(found.steps),
        keyframes=len(found.keyframes),
        untrusted=counts["untrusted"],
        degenerate=counts["degenerate"],
        fixes=counts["fixes_accepted"],
        fixes_refused=counts["fixes_refused"],
        path_m=float(smoothed.path_m[-1]),
        sweeps_per_s=timing["sweeps_per_s"],
        real_time_factor=timing["real_time_factor"],
        in_map=found.in_map,
        start_off_m=found.start_off_m,
    )


def _sweeps(found: Localization) -> pl.DataFrame:
    steps = found.steps
    weak = np.array([_weakest(step) for step in steps]).reshape(-1, 3)
    return pl.DataFrame(
        {
            "stamp_ns": [s.stamp_ns for s in steps],
            "trusted": [s.trusted for s in steps],
            "reason": [s.reason for s in steps],
            "inlier_ratio": [s.inlier_ratio for s in steps],
            "residual_m": [s.residual_m for s in steps],
            "points_used": [s.points_used for s in steps],
            "degeneracy_score": [s.degeneracy.score if s.degeneracy else float("nan") for s in steps],
            "is_degenerate": [s.degeneracy.is_degenerate if s.degeneracy else False for s in steps],
            "weak_x": weak[:, 0],
            "weak_y": weak[:, 1],
            "weak_z": weak[:, 2],
        }
    )


def _weakest(step: OdometryStep) -> F64:
    if step.degeneracy is None or not step.degeneracy.is_degenerate:
        return np.full(3, np.nan)
    return np.concatenate([step.degeneracy.weak_directions, step.degeneracy.blurred_directions])[0]


def _keyframes(found: Localization) -> pl.DataFrame:
    stamps = np.array([k.stamp_ns for k in found.keyframes])
    nearest = np.searchsorted(found.smoothed.stamps_ns, stamps)
    spread = np.array([sigmas(T, c) for T, c in zip(found.keyframe_poses, found.covariances, strict=True)])
    spread = spread.reshape(-1, 3)
    return pl.DataFrame(
        {
            "index": [k.index for k in found.keyframes],
            "stamp_ns": stamps,
            "path_m": found.smoothed.path_m[nearest],
            **pose_columns(found.keyframe_poses),
            **pose_columns(np.array([k.T_odom_lidar for k in found.keyframes]), prefix="odom_"),
            "sigma_xy_m": spread[:, 0],
            "sigma_z_m": spread[:, 1],
            "sigma_yaw_deg": spread[:, 2],
        }
    )


def _points(found: Localization) -> pl.DataFrame:
    index, clouds = [np.zeros(0, np.int32)], [np.zeros((0, 3), np.float32)]
    for keyframe in found.keyframes:
        clouds.append(keyframe.points_lidar)
        index.append(np.full(len(keyframe.points_lidar), keyframe.index, np.int32))
    x, y, z = np.concatenate(clouds).T
    return pl.DataFrame({"keyframe": np.concatenate(index), "x_m": x, "y_m": y, "z_m": z})


def _counts(found: Localization, recorded: int) -> dict[str, int]:
    return {
        "sweeps": len(found.steps),
        "recorded_sweeps": recorded,
        "keyframes": len(found.keyframes),
        "untrusted": sum(not step.trusted for step in found.steps),
        "degenerate": sum(step.degeneracy is not None and step.degeneracy.is_degenerate for step in found.steps),
        "fixes_accepted": sum(fix.trusted for fix in found.fixes),
        "fixes_refused": sum(not fix.trusted for fix in found.fixes),
        **found.counts,
    }


def _timing(found: Localization, duration_s: float) -> dict[str, Any]:
    total = sum(sum(values) for values in found.seconds.values())
    return {
        "modules": {name: _percentiles(values) for name, values in sorted(found.seconds.items())},
        "sweeps_per_s": len(found.steps) / total,
        "real_time_factor": duration_s / total,
    }


def _percentiles(seconds: Sequence[float]) -> Mapping[str, float]:
    ms = 1e3 * np.array(seconds)
    return {
        "total_s": float(ms.sum() * 1e-3),
        "p50_ms": float(np.percentile(ms, 50)),
        "p95_ms": float(np.percentile(ms, 95)),
        "max_ms": float(ms.max()),
    }


def _in_map(found: Localization) -> Mapping[str, Any]:
    """What became of a flight in a map."""
    return {"found": found.in_map, "start_off_m": found.start_off_m}


def _manifest(
    flight: Path, reader: FlightReader, method: str, chosen: Method, config: Config, counts: Mapping[str, int]
) -> dict[str, Any]:
    with flight.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {
        "mineloc_version": __version__,
        "method": method,
        "front_end": chosen.front_end,
        "flight": {"name": reader.info.flight or flight.stem, "sha256": digest, "info": asdict(reader.info)},
        "health": reader.health,
        "calibration": _calibration(reader.calibration),
        "configuration": json.loads(config.model_dump_json(include=_SECTIONS)),
        "coverage": counts["sweeps"] / max(counts["recorded_sweeps"], 1),
        "counts": dict(counts),
    }


def _calibration(calibration: Calibration) -> dict[str, list[list[float]]]:
    return {name: getattr(calibration, name).tolist() for name in ("T_body_lidar", "T_body_imu")}
