"""Wrong ids among the recognitions of a long flight: named by the condensed graph, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graph_scene import NO_POINTS, SIGMA, Tour, tour

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import F64, Fix, Keyframe, RelativePose
from mineloc.graph.condensed import outvoted_fixes

CONFIG = GraphConfig()
FIX_SIGMA = np.r_[np.radians([0.2, 0.2, 0.2]), [0.05, 0.05, 0.05]]


def flown(scene: Tour) -> tuple[list[Keyframe], list[RelativePose | None]]:
    edges: list[RelativePose | None] = [None]
    T_odom = np.eye(4)
    keyframes = [Keyframe(0, 0, T_odom, NO_POINTS)]
    for k in range(1, len(scene.truth)):
        motion = se3.inverse(scene.truth[k - 1]) @ scene.truth[k] @ se3.exp(scene.rng.normal(size=6) * SIGMA)
        T_odom = se3.rigid(T_odom @ motion)
        keyframes.append(Keyframe(k, k, T_odom, NO_POINTS))
        edges.append(RelativePose(k - 1, k, motion, np.diag(SIGMA**-2)))
    return keyframes, edges


def recognised(scene: Tour, wrong: int) -> tuple[list[Fix], set[int]]:
    """A fix a visit; the misled ones believe that they are at another place, with another heading."""
    misled = set(scene.rng.choice(len(scene.visits), wrong, replace=False).tolist())
    fixes: list[Fix] = []
    for v, (k, place) in enumerate(scene.visits):
        T: F64 = scene.truth[k] @ se3.exp(scene.rng.normal(size=6) * FIX_SIGMA)
        if v in misled:
            other = scene.rng.choice([p for p in range(len(scene.places)) if p != place])
            T = T @ se3.exp(np.array([0, 0, scene.rng.choice([0.0, np.pi / 2, np.pi]), 0, 0, 0]))
            T[:3, 3] += scene.places[other] - scene.places[place]
        fixes.append(Fix(k, k, T, np.diag(FIX_SIGMA**2), True, target=str(place)))
    return fixes, misled


@pytest.mark.parametrize("seed", [1, 2, 7])
def test_twelve_wrong_ids_of_33_are_named(seed: int) -> None:
    scene = tour(visits=33, spacing_m=40, seed=seed)
    odometry = flown(scene)
    fixes, misled = recognised(scene, wrong=12)
    judged = outvoted_fixes(*odometry, fixes, CONFIG)
    assert {v for v, fix in enumerate(judged) if not fix.trusted} == misled
    assert all("outvoted by 21" in judged[v].reason for v in misled)


def test_nothing_right_is_outvoted() -> None:
    for seed in range(2):
        scene = tour(visits=33, spacing_m=40, seed=10 + seed)
        fixes, _ = recognised(scene, wrong=0)
        assert all(fix.trusted for fix in outvoted_fixes(*flown(scene), fixes, CONFIG))


def test_two_that_disagree_are_left_to_others_and_refused_ones_have_no_vote() -> None:
    scene = tour(visits=4, spacing_m=40, seed=1)
    odometry = flown(scene)
    fixes, _ = recognised(scene, wrong=0)
    far = fixes[1].T_map_lidar.copy()
    far[0, 3] += 30.0
    few = [fixes[0], replace(fixes[1], T_map_lidar=far)]
    assert outvoted_fixes(*odometry, few, CONFIG) == few
    refused = [replace(fixes[k], T_map_lidar=far, trusted=False, reason="step 9") for k in (1, 2)]
    judged = outvoted_fixes(*odometry, [fixes[0], *refused, fixes[3], *few[:1]], CONFIG)
    assert [fix.trusted for fix in judged] == [True, False, False, True, True]
    assert judged[1] is refused[0]
