"""A complete run folder without a localization: a flight round and round through a mine of two loops.

The truth is known, so the errors of `online` (a random walk) and `smoothed` (a fraction of it) are too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from mineloc import se3
from mineloc.data import Fix, Trajectory
from mineloc.output import new_folder
from mineloc.stages.run_folder import write_run_folder
from mineloc.stages.run_tables import KEYFRAMES, POINTS, fixes_table, pose_columns

START_NS = 1_790_000_000_123_456_789
PERIOD_NS = 100_000_000
STEP_M = 0.15
_EAST = [[120, 0, 1], [120, 70, 4], [60, 80, 6]]
_WEST = [[0, 0, 0], [-20, 60, -3], [30, 90, 2], [60, 80, 6]]
CORNERS_M = np.array([[0, 0, 0], *_EAST, [60, 0, 0.5], *_WEST, *reversed(_EAST[:2]), [60, 0, 0.5]], dtype=np.float64)
T_BODY_LIDAR = se3.from_xyzw([0.05, 0.0, 0.12], [0, 0, 0, 1])


@dataclass(frozen=True)
class SyntheticRun:
    """What to write; `scale` multiplies the error of the estimate."""

    poses: int = 1500
    reference: bool = True
    method: str = "odometry"
    front_end: str = "mineloc"
    flight: str = "synthetic flight"
    site: str = "two loops"
    scale: float = 1.0
    seed: int = 1
    degenerate: bool = True
    points_per_keyframe: int = 120


def write_synthetic_run(path: Path, what: SyntheticRun | None = None) -> Path:
    what = what or SyntheticRun()
    rng = np.random.default_rng(what.seed)
    stamps = START_NS + PERIOD_NS * np.arange(what.poses, dtype=np.int64)
    truth = _truth(what.poses)
    walk = np.cumsum(rng.normal(0, 0.004 * what.scale, (what.poses, 3)), axis=0)
    yaw = np.cumsum(rng.normal(0, 2e-5 * what.scale, what.poses))
    online = truth @ _small(walk, yaw)
    smoothed = truth @ _small(0.3 * walk, 0.3 * yaw)
    sweeps = _sweeps(what, stamps, rng)
    chosen = np.arange(0, what.poses, max(1, round(1.0 / STEP_M)))
    keyframes = _keyframes(stamps[chosen], smoothed[chosen], online[chosen])
    with new_folder(path) as folder:
        write_run_folder(
            folder,
            smoothed=Trajectory(stamps, smoothed),
            online=Trajectory(stamps, online),
            reference=Trajectory(stamps, truth) if what.reference else None,
            sweeps=sweeps,
            keyframes=keyframes,
            points=_points(len(chosen), what.points_per_keyframe, rng),
            fixes=fixes_table(_fixes(stamps[chosen], smoothed[chosen])),
            timing=_timing(what),
            manifest=_manifest(what, len(chosen)),
        )
    return path


def _truth(n: int) -> np.ndarray:
    legs = np.linalg.norm(np.diff(CORNERS_M, axis=0, append=CORNERS_M[:1]), axis=1)
    s = np.concatenate([[0.0], np.cumsum(legs)])
    fine = np.arange(0.0, s[-1], 0.5)
    ring = np.stack([np.interp(fine, s, np.append(column, column[0])) for column in CORNERS_M.T], axis=1)
    kernel = np.hanning(17) / np.hanning(17).sum()
    smooth = np.stack([np.convolve(np.tile(c, 3), kernel, "same")[len(c) : 2 * len(c)] for c in ring.T], axis=1)
    along = np.mod(np.arange(n) * STEP_M, s[-1])
    position = np.stack([np.interp(along, fine, c, period=s[-1]) for c in smooth.T], axis=1)
    ahead = (
        np.stack([np.interp(np.mod(along + 0.5, s[-1]), fine, c, period=s[-1]) for c in smooth.T], axis=1) - position
    )
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    out = np.tile(np.eye(4), (n, 1, 1))
    out[:, 0, 0], out[:, 0, 1] = np.cos(heading), -np.sin(heading)
    out[:, 1, 0], out[:, 1, 1] = np.sin(heading), np.cos(heading)
    out[:, :3, 3] = position
    return se3.inverse(out[:1]) @ out  # the map frame is the body frame at the first pose


def _small(t: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    zero = np.zeros_like(yaw)
    return se3.exp(np.column_stack([zero, zero, yaw, t]))


def _sweeps(what: SyntheticRun, stamps: np.ndarray, rng: np.random.Generator) -> pl.DataFrame:
    n = len(stamps)
    at = np.arange(n)
    weak = (at % 700 > 450) & (at % 700 < 560) & what.degenerate
    lost = (at % 900 > 500) & (at % 900 < 506)
    return pl.DataFrame(
        {
            "stamp_ns": stamps,
            "trusted": ~lost,
            "reason": np.where(lost, "inlier ratio 0.08 < 0.2", "").tolist(),
            "inlier_ratio": np.where(lost, 0.08, 0.8 + 0.1 * rng.random(n)),
            "residual_m": np.where(lost, np.nan, 0.02 + 0.005 * rng.random(n)),
            "points_used": np.where(lost, 12, 900),
            "degeneracy_score": np.where(weak, 0.003, 0.2 + 0.05 * rng.random(n)),
            "is_degenerate": weak,
            "weak_x": np.where(weak, 1.0, np.nan),
            "weak_y": np.where(weak, 0.0, np.nan),
            "weak_z": np.where(weak, 0.0, np.nan),
        }
    )


def _keyframes(stamps: np.ndarray, smoothed: np.ndarray, online: np.ndarray) -> pl.DataFrame:
    k = len(stamps)
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(online[:, :3, 3], axis=0), axis=1))])[:k]
    columns: dict[str, Any] = {
        "index": np.arange(k),
        "stamp_ns": stamps,
        "path_m": path_m,
        **pose_columns(smoothed @ T_BODY_LIDAR),
        **pose_columns(online @ T_BODY_LIDAR, prefix="odom_"),
        "sigma_xy_m": 0.01 + 1e-3 * np.sqrt(path_m),
        "sigma_z_m": 0.01 + 5e-4 * np.sqrt(path_m),
        "sigma_yaw_deg": 0.01 * np.sqrt(path_m),
    }
    return pl.DataFrame(columns).cast(KEYFRAMES)


def _points(keyframes: int, each: int, rng: np.random.Generator) -> pl.DataFrame:
    n = keyframes * each
    along = rng.uniform(-2.0, 2.0, n)
    around = rng.uniform(0.0, 2 * np.pi, n)
    radius = 2.0 + 0.05 * rng.standard_normal(n)
    return pl.DataFrame(
        {
            "keyframe": np.repeat(np.arange(keyframes), each),
            "x_m": along,
            "y_m": radius * np.cos(around),
            "z_m": radius * np.sin(around),
        }
    ).cast(POINTS)


def _fixes(stamps: np.ndarray, smoothed: np.ndarray) -> list[Fix]:
    k = len(stamps)
    good = [
        Fix(int(stamps[i]), i, smoothed[i] @ T_BODY_LIDAR, np.eye(6) * 1e-4, True, target="J1", scores={"overlap": 0.9})
        for i in range(5, k, 40)
    ]
    refused = [Fix(int(stamps[i]), i, None, None, False, reason="overlap 0.31 < 0.6") for i in range(25, k, 80)]
    return sorted(good + refused, key=lambda fix: fix.stamp_ns)


def _timing(what: SyntheticRun) -> dict[str, Any]:
    one = {"total_s": what.poses * 0.0145, "p50_ms": 14.4, "p95_ms": 15.1, "max_ms": 31.0}
    return {
        "modules": {"odometry": one, "graph": {**one, "p50_ms": 0.8}},
        "sweeps_per_s": 68.9,
        "real_time_factor": 6.9,
    }


def _manifest(what: SyntheticRun, keyframes: int) -> dict[str, Any]:
    return {
        "mineloc_version": "0.1.0",
        "method": what.method,
        "front_end": what.front_end,
        "flight": {
            "name": what.flight,
            "sha256": "ab" * 32,
            "info": {"flight": what.flight, "site": what.site, "lidar": "VLP-16", "start_utc": "2026-09-21T10:13:20Z"},
        },
        "health": None,
        "calibration": {"T_body_lidar": T_BODY_LIDAR.tolist(), "T_body_imu": np.eye(4).tolist()},
        "configuration": {"odometry": {"use_imu": True}},
        "coverage": 1.0,
        "counts": {"sweeps": what.poses, "keyframes": keyframes},
    }
