"""Sweeps of a VLP-16 in scenes with a formula: rooms, pillars, smooth and rough tunnels. For the odometry's tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from mineloc import se3
from mineloc.data import F64, Sweep

Scene = Callable[[F64, F64], F64]
"""Ranges (n,) along rays from origins (n, 3) in directions (n, 3); infinite where nothing is hit."""

PERIOD_NS = 100_000_000
RINGS = 16
FIRINGS = 1800
REACH_M = 60.0
FIRST_NS = 1_700_000_000_000_000_000


def room(x_m: float, y_m: float, z_m: float) -> Scene:
    """The inside of a box around the origin, given by its half sizes."""
    half = np.array([x_m, y_m, z_m])

    def cast(origins: F64, directions: F64) -> F64:
        with np.errstate(divide="ignore"):
            ranges = ((half * np.where(directions < 0, -1, 1) - origins) / directions).min(axis=1)
        return np.where(ranges < REACH_M, ranges, np.inf)

    return cast


def smooth_tunnel() -> Scene:
    """4 m × 3 m, straight along x, without ends."""
    return room(1e6, 2.0, 1.5)


def with_pillar(scene: Scene, x_m: float, y_m: float, half_m: float) -> Scene:
    """The scene with a square pillar from floor to roof in it."""

    def cast(origins: F64, directions: F64) -> F64:
        with np.errstate(divide="ignore"):
            to = (np.array([x_m, y_m]) - origins[:, :2])[:, :, None] + np.array([-half_m, half_m])
            ways = np.sort(to / directions[:, :2, None], axis=2)
        enter, leave = ways[:, :, 0].max(axis=1), ways[:, :, 1].min(axis=1)
        return np.where(
            (enter > 0) & (enter < leave), np.minimum(enter, scene(origins, directions)), scene(origins, directions)
        )

    return cast


def rough_tunnel(roughness_m: float) -> Scene:
    """The smooth tunnel with waves of 0.7 to 3 m in its walls, `roughness_m` the root mean square."""
    rng = np.random.default_rng(7)
    waves = rng.normal(0, 1, (8, 3))
    waves *= 2 * np.pi / rng.uniform(0.7, 3.0, 8)[:, None] / np.linalg.norm(waves, axis=1)[:, None]
    phases = rng.uniform(0, 2 * np.pi, 8)

    def to_wall(p: F64) -> F64:
        flat = np.minimum(2.0 - np.abs(p[:, 1]), 1.5 - np.abs(p[:, 2]))
        return flat + roughness_m / 2.0 * np.sin(p @ waves.T + phases).sum(axis=1)

    def cast(origins: F64, directions: F64) -> F64:
        ranges = np.zeros(len(origins))
        running = np.arange(len(origins))
        while len(running):
            step = to_wall(origins[running] + ranges[running, None] * directions[running])
            ranges[running] += 0.8 * step
            running = running[(np.abs(step) > 2e-3) & (ranges[running] < REACH_M)]
        return np.where(ranges < REACH_M, ranges, np.inf)

    return cast


def vlp16_sweep(
    scene: Scene,
    T_map_lidar: F64,
    twist_lidar: F64,
    *,
    stamp_ns: int = FIRST_NS,
    sigma_m: float = 0.0,
    rng: np.random.Generator | None = None,
) -> Sweep:
    """One revolution that starts at `T_map_lidar` and moves with a constant twist, in the order of firing."""
    elevation = np.deg2rad(np.linspace(-15, 15, RINGS))
    order = np.arange(RINGS).reshape(2, 8).T.reshape(-1)  # -15°, 1°, -13°, 3° …
    azimuth = -np.arange(FIRINGS)[:, None] * 2 * np.pi / FIRINGS
    offsets = np.arange(FIRINGS)[:, None] * 55_296 + np.arange(RINGS) * 2_304
    e = np.broadcast_to(elevation[order], (FIRINGS, RINGS))
    directions = np.stack([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)], axis=-1)
    poses = T_map_lidar @ se3.exp(offsets.reshape(-1, 1) * 1e-9 * twist_lidar)
    rays = np.einsum("nij,nj->ni", poses[:, :3, :3], directions.reshape(-1, 3))
    ranges = scene(poses[:, :3, 3], rays)
    if sigma_m:
        assert rng is not None
        ranges = ranges + rng.normal(0, sigma_m, len(ranges))
    hit = np.isfinite(ranges)
    points = (directions.reshape(-1, 3)[hit] * ranges[hit, None]).astype(np.float32)
    ring = np.broadcast_to(order, (FIRINGS, RINGS)).reshape(-1).astype(np.uint16)
    return Sweep(stamp_ns, points, offsets.reshape(-1)[hit].astype(np.int64), ring[hit], None, PERIOD_NS)


def flight(scene: Scene, twists: Sequence[F64], *, sigma_m: float = 0.0, seed: int = 0) -> Iterator[tuple[Sweep, F64]]:
    """A flight with one twist a sweep, from the origin: sweeps and the true pose at the last point of each."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    for k, twist in enumerate(twists):
        sweep = vlp16_sweep(scene, T, twist, stamp_ns=FIRST_NS + k * PERIOD_NS, sigma_m=sigma_m, rng=rng)
        yield sweep, T @ se3.exp((sweep.end_ns - sweep.stamp_ns) * 1e-9 * twist)
        T = T @ se3.exp(PERIOD_NS * 1e-9 * twist)


def from_rest(twist: Sequence[float], *, rest: int = 2, ramp: int = 8, cruise: int = 10) -> list[F64]:
    """Twists of a drone that hovers, speeds up evenly and flies on."""
    share = np.concatenate([np.zeros(rest), np.arange(1, ramp + 1) / ramp, np.ones(cruise)])
    return list(share[:, None] * np.asarray(twist, dtype=np.float64))
