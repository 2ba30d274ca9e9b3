"""Scan Context: a sweep seen from above as rings and sectors (Kim and Kim, IROS 2018; METHOD 2.4, 4.2).

Written from the paper and METHOD alone. Four things differ from the published code, each of them a known fault of it:
columns that do not overlap give distance 1 and not NaN; the height of the lidar is never left out; the clouds must be
levelled; and the shift has a sign, so that its yaw can start a registration and reverse revisits are found too.
"""

from __future__ import annotations

import math

import numpy as np

from mineloc.compiled import njit
from mineloc.config import ScanContextConfig
from mineloc.data import F32, F64

UNLIKE = 1.0
"""The distance of contexts that have nothing in common: cosine distances of heights that are not negative end here."""


def scan_context(points_level: F32 | F64, config: ScanContextConfig) -> F32:
    """The context of a sweep.

    Cell (r, s) holds the points whose horizontal range is in ring r and whose azimuth is in sector s. Sector 0 begins
    at +x, the others follow counter-clockwise. Points that are not finite are dropped. By `cell`:

    - `max_height`, as published: the largest `z + lidar_height_m` in the cell, never negative; 0 where there is no
      point. Points beyond `radius_m` are dropped. In a mine this is the height of the roof, everywhere.
    - `free_range`: the share of the cell that lies before the farthest point of its sector, 1 in all rings that one
      sees across. How far one sees in each direction is what tells one place of a roadway from another.

    Args:
        points_level: (n, 3) metres, the lidar at the origin, z up (turned by the measured direction of up).
        config: `cell`, `rings`, `sectors`, `radius_m`, `lidar_height_m`.

    Returns:
        (rings, sectors) float32.
    """
    if config.cell == "free_range":
        return _as_free_range(_farthest(points_level, config.sectors), config)
    return _highest(points_level, config.rings, config.sectors, config.radius_m, config.lidar_height_m)


def ring_key(context: F32) -> F32:
    """(rings,) float32 mean of each row: the same for every heading."""
    return context.mean(axis=1, dtype=np.float64).astype(np.float32)


def sector_key(context: F32) -> F32:
    """(sectors,) float32 mean of each column: turns with the heading."""
    return context.mean(axis=0, dtype=np.float64).astype(np.float32)


def context_distance(a: F32, b: F32, config: ScanContextConfig) -> tuple[float, int]:
    """How unlike two contexts are, under the best turn.

    The turn that brings the sector keys nearest (L2) is found among all; around it `search_ratio` of all turns are
    tried with the contexts themselves: the mean of 1 - cos of their columns, over the columns filled in both.

    Args:
        a, b: (rings, sectors).
        config: `search_ratio`, `min_shared_columns`.

    Returns:
        Distance in [0, 1], `UNLIKE` when too few columns are filled in both; and the shift in 0 … sectors - 1 such that
        `np.roll(a, shift, axis=1)` lies on b. `yaw_of_shift` tells the rotation that it stands for.

    Raises:
        ValueError: the shapes differ.
    """
    if a.shape != b.shape:
        raise ValueError(f"contexts of shapes {a.shape} and {b.shape}")
    distance, shift = _distance(
        a, b, sector_key(a), sector_key(b), _half_window(config, a.shape[1]), _least_shared(config, a.shape[1])
    )
    return float(distance), int(shift)


def yaw_of_shift(shift: int, sectors: int) -> float:
    """Rotation about z, in (-π, π], that takes the coordinates of a to those of b: b's azimuth is a's plus the yaw."""
    turns = shift / sectors
    return 2 * math.pi * (turns - math.ceil(turns - 0.5))


def _half_window(config: ScanContextConfig, sectors: int) -> int:
    return round(0.5 * config.search_ratio * sectors)


def _least_shared(config: ScanContextConfig, sectors: int) -> int:
    return max(1, math.ceil(config.min_shared_columns * sectors))


def _as_free_range(far_m: F64, config: ScanContextConfig) -> F32:
    """(rings, sectors) share of each cell that lies before (sectors,) ranges."""
    rings = far_m * config.rings / config.radius_m - np.arange(config.rings)[:, None]
    return np.clip(rings, 0, 1).astype(np.float32)


@njit(cache=True, nogil=True)
def _sector_of(x: float, y: float, sectors: int) -> int:
    angle = math.atan2(y, x)
    if angle < 0.0:
        angle += 2.0 * math.pi
    # an angle just below zero can round up to a whole turn
    return min(int(angle * sectors / (2.0 * math.pi)), sectors - 1)


@njit(cache=True, nogil=True)
def _farthest(points: F32 | F64, sectors: int) -> F64:
    """(sectors,) horizontal range of the farthest point, 0 without one."""
    out = np.zeros(sectors)
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        away = math.hypot(x, y)
        if away < np.inf and abs(z) < np.inf:
            sector = _sector_of(x, y, sectors)
            out[sector] = max(out[sector], away)
    return out


@njit(cache=True, nogil=True)
def _highest(points: F32 | F64, rings: int, sectors: int, radius_m: float, height_m: float) -> F32:
    out = np.zeros((rings, sectors), np.float32)
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        away = math.hypot(x, y)
        if not (away < radius_m and abs(z) < np.inf):
            continue
        sector = _sector_of(x, y, sectors)
        ring = min(int(away * rings / radius_m), rings - 1)
        out[ring, sector] = max(out[ring, sector], np.float32(z + height_m))
    return out


@njit(cache=True, nogil=True)
def _distance(a: F32, b: F32, key_a: F32, key_b: F32, half_window: int, least_shared: int) -> tuple[float, int]:
    sectors = a.shape[1]
    near = _nearest_turn(key_a, key_b)
    norm_a, norm_b = _column_norms(a), _column_norms(b)
    best, best_shift = UNLIKE, near
    for offset in range(-half_window, half_window + 1):
        shift = (near + offset) % sectors
        distance = _column_distance(a, b, norm_a, norm_b, shift, least_shared)
        if distance < best:
            best, best_shift = distance, shift
    return best, best_shift


@njit(cache=True, nogil=True)
def _nearest_turn(key_a: F32, key_b: F32) -> int:
    """The shift of a key that makes it most like the other; the smallest of equals."""
    n = len(key_a)
    best, best_shift = np.inf, 0
    for shift in range(n):
        total = 0.0
        for j in range(n):
            off = np.float64(key_a[j]) - np.float64(key_b[(j + shift) % n])
            total += off * off
        if total < best:
            best, best_shift = total, shift
    return best_shift


@njit(cache=True, nogil=True)
def _column_norms(context: F32) -> F64:
    out = np.zeros(context.shape[1])
    for i in range(context.shape[0]):
        for j in range(context.shape[1]):
            out[j] += np.float64(context[i, j]) * np.float64(context[i, j])
    return np.sqrt(out)


@njit(cache=True, nogil=True)
def _column_distance(a: F32, b: F32, norm_a: F64, norm_b: F64, shift: int, least_shared: int) -> float:
    sectors = a.shape[1]
    total, shared = 0.0, 0
    for j in range(sectors):
        k = (j + shift) % sectors
        if norm_a[j] == 0.0 or norm_b[k] == 0.0:
            continue
        dot = 0.0
        for i in range(a.shape[0]):
            dot += np.float64(a[i, j]) * np.float64(b[i, k])
        total += max(0.0, 1.0 - dot / (norm_a[j] * norm_b[k]))
        shared += 1
    return total / shared if shared >= least_shared else UNLIKE


def scan_context_plainly(points_level: F32 | F64, config: ScanContextConfig) -> F32:
    """`scan_context` in plain numpy: what the kernels are held to."""
    points = points_level.astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    away = np.hypot(points[:, 0], points[:, 1])
    angle = np.arctan2(points[:, 1], points[:, 0])
    angle += np.where(angle < 0, 2 * np.pi, 0.0)
    sector = np.minimum((angle * config.sectors / (2 * np.pi)).astype(np.int64), config.sectors - 1)
    if config.cell == "free_range":
        far = np.zeros(config.sectors)
        np.maximum.at(far, sector, away)
        return _as_free_range(far, config)
    kept = away < config.radius_m
    ring = np.minimum((away * config.rings / config.radius_m).astype(np.int64), config.rings - 1)
    out = np.zeros((config.rings, config.sectors))
    np.maximum.at(out, (ring[kept], sector[kept]), points[kept, 2] + config.lidar_height_m)
    return out.astype(np.float32)


def context_distance_plainly(a: F32, b: F32, config: ScanContextConfig) -> tuple[float, int]:
    """`context_distance` in plain numpy: what the kernel is held to."""
    one, two, sectors = a.astype(np.float64), b.astype(np.float64), a.shape[1]
    keys = sector_key(a).astype(np.float64), sector_key(b).astype(np.float64)
    turned = [np.linalg.norm(np.roll(keys[0], shift) - keys[1]) for shift in range(sectors)]
    near, half = int(np.argmin(turned)), _half_window(config, sectors)
    found = [(UNLIKE, near)]
    for shift in ((near + offset) % sectors for offset in range(-half, half + 1)):
        turned_one = np.roll(one, shift, axis=1)
        scale = np.linalg.norm(turned_one, axis=0) * np.linalg.norm(two, axis=0)
        both = scale > 0
        if both.sum() >= _least_shared(config, sectors):
            cosine = (turned_one * two).sum(axis=0)[both] / scale[both]
            found.append((float(np.maximum(1 - cosine, 0).mean()), shift))
    return min(found, key=lambda item: item[0])
