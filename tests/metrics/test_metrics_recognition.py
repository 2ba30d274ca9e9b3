"""Passages of intersections and the fixes made on them."""

from __future__ import annotations

import numpy as np
import pytest

from mineloc import se3
from mineloc.data import F64, Trajectory
from mineloc.metrics.recognition import recognition_score

POINTS = np.array([[20.0, 0.0, 0.0], [60.0, 0.0, 0.0], [100.0, 2.0, 0.0], [60.0, 0.0, -9.0], [60.0, 8.0, 0.0]])


def there_and_back() -> Trajectory:
    """Along x to 120 m and back, 1.5 m above the floor, a metre a second."""
    x = np.concatenate([np.arange(0.0, 120.0), np.arange(120.0, -1.0, -1.0)])
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = x, 1.5
    return Trajectory(np.arange(len(x)) * 10**9, poses, child="lidar")


def fix(flown: Trajectory, second: int, *, off_m: float = 0.0, off_deg: float = 0.0) -> F64:
    return flown.poses[second] @ se3.exp(np.array([0, 0, np.radians(off_deg), off_m, 0, 0]))


def test_passages_are_told_with_what_was_recognised() -> None:
    flown = there_and_back()
    seconds, rows = [18, 25, 58, 222], [0, 0, 1, 0]
    poses = np.array([fix(flown, s, off_m=0.1) for s in seconds])
    score = recognition_score(POINTS, flown, stamps_ns=np.array(seconds) * 10**9, poses=poses, targets=rows)
    told = [(one.target, one.nearest_ns // 10**9, one.recognised) for one in score.passages]
    # the fourth lies on another level, the fifth is never nearer than 8 m
    assert told == [(0, 20, True), (1, 60, True), (2, 100, False), (2, 140, False), (1, 180, False), (0, 220, True)]
    assert score.recall == pytest.approx(0.5)
    assert score.precision == 1.0
    assert score.errors_m == pytest.approx(0.1)
    assert score.first_m == pytest.approx(18.0)
    assert [one.nearest_m for one in score.passages] == pytest.approx([0, 0, 2, 2, 0, 0])


@pytest.mark.parametrize(("off_m", "off_deg", "wrong"), [(0.9, 4.0, 0), (1.1, 0.0, 1), (0.0, 6.0, 1)])
def test_a_pose_that_is_off_is_wrong_whatever_its_name(off_m: float, off_deg: float, wrong: int) -> None:
    flown = there_and_back()
    poses = fix(flown, 20, off_m=off_m, off_deg=off_deg)[None]
    score = recognition_score(POINTS, flown, stamps_ns=np.array([20 * 10**9]), poses=poses, targets=[0])
    assert (score.accepted, score.wrong) == (1, wrong)


def test_a_fix_of_another_intersection_recognises_none_that_was_passed() -> None:
    flown = there_and_back()
    poses = fix(flown, 20)[None]
    score = recognition_score(POINTS, flown, stamps_ns=np.array([20 * 10**9]), poses=poses, targets=[2])
    assert not any(one.recognised for one in score.passages)


def test_without_fixes_or_intersections_nothing_is_invented() -> None:
    flown = there_and_back()
    nothing = {"stamps_ns": np.zeros(0, np.int64), "poses": np.zeros((0, 4, 4)), "targets": []}
    none = recognition_score(POINTS, flown, **nothing)
    assert (none.precision, none.recall, none.first_m) == (None, 0.0, None)
    assert none.to_dict()["median_error_m"] is None
    empty = recognition_score(np.zeros((0, 3)), flown, **nothing)
    assert (empty.recall, empty.passages) == (None, ())
