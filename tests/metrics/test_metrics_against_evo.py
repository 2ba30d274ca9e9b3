"""evo 1.38 as the oracle; it is never imported outside the tests."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D

from mineloc import se3
from mineloc.data import Trajectory
from mineloc.metrics.absolute import absolute_error
from mineloc.metrics.association import Pairs, associate
from mineloc.metrics.relative import relative_error

RELATIONS = {
    "translation": evo_metrics.PoseRelation.translation_part,
    "rotation": evo_metrics.PoseRelation.rotation_angle_deg,
}
UNITS = {"frames": evo_metrics.Unit.frames, "m": evo_metrics.Unit.meters}
NAMES = ("rmse", "mean", "median", "std", "min", "max", "sse")


def _flight(rng: np.random.Generator, n: int) -> np.ndarray:
    """A wandering path with stand-stills, far from the origin."""
    xi = rng.normal(size=(n, 6)) * [0.1, 0.1, 0.3, 0.5, 0.2, 0.05] + [0, 0, 0, 0.6, 0, 0]
    xi[rng.random(n) < 0.1] = 0.0
    out = np.empty((n, 4, 4))
    T = se3.exp(rng.normal(size=6) * [1, 1, 1, 100, 100, 10])
    for k, step in enumerate(se3.exp(xi)):
        T = T @ step
        out[k] = T
    return out


def _with_drift(rng: np.random.Generator, poses: np.ndarray) -> np.ndarray:
    noise = se3.exp(rng.normal(size=(len(poses), 6)) * [0.02, 0.02, 0.02, 0.1, 0.1, 0.1])
    return se3.exp(rng.normal(size=6)) @ poses @ noise


def _to_evo(stamps_s: np.ndarray, poses: np.ndarray) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(poses), timestamps=stamps_s.copy())


def _paired(rng: np.random.Generator, n: int) -> tuple[Pairs, PoseTrajectory3D, PoseTrajectory3D]:
    reference = _flight(rng, n)
    estimate = _with_drift(rng, reference)
    stamps = np.arange(n, dtype=np.int64) * 10**8
    pairs = associate(Trajectory(stamps, reference), Trajectory(stamps, estimate))
    return pairs, _to_evo(stamps * 1e-9, reference), _to_evo(stamps * 1e-9, estimate)


def _compare(ours, oracle: evo_metrics.PE) -> None:
    theirs = oracle.get_all_statistics()
    for name in NAMES:
        assert getattr(ours, name) == pytest.approx(theirs[name], rel=1e-9, abs=1e-9), name


@pytest.mark.parametrize("kind", ["none", "origin", "se3"])
@pytest.mark.parametrize("seed", range(4))
def test_absolute_error_equals_evo(kind, seed):
    pairs, reference, estimate = _paired(np.random.default_rng(seed), 120)
    if kind == "origin":
        estimate.align_origin(reference)
    elif kind == "se3":
        estimate.align(reference)
    ours = absolute_error(pairs, kind)
    for part, statistics in (("translation", ours.translation_m), ("rotation", ours.rotation_deg)):
        oracle = evo_metrics.APE(RELATIONS[part])
        oracle.process_data((reference, estimate))
        _compare(statistics, oracle)


@pytest.mark.parametrize(("delta", "unit"), [(1, "frames"), (7, "frames"), (3.0, "m"), (20.0, "m")])
@pytest.mark.parametrize("all_pairs", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_relative_error_equals_evo(delta, unit, all_pairs, seed):
    pairs, reference, estimate = _paired(np.random.default_rng(100 + seed), 120)
    ours = relative_error(pairs, delta=delta, unit=unit, all_pairs=all_pairs)
    for part, statistics in (("translation", ours.translation_m), ("rotation", ours.rotation_deg)):
        oracle = evo_metrics.RPE(RELATIONS[part], delta, UNITS[unit], rel_delta_tol=0.1, all_pairs=all_pairs)
        oracle.process_data((reference, estimate))
        assert statistics is not None
        assert statistics.count == len(oracle.error)
        _compare(statistics, oracle)


@pytest.mark.parametrize("seed", range(8))
def test_nearest_association_equals_evo(seed):
    rng = np.random.default_rng(200 + seed)
    start = 1_700_000_000 * 10**9
    # a decimal grid makes poses that are equally near, which evo lets rounding decide
    reference_ns = start + np.unique(rng.integers(0, 40_000, 3000)) * 1_000_000
    estimate_ns = start - 10**9 + np.arange(420) * 100_500_000
    if seed % 2:
        reference_ns, estimate_ns = estimate_ns, reference_ns
    reference = Trajectory(reference_ns, _flight(rng, len(reference_ns)))
    estimate = Trajectory(estimate_ns, _flight(rng, len(estimate_ns)))
    pairs = associate(reference, estimate, method="nearest", max_time_difference_s=0.015)
    theirs = sync.associate_trajectories(
        _to_evo(_float_seconds(reference_ns), reference.poses),
        _to_evo(_float_seconds(estimate_ns), estimate.poses),
        max_diff=0.015,
    )
    assert 0 < len(pairs) < min(len(reference), len(estimate))
    np.testing.assert_array_equal(pairs.reference, theirs[0].poses_se3)
    np.testing.assert_array_equal(pairs.estimate, theirs[1].poses_se3)


def _float_seconds(stamps_ns: np.ndarray) -> np.ndarray:
    return np.array([float(f"{t // 10**9}.{t % 10**9:09d}") for t in stamps_ns.tolist()])
