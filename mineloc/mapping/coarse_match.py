"""A coarse registration from features alone: ISS keypoints, FPFH, RANSAC (paper A, 1.9; METHOD 6.2).

In a roadway the FPFH of plain wall repeats: the answer is a guess that odometry must confirm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d

from mineloc.data import F64
from mineloc.mapping.one_thread import one_thread
from mineloc.mapping.submaps import Submap, open3d_cloud

_FEWEST_KEYPOINTS = 10
_EDGE_LENGTH = 0.9
_TRIALS = 100_000
_CONFIDENCE = 0.999


@dataclass(frozen=True, slots=True, eq=False)
class CoarseMatch:
    """A guess of where one submap lies in another.

    Attributes:
        T_target_source: (4, 4).
        fitness: share of the source's keypoints that found their place.
        keypoints: of the source and of the target.
    """

    T_target_source: F64
    fitness: float
    keypoints: tuple[int, int]


def match_coarsely(
    source: Submap, target: Submap, *, salient_m: float, suppression_m: float, feature_m: float, distance_m: float
) -> CoarseMatch | None:
    """Match the ISS keypoints of two submaps by FPFH; None with too few keypoints or no agreement.

    Args:
        source, target: with points.
        salient_m, suppression_m: radii of ISS.
        feature_m: radius of FPFH.
        distance_m: RANSAC's inlier distance.
    """
    pipeline: Any = o3d.pipelines.registration
    o3d.utility.random.seed(0)
    (a, features_a), (b, features_b) = (_features(s, salient_m, suppression_m, feature_m) for s in (source, target))
    count = len(a.points), len(b.points)
    if min(count) < _FEWEST_KEYPOINTS:
        return None
    with one_thread():
        found = pipeline.registration_ransac_based_on_feature_matching(
            a,
            b,
            features_a,
            features_b,
            True,
            distance_m,
            pipeline.TransformationEstimationPointToPoint(False),
            3,
            [
                pipeline.CorrespondenceCheckerBasedOnEdgeLength(_EDGE_LENGTH),
                pipeline.CorrespondenceCheckerBasedOnDistance(distance_m),
            ],
            pipeline.RANSACConvergenceCriteria(_TRIALS, _CONFIDENCE),
        )
    if found.fitness <= 0.0:
        return None
    return CoarseMatch(np.asarray(found.transformation).copy(), float(found.fitness), count)


def _features(submap: Submap, salient_m: float, suppression_m: float, feature_m: float) -> tuple[Any, Any]:
    """The ISS keypoints of a submap with their FPFH, computed from all of its points."""
    cloud = open3d_cloud(submap)
    keypoints = o3d.geometry.keypoint.compute_iss_keypoints(cloud, salient_m, suppression_m)
    tree = o3d.geometry.KDTreeFlann(cloud)
    # in rising order, as select_by_index gives them
    index = sorted({int(tree.search_knn_vector_3d(point, 1)[1][0]) for point in keypoints.points})
    pipeline: Any = o3d.pipelines.registration
    features = pipeline.compute_fpfh_feature(
        cloud, o3d.geometry.KDTreeSearchParamHybrid(radius=feature_m, max_nn=100), index
    )
    return cloud.select_by_index(index), features
