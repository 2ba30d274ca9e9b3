"""How well intersections are recognised: what share of passages, and whether what is recognised is right (METHOD 8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mineloc import se3
from mineloc.data import F64, I64, Bool, Trajectory
from mineloc.data.checks import need

PASSED_M, LEFT_M = 3.0, 12.0
"""A flight passes an intersection when it comes so near; the passage begins and ends so far away."""
WRONG_M, WRONG_DEG = 1.0, 5.0
"""A recognition whose pose is off by more is wrong."""


@dataclass(frozen=True, slots=True)
class Passage:
    """One pass by one intersection.

    Attributes:
        target: row of the intersection.
        first_ns, nearest_ns, last_ns: when the flight came, was nearest, and left.
        nearest_m: how near it was.
        recognised: whether a fix of that intersection was accepted meanwhile.
    """

    target: int
    first_ns: int
    nearest_ns: int
    last_ns: int
    nearest_m: float
    recognised: bool


@dataclass(frozen=True, slots=True, eq=False)
class RecognitionScore:
    """Recognition over a whole flight.

    Attributes:
        passages: by time.
        accepted, wrong: fixes that were accepted, and those of them whose pose is wrong.
        errors_m, errors_deg: (accepted,) of their poses.
        first_m: way flown until the first accepted fix; None without one.
    """

    passages: tuple[Passage, ...]
    accepted: int
    wrong: int
    errors_m: F64
    errors_deg: F64
    first_m: float | None

    @property
    def recall(self) -> float | None:
        """Share of the passages that were recognised; None without passages."""
        return sum(one.recognised for one in self.passages) / len(self.passages) if self.passages else None

    @property
    def precision(self) -> float | None:
        """Share of the accepted fixes that are right; None without any."""
        return 1.0 - self.wrong / self.accepted if self.accepted else None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "passages": [asdict(one) for one in self.passages],
            "accepted": self.accepted,
            "wrong": self.wrong,
            "precision": self.precision,
            "recall": self.recall,
            "median_error_m": float(np.median(self.errors_m)) if self.accepted else None,
            "max_error_m": float(self.errors_m.max()) if self.accepted else None,
            "max_error_deg": float(self.errors_deg.max()) if self.accepted else None,
            "first_m": self.first_m,
        }


def recognition_score(
    points_map: F64, reference: Trajectory, *, stamps_ns: I64, poses: F64, targets: Sequence[int]
) -> RecognitionScore:
    """Score the accepted fixes of a flight.

    Args:
        points_map: (k, 3) invariant points of all intersections.
        reference: `T_map_lidar`, in the same map.
        stamps_ns: (n,) of the accepted fixes, rising.
        poses: (n, 4, 4) their `T_map_lidar`.
        targets: (n,) row of the intersection that each recognised.
    """
    need(len(stamps_ns) == len(poses) == len(targets), "stamps, poses and targets belong together")
    within = (stamps_ns >= reference.stamps_ns[0]) & (stamps_ns <= reference.stamps_ns[-1])
    stamps, fixed = stamps_ns[within], poses[within]
    rows = np.array(targets, dtype=np.int64)[within]
    errors_m, errors_deg = np.zeros(0), np.zeros(0)
    if len(stamps):
        away = se3.inverse(reference.at(stamps)) @ fixed
        errors_m = np.linalg.norm(away[:, :3, 3], axis=1)
        errors_deg = np.degrees([se3.angle_rad(T) for T in away])
    passed = [
        one for row, point in enumerate(points_map) for one in _passages(row, point, reference, stamps[rows == row])
    ]
    first_m = float(np.interp(stamps[0], reference.stamps_ns, reference.path_m)) if len(stamps) else None
    return RecognitionScore(
        passages=tuple(sorted(passed, key=lambda one: one.nearest_ns)),
        accepted=len(stamps),
        wrong=int(((errors_m > WRONG_M) | (errors_deg > WRONG_DEG)).sum()),
        errors_m=errors_m,
        errors_deg=errors_deg,
        first_m=first_m,
    )


def _passages(row: int, point_map: F64, reference: Trajectory, recognised_ns: I64) -> list[Passage]:
    away = reference.positions_m - point_map
    # the invariant point lies on the floor, the drone flies above it; another level is farther
    distance = np.where(np.abs(away[:, 2]) < 2.0 * PASSED_M, np.hypot(away[:, 0], away[:, 1]), np.inf)
    found: list[Passage] = []
    for first, last in _runs(distance < LEFT_M):
        nearest = first + int(distance[first:last].argmin())
        if distance[nearest] < PASSED_M:
            start, end = int(reference.stamps_ns[first]), int(reference.stamps_ns[last - 1])
            is_recognised = bool(((recognised_ns >= start) & (recognised_ns <= end)).any())
            at = int(reference.stamps_ns[nearest])
            found.append(Passage(row, start, at, end, float(distance[nearest]), is_recognised))
    return found


def _runs(mask: Bool) -> list[tuple[int, int]]:
    """(first, end) of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
