from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mineloc import se3
from mineloc.data import Trajectory
from mineloc.metrics.absolute import absolute_error
from mineloc.metrics.alignment import alignment, umeyama
from mineloc.metrics.association import Pairs, associate
from mineloc.metrics.coverage import coverage
from mineloc.metrics.relative import relative_error
from mineloc.metrics.statistics import Statistics
from mineloc.metrics.subtrajectories import percent_errors, segment_errors

SEEDS = st.integers(0, 10_000)


def _flight(n: int, seed: int, *, step_m: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(n, 6)) * [0.02, 0.02, 0.1, 0.3 * step_m, 0.1, 0.02] + [0, 0, 0, step_m, 0, 0]
    out = np.empty((n, 4, 4))
    T = np.eye(4)
    for k, motion in enumerate(se3.exp(xi)):
        out[k] = T
        T = T @ motion
    return out


def _pairs(reference: np.ndarray, estimate: np.ndarray) -> Pairs:
    stamps = np.arange(len(reference), dtype=np.int64) * 10**8
    return associate(Trajectory(stamps, reference), Trajectory(stamps, estimate), method="nearest")


def _noisy(poses: np.ndarray, seed: int, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed + 1)
    return poses @ se3.exp(rng.normal(size=(len(poses), 6)) * scale * [0.01, 0.01, 0.01, 0.1, 0.1, 0.1])


@given(hnp.arrays(np.float64, st.integers(1, 50), elements=st.floats(0, 1e3)))
def test_rmse_is_made_of_mean_and_std(errors):
    s = Statistics.of(errors)
    assert s.rmse**2 == pytest.approx(s.mean**2 + s.std**2, rel=1e-9, abs=1e-12)
    assert s.min <= s.median <= s.max
    assert s.sse == pytest.approx(s.rmse**2 * s.count)


def test_no_errors_have_no_statistics():
    with pytest.raises(ValueError, match="no errors"):
        Statistics.of(np.zeros(0))


@given(SEEDS)
def test_se3_alignment_undoes_any_rigid_motion_and_posyaw_those_that_keep_the_vertical(seed):
    reference = _flight(30, seed)
    rng = np.random.default_rng(seed)
    moved = se3.exp(rng.normal(size=6) * [1, 1, 1, 10, 10, 10]) @ reference
    assert absolute_error(_pairs(reference, moved), "se3").translation_m.max < 1e-9
    turned = se3.exp([0, 0, rng.uniform(-3, 3), *rng.normal(size=3) * 10]) @ reference
    for kind in ("posyaw", "origin", "se3"):
        error = absolute_error(_pairs(reference, turned), kind)
        assert error.translation_m.max < 1e-9
        assert error.rotation_deg.max < 1e-5


@given(SEEDS)
def test_se3_is_the_best_rigid_alignment_and_posyaw_the_best_about_the_vertical(seed):
    reference = _flight(25, seed)
    pairs = _pairs(reference, se3.exp([0.1, -0.2, 1, 3, 2, 1]) @ _noisy(reference, seed, 5))
    for kind, free in (("se3", np.ones(6)), ("posyaw", np.array([0, 0, 1.0, 1, 1, 1]))):
        T = alignment(pairs.reference, pairs.estimate, kind)
        best = np.sum((se3.apply(T, pairs.estimate[:, :3, 3]) - pairs.reference[:, :3, 3]) ** 2)
        for nudge in np.random.default_rng(seed).normal(size=(10, 6)) * 1e-3 * free:
            other = se3.exp(nudge) @ T
            cost = np.sum((se3.apply(other, pairs.estimate[:, :3, 3]) - pairs.reference[:, :3, 3]) ** 2)
            assert cost >= best - 1e-9


def test_a_mirrored_estimate_is_not_mirrored_back():
    points = np.random.default_rng(0).normal(size=(20, 3))
    T = umeyama(points * [1, 1, -1], points)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("name", ["two poses", "hover", "straight line"])
def test_alignments_that_the_poses_leave_open_are_refused(name):
    poses = np.tile(np.eye(4), (20, 1, 1))
    if name == "straight line":
        poses[:, 0, 3] = np.arange(20.0)
    pairs = _pairs(poses[:2] if name == "two poses" else poses, poses[:2] if name == "two poses" else poses)
    with pytest.raises(ValueError, match=r"open|needs 3"):
        absolute_error(pairs, "se3")
    assert absolute_error(pairs, "origin").translation_m.max == 0.0


def test_a_constant_rotation_between_body_and_lidar_shows_in_rotation_and_in_rep_alone():
    # METHOD D13: positions agree to the millimetre, yet relative errors are large
    reference = _flight(400, 3)
    turned = reference @ se3.exp([0, 0, math.radians(3), 0, 0, 0])
    pairs = _pairs(reference, turned)
    error = absolute_error(pairs, "none")
    assert error.translation_m.max < 1e-9
    assert error.rotation_deg.min == pytest.approx(3.0)
    rep = percent_errors(pairs, path_length_m=float(pairs.reference_path_m[-1]), percents=(20,))[0]
    assert rep.literal is not None
    assert rep.literal.mean > 1.0


def test_along_the_flight_the_error_has_time_path_and_direction():
    reference = _flight(50, 5)
    shifted = reference.copy()
    shifted[:, 2, 3] += np.linspace(0, 2, 50)
    error = absolute_error(_pairs(reference, shifted), "none")
    np.testing.assert_allclose(error.error_m, np.linspace(0, 2, 50))
    np.testing.assert_allclose(error.offset_m[:, 2], np.linspace(0, 2, 50))
    assert error.path_m[0] == 0.0
    assert (np.diff(error.path_m) > 0).all()
    assert error.stamps_ns[-1] == 49 * 10**8


@given(SEEDS)
def test_relative_errors_know_no_alignment(seed):
    reference = _flight(60, seed)
    estimate = _noisy(reference, seed)
    moved = se3.exp(np.random.default_rng(seed).normal(size=6) * 3) @ estimate
    for delta, unit in ((3, "frames"), (10.0, "m")):
        a = relative_error(_pairs(reference, estimate), delta=delta, unit=unit)
        b = relative_error(_pairs(reference, moved), delta=delta, unit=unit)
        assert a.translation_m is not None
        assert b.translation_m is not None
        assert a.translation_m.rmse == pytest.approx(b.translation_m.rmse, abs=1e-9)


def test_relative_error_over_more_than_there_is_says_nothing():
    pairs = _pairs(_flight(20, 0), _flight(20, 1))
    assert relative_error(pairs, delta=1000.0, unit="m").translation_m is None
    assert relative_error(pairs, delta=1000.0, unit="m", all_pairs=True).to_dict()["translation_m"] is None
    assert relative_error(pairs, delta=50, unit="frames").rotation_deg is None
    for delta, unit in ((0, "m"), (1.5, "frames"), (-1, "frames")):
        with pytest.raises(ValueError, match="delta"):
            relative_error(pairs, delta=delta, unit=unit)


def _toolbox(reference, estimate, distance, *, tolerance=0.2):
    """Zhang and Scaramuzza's search, pair by pair, in plain loops."""
    p = reference[:, :3, 3]
    s = [0.0]
    for k in range(1, len(p)):
        s.append(s[-1] + float(np.linalg.norm(p[k] - p[k - 1])))
    percents, starts = [], []
    for i in range(len(p)):
        best, error = -1, tolerance * distance
        for j in range(i, len(p)):
            if abs(s[j] - (s[i] + distance)) < error:
                best, error = j, abs(s[j] - (s[i] + distance))
        if best >= 0:
            truth = np.linalg.inv(reference[i]) @ reference[best]
            guess = np.linalg.inv(estimate[i]) @ estimate[best]
            T = np.linalg.inv(truth) @ guess
            percents.append(float(np.linalg.norm(T[:3, 3])) / distance * 100)
            starts.append(i)
    return np.array(percents), starts


@pytest.mark.parametrize("seed", range(5))
def test_rep_equals_the_toolbox_search(seed):
    reference = _flight(150, seed)
    reference[60:70] = reference[60]  # a hover: several poses at one travelled distance
    estimate = _noisy(reference, seed)
    pairs = _pairs(reference, estimate)
    length = float(pairs.reference_path_m[-1])
    for rep in percent_errors(pairs, path_length_m=length, percents=(20, 40, 60, 80, 100)):
        assert rep.distance_m == math.trunc(rep.percent_of_path * length) / 100 or rep.distance_m == pytest.approx(
            rep.percent_of_path / 100 * length, abs=0.01
        )
        want, starts = _toolbox(reference, estimate, rep.distance_m)
        assert rep.literal is not None
        assert rep.literal.count == len(want)
        assert rep.literal.mean == pytest.approx(want.mean(), rel=1e-9)
        assert rep.literal.rmse == pytest.approx(math.sqrt((want**2).mean()), rel=1e-9)
        if rep.percent_of_path < 100:
            assert rep.strict == rep.literal
        else:
            assert len(starts) > 10
            assert rep.strict is not None
            assert rep.strict.count == 1
            motion = se3.inverse(se3.inverse(reference[0]) @ reference[-1]) @ se3.inverse(estimate[0]) @ estimate[-1]
            assert rep.strict.mean == pytest.approx(np.linalg.norm(motion[:3, 3]) / rep.distance_m * 100)
            assert rep.strict.mean != pytest.approx(rep.literal.mean)


def test_rep_keeps_start_and_end_together_where_some_starts_have_no_end():
    # a hole in the middle leaves starts without an end; the toolbox would then compare other pairs
    reference = np.concatenate([_flight(40, 1), se3.exp([0, 0, 0, 400, 0, 0]) @ _flight(40, 1)])
    estimate = _noisy(reference, 1)
    pairs = _pairs(reference, estimate)
    rep = percent_errors(pairs, path_length_m=50.0, percents=(20,))[0]
    want, starts = _toolbox(reference, estimate, 10.0)
    assert starts != list(range(len(starts)))
    assert rep.literal is not None
    assert rep.literal.mean == pytest.approx(want.mean())


def test_rep_of_too_little_is_nothing():
    pairs = _pairs(_flight(30, 2), _flight(30, 2))
    few = percent_errors(pairs, path_length_m=500.0, percents=(20, 100))
    assert [(rep.literal, rep.strict) for rep in few] == [(None, None)] * 2
    assert percent_errors(pairs, path_length_m=0.0, percents=(20,))[0].literal is None


def test_kitti_segments_equal_a_plain_loop():
    reference = _flight(900, 4)
    estimate = _noisy(reference, 4)
    pairs = _pairs(reference, estimate)
    s = pairs.reference_path_m
    shares, turns = [], []
    for length in (100, 200, 300):
        for i in range(0, 900, 10):
            j = next((k for k in range(i, 900) if s[k] > s[i] + length), None)
            if j is not None:
                truth = np.linalg.inv(reference[i]) @ reference[j]
                T = np.linalg.inv(truth) @ np.linalg.inv(estimate[i]) @ estimate[j]
                shares.append(np.linalg.norm(T[:3, 3]) / length * 100)
                turns.append(math.degrees(math.acos(min(1.0, (np.trace(T[:3, :3]) - 1) / 2))) / length)
    found = segment_errors(pairs, lengths_m=(100, 200, 300))
    assert found.count == len(shares)
    assert found.percent == pytest.approx(np.mean(shares))
    assert found.deg_per_m == pytest.approx(np.mean(turns), rel=1e-5)
    assert [row[0] for row in found.by_length] == [100, 200, 300]
    assert segment_errors(pairs, lengths_m=(100,)).percent == pytest.approx(found.by_length[0][1])
    short = segment_errors(_pairs(reference[:50], estimate[:50]))
    assert (short.percent, short.count, short.by_length) == (None, 0, ())
    with pytest.raises(ValueError, match="step 0"):
        segment_errors(pairs, step=0)


def _timed(stamps_s, positions_x) -> Trajectory:
    poses = np.tile(np.eye(4), (len(stamps_s), 1, 1))
    poses[:, 0, 3] = positions_x
    return Trajectory(np.round(np.asarray(stamps_s) * 1e9).astype(np.int64), poses)


def test_coverage_counts_time_and_path_between_near_poses():
    t = np.arange(0, 10.01, 0.5)
    # at rest for 5 s, then 4 m/s
    reference = _timed(t, np.where(t < 5, 0, (t - 5) * 4))
    whole = coverage(reference, _timed(np.arange(-1, 12, 0.1), np.zeros(130)))
    assert (whole.time, whole.path) == pytest.approx((1.0, 1.0))
    first = coverage(reference, _timed(np.arange(0, 5.01, 0.1), np.zeros(51)))
    assert (first.time, first.path) == pytest.approx((0.5, 0.0))
    hole = np.concatenate([np.arange(0, 6.01, 0.1), np.arange(8, 10.01, 0.1)])
    holed = coverage(reference, _timed(hole, np.zeros(len(hole))))
    assert (holed.time, holed.path) == pytest.approx((0.8, 0.6))
    assert coverage(reference, _timed(hole, np.zeros(len(hole))), max_gap_s=3).time == pytest.approx(1.0)
    assert coverage(reference, _timed([3.0], [0.0])).time == 0.0
    still = coverage(_timed([0.0, 1.0, 2.0], [0, 0, 0]), _timed([0.0, 1.0], [0, 0]))
    assert (still.time, still.path, still.reference_path_m) == pytest.approx((0.5, 0.5, 0.0))
    assert holed.to_dict()["reference_duration_s"] == pytest.approx(10.0)
