from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mineloc import se3
from mineloc.config import KeyframeConfig
from mineloc.odometry.keyframes import KeyframeSelector


def moved(x_m: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    return se3.exp([0, 0, np.deg2rad(yaw_deg), 0, 0, 0]) @ se3.exp([0, 0, 0, x_m, 0, 0])


def test_the_first_pose_is_a_keyframe_wherever_it_is() -> None:
    selector = KeyframeSelector(KeyframeConfig())
    assert selector.consider(5, moved(100.0))
    assert selector.index == 0
    assert selector.T_before_last is None


@pytest.mark.parametrize(
    ("x_m", "yaw_deg", "expected"),
    [
        (0.99, 0, False),
        (1.01, 0, True),
        (-1.01, 0, True),
        (0, 9.9, False),
        (0, 10.1, True),
        (0, -10.1, True),
        (0.9, 9, False),
    ],
)
def test_distance_or_angle_makes_a_keyframe(x_m: float, yaw_deg: float, expected: bool) -> None:
    selector = KeyframeSelector(KeyframeConfig(distance_m=1.0, angle_deg=10.0))
    start = se3.exp([0.3, -0.2, 0.5, 4, 5, 6])
    selector.consider(0, start)
    assert selector.consider(1, start @ moved(x_m, yaw_deg)) is expected


@given(st.lists(st.floats(0, 0.6), min_size=1, max_size=60))
def test_keyframes_lie_apart_and_their_motions_chain(steps: list[float]) -> None:
    selector = KeyframeSelector(KeyframeConfig(distance_m=1.0))
    T = se3.exp([0, 0, 1, 1, 2, 3])
    selector.consider(0, T)
    chained = T
    for k, step in enumerate(steps):
        T = T @ moved(step, 1.0)
        if selector.consider(k + 1, T):
            assert selector.T_before_last is not None
            chained = chained @ selector.T_before_last
            assert np.allclose(chained, T)
    assert np.linalg.norm((se3.inverse(chained) @ T)[:3, 3]) <= 1.0 + 1e-9


def test_a_wobble_without_progress_makes_none() -> None:
    selector = KeyframeSelector(KeyframeConfig())
    assert sum(selector.consider(k, moved(0.8 * (-1) ** k * 0.6, 4 * (-1) ** k)) for k in range(50)) == 1


def test_time_must_rise() -> None:
    selector = KeyframeSelector(KeyframeConfig())
    selector.consider(10, np.eye(4))
    with pytest.raises(ValueError, match="not after"):
        selector.consider(10, moved(5))
