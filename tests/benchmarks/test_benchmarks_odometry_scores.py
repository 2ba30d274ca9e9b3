"""The judge of the odometry comparison: known errors come out as they are, whoever ran."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from mineloc import se3
from mineloc.data import F64, Trajectory

STEP_NS = 100_000_000
SWEEPS, SPEED_MPS = 1500, 2.0
T_BODY_LIDAR = se3.exp([0.02, -0.03, 0.1, 0.05, 0.0, 0.12])


@pytest.fixture(scope="module")
def judge() -> ModuleType:
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "odometry_scores.py"
    spec = importlib.util.spec_from_file_location("odometry_scores", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def body_at(stamps_ns: np.ndarray, *, scale: float = 1.0) -> F64:
    """A gentle curve; `scale` stretches the way, not the turns."""
    t = stamps_ns * 1e-9
    yaw = 0.3 * np.sin(0.05 * t)
    poses = se3.exp(np.stack([0 * t, 0 * t, yaw, 0 * t, 0 * t, 0 * t], axis=1))
    fine = np.linspace(0.0, float(t[-1]), 20_001)
    way = np.cumsum(np.stack([np.cos(0.3 * np.sin(0.05 * fine)), np.sin(0.3 * np.sin(0.05 * fine))], axis=1), axis=0)
    way = (way - way[0]) * (fine[1] - fine[0]) * SPEED_MPS * scale
    poses[:, 0, 3], poses[:, 1, 3] = np.interp(t, fine, way[:, 0]), np.interp(t, fine, way[:, 1])
    return poses


def write_run(path: Path, poses_body: F64, *, pose_at: float, block: int = 50, **changed: Any) -> Path:
    begin = np.arange(len(poses_body)) * STEP_NS
    facts = {"system": "kiss_icp", "version": "1", "configuration": {}, "pose_at": pose_at, "sweeps": len(poses_body)}
    facts |= {"block": block, "error": "", "peak_mib": 100.0} | changed
    np.savez(
        path,
        stamps_ns=np.stack([begin, begin + STEP_NS - 1], axis=1),
        poses=poses_body @ T_BODY_LIDAR,
        step_s=np.full(len(poses_body), 0.01),
        read_s=np.full(-(-len(poses_body) // block), 0.5),
        facts=json.dumps(facts),
    )
    return path


@pytest.fixture(scope="module")
def reference() -> Trajectory:
    stamps = np.arange(SWEEPS + 2, dtype=np.int64) * STEP_NS
    return Trajectory(stamps, body_at(stamps))


@pytest.mark.parametrize("pose_at", [0.0, 0.5, 1.0])
def test_an_estimate_that_is_right_at_its_own_time_has_no_error(
    judge: ModuleType, reference: Trajectory, tmp_path: Path, pose_at: float
):
    stamps = np.arange(SWEEPS) * STEP_NS + round(pose_at * (STEP_NS - 1))
    path = write_run(tmp_path / "run.npz", reference.at(stamps), pose_at=pose_at)
    found = judge.score(path, reference, se3.inverse(T_BODY_LIDAR))
    assert found.segment_percent < 1e-6
    assert found.ape_rmse_m < 1e-6
    assert found.coverage > 0.99
    assert found.failures == 0
    wrong = write_run(tmp_path / "wrong.npz", reference.at(stamps), pose_at=(pose_at + 0.5) % 1.5)
    assert judge.score(wrong, reference, se3.inverse(T_BODY_LIDAR)).ape_rmse_m > 0.001


def test_a_way_too_long_by_one_percent_is_one_percent(judge: ModuleType, reference: Trajectory, tmp_path: Path):
    stretched = body_at(reference.stamps_ns, scale=1.01)[:SWEEPS]
    found = judge.score(write_run(tmp_path / "run.npz", stretched, pose_at=0.0), reference, se3.inverse(T_BODY_LIDAR))
    assert found.segment_percent == pytest.approx(1.0, abs=0.02)
    assert found.segments > 50
    assert found.end_percent == pytest.approx(1.0, abs=0.05)


def test_poses_that_are_missing_or_not_finite_are_failures(judge: ModuleType, reference: Trajectory, tmp_path: Path):
    poses = body_at(reference.stamps_ns)[:1000]
    poses[10:15] = np.nan
    run = write_run(tmp_path / "run.npz", poses, pose_at=0.0, sweeps=SWEEPS, error="ValueError: lost")
    found = judge.score(run, reference, se3.inverse(T_BODY_LIDAR))
    assert found.failures == SWEEPS - 995
    assert found.coverage < 0.7
    assert "505 (stopped: ValueError: lost)" in judge.table([found], {"kiss_icp": ("kiss-icp", False)})


def test_speed_leaves_the_first_block_out_and_takes_the_median_block(judge: ModuleType):
    steps = np.concatenate([np.full(50, 1.0), np.full(100, 0.01), np.full(50, 0.02)])
    found = judge.speed(steps, np.array([9.0, 0.5, 0.5, 0.5]), 50)
    assert found["sweeps_per_s"] == pytest.approx(100)
    assert found["with_reading_per_s"] == pytest.approx(150 / 3.5)
    assert found["median_ms"] == pytest.approx(10)
    assert judge.speed(np.full(10, 0.01), np.array([0.1]), 50)["sweeps_per_s"] == pytest.approx(100)
