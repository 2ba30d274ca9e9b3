"""The shots of one sweep: rays from the moving sensor, and what it makes of the surfaces that they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit
from mineloc.sim.lidar import LidarModel
from mineloc.sim.scene import Hits

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U16 = NDArray[np.uint16]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Firings:
    """When a rotor fires during one revolution.

    Attributes:
        time_s: (c,) start of each firing since the flight's start.
        azimuth_rad: (c,) of the rotor, clockwise from above means falling.
    """

    time_s: F64
    azimuth_rad: F64


def firings_of(lidar: LidarModel, revolution: int, rate_hz: float) -> Firings:
    """The firings of one revolution; a free-running clock fires 1808 or 1809 times (VLP-16 at 10 Hz).

    A revolution starts looking backwards (azimuth π), so that the cut between sweeps is behind the drone.
    """
    period = lidar.firing_period_s(rate_hz)
    if lidar.columns:
        index = np.arange(revolution * lidar.columns, (revolution + 1) * lidar.columns)
    else:
        # counted in whole picoseconds: the number of firings must not depend on rounding
        period_ps, turn_ps = round(period * 1e12), round(1e12 / rate_hz)
        index = np.arange(-(-revolution * turn_ps // period_ps), -(-(revolution + 1) * turn_ps // period_ps))
    time = index.astype(np.float64) * np.float64(period)
    turned = np.mod(time * rate_hz, 1.0)
    return Firings(time, np.pi - 2 * np.pi * turned)


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """All shots of a revolution in the order of firing, n = firings × lasers.

    Attributes:
        origins_lidar, directions_lidar: (n, 3) float64, in the lidar frame at the time of each shot.
        rays: (n, 6) float32 in the scene's frame.
        offsets_ns: (n,) after the first firing.
        ring: (n,).
    """

    origins_lidar: F64
    directions_lidar: F64
    rays: F32
    offsets_ns: I64
    ring: U16


def aim(lidar: LidarModel, firings: Firings, poses: F64, rate_hz: float) -> Shots:
    """The rays of all shots.

    Args:
        lidar: the sensor.
        firings: c firings.
        poses: (c + 1, 4, 4) `T_scene_lidar` at each firing's start and one firing after the last.
        rate_hz: of the rotor.
    """
    period = lidar.firing_period_s(rate_hz)
    origins, directions, rays = _aim(
        lidar.elevation_rad,
        lidar.azimuth_rad,
        lidar.height_m,
        lidar.radius_m,
        lidar.fire_s,
        period,
        2 * np.pi * rate_hz,
        firings.azimuth_rad,
        np.ascontiguousarray(poses),
    )
    since_ns = np.rint((firings.time_s - firings.time_s[0])[:, None] * 1e9 + lidar.fire_s * 1e9).astype(np.int64)
    ring = np.tile(lidar.ring, len(firings.time_s))
    return Shots(origins, directions, rays, since_ns.ravel(), ring)


@njit(cache=True, nogil=True)
def _aim(
    elevation: F64,
    stagger: F64,
    height: F64,
    radius: float,
    fire_s: F64,
    period_s: float,
    spin_radps: float,
    azimuth: F64,
    poses: F64,
) -> tuple[F64, F64, F32]:
    columns, lasers = len(azimuth), len(elevation)
    origins = np.empty((columns * lasers, 3))
    directions = np.empty((columns * lasers, 3))
    rays = np.empty((columns * lasers, 6), np.float32)
    for c in range(columns):
        for k in range(lasers):
            i = c * lasers + k
            turn = azimuth[c] - spin_radps * fire_s[k]
            look = turn + stagger[k]
            ce = np.cos(elevation[k])
            origins[i, 0] = radius * np.cos(turn)
            origins[i, 1] = radius * np.sin(turn)
            origins[i, 2] = height[k]
            directions[i, 0] = ce * np.cos(look)
            directions[i, 1] = ce * np.sin(look)
            directions[i, 2] = np.sin(elevation[k])
            # between two firings (55 µs) the pose moves on a straight line to 1e-9
            u = fire_s[k] / period_s
            for a in range(3):
                o = 0.0
                d = 0.0
                for b in range(3):
                    r = (1 - u) * poses[c, a, b] + u * poses[c + 1, a, b]
                    o += r * origins[i, b]
                    d += r * directions[i, b]
                rays[i, a] = o + (1 - u) * poses[c, a, 3] + u * poses[c + 1, a, 3]
                rays[i, a + 3] = d
    return origins, directions, rays


@dataclass(frozen=True, slots=True)
class RangeErrors:
    """How a range is measured wrongly or not at all.

    Attributes:
        sigma_m: at normal incidence.
        grazing: growth, metres a metre of range and tangent of the incidence angle (beam footprint), tangent ≤ 6.
        loss: share of shots lost whatever they hit.
        dust: share of shots that return from dust, if the wall is behind it.
        dust_depth_m: mean distance of dust returns beyond the sensor's minimum.
    """

    sigma_m: float
    grazing: float
    loss: float
    dust: float
    dust_depth_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """What the sensor reports for each shot.

    Attributes:
        seen: (n,) whether there is a return.
        range_m: (n,) float64.
        intensity: (n,) float32, 0 … 255.
    """

    seen: Bool
    range_m: F64
    intensity: F32


def measure(lidar: LidarModel, shots: Shots, hits: Hits, errors: RangeErrors, rng: np.random.Generator) -> Returns:
    """Ranges with noise, quantisation and drop-outs.

    A shot returns with probability 1 / (1 + s⁻⁴), s = (ρ/0.1) cos θ (R₁₀/r)²: half of the shots on a 10 % reflector at
    normal incidence and R₁₀ come back; grazing and far ones are lost. The noise is
    σ² = σ₀² + (grazing · r · min(tan θ, 6))².

    Args:
        lidar: the sensor.
        shots: where it aimed.
        hits: what the rays met.
        errors: of the measurement.
        rng: noise and chance.
    """
    n = len(hits.range_m)
    noise = rng.standard_normal(n, dtype=np.float32)
    chance = rng.random((3, n), dtype=np.float32)
    seen, ranges, intensity = _measure(
        shots.rays,
        hits.range_m,
        hits.normals,
        noise,
        chance,
        (errors.sigma_m, errors.grazing, errors.loss, errors.dust, errors.dust_depth_m),
        (lidar.min_range_m, lidar.max_range_m, lidar.quantum_m, lidar.range_10_percent_m),
    )
    return Returns(seen, ranges, intensity)


@njit(cache=True, nogil=True)
def _measure(
    rays: F32,
    true_range: F32,
    normals: F32,
    noise: F32,
    chance: F32,
    errors: tuple[float, float, float, float, float],
    limits: tuple[float, float, float, float],
) -> tuple[Bool, F64, F32]:
    sigma, grazing, loss, dust, dust_depth = errors
    nearest, farthest, quantum, range10 = limits
    n = len(true_range)
    seen = np.zeros(n, np.bool_)
    ranges = np.zeros(n)
    intensity = np.zeros(n, np.float32)
    for i in range(n):
        r = float(true_range[i])
        reflectivity, cosine, spread = 0.1, 1.0, sigma
        if np.isfinite(r):
            reflectivity, cosine = _surface(rays[i], r, normals[i])
            tangent = min(np.sqrt(1.0 - cosine * cosine) / cosine, 6.0)
            spread = np.sqrt(sigma * sigma + (grazing * r * tangent) ** 2)
        if chance[0, i] < dust:
            # dust thins out with distance; the wall wins where it is nearer
            depth = nearest - dust_depth * np.log(1.0 - chance[1, i])
            if depth < r:
                r, reflectivity, cosine, spread = depth, 0.02, 1.0, sigma
        if not np.isfinite(r) or chance[2, i] < loss:
            continue
        signal = reflectivity / 0.1 * cosine * (range10 / max(r, 0.1)) ** 2
        # one random number decides both losses: rescaled, it is uniform again
        if (chance[2, i] - loss) / (1.0 - loss) > 1.0 / (1.0 + signal**-4):
            continue
        r += spread * noise[i]
        r = np.rint(r / quantum) * quantum
        if nearest <= r <= farthest:
            seen[i] = True
            ranges[i] = r
            intensity[i] = np.rint(min(max(255.0 * reflectivity * cosine**0.5, 0.0), 255.0))
    return seen, ranges, intensity


@njit(cache=True, nogil=True)
def _surface(ray: F32, r: float, normal: F32) -> tuple[float, float]:
    """Reflectivity and cosine of the incidence angle where a ray meets a surface after `r` metres."""
    reflectivity = _reflectivity(ray[0] + r * ray[3], ray[1] + r * ray[4], ray[2] + r * ray[5])
    cosine = abs(ray[3] * normal[0] + ray[4] * normal[1] + ray[5] * normal[2])
    return reflectivity, min(max(float(cosine), 1e-3), 1.0)


def points_of(shots: Shots, index: I64, range_m: F64) -> F32:
    """(k, 3) float32 points of some shots in the lidar frame at each one's own time.

    Args:
        shots: all.
        index: (k,) which.
        range_m: (n,) measured ranges of all.
    """
    return _points(shots.origins_lidar, shots.directions_lidar, range_m, index)


@njit(cache=True, nogil=True)
def _points(origins: F64, directions: F64, ranges: F64, index: I64) -> F32:
    out = np.empty((len(index), 3), np.float32)
    for k in range(len(index)):
        i = index[k]
        for a in range(3):
            out[k, a] = origins[i, a] + ranges[i] * directions[i, a]
    return out


@njit(cache=True, nogil=True)
def _reflectivity(x: float, y: float, z: float) -> float:
    """Diffuse reflectivity of rock, 8 to 40 %, in patches of metres and decimetres."""
    wide = np.sin(0.9 * x + 1.7 * z) * np.sin(1.1 * y - 0.7 * z)
    fine = np.sin(5.1 * x - 3.3 * z) * np.sin(4.7 * y + 6.1 * z)
    return 0.22 + 0.1 * wide + 0.06 * fine
