"""Whether a shift of a pose is seen at all: what tells structure from noise that looks like it."""

from __future__ import annotations

import numpy as np

from mineloc.data import F64
from mineloc.odometry.registration import Thinned, Weighting, linearise
from mineloc.odometry.voxel_map import VoxelMap


def contrast(
    sweep: Thinned,
    T_odom_body: F64,
    twist: F64,
    maps: tuple[VoxelMap, VoxelMap],
    w: Weighting,
    shift_m: F64,
    *,
    here_m: float | None = None,
) -> float:
    """By what share a shift of the pose makes the points' mean squared distance from the planes grow.

    A Hessian takes noise for structure: the normals of patches along a smooth roadway tilt at random, and that looks
    like information. Points that find their patches anew show whether the shift is really seen.

    Args:
        sweep, T_odom_body, twist, maps, w: as for `linearise`, at the registered pose.
        shift_m: (3,) in odom; tried forwards and backwards.
        here_m: root mean square distance at the pose itself; computed when not given.

    Returns:
        Zero where the points fit as well elsewhere, one where the shift weighs as much as all noise; infinite without
        a residual.
    """
    if here_m is None:
        here_m = linearise(sweep, T_odom_body, twist, maps, w).residual_m
    shifted = [np.array(T_odom_body), np.array(T_odom_body)]
    shifted[0][:3, 3] += shift_m
    shifted[1][:3, 3] -= shift_m
    here, there = here_m**2, np.mean([linearise(sweep, T, twist, maps, w).residual_m ** 2 for T in shifted])
    return float(there / here) - 1.0 if here > 0.0 and np.isfinite(there) else float("inf")
