"""Scores and the table of the odometry comparison: every estimate is judged alike, by mineloc's metrics."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import Trajectory
from mineloc.metrics.absolute import absolute_error
from mineloc.metrics.association import associate
from mineloc.metrics.coverage import coverage
from mineloc.metrics.subtrajectories import segment_errors

SEGMENT_M, SEGMENT_STEP = 100.0, 10


@dataclass(frozen=True, slots=True)
class Score:
    """One system on one flight.

    Attributes:
        system, version, configuration: what ran.
        sweeps, poses: how many there were, for how many it gave a finite pose.
        stopped: why it ended early, empty if it did not.
        sweeps_per_s: median over the blocks, the odometry alone; `with_reading_per_s` with reading, in turn.
        median_ms, p95_ms: of a sweep, the odometry alone.
        segment_percent: KITTI's translation error over 100 m, None when the estimate is shorter; `segments` how many.
        ape_rmse_m: after se3 alignment.
        end_m, end_percent: distance of the last poses with the first ones laid on each other; share of the path.
        coverage: share of the reference's path.
        peak_mib: largest resident memory of the process.
    """

    system: str
    version: str
    configuration: Mapping[str, Any]
    sweeps: int
    poses: int
    stopped: str
    sweeps_per_s: float
    with_reading_per_s: float
    median_ms: float
    p95_ms: float
    segment_percent: float | None
    segments: int
    ape_rmse_m: float
    end_m: float
    end_percent: float
    coverage: float
    peak_mib: float

    @property
    def failures(self) -> int:
        """Sweeps without a pose."""
        return self.sweeps - self.poses


def load(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Facts and arrays that `run_odometry.py` wrote."""
    with np.load(path) as saved:
        arrays = {name: saved[name] for name in saved.files if name != "facts"}
        return json.loads(str(saved["facts"])), arrays


def trajectory(facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray], T_lidar_body: np.ndarray) -> Trajectory:
    """`T_odom_body` at the times for which the system's poses are true; what is not finite is left out."""
    begin, end = arrays["stamps_ns"].T
    stamps = begin + np.round((end - begin) * facts["pose_at"]).astype(np.int64)
    poses = arrays["poses"]
    finite = np.isfinite(poses).all(axis=(1, 2)) & (np.abs(poses).max(axis=(1, 2), initial=0) < 1e9)
    poses = poses[finite]
    # products of many poses are rigid only to 1e-6 or so
    rotations = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()
    return Trajectory(stamps[finite], se3.from_rt(rotations, poses[:, :3, 3]) @ T_lidar_body)


def score(path: Path, reference: Trajectory, T_lidar_body: np.ndarray) -> Score:
    """Everything about one run.

    Raises:
        ValueError: too few poses to compare.
    """
    facts, arrays = load(path)
    estimate = trajectory(facts, arrays, T_lidar_body)
    pairs = associate(reference, estimate, method="interpolate")
    if len(pairs) < 3:
        raise ValueError(f"{path}: {len(pairs)} poses to compare")
    segments = segment_errors(pairs, lengths_m=(SEGMENT_M,), step=SEGMENT_STEP)
    end_m = float(absolute_error(pairs, "origin").error_m[-1])
    return Score(
        system=facts["system"],
        version=facts["version"],
        configuration=facts["configuration"],
        sweeps=facts["sweeps"],
        poses=len(estimate),
        stopped=facts["error"],
        **speed(arrays["step_s"], arrays["read_s"], facts["block"]),
        segment_percent=segments.percent,
        segments=segments.count,
        ape_rmse_m=absolute_error(pairs, "se3").translation_m.rmse,
        end_m=end_m,
        end_percent=100.0 * end_m / float(pairs.reference_path_m[-1]),
        coverage=coverage(reference, estimate).path,
        peak_mib=facts["peak_mib"],
    )


def speed(step_s: np.ndarray, read_s: np.ndarray, block: int) -> dict[str, float]:
    """Speeds of one run; the first block (start-up, compilation) does not count if there are others."""
    skipped = block if len(step_s) > block else 0
    steps = step_s[skipped:]
    sums = [part.sum() / len(part) for k in range(0, len(steps), block) if len(part := steps[k : k + block])]
    total = steps.sum() + read_s[skipped // block :].sum()
    return {
        "sweeps_per_s": float(1.0 / np.median(sums)),
        "with_reading_per_s": float(len(steps) / total),
        "median_ms": float(1e3 * np.median(steps)),
        "p95_ms": float(1e3 * np.percentile(steps, 95)),
    }


COLUMNS = (
    "system", "IMU", "sweeps/s", "with reading", "ms median", "ms p95", "error over 100 m %", "APE rmse m",
    "end error m (%)", "peak MiB", "sweeps without pose",
)  # fmt: skip


def table(scores: Sequence[Score], titles: Mapping[str, tuple[str, bool]]) -> str:
    """Markdown, a row a system; `titles` gives name and whether it uses the IMU."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "| --- | --- " + "| ---: " * (len(COLUMNS) - 2) + "|"]
    for s in scores:
        title, imu = titles[s.system]
        percent = "–" if s.segment_percent is None else f"{s.segment_percent:.3f}"
        cells = [f"{title} {s.version}", "yes" if imu else "no", f"{s.sweeps_per_s:.1f}", f"{s.with_reading_per_s:.1f}"]
        cells += [f"{s.median_ms:.1f}", f"{s.p95_ms:.1f}", percent, f"{s.ape_rmse_m:.3f}"]
        cells += [f"{s.end_m:.2f} ({s.end_percent:.2f})", f"{s.peak_mib:.0f}", _failures(s)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _failures(s: Score) -> str:
    return f"{s.failures}" + (f" (stopped: {s.stopped})" if s.stopped else "")


def as_json(scores: Sequence[Score], about: Mapping[str, Any]) -> str:
    """The same and the configurations, for programs."""
    return json.dumps({**about, "systems": [asdict(s) for s in scores]}, indent=1) + "\n"
