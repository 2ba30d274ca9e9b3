"""Registration of one submap to another, and what it is worth (METHOD 6.2, 7.3).

ICP (open3d, point to plane, Tukey's kernel) from a predicted pose, with matches from far to near. Point to plane alone
is unsafe as odometry (METHOD 7.1); between two submaps of one place, which show the same roughness, it is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from scipy.spatial import KDTree

from mineloc import se3
from mineloc.data import F64, I64, Bool
from mineloc.mapping.one_thread import one_thread
from mineloc.mapping.submaps import Submap, open3d_cloud

_LOSS = 1e-6
_ROUNDS = 20
_DIGITS = 9
_THINNED = 3  # all but the last ICP only come near
_SEEN_BY_BOTH = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class SubmapRegistration:
    """Where a submap lies in another one.

    Attributes:
        T_target_source: (4, 4) place of the source's root seen from the target's.
        overlap: share of the points of either submap that have a point of the other within `inlier_m`; the smaller of
            the two shares. Of points that only one of them can reach nothing is said.
        residual_m: root mean square of the inliers' distances along the normal.
        hessian: (6, 6) Σ hᵀh over the inliers, h = nᵀ R [-p^ I] (METHOD D3): `[rotation, translation]`, right
            perturbation of the source.
        inliers: their number.
    """

    T_target_source: F64
    overlap: float
    residual_m: float
    hessian: F64
    inliers: int


def register_submaps(
    source: Submap, target: Submap, T_target_source: F64, *, distances_m: Sequence[float], kernel_m: float
) -> SubmapRegistration:
    """ICP of a submap to another, then the judgement of the result.

    Args:
        source, target: with points.
        T_target_source: (4, 4) where to start.
        distances_m: largest distance of a match, one ICP after the other; the last one counts as inlier.
        kernel_m: of Tukey's kernel.
    """
    pipeline: Any = o3d.pipelines.registration
    target_cloud = open3d_cloud(target)
    T = T_target_source
    for distance_m in distances_m:
        is_last = distance_m == distances_m[-1]
        moving = source if is_last else source.thinned(_THINNED)
        with one_thread():
            found = pipeline.registration_icp(
                open3d_cloud(moving, normals=False),
                target_cloud,
                distance_m,
                T,
                pipeline.TransformationEstimationPointToPlane(pipeline.TukeyLoss(max(kernel_m, distance_m / 3.0))),
                pipeline.ICPConvergenceCriteria(_LOSS, _LOSS, _ROUNDS),
            )
        T = np.asarray(found.transformation)
    # the last digits depend on how a machine adds up: they are no result
    T = se3.rigid(np.round(T, _DIGITS))
    return judge(source, target, T, inlier_m=distances_m[-1])


def judge(source: Submap, target: Submap, T_target_source: F64, *, inlier_m: float) -> SubmapRegistration:
    """How well two submaps fit when one lies in the other at a given pose."""
    points = se3.apply(T_target_source, source.points_root)
    nearest, matched = _nearest(target.points_root, points, inlier_m)
    T_source_target = se3.inverse(T_target_source)
    points_source = se3.apply(T_source_target, target.points_root)
    _, back = _nearest(source.points_root, points_source, inlier_m)
    overlap = min(
        _share(matched, points, target.reach_m),
        _share(back, points_source, source.reach_m),
    )
    normals = target.normals_root[nearest[matched]]
    residual = np.einsum("ni,ni->n", normals, points[matched] - target.points_root[nearest[matched]])
    normals_source = normals @ T_target_source[:3, :3]
    rows = np.concatenate([np.cross(source.points_root[matched], normals_source), normals_source], axis=1)
    return SubmapRegistration(
        T_target_source=T_target_source,
        overlap=overlap,
        residual_m=float(np.sqrt(np.mean(residual**2))) if matched.any() else float("nan"),
        hessian=rows.T @ rows,
        inliers=int(matched.sum()),
    )


def _nearest(points: F64, queries: F64, within_m: float) -> tuple[I64, Bool]:
    """(n,) the nearest of the points for every query, and whether it is near enough."""
    distance, index = KDTree(points).query(queries, distance_upper_bound=within_m)
    return np.asarray(index, dtype=np.int64), np.isfinite(np.asarray(distance))


def _share(matched: Bool, points_other: F64, reach_m: float) -> float:
    """Share of matched points among those well within the other's reach."""
    within = np.einsum("ni,ni->n", points_other, points_other) < (_SEEN_BY_BOTH * reach_m) ** 2
    return float(matched[within].mean()) if within.any() else 0.0
