"""An intersection seen again closes a loop without a map, also when it is passed the other way."""

from __future__ import annotations

import numpy as np
import pytest
from plan_scenes import Plan, TwoIntersections, edges_of, flown

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, Keyframe, RelativePose
from mineloc.localize.loops import LoopCloser
from mineloc.localize.visits import Visit, Visits

CONFIG = Config()
DRIFT = se3.exp(np.array([0, 0, np.radians(0.02), 0.002, 0.003, 0]))


def there_and_back(plan: Plan, *, ahead: bool = False) -> tuple[list[Keyframe], list[RelativePose | None], F64]:
    """Past both intersections and back again by drifting odometry; `ahead`: from the start once more instead."""
    keyframes, truth = flown(plan, -14.0, 42.0, seed=1)
    again, truth_again = flown(plan, -14.0, 42.0, seed=2) if ahead else flown(plan, 42.0, -14.0, seed=2)
    poses = np.concatenate([truth, truth_again])
    edges = edges_of([*keyframes, *again])
    T = keyframes[0].T_odom_lidar
    drifted: list[Keyframe] = []
    told: list[RelativePose | None] = []
    for k, (keyframe, edge) in enumerate(zip([*keyframes, *again], edges, strict=True)):
        if edge is not None:
            moved = se3.inverse(poses[k - 1]) @ poses[k] @ DRIFT
            T = se3.rigid(T @ moved)
            told.append(RelativePose(k - 1, k, moved, edge.information))
        else:
            told.append(None)
        drifted.append(Keyframe(k, k, T, keyframe.points_lidar))
    return drifted, told, poses


@pytest.mark.parametrize("ahead", [False, True], ids=["other way", "same way"])
def test_an_intersection_passed_again_closes_the_loop(ahead: bool) -> None:
    keyframes, edges, truth = there_and_back(TwoIntersections(), ahead=ahead)
    closer = LoopCloser(CONFIG, by_place=False, by_position=False, by_intersection=True)
    for keyframe, edge in zip(keyframes, edges, strict=True):
        closer.add(keyframe, edge, keyframe.T_odom_lidar)
    assert len(closer.loops) >= 2
    for loop in closer.loops:
        true = se3.inverse(truth[loop.i]) @ truth[loop.j]
        error = se3.inverse(true) @ loop.T_i_j
        # roadways of the drawing are even: along them a closure is held by the intersection alone
        assert np.linalg.norm(error[:3, 3]) < 0.15
        assert np.degrees(se3.angle_rad(error)) < 0.5
    near = {round(float(truth[loop.i, 0, 3]) / 30.0) for loop in closer.loops}
    assert near <= {0, 1}
    fixes = closer.fixes(np.array([keyframe.T_odom_lidar for keyframe in keyframes]))
    assert all("similarity" in fix.scores for fix in fixes)


def test_a_passage_is_told_once_when_it_is_over() -> None:
    keyframes, truth = flown(TwoIntersections(), -14.0, 48.0)
    visits = Visits(CONFIG.intersections)
    ended: list[Visit] = []
    for keyframe in keyframes:
        visit = visits.follow(keyframe)
        if visit is not None:
            assert keyframe.index >= visit.keyframes[-1]
            assert visit.keyframe in visit.roots
            assert list(visit.keyframes) == sorted(visit.keyframes)
            assert visits.like(visit) == [] or visits.like(visit)[0].earlier.keyframe < visit.keyframe
            ended.append(visit)
    at = [float(truth[visit.keyframe, 0, 3]) for visit in ended]
    assert any(abs(x) < 3 for x in at)
    assert any(abs(x - 30) < 3 for x in at)


def test_a_straight_roadway_has_nothing_to_see_again() -> None:
    keyframes, _ = flown(Plan((0, 180)), -20.0, 20.0)
    visits = Visits(CONFIG.intersections)
    assert all(visits.follow(keyframe) is None for keyframe in keyframes)
