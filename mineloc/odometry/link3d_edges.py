"""LinK3D's edge points: where a ring bends more than noise does (paper B, eq. 1; METHOD 2.2, 4.3, D14).

The published gate (10 … 20000, not normalised) was made for 64 beams outdoors; in a roadway it leaves a VLP-16 with
next to nothing. The adaptive gate takes the sharpest twentieth of the sweep, but nothing that range noise explains:
ten neighbours with noise σ along the beam have a mean of 110 σ² (METHOD 0.6).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from mineloc.compiled import njit
from mineloc.config import Link3dConfig
from mineloc.data import F32, F64, I64, Sweep
from mineloc.odometry.loam_features import ring_starts, unreliable_points
from mineloc.sweep import deskew_constant_twist

NEIGHBOURS = 5
"""On each side of a point."""

NOISE = 2 * NEIGHBOURS * (2 * NEIGHBOURS + 1)
"""Mean smoothness of pure noise over σ²: 110."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgePoints:
    """The edge points of a sweep.

    Attributes:
        sweep: sorted by ring, with times if the sweep has them.
        smoothness: (m,) of each, m² as configured (sum or mean).
        gate_m2: what they exceed.
    """

    sweep: Sweep
    smoothness: F64
    gate_m2: float

    def deskewed(self, twist_lidar: F64, *, target_ns: int) -> EdgePoints:
        """All at one time, under a constant twist (see `deskew_constant_twist`)."""
        return replace(self, sweep=deskew_constant_twist(self.sweep, twist_lidar, target_ns=target_ns))


def edge_points(by_ring: Sweep, config: Link3dConfig) -> EdgePoints:
    """The points whose smoothness lies between the gates.

    Args:
        by_ring: sorted by ring, in the order of firing within a ring; not deskewed (smoothness is local).
        config: form and gates.
    """
    smoothness = smoothness_of(by_ring.points_lidar, ring_starts(by_ring), config.smoothness == "mean")
    if config.reject_unreliable:
        smoothness[unreliable_points(by_ring.points_lidar, ring_starts(by_ring))] = np.nan
    gate_m2 = lower_gate(smoothness, config)
    unit = _unit(config)
    # NaN marks the ends of rings and fails both
    edges = np.flatnonzero((smoothness > gate_m2) & (smoothness < config.upper_gate_m2 * unit))
    return EdgePoints(by_ring.keep(edges), smoothness[edges], gate_m2)


def lower_gate(smoothness: F64, config: Link3dConfig) -> float:
    """The gate that this sweep's edge points exceed, in the configured form (METHOD 4.3).

    Args:
        smoothness: (n,), NaN where undefined.
        config: `fixed_gate_m2`, or `gate_percentile` and `gate_noise_multiple`.
    """
    unit = _unit(config)
    if config.gate == "fixed":
        return config.fixed_gate_m2 * unit
    noise_m2 = config.gate_noise_multiple * NOISE * config.range_sigma_m**2 * unit
    known = smoothness[~np.isnan(smoothness)]
    return max(noise_m2, float(np.percentile(known, config.gate_percentile))) if len(known) else noise_m2


def _unit(config: Link3dConfig) -> float:
    """What the sum is multiplied by: paper B divides by |S| (METHOD D14)."""
    return 1.0 if config.smoothness == "sum" else 1.0 / (2 * NEIGHBOURS)


@njit(cache=True, nogil=True)
def smoothness_of(points: F32, starts: I64, mean: bool) -> F64:
    """‖Σ_j (p_j − p_i)‖² over `NEIGHBOURS` points on each side on the ring (B(1)).

    Args:
        points: (n, 3) sorted by ring.
        starts: (r + 1,) from `ring_starts`.
        mean: divided by the number of neighbours.

    Returns:
        (n,) m², NaN where a ring has too few neighbours on one side.
    """
    out = np.full(points.shape[0], np.nan)
    unit = 1.0 / (2 * NEIGHBOURS) if mean else 1.0
    for ring in range(starts.shape[0] - 1):
        for i in range(starts[ring] + NEIGHBOURS, starts[ring + 1] - NEIGHBOURS):
            total = 0.0
            for axis in range(3):
                d = -2.0 * NEIGHBOURS * np.float64(points[i, axis])
                for k in range(1, NEIGHBOURS + 1):
                    d += np.float64(points[i - k, axis]) + np.float64(points[i + k, axis])
                total += d * d
            out[i] = total * unit
    return out


def smoothness_plainly(points: F32, starts: I64, mean: bool) -> F64:
    """`smoothness_of` in plain numpy, as B(1) is written."""
    out = np.full(len(points), np.nan)
    for first, last in itertools.pairwise(starts):
        for i in range(first + NEIGHBOURS, last - NEIGHBOURS):
            others = np.r_[i - NEIGHBOURS : i, i + 1 : i + NEIGHBOURS + 1]
            total = (points[others].astype(np.float64) - points[i].astype(np.float64)).sum(axis=0)
            out[i] = total @ total / (len(others) if mean else 1)
    return out
