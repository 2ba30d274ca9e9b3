"""Depth fusion against what is simpler, on simulated images whose truth is known.

    .venv/bin/python benchmarks/depth_fusion.py [--mesh FILE] [--seed N] [--images N]

flies a depth camera and a VLP-16 through a mine and compares, image by image: the camera alone, linear interpolation
of the LiDAR, ordinary kriging of the LiDAR, and the fusion; each over its own pixels and over those that all have.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import KDTree

from mineloc import se3
from mineloc.config import FusionConfig, SimulateConfig
from mineloc.data import F64, DepthImage
from mineloc.mapping.depth_fusion import DepthFusion
from mineloc.mapping.depth_projection import Samples, project
from mineloc.mapping.kriging import krige_near
from mineloc.mapping.variogram import bin_lags, fit_exponential
from mineloc.sim.flight import SimulatedFlight
from mineloc.sim.mine import load_mine
from mineloc.sweep.deskew import deskew_poses

MESH = Path(__file__).resolve().parents[2] / "shared/data/meshes/edgar_mine/edgar_mine_rough_200k.ply"
BANDS_M = ((0, 2), (2, 4), (4, 6), (6, 10))


def interpolated(lidar: Samples, depth: DepthImage) -> F64:
    """Linear between the LiDAR's pixels (Delaunay), NaN outside."""
    v, u = np.mgrid[: depth.camera.height_px, : depth.camera.width_px]
    places = np.column_stack([u.ravel() - depth.camera.cx_px, v.ravel() - depth.camera.cy_px])
    return 1.0 / LinearNDInterpolator(lidar.places_px, lidar.inverse_depth)(places).reshape(depth.depth_m.shape)


def ordinarily_kriged(lidar: Samples, depth: DepthImage, reach_px: float) -> F64:
    """Ordinary kriging of the LiDAR's depth: one free mean, exponential variogram, 12 neighbours; NaN far away."""
    v, u = np.mgrid[: depth.camera.height_px, : depth.camera.width_px]
    at = np.column_stack([u.ravel() - depth.camera.cx_px, v.ravel() - depth.camera.cy_px]).astype(np.float64)
    z = 1.0 / lidar.inverse_depth
    some = slice(None, None, max(1, len(lidar) // 400))
    fitted = fit_exponential(bin_lags(lidar.places_px[some], z[some], lags=12, reach=60.0), nugget=4e-4)
    sill, range_ = fitted if fitted is not None else (0.1, 20.0)
    gap, near = KDTree(lidar.places_px).query(at, k=12)
    free = np.diag([1e6, 0.0, 0.0])
    noise = np.full(len(z), 4e-4)
    value, _ = krige_near(
        lidar.places_px, z, noise, at, near.astype(np.int64), sill=max(sill, 1e-4), range_=range_,
        mean=np.zeros(3), prior=free,
    )  # fmt: skip
    return np.where(gap[:, 0] < reach_px, value, np.nan).reshape(depth.depth_m.shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default=str(MESH))
    parser.add_argument("--seed", type=int, default=102)
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--size", default="424x240")
    chosen = parser.parse_args()
    settings = SimulateConfig(length_m=200, seed=chosen.seed, camera=True, camera_size=chosen.size, camera_hz=2.0)
    flight = SimulatedFlight(load_mine(chosen.mesh), settings)
    T_camera_lidar = se3.inverse(flight.calibration.T_body_camera) @ flight.calibration.T_body_lidar
    config = FusionConfig()
    names = ("camera", "LiDAR linear", "LiDAR ordinary kriging", "fused")
    squares, counts = dict.fromkeys(names, 0.0), dict.fromkeys(names, 0)
    shared, shared_count, pixels = dict.fromkeys(names, 0.0), 0, 0
    normalised: list[F64] = []
    depths: list[F64] = []
    seconds: list[float] = []
    fusion: DepthFusion | None = None
    done = 0
    for revolution, packet in enumerate(flight.packets()):
        if revolution < 60 or packet.sweep is None or not packet.depth:
            continue
        depth = packet.depth[0]
        fusion = fusion or DepthFusion(config, depth.camera)
        stamps = np.linspace(packet.sweep.stamp_ns - 1, max(packet.sweep.end_ns, depth.stamp_ns) + 1, 30).astype(
            np.int64
        )
        stamps = np.unique(np.append(stamps, depth.stamp_ns - 1))
        poses = flight.pose(stamps) @ flight.calibration.T_body_lidar
        points = deskew_poses(packet.sweep, stamps, poses, target_ns=depth.stamp_ns).points_lidar
        start = perf_counter()
        fused = fusion.fuse(depth, points, T_camera_lidar=T_camera_lidar)
        seconds.append(perf_counter() - start)
        truth = flight.true_depth(depth.stamp_ns).depth_m.astype(np.float64)
        lidar = project(points, T_camera_lidar, depth.camera)
        found = {
            "camera": np.where(depth.depth_m > 0, depth.depth_m, np.nan).astype(np.float64),
            "LiDAR linear": interpolated(lidar, depth),
            "LiDAR ordinary kriging": ordinarily_kriged(lidar, depth, config.gap_px),
            "fused": np.where(fused.depth_m > 0, fused.depth_m, np.nan).astype(np.float64),
        }
        valid = truth > 0
        pixels += int(valid.sum())
        everywhere = valid & np.all([np.isfinite(z) for z in found.values()], axis=0)
        shared_count += int(everywhere.sum())
        for name, z in found.items():
            own = valid & np.isfinite(z)
            squares[name] += float(((z - truth)[own] ** 2).sum())
            counts[name] += int(own.sum())
            shared[name] += float(((z - truth)[everywhere] ** 2).sum())
        own = valid & (fused.depth_m > 0)
        normalised.append(((fused.depth_m - truth) / fused.sigma_m)[own])
        depths.append(truth[own])
        done += 1
        if done == chosen.images:
            break
    print(f"mesh {Path(chosen.mesh).stem}, seed {chosen.seed}, {done} images of {chosen.size}\n")
    print("| estimate | RMSE m, own pixels | coverage % | RMSE m, pixels that all have |\n| --- | ---: | ---: | ---: |")
    for name in names:
        own = np.sqrt(squares[name] / max(counts[name], 1))
        both = np.sqrt(shared[name] / max(shared_count, 1))
        print(f"| {name} | {own:.4f} | {100 * counts[name] / pixels:.1f} | {both:.4f} |")
    e, z = np.concatenate(normalised), np.concatenate(depths)
    print(f"\nnormalised error {np.sqrt(np.mean(e**2)):.3f} (median |e|/0.6745: {np.median(np.abs(e)) / 0.6745:.3f})")
    for low, high in BANDS_M:
        band = (z >= low) & (z < high)
        if band.any():
            print(f"  {low}-{high} m: {np.sqrt(np.mean(e[band] ** 2)):.3f}, {100 * band.mean():.0f} % of the pixels")
    print(f"\n{1e3 * np.median(seconds):.0f} ms an image (median of {len(seconds)})")


if __name__ == "__main__":
    main()
