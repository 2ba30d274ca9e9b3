"""Loop closures on a mine of wall points: found where the flight meets itself, refused everywhere else."""

from __future__ import annotations

import numpy as np
import pytest
from rough_mine import Drifted, fly_along, ring, roadway_along

from mineloc import se3
from mineloc.config import Config
from mineloc.data import RelativePose
from mineloc.localize.loops import LoopCloser

NORTH = np.array([0.0, 60.0, 0.0])


def small() -> Config:
    """Small submaps: the test's roadways are short."""
    config = Config()
    return config.model_copy(
        update={"loops": config.loops.model_copy(update={"submap_keyframes": 3, "submap_reach_m": 12.0})}
    )


def closed(flown: Drifted, closer: LoopCloser) -> list[RelativePose]:
    for keyframe, edge in zip(flown.keyframes, flown.edges, strict=True):
        closer.add(keyframe, edge, keyframe.T_odom_lidar)
    return closer.keep_consistent()


def error_of(loop: RelativePose, flown: Drifted) -> float:
    T = se3.inverse(flown.truth[loop.i]) @ flown.truth[loop.j]
    return float(np.linalg.norm((se3.inverse(T) @ loop.T_i_j)[:3, 3]))


@pytest.fixture(scope="module")
def twice_around() -> Drifted:
    rng = np.random.default_rng(1)
    line = ring(13.0)
    mine = roadway_along(line, rough_m=0.12, rng=rng)
    way = np.concatenate([line[::4], line[: len(line) // 2 : 4]])
    return fly_along(way, mine, sigma_rad=0.002, sigma_m=0.01, rng=rng, bias_rad=0.0003)


@pytest.mark.parametrize("source", ["place", "position"])
def test_a_second_round_is_closed(twice_around: Drifted, source: str) -> None:
    closer = LoopCloser(small(), by_place=source == "place", by_position=source == "position")
    loops = closed(twice_around, closer)
    assert len(loops) >= 3
    assert max(error_of(loop, twice_around) for loop in loops) < 0.15
    assert all(loop.j - loop.i > 60 for loop in loops)


def test_every_candidate_is_told_with_its_numbers(twice_around: Drifted) -> None:
    closer = LoopCloser(small(), by_place=True, by_position=True)
    loops = closed(twice_around, closer)
    fixes = closer.fixes(twice_around.truth)
    assert sum(fix.trusted for fix in fixes) == len(loops)
    for fix in fixes:
        assert fix.trusted != bool(fix.reason)
        assert fix.target.startswith("keyframe ")
    accepted = next(fix for fix in fixes if fix.trusted)
    assert accepted.scores["overlap"] >= Config().loops.min_overlap
    assert accepted.T_map_lidar is not None
    assert np.linalg.norm(accepted.T_map_lidar[:3, 3] - twice_around.truth[accepted.keyframe][:3, 3]) < 0.2


def test_one_closure_alone_is_not_believed(twice_around: Drifted) -> None:
    config = small()
    alone = config.model_copy(update={"loops": config.loops.model_copy(update={"support": 99})})
    closer = LoopCloser(alone, by_place=False, by_position=True)
    assert closed(twice_around, closer) == []
    assert any("closures agree" in fix.reason for fix in closer.fixes(twice_around.truth))


def test_a_smooth_roadway_closes_nothing() -> None:
    """Two passes through a smooth straight roadway: any shift along it fits as well."""
    rng = np.random.default_rng(2)
    line = np.column_stack([np.arange(0, 70, 0.25), np.zeros(280), np.zeros(280)])
    mine = roadway_along(line, rough_m=0.0, rng=rng)
    way = np.concatenate([line[80:200:4], line[200:80:-4]])
    flown = fly_along(way, mine, sigma_rad=0.001, sigma_m=0.05, rng=rng)
    closer = LoopCloser(small(), by_place=True, by_position=True)
    assert closed(flown, closer) == []
    assert any("eigenvalue" in fix.reason for fix in closer.fixes(flown.truth))


def test_twin_places_are_told_apart_by_odometry() -> None:
    """Two equal roadways 60 m apart: the second looks like the first, odometry knows better."""
    rng = np.random.default_rng(3)
    line = np.column_stack([np.arange(0, 30, 0.25), 3 * np.sin(np.arange(0, 30, 0.25) / 5), np.zeros(120)])
    first = roadway_along(line, rough_m=0.12, rng=np.random.default_rng(4))
    second = roadway_along(line + NORTH, rough_m=0.12, rng=np.random.default_rng(4))
    a = fly_along(line[::4], first, sigma_rad=0.001, sigma_m=0.02, rng=rng)
    b = fly_along(line[::4] + NORTH, second, sigma_rad=0.001, sigma_m=0.02, rng=rng)
    # a way of 60 m between them that sees nothing but is known as well as the rest
    gap = se3.inverse(a.truth[-1]) @ b.truth[0]
    noise = np.diag(1 / np.square([0.01] * 3 + [0.3] * 3))
    n = len(a.keyframes)
    closer = LoopCloser(small(), by_place=True, by_position=True)
    for keyframe, edge in zip(a.keyframes, a.edges, strict=True):
        closer.add(keyframe, edge, keyframe.T_odom_lidar)
    T_a_b = a.keyframes[-1].T_odom_lidar @ gap
    for k, (keyframe, edge) in enumerate(zip(b.keyframes, b.edges, strict=True)):
        T_i_j, information = (gap, noise) if edge is None else (edge.T_i_j, edge.information)
        moved = RelativePose(n + k - 1, n + k, T_i_j, information)
        placed = type(keyframe)(n + k, (n + k) * 10**9, se3.rigid(T_a_b @ keyframe.T_odom_lidar), keyframe.points_lidar)
        closer.add(placed, moved, placed.T_odom_lidar)
    assert closer.loops == []
    reasons = [fix.reason for fix in closer.fixes(np.concatenate([a.truth, b.truth]))]
    assert any("apart by odometry" in reason for reason in reasons)
