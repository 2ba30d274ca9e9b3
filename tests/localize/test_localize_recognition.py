"""Recognition in flight on two drawn intersections: what is seen, what is refused and at which step."""

from __future__ import annotations

import numpy as np
import pytest
from plan_scenes import Plan, TwoIntersections, flown

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, Fix, IntersectionDatabase
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.recognition import Recognizer

CONFIG = Config()


def at(T_map_lidar: F64, *, sigma_m: float = 0.5, sigma_deg: float = 3.0) -> PoseFilter:
    """What is known of a drone that is there."""
    covariance = np.diag([np.radians(sigma_deg) ** 2] * 3 + [sigma_m**2] * 3)
    return PoseFilter(T_map_lidar, covariance, CONFIG.graph)


def errors_at(fixes: list[Fix], truth: F64, name: str) -> list[F64]:
    return [se3.inverse(truth[fix.keyframe]) @ fix.T_map_lidar for fix in fixes if fix.target == name]


def test_both_are_recognised_from_either_side_without_knowing_where(database: IntersectionDatabase) -> None:
    for start_m, end_m in ((-14.0, 42.0), (44.0, -12.0)):
        recognizer = Recognizer(CONFIG, database)
        keyframes, truth = flown(TwoIntersections(), start_m, end_m)
        fixes = [fix for keyframe in keyframes for fix in recognizer.follow_lost(keyframe)]
        trusted = [fix for fix in fixes if fix.trusted]
        assert {fix.target for fix in trusted} == {"T 0", "X 1"}
        for fix in trusted:
            error = se3.inverse(truth[fix.keyframe]) @ fix.T_map_lidar
            # the X looks the same from four sides, the T does not
            if fix.target == "T 0":
                assert np.linalg.norm(error[:2, 3]) < 0.3
                assert np.degrees(se3.angle_rad(error)) < 3
        # of several ways to see the X, the right one is among those that are told
        assert min(np.linalg.norm(error[:2, 3]) for error in errors_at(trusted, truth, "X 1")) < 0.3


def test_what_is_known_of_the_position_decides_between_sides(database: IntersectionDatabase) -> None:
    recognizer = Recognizer(CONFIG, database)
    keyframes, truth = flown(TwoIntersections(), 18.0, 42.0)
    count = 0
    for keyframe, T in zip(keyframes, truth, strict=True):
        fix = recognizer.follow(keyframe, at(T))
        if fix.trusted:
            count += 1
            assert np.linalg.norm((se3.inverse(T) @ fix.T_map_lidar)[:2, 3]) < 0.3
            assert fix.point_map is not None
            assert np.linalg.norm(fix.point_map[:2] - [30.0, 0.0]) < 0.5
    assert count >= 2


@pytest.mark.parametrize("bearings", [(0, 180), (0, 55, 180), (0, 72, 144, 216, 288)], ids=["straight", "Y", "five"])
def test_another_mine_is_refused_with_the_step(database: IntersectionDatabase, bearings: tuple[float, ...]) -> None:
    for known in (None, at(np.eye(4), sigma_m=1000.0, sigma_deg=100.0)):
        recognizer = Recognizer(CONFIG, database)
        keyframes, _ = flown(Plan(bearings), -10.0, 8.0)
        fixes = [
            fix
            for keyframe in keyframes
            for fix in (recognizer.follow_lost(keyframe) if known is None else [recognizer.follow(keyframe, known)])
        ]
        assert not any(fix.trusted for fix in fixes)
        assert all("(step " in fix.reason for fix in fixes)


def test_a_position_that_excludes_all_is_a_reason(database: IntersectionDatabase) -> None:
    keyframes, truth = flown(TwoIntersections(), -14.0, 10.0)
    for shift, reason in ((100.0, "from the nearest known one"), (0.0, "the pose rules out")):
        recognizer = Recognizer(CONFIG, database)
        fixes: list[Fix] = []
        for keyframe, T in zip(keyframes, truth, strict=True):
            wrong = T @ se3.exp(np.array([0, 0, 0.5 * np.pi if not shift else 0, 0, 0, 0]))
            wrong[1, 3] += shift
            fixes.append(recognizer.follow(keyframe, at(wrong)))
        assert not any(fix.trusted for fix in fixes)
        assert {fix.reason.split("(")[-1] for fix in fixes} <= {"step 2)", "step 4)"}
        assert any(reason in fix.reason for fix in fixes)


def test_a_position_that_is_open_in_a_direction_is_refused(database: IntersectionDatabase) -> None:
    demanding = CONFIG.model_copy(
        update={"intersections": CONFIG.intersections.model_copy(update={"verify_sigma_m": 0.01})}
    )
    recognizer = Recognizer(demanding, database)
    keyframes, truth = flown(TwoIntersections(), -14.0, 10.0)
    fixes = [recognizer.follow(keyframe, at(T)) for keyframe, T in zip(keyframes, truth, strict=True)]
    verified = [fix for fix in fixes if "inlier_ratio" in fix.scores]
    assert verified
    assert not any(fix.trusted for fix in fixes)
    assert all("in one direction, 0.01 m needed (step 9)" in fix.reason for fix in verified)
