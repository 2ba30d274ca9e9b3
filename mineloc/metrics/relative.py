"""Relative pose error (RPE): motion against motion over a fixed distance, as evo defines it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import F64, I64
from mineloc.metrics.association import Pairs
from mineloc.metrics.statistics import Statistics

Unit = Literal["frames", "m"]


@dataclass(frozen=True, slots=True)
class RelativeError:
    """RPE over one distance. The statistics are None when no two poses are that far apart.

    Attributes:
        delta, unit: poses, or metres along the estimate.
        all_pairs: every start, or one stretch after the other.
    """

    delta: float
    unit: Unit
    all_pairs: bool
    translation_m: Statistics | None
    rotation_deg: Statistics | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name."""
        return {
            "delta": self.delta,
            "unit": self.unit,
            "all_pairs": self.all_pairs,
            "translation_m": self.translation_m.to_dict() if self.translation_m else None,
            "rotation_deg": self.rotation_deg.to_dict() if self.rotation_deg else None,
        }


def relative_error(
    pairs: Pairs,
    *,
    delta: float,
    unit: Unit,
    all_pairs: bool = False,
    tolerance: float = 0.1,
    T_reference_estimate: F64 | None = None,
) -> RelativeError:
    """RPE with evo's rules: distances are taken along the estimate.

    Args:
        delta: number of poses (whole) or metres.
        all_pairs: every start; metres then have to be met within `tolerance * delta`.
        T_reference_estimate: an alignment put in front first. It changes nothing but the last digits, and those only
            where rotations are rounded (KITTI files).

    Raises:
        ValueError: `delta` is not positive, or not whole for `frames`.
    """
    if not delta > 0 or (unit == "frames" and delta != int(delta)):
        raise ValueError(f"delta {delta} {unit}")
    estimate = pairs.estimate if T_reference_estimate is None else T_reference_estimate @ pairs.estimate
    if unit == "frames":
        i, j = _pairs_by_count(len(pairs), int(delta), all_pairs=all_pairs)
    else:
        i, j = _pairs_by_path(estimate[:, :3, 3], delta, tolerance * delta, all_pairs=all_pairs)
    if not len(i):
        return RelativeError(delta, unit, all_pairs, None, None)
    error = motion_error(pairs.reference, estimate, i, j)
    return RelativeError(
        delta,
        unit,
        all_pairs,
        Statistics.of(np.linalg.norm(error[:, :3, 3], axis=1)),
        Statistics.of(turn_deg(error)),
    )


def motion_error(reference: F64, estimate: F64, i: I64, j: I64) -> F64:
    """(k, 4, 4) `(T_ref,i⁻¹ T_ref,j)⁻¹ (T_est,i⁻¹ T_est,j)` of pose pairs i → j."""
    reference_motion = se3.inverse(reference[i]) @ reference[j]
    estimated_motion = se3.inverse(estimate[i]) @ estimate[j]
    return se3.inverse(reference_motion) @ estimated_motion


def turn_deg(T: F64) -> F64:
    """(n,) rotation angles of (n, 4, 4), degrees; of the nearest rotation where the digits of a file are few."""
    return np.asarray(np.degrees(Rotation.from_matrix(T[:, :3, :3]).magnitude()), dtype=np.float64)


def nearest_on_path(path_m: F64, start: I64, delta_m: float, first_end: I64) -> tuple[I64, F64]:
    """For each start the pose whose travelled distance is nearest to `delta_m` ahead; the first of several.

    Args:
        path_m: (n,) non-decreasing travelled distance.
        start: (k,) indices.
        first_end: (k,) smallest index allowed, < n.

    Returns:
        (k,) end indices and (k,) how far they miss the distance, metres.
    """
    after = np.clip(np.searchsorted(path_m, path_m[start] + delta_m, side="left"), first_end, len(path_m) - 1)
    # the first pose of a stand-still has the same travelled distance as its last
    before = np.searchsorted(path_m, path_m[np.maximum(after - 1, 0)], side="left")
    before = np.clip(before, first_end, None)
    miss_before = np.abs(path_m[before] - path_m[start] - delta_m)
    miss_after = np.abs(path_m[after] - path_m[start] - delta_m)
    closer = miss_after < miss_before
    return np.where(closer, after, before), np.where(closer, miss_after, miss_before)


def _pairs_by_count(n: int, delta: int, *, all_pairs: bool) -> tuple[I64, I64]:
    i = np.arange(0, n - delta, 1 if all_pairs else delta)
    return i, i + delta


def _pairs_by_path(positions: F64, delta_m: float, tolerance_m: float, *, all_pairs: bool) -> tuple[I64, I64]:
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    if all_pairs:
        path = np.concatenate([[0.0], np.cumsum(steps)])
        i = np.arange(len(positions) - 1)
        j, miss = nearest_on_path(path, i, delta_m, i + 1)
        return i[miss <= tolerance_m], j[miss <= tolerance_m]
    ends = [0]
    travelled = 0.0
    for k, step in enumerate(steps.tolist(), start=1):
        travelled += step
        if travelled >= delta_m:
            ends.append(k)
            travelled = 0.0
    chain = np.array(ends, dtype=np.int64)
    return chain[:-1], chain[1:]
