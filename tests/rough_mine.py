"""A mine as a cloud of wall points: what a keyframe sees is what lies around it. No rays, so tests are quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

from mineloc import se3
from mineloc.data import F64, Calibration, FlightInfo, Keyframe, RelativePose, Sweep, Trajectory
from mineloc.io.flight import FlightWriter

WIDTH_M, HEIGHT_M, REACH_M = 4.0, 3.0, 12.0
_AROUND = 40
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class WallPoints:
    """Points on the walls of a roadway along a line."""

    points_m: F64
    tree: KDTree

    def seen_from(self, T_map_lidar: F64, rng: np.random.Generator) -> np.ndarray:
        near = self.points_m[self.tree.query_ball_point(T_map_lidar[:3, 3], REACH_M)]
        some = near[rng.random(len(near)) < 0.7]
        return (se3.apply(se3.inverse(T_map_lidar), some) + rng.normal(0, 0.01, (len(some), 3))).astype(np.float32)


def roadway_along(line_m: F64, *, rough_m: float, rng: np.random.Generator) -> WallPoints:
    """Rings of points around the line, every 0.25 m along and around, moved in and out by smooth bumps."""
    around = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    bumps = gaussian_filter1d(rng.standard_normal((len(line_m), _AROUND)), 3, axis=0)
    bumps = gaussian_filter1d(bumps, 2, axis=1, mode="wrap")
    bumps *= rough_m / max(bumps.std(), 1e-12)
    ahead = np.gradient(line_m, axis=0)
    side = np.cross([0.0, 0.0, 1.0], ahead / np.linalg.norm(ahead, axis=1)[:, None])
    y, z = (WIDTH_M / 2 + bumps) * np.cos(around), (HEIGHT_M / 2 + bumps) * np.sin(around)
    points = line_m[:, None] + y[:, :, None] * side[:, None] + z[:, :, None] * [0.0, 0.0, 1.0]
    points = points.reshape(-1, 3)
    return WallPoints(points, KDTree(points))


def ring(radius_m: float, *, step_m: float = 0.25) -> F64:
    """(n, 3) a circle, then a bulge that makes its parts differ in curvature."""
    angle = np.arange(0, 2 * np.pi, step_m / radius_m)
    r = radius_m * (1 + 0.1 * np.sin(3 * angle))
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), np.zeros(len(angle))])


@dataclass(frozen=True)
class Drifted:
    """Keyframes every metre along a way, with odometry that errs as its edges say."""

    keyframes: list[Keyframe]
    edges: list[RelativePose | None]
    truth: F64


def fly_along(
    way_m: F64, mine: WallPoints, *, sigma_rad: float, sigma_m: float, rng: np.random.Generator, bias_rad: float = 0.0
) -> Drifted:
    """Take the way (n, 3), heading along it, a keyframe at every point."""
    ahead = np.gradient(way_m, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    turns = np.zeros((len(way_m), 6))
    turns[:, 2] = yaw
    truth = se3.exp(turns)
    truth[:, :3, 3] = way_m
    sigma = np.array([sigma_rad] * 3 + [sigma_m] * 3)
    keyframes, edges, T_odom = [], [], se3.inverse(truth[0]) @ truth[0]
    for k, T in enumerate(truth):
        edge = None
        if k:
            error = rng.normal(0, 1, 6) * sigma + [0, 0, bias_rad, 0, 0, 0]
            moved = se3.inverse(truth[k - 1]) @ T @ se3.exp(error)
            T_odom = se3.rigid(T_odom @ moved)
            edge = RelativePose(k - 1, k, moved, np.diag(1 / (sigma**2 + [0, 0, bias_rad**2, 0, 0, 0])))
        keyframes.append(Keyframe(k, k * 1_000_000_000, T_odom, mine.seen_from(T, rng)))
        edges.append(edge)
    return Drifted(keyframes, edges, truth)


def write_flight(
    path: Path, line_m: F64, mine: WallPoints, *, seed: int, name: str = "rough", shift: F64 | None = None
) -> F64:
    """A canonical flight along a line with 0.4 m a sweep, instant sweeps, no IMU; the true poses of its sweeps.

    Args:
        shift: (4, 4) the reference is told in another frame: `shift @ truth`.
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    at = np.arange(0.0, along[-1], 0.4)
    way = np.column_stack([np.interp(at, along, line_m[:, k]) for k in range(3)])
    ahead = np.gradient(way, axis=0)
    xi = np.zeros((len(way), 6))
    xi[:, 2] = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    truth = se3.exp(xi)
    truth[:, :3, 3] = way
    rng = np.random.default_rng(seed)
    stamps = START_NS + np.arange(len(way), dtype=np.int64) * 100_000_000
    told = truth if shift is None else shift @ truth
    with FlightWriter(path, FlightInfo(flight=name), Calibration()) as writer:
        writer.add_reference(Trajectory(stamps, told))
        for stamp, T in zip(stamps.tolist(), truth, strict=True):
            writer.add_sweep(Sweep(stamp, mine.seen_from(T, rng)))
    return truth
