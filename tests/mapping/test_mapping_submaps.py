"""Submaps and their registration on analytic rooms and on roadways of wall points."""

from __future__ import annotations

import numpy as np
import pytest
from rough_mine import roadway_along

from mineloc import se3
from mineloc.data import F64
from mineloc.mapping.coarse_match import match_coarsely
from mineloc.mapping.submap_registration import judge, register_submaps
from mineloc.mapping.submaps import Submap, submap_of

DISTANCES_M = (2.0, 0.8, 0.3)


def bend(seed: int, *, rough_m: float = 0.12) -> F64:
    x = np.arange(-15, 15, 0.25)
    line = np.column_stack([x, 0.02 * x**2, 0 * x])
    return roadway_along(line, rough_m=rough_m, rng=np.random.default_rng(seed)).points_m


def seen(points: F64, T_map_lidar: F64, seed: int) -> Submap:
    rng = np.random.default_rng(seed)
    some = points[rng.random(len(points)) < 0.8]
    cloud = se3.apply(se3.inverse(T_map_lidar), some) + rng.normal(0, 0.01, (len(some), 3))
    return submap_of([cloud.astype(np.float32)], np.eye(4)[None], voxel_m=0.3, reach_m=14.0, normal_radius_m=1.0)


def test_each_cloud_is_placed_by_its_own_pose() -> None:
    turned = se3.from_rt(se3.exp(np.array([0, 0, np.pi / 2, 0, 0, 0.0]))[:3, :3], [5.0, 0.0, 0.0])
    T = np.array([np.eye(4), turned])
    cloud = np.array([[1.0, 0.0, 0.0]], np.float32)
    submap = submap_of([cloud, cloud], T, voxel_m=0.1, reach_m=20.0, normal_radius_m=1.0)
    assert submap.points_root[submap.points_root[:, 0].argsort()] == pytest.approx(
        np.array([[1, 0, 0], [5, 1, 0]]), abs=1e-6
    )


def test_far_points_are_left_out_and_empty_submaps_are_submaps() -> None:
    cloud = np.array([[1.0, 0.0, 0.0], [30.0, 0.0, 0.0]], np.float32)
    assert len(submap_of([cloud], np.eye(4)[None], voxel_m=0.1, reach_m=20.0, normal_radius_m=1.0)) == 1
    assert len(submap_of([], np.zeros((0, 4, 4)), voxel_m=0.1, reach_m=20.0, normal_radius_m=1.0)) == 0
    with pytest.raises(ValueError, match="poses"):
        submap_of([cloud], np.zeros((0, 4, 4)), voxel_m=0.1, reach_m=20.0, normal_radius_m=1.0)


def test_registration_finds_the_place_from_near_by() -> None:
    points = bend(1)
    T_a, T_b = se3.exp(np.array([0, 0, 0.1, -1, 0.2, 0])), se3.exp(np.array([0, 0, 3.0, 1.5, -0.1, 0.1]))
    a, b = seen(points, T_a, 2), seen(points, T_b, 3)
    T = se3.inverse(T_a) @ T_b
    found = register_submaps(
        b, a, T @ se3.exp(np.array([0.01, 0, 0.05, 0.4, 0.2, 0.1])), distances_m=DISTANCES_M, kernel_m=0.1
    )
    error = se3.log(se3.rigid(se3.inverse(T) @ found.T_target_source))
    assert np.linalg.norm(error[3:]) < 0.03
    assert np.degrees(np.linalg.norm(error[:3])) < 0.3
    assert found.overlap > 0.9
    assert found.residual_m < 0.06


def test_another_roadway_does_not_fit() -> None:
    a, b = seen(bend(1), np.eye(4), 2), seen(bend(9), np.eye(4), 3)
    found = register_submaps(b, a, np.eye(4), distances_m=DISTANCES_M, kernel_m=0.1)
    right = judge(seen(bend(1), np.eye(4), 5), a, np.eye(4), inlier_m=0.3)
    assert found.residual_m > 1.5 * right.residual_m


def test_a_branch_that_only_one_of_them_has_lowers_the_overlap() -> None:
    points = bend(1)
    a = seen(points, np.eye(4), 2)
    side = points[np.abs(points[:, 0]) < 6][:, [1, 0, 2]] + [0.0, 4.0, 0.0]
    b = seen(np.concatenate([points, side]), np.eye(4), 3)
    whole = judge(seen(points, np.eye(4), 4), a, np.eye(4), inlier_m=0.3)
    for one, other in ((a, b), (b, a)):
        assert judge(one, other, np.eye(4), inlier_m=0.3).overlap < whole.overlap - 0.1


def test_a_smooth_straight_roadway_is_open_along_its_axis() -> None:
    x = np.arange(-15, 15, 0.25)
    smooth = roadway_along(np.column_stack([x, 0 * x, 0 * x]), rough_m=0.0, rng=np.random.default_rng(0)).points_m
    found = judge(seen(smooth, np.eye(4), 1), seen(smooth, np.eye(4), 2), np.eye(4), inlier_m=0.3)
    values, vectors = np.linalg.eigh(found.hessian[3:, 3:] / found.inliers)
    assert values[0] < 0.003
    assert abs(vectors[0, 0]) > 0.99
    rough = judge(seen(bend(1), np.eye(4), 1), seen(bend(1), np.eye(4), 2), np.eye(4), inlier_m=0.3)
    assert np.linalg.eigvalsh(rough.hessian[3:, 3:] / rough.inliers)[0] > 0.01


def test_the_hessian_predicts_what_a_small_move_costs() -> None:
    """Three planes apart from one another: the residual of a move ξ of the source is ξᵀ H ξ."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-1, 1, (2, 3, 3000))
    floor = np.column_stack([3 * u[0], 3 * v[0], np.full(3000, -1.5)])
    wall = np.column_stack([3 * u[1], np.full(3000, 4.0), v[1]])
    end = np.column_stack([np.full(3000, 6.0), 2 * u[2], v[2]])
    points = np.concatenate([floor, wall, end]).astype(np.float32)
    room = submap_of([points], np.eye(4)[None], voxel_m=0.2, reach_m=12.0, normal_radius_m=0.8)
    T = se3.exp(np.array([0.1, -0.2, 0.8, 2.0, 1.0, 0.3]))
    moved = submap_of([se3.apply(se3.inverse(T), points).astype(np.float32)], np.eye(4)[None],
                      voxel_m=0.01, reach_m=12.0, normal_radius_m=0.8)  # fmt: skip
    hessian = judge(moved, room, T, inlier_m=0.5).hessian
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = 0.01
        found = judge(moved, room, T @ se3.exp(xi), inlier_m=0.5)
        assert found.inliers * found.residual_m**2 == pytest.approx(xi @ hessian @ xi, rel=0.05)


def test_features_find_the_place_from_nothing() -> None:
    points = bend(1, rough_m=0.2)
    T_a, T_b = np.eye(4), se3.exp(np.array([0, 0, 2.5, 3.0, -0.3, 0.1]))
    found = match_coarsely(
        seen(points, T_b, 3), seen(points, T_a, 2), salient_m=1.2, suppression_m=0.8, feature_m=2.0, distance_m=0.6
    )
    assert found is not None
    error = se3.inverse(se3.inverse(T_a) @ T_b) @ found.T_target_source
    assert np.linalg.norm(error[:3, 3]) < 1.0
    assert np.degrees(se3.angle_rad(error)) < 10


def test_no_features_no_match() -> None:
    plane = np.column_stack([np.random.default_rng(0).uniform(-5, 5, (800, 2)), np.full(800, -1.0)])
    flat = seen(plane, np.eye(4), 1)
    few = submap_of([np.zeros((3, 3), np.float32)], np.eye(4)[None], voxel_m=0.3, reach_m=5, normal_radius_m=1)
    assert match_coarsely(few, flat, salient_m=1.2, suppression_m=0.8, feature_m=2.0, distance_m=0.6) is None
