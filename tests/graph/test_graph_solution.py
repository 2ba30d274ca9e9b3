from __future__ import annotations

import numpy as np
import pytest
from graph_scene import NO_POINTS, SIGMA, measure, rmse_m, tour

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import Fix, Keyframe, RelativePose
from mineloc.graph.batch import solve
from mineloc.graph.causal import CausalEstimate
from mineloc.graph.measurements import PointFix
from mineloc.graph.noise import edge_noise
from mineloc.graph.pose_graph import PoseGraph


@pytest.mark.parametrize("seed", [0, 1])
def test_two_wrong_intersections_of_33_are_outvoted_and_ruin_a_plain_solution(seed):
    scene = measure(tour(visits=33, spacing_m=40, seed=seed), wrong=2)
    robust = solve(scene.graph)
    assert rmse_m(np.array(scene.graph.initial), scene.truth) > 0.8
    assert rmse_m(robust.poses, scene.truth) < 0.5
    (fit,) = (fit for fit in robust.fits if fit.kind == "point_fix")
    assert (fit.count, fit.outvoted) == (33, 2)
    assert fit.to_dict()["chi2_per_dof"] == fit.chi2_per_dof > 10
    plain = measure(tour(visits=33, spacing_m=40, seed=seed), GraphConfig(robust=False), wrong=2)
    assert rmse_m(solve(plain.graph).poses, plain.truth) > 3.0


def test_a_third_of_the_intersections_may_be_wrong():
    scene = measure(tour(visits=33, spacing_m=40, seed=3), wrong=12, as_pose=True, gravity=True)
    solution = solve(scene.graph)
    assert rmse_m(solution.poses, scene.truth) < 0.6
    wrong = [f.kind == "fix" for f in scene.graph.factors]
    assert int(solution.outvoted[wrong].sum()) == 12


def test_errors_are_as_large_as_the_covariances_say():
    squared = []
    for seed in range(6):
        scene = measure(tour(visits=6, spacing_m=30, seed=seed), GraphConfig(robust=False), gravity=True)
        solution = solve(scene.graph)
        for pose, truth, covariance in zip(solution.poses, scene.truth, solution.covariances, strict=True):
            error = se3.log(se3.inverse(pose) @ truth)
            squared.append(error @ np.linalg.solve(covariance, error))
        (fit,) = (fit for fit in solution.fits if fit.kind == "gravity")
        assert 0.7 < fit.chi2_per_dof < 1.2
    # six degrees of freedom; neighbours are correlated, so few are independent
    assert 4.0 < np.mean(squared) < 8.5


def test_gravity_holds_the_tilt_and_with_it_the_height():
    errors = {}
    for gravity in (False, True):
        scene = measure(tour(visits=10, spacing_m=60, seed=5), gravity=gravity)
        # odometry alone: no visits
        graph = PoseGraph(GraphConfig(use_gravity=gravity))
        graph.factors = [f for f in scene.graph.factors if f.kind != "point_fix"]
        graph.initial = scene.graph.initial
        solution = solve(graph)
        up = np.einsum("nij,nkj->nik", solution.poses[:, :3, :3], scene.truth[:, :3, :3])[:, :, 2]
        tilt = np.degrees(np.arccos(np.clip(up[:, 2], -1, 1)))
        height = np.abs(solution.poses[:, 2, 3] - scene.truth[:, 2, 3])
        errors[gravity] = (tilt.max(), height.max(), float(np.sqrt(solution.covariances[-1][5, 5])))
    assert errors[True][0] < 0.6 < errors[False][0]
    assert errors[True][1] < errors[False][1]
    assert errors[True][2] < 0.5 * errors[False][2]


def _straight(information: np.ndarray, n: int = 50) -> PoseGraph:
    """Along x; the odometry stalls: it says 0.9 m where 1 m was flown."""
    graph = PoseGraph(GraphConfig())
    T = np.eye(4)
    graph.add_first(Keyframe(0, 0, T, NO_POINTS))
    for k in range(1, n):
        T = T @ se3.exp([0, 0, 0, 0.9, 0, 0])
        graph.add_next(Keyframe(k, k, T, NO_POINTS), RelativePose(k - 1, k, se3.exp([0, 0, 0, 0.9, 0, 0]), information))
    return graph


def test_a_smooth_tunnel_is_unsure_along_its_axis_and_a_fix_corrects_that_alone():
    sure = np.diag(SIGMA**-2)
    blind = sure.copy()
    blind[3, :] = blind[:, 3] = 0.0  # exactly singular
    graph = _straight(blind)
    before = solve(graph)
    assert before.weak_edges == 49
    sigma = np.sqrt(np.diagonal(before.covariances[-1])[3:])
    assert sigma[0] > 15 > 5 * sigma[1]
    truth = np.eye(4)
    truth[0, 3] = 49.0
    graph.add_fix(Fix(49, 49, truth, np.diag([0.01] * 3 + [0.1] * 3) ** 2, True))
    after = solve(graph)
    np.testing.assert_allclose(after.poses[:, 0, 3], np.arange(50), atol=0.3)
    assert np.abs(after.poses[:, 1:3, 3]).max() < 1e-3
    assert np.sqrt(after.covariances[-1][3, 3]) < 0.2
    # the same error with a confident odometry is taken for a wrong fix
    confident = _straight(np.diag([1e6] * 3 + [1e6] * 3))
    confident.add_fix(Fix(49, 49, truth, np.diag([0.01] * 3 + [0.1] * 3) ** 2, True))
    assert solve(confident).outvoted.sum() == 1


def test_noise_of_edges():
    config = GraphConfig(relative_max_m=3.0, relative_max_deg=20.0)
    strong = np.diag([1e4] * 3 + [400.0] * 3)
    noise = edge_noise(strong, config)
    assert not noise.is_weak
    np.testing.assert_allclose(noise.covariance, np.linalg.inv(strong), rtol=2e-3, atol=1e-15)
    nothing = edge_noise(np.zeros((6, 6)), config)
    assert nothing.is_weak
    np.testing.assert_allclose(np.sqrt(np.diag(nothing.covariance)), [np.radians(20)] * 3 + [3.0] * 3)
    rng = np.random.default_rng(0)
    row = rng.normal(size=(1, 6)) * 100
    rank_one = edge_noise(row.T @ row, config)
    assert np.linalg.eigvalsh(rank_one.covariance)[0] > 0
    assert float(row[0] @ rank_one.covariance @ row[0]) == pytest.approx(1.0, rel=1e-3)
    with pytest.raises(ValueError, match="negative eigenvalue"):
        edge_noise(np.diag([1e4] * 5 + [-1e3]), config)
    edge_noise(np.diag([1e12] * 5 + [-1e-3]), config)  # rounding


def test_the_first_pose_is_certain_but_for_its_tilt():
    config = GraphConfig(anchor_tilt_deg=0.5, anchor_yaw_deg=0.01, anchor_m=0.001)
    graph = PoseGraph(config)
    T = se3.exp([0.3, 1.2, -0.7, 5, 6, 7])
    graph.add_first(Keyframe(0, 0, T, NO_POINTS))
    covariance = solve(graph).covariances[0]
    in_map = T[:3, :3] @ covariance[:3, :3] @ T[:3, :3].T
    np.testing.assert_allclose(np.degrees(np.sqrt(np.diag(in_map))), [0.5, 0.5, 0.01], rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance[3:, 3:])), 0.001, rtol=1e-6)


def test_a_flight_may_start_anywhere_in_a_prior_map():
    start = se3.exp([0, 0, 1.0, 100, 50, 3])
    guess = start @ se3.exp([0, 0, 0.1, 1, -1, 0.2])
    graph = PoseGraph(GraphConfig())
    graph.add_first(Keyframe(0, 0, np.eye(4), NO_POINTS), T_map_lidar=guess, covariance=np.eye(6) * 4)
    motion = se3.exp([0, 0, 0.05, 1, 0, 0])
    T_odom, truth = np.eye(4), [start]
    for k in range(1, 20):
        T_odom = T_odom @ motion
        truth.append(truth[-1] @ motion)
        graph.add_next(Keyframe(k, k, T_odom, NO_POINTS), RelativePose(k - 1, k, motion, np.eye(6) * 1e6))
    for k in (5, 15):
        graph.add_fix(Fix(k, k, truth[k], np.eye(6) * 1e-4, True))
    np.testing.assert_allclose(solve(graph).poses, truth, atol=1e-2)


def test_loops_close():
    scene = measure(tour(visits=12, spacing_m=30, seed=2), gravity=True)
    factors = [f for f in scene.graph.factors if f.kind != "point_fix"]
    graph = scene.graph
    graph.factors = factors
    drifted = rmse_m(solve(graph).poses, scene.truth)
    last: dict[int, int] = {}
    for keyframe, place in scene.visits:
        if place in last:
            T = se3.inverse(scene.truth[last[place]]) @ scene.truth[keyframe]
            graph.add_loop(RelativePose(last[place], keyframe, T, np.eye(6) * 1e3))
        last[place] = keyframe
    solution = solve(graph)
    assert rmse_m(solution.poses, scene.truth) < 0.6 * drifted
    assert {fit.kind for fit in solution.fits} == {"prior", "gravity", "relative", "loop"}


def test_the_causal_estimate_is_the_smoothed_end_of_every_beginning():
    scene = measure(tour(visits=4, spacing_m=15, seed=4), causal=True, gravity=True)
    n = len(scene.truth)
    smoothed = solve(scene.graph)
    np.testing.assert_allclose(scene.causal[-1], smoothed.poses[-1], atol=0.01)
    for end in (10, 31, 45):
        part = PoseGraph(GraphConfig())
        part.initial = scene.graph.initial[:end]
        part.factors = [f for f in scene.graph.factors if max(f.keyframes) < end]
        np.testing.assert_allclose(scene.causal[end - 1], solve(part).poses[-1], atol=0.01)
    assert rmse_m(smoothed.poses, scene.truth) < rmse_m(np.array(scene.causal), scene.truth)
    assert len(scene.causal) == n


def test_what_comes_later_does_not_change_what_was_said():
    whole = measure(tour(visits=4, spacing_m=15, seed=6), causal=True)
    head = PoseGraph(GraphConfig())
    follow = CausalEstimate(head)
    poses = []
    for k in range(30):
        head.initial.append(whole.graph.initial[k])
        head.factors = [f for f in whole.graph.factors if max(f.keyframes) <= k]
        poses.append(follow.update())
    np.testing.assert_array_equal(poses, whole.causal[:30])


def test_the_same_graph_gives_the_same_bits():
    a, b = (solve(measure(tour(visits=5, spacing_m=20, seed=7), wrong=1).graph) for _ in range(2))
    np.testing.assert_array_equal(a.poses, b.poses)
    np.testing.assert_array_equal(a.covariances, b.covariances)


def test_what_does_not_fit_is_refused():
    graph = PoseGraph(GraphConfig())
    keyframe = Keyframe(0, 0, np.eye(4), NO_POINTS)
    edge = RelativePose(0, 1, np.eye(4), np.eye(6))
    with pytest.raises(ValueError, match="without keyframes"):
        solve(graph)
    with pytest.raises(ValueError, match="without keyframes"):
        CausalEstimate(graph).update()
    with pytest.raises(ValueError, match="index 0"):
        graph.add_first(Keyframe(1, 0, np.eye(4), NO_POINTS))
    with pytest.raises(ValueError, match="edge 0-1 after 0"):
        graph.add_next(Keyframe(1, 1, np.eye(4), NO_POINTS), edge)
    graph.add_first(keyframe)
    with pytest.raises(ValueError, match="added once"):
        graph.add_first(keyframe)
    with pytest.raises(ValueError, match="no direction"):
        graph.add_next(Keyframe(1, 1, np.eye(4), NO_POINTS, np.zeros(3)), edge)
    for fix in (Fix(0, 7, np.eye(4), np.eye(6), True), Fix(0, 0, np.eye(4), np.eye(6), False, "no")):
        with pytest.raises(ValueError, match=r"keyframe 7|trusted"):
            graph.add_fix(fix)
    for bad in (np.zeros((6, 6)), np.diag([1.0] * 5 + [np.inf]), np.eye(6) + np.eye(6, k=1)):
        with pytest.raises(ValueError, match="covariance must be"):
            graph.add_fix(Fix(0, 0, np.eye(4), bad, True))
    with pytest.raises(ValueError, match="covariance must be"):
        graph.add_point_fix(PointFix(0, np.zeros(3), np.zeros(3), -np.eye(3)))
    with pytest.raises(ValueError, match="to itself"):
        graph.add_loop(RelativePose(0, 0, np.eye(4), np.eye(6)))
    with pytest.raises(ValueError, match="2 first guesses"):
        solve(graph, initial=np.tile(np.eye(4), (2, 1, 1)))
    assert (len(graph), [f.kind for f in graph.factors]) == (1, ["prior"])


@pytest.mark.slow
def test_a_flight_of_5700_keyframes():
    scene = measure(tour(visits=38, spacing_m=150, seed=0), wrong=4, gravity=True, causal=True)
    assert len(scene.truth) == 5701
    solution = solve(scene.graph)
    smoothed, causal = rmse_m(solution.poses, scene.truth), rmse_m(np.array(scene.causal), scene.truth)
    assert smoothed < 0.7
    assert causal < 2.5
    assert smoothed < causal
    assert solution.iterations < 60


def test_a_chain_of_thousands_of_keyframes_stays_rigid_and_determined():
    # motions that are rotations but for rounding: along a chain of products that grew until nothing was finite
    rng = np.random.default_rng(0)
    graph = PoseGraph(GraphConfig())
    causal = CausalEstimate(graph)
    almost = np.eye(4)
    almost[:3, :3] += 1e-13 * rng.normal(size=(3, 3))
    for k in range(1500):
        keyframe = Keyframe(k, k * 10**9, np.eye(4), NO_POINTS, None)
        if k == 0:
            graph.add_first(keyframe)
        else:
            motion = se3.exp(np.r_[0.1 * rng.normal(size=3), 1.0, 0.0, 0.0]) @ almost
            graph.add_next(keyframe, RelativePose(k - 1, k, motion, 1e4 * np.eye(6)))
        newest = causal.update()
    solution = solve(graph)
    for poses in (newest[None], np.array(graph.initial), solution.poses):
        rotations = poses[:, :3, :3]
        assert np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max() < 1e-9
    assert np.abs(solution.poses - graph.initial).max() < 1e-6
    assert np.all(np.linalg.eigvalsh(solution.covariances) > 0)


def test_ten_false_loops_of_forty_do_not_move_the_map() -> None:
    """False loops that slip through all checks: the map is as if they were not there."""
    without, truth = _looped(false=0)
    planted, _ = _looped(false=10)
    assert rmse_m(planted, truth) < 1.1 * rmse_m(without, truth)
    assert rmse_m(planted, without) < 0.1 * rmse_m(without, truth)
    # a plain least-squares graph fails the same case
    plain, _ = _looped(false=10, config=GraphConfig(robust=False))
    assert rmse_m(plain, truth) > 5 * rmse_m(without, truth)


def _looped(*, false: int, config: GraphConfig | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Thirty right loops between visits of one place; false ones claim that two places are one. Poses, truth."""
    scene = measure(tour(visits=45, spacing_m=25, seed=5), config)
    scene.graph.factors = [factor for factor in scene.graph.factors if factor.kind != "point_fix"]
    sigma = np.r_[np.radians([0.3] * 3), [0.05] * 3]
    every = [(a, b, p == q) for n, (b, p) in enumerate(scene.visits) for a, q in scene.visits[:n]]
    rng = np.random.default_rng(6)
    for is_right, count in ((True, 30), (False, false)):
        pairs = [(a, b) for a, b, same in every if same == is_right]
        for k in rng.choice(len(pairs), count, replace=False):
            i, j = pairs[k]
            T = se3.inverse(scene.truth[i]) @ scene.truth[j]
            if not is_right:
                T[:3, 3] = rng.normal(size=3) * 0.3
            T = se3.rigid(T @ se3.exp(rng.normal(size=6) * sigma))
            scene.graph.add_loop(RelativePose(i, j, T, np.diag(sigma**-2)))
    return solve(scene.graph).poses, scene.truth
