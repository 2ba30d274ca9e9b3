"""How well a map agrees with surveyed targets: the residual table of a survey report (PLATFORM 5, item 4).

Control points placed the map; only check points, which did not, are evidence of its accuracy. An error is the seen
position minus the surveyed one (METHOD 1.11).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from mineloc.data import F64, I64, ControlPoint
from mineloc.data.checks import need
from mineloc.data.control import Role

LEAST_CHECK_POINTS = 3
"""Fewer independent check points are no evidence."""

ASPRS_CHECK_POINTS = 30
"""ASPRS Positional Accuracy Standards, Edition 2 (2023), asks for so many."""

MEDIAN_NORM = 1.538
"""Median length of a standard normal vector in space."""

_LOUDEST_M = 0.001


@dataclass(frozen=True, slots=True)
class TargetResidual:
    """One surveyed target.

    Attributes:
        name, role: of the target.
        observations: how often it was seen.
        left_out: how many of them were gross errors and do not count.
        de_m, dn_m, dz_m: seen minus surveyed, the mean of the observations that count.
        horizontal_m, distance_m: lengths of that.
        spread_m: root mean square distance of the observations that count from their mean.
        sigma_m: expected of one axis: survey, and sightings as far as averaging helps.
        is_outlier: whether it contradicts the others: its survey, its name or the map is wrong there.
    """

    name: str
    role: Role
    observations: int
    left_out: int
    de_m: float
    dn_m: float
    dz_m: float
    horizontal_m: float
    distance_m: float
    spread_m: float
    sigma_m: float
    is_outlier: bool


@dataclass(frozen=True, slots=True)
class RoleSummary:
    """All targets of one role. Control points that are outliers are not in it, check points are all in it.

    Attributes:
        count: targets.
        rmse_e_m, rmse_n_m, rmse_z_m, rmse_h_m, rmse_3d_m: of the residuals.
        survey_h_m, survey_z_m, survey_3d_m: root mean square error that the survey itself is expected to have.
        total_h_m, total_z_m, total_3d_m: both in quadrature (ASPRS Edition 2, 7.11).
        bias_e_m, bias_n_m, bias_z_m: mean residuals.
        max_h_m, max_3d_m: the largest; `worst` is the target that has the latter.
    """

    count: int
    rmse_e_m: float
    rmse_n_m: float
    rmse_z_m: float
    rmse_h_m: float
    rmse_3d_m: float
    survey_h_m: float
    survey_z_m: float
    survey_3d_m: float
    total_h_m: float
    total_z_m: float
    total_3d_m: float
    bias_e_m: float
    bias_n_m: float
    bias_z_m: float
    max_h_m: float
    max_3d_m: float
    worst: str


@dataclass(frozen=True, slots=True)
class ControlTable:
    """Residuals of all targets that were seen.

    Attributes:
        rows: one a target, in the order of the survey.
        control, check: summaries; None without such targets.
        outliers: names of targets that contradict the others.
        unseen: names of targets without an observation that counts.
    """

    rows: tuple[TargetResidual, ...]
    control: RoleSummary | None
    check: RoleSummary | None
    outliers: tuple[str, ...]
    unseen: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the check points say about a tolerance.

    Attributes:
        value: `insufficient evidence` with fewer than three check points.
        check_points: independent ones that were seen.
        tolerance_m: for the total RMSE in space.
        reasons: sentences; also what limits a pass.
    """

    value: Literal["pass", "warn", "fail", "insufficient evidence"]
    check_points: int
    tolerance_m: float
    reasons: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def control_table(
    points: Sequence[ControlPoint],
    target: I64,
    seen_grid: F64,
    seen_sigma_m: F64,
    *,
    outlier_sigmas: float,
    gross_m: float,
    outliers: Collection[str] = (),
) -> ControlTable:
    """Residuals of targets in the mine grid.

    Args:
        points: m surveyed targets.
        target: (n,) which of them each observation is of.
        seen_grid: (n, 3) where the finished map puts what was observed.
        seen_sigma_m: (n,) of an observation, one axis.
        outlier_sigmas: a target that is farther off than so many of what is expected, and of what its role shows, is
            an outlier.
        gross_m: an observation farther than this from the middle of three or more of one target is left out.
        outliers: names of targets that were found out before.
    """
    n = len(target)
    need(seen_grid.shape == (n, 3) and seen_sigma_m.shape == (n,), "one target, place and sigma an observation")
    # the differences first: they are metres, the coordinates have seven digits
    off = seen_grid - np.array([point.position_grid for point in points]).reshape(-1, 3)[target]
    rows: list[TargetResidual] = []
    for k, point in enumerate(points):
        mask = target == k
        if mask.any():
            rows.append(_row(point, off[mask], seen_sigma_m[mask], gross_m))
    rows = _named(rows, outlier_sigmas, outliers)
    by_name = {point.name: point for point in points}
    return ControlTable(
        rows=tuple(rows),
        control=_summary([row for row in rows if row.role == "control" and not row.is_outlier], by_name),
        check=_summary([row for row in rows if row.role == "check"], by_name),
        outliers=tuple(row.name for row in rows if row.is_outlier),
        unseen=tuple(point.name for k, point in enumerate(points) if not (target == k).any()),
    )


def verdict_of(table: ControlTable, *, tolerance_m: float) -> Verdict:
    """PASS, WARN or FAIL by the check points alone.

    Fails when their total RMSE in space exceeds the tolerance; warns when a single one is off by more than twice the
    tolerance, or a target is an outlier.
    """
    count = table.check.count if table.check is not None else 0
    if table.check is None or count < LEAST_CHECK_POINTS:
        reason = f"{count} independent check points, at least {LEAST_CHECK_POINTS} are needed"
        return Verdict("insufficient evidence", count, tolerance_m, (reason,))
    check, reasons = table.check, list[str]()
    value: Literal["pass", "warn", "fail"] = "pass"
    if check.max_3d_m > 2.0 * tolerance_m:
        value = "warn"
        reasons.append(f"{check.worst} is {check.max_3d_m:.3f} m off, more than twice the tolerance")
    if table.outliers:
        value = "warn"
        reasons.append(f"contradicted by the other targets: {', '.join(table.outliers)}")
    if check.total_3d_m > tolerance_m:
        value = "fail"
        reasons.insert(0, f"RMSE {check.total_3d_m:.3f} m of the check points, at most {tolerance_m:g} m allowed")
    if count < ASPRS_CHECK_POINTS:
        reasons.append(f"{count} check points, fewer than the {ASPRS_CHECK_POINTS} that ASPRS asks for")
    return Verdict(value, count, tolerance_m, tuple(reasons))


def _row(point: ControlPoint, off: F64, sigma_m: F64, gross_m: float) -> TargetResidual:
    counts = np.ones(len(off), np.bool_)
    if len(off) >= 3:
        counts = np.linalg.norm(off - np.median(off, axis=0), axis=1) <= gross_m
    if not counts.any():  # none agrees with any other: all of them, and let the residual say so
        counts[:] = True
    weight = 1.0 / sigma_m[counts] ** 2
    mean = weight @ off[counts] / weight.sum()
    spread = off[counts] - mean
    survey = float(np.trace(point.covariance_grid)) / 3.0
    return TargetResidual(
        name=point.name,
        role=point.role,
        observations=len(off),
        left_out=int((~counts).sum()),
        de_m=float(mean[0]),
        dn_m=float(mean[1]),
        dz_m=float(mean[2]),
        horizontal_m=float(np.hypot(mean[0], mean[1])),
        distance_m=float(np.linalg.norm(mean)),
        spread_m=float(np.sqrt((spread**2).sum(axis=1).mean())),
        sigma_m=float(np.sqrt(survey + 1.0 / weight.sum())),
        is_outlier=False,
    )


def _named(rows: list[TargetResidual], sigmas: float, known: Collection[str]) -> list[TargetResidual]:
    """The rows with those marked that contradict the rest of their role."""
    out: list[TargetResidual] = []
    for row in rows:
        peers = sorted(other.distance_m for other in rows if other.role == row.role and other.name not in known)
        usual = peers[(len(peers) - 1) // 2] / MEDIAN_NORM if peers else 0.0
        limit = sigmas * max(row.sigma_m, usual, _LOUDEST_M)
        is_outlier = row.name in known or row.distance_m > limit
        out.append(replace(row, is_outlier=is_outlier))
    return out


def _summary(rows: Sequence[TargetResidual], points: dict[str, ControlPoint]) -> RoleSummary | None:
    if not rows:
        return None
    off = np.array([(row.de_m, row.dn_m, row.dz_m) for row in rows])
    mean_square = (off**2).mean(axis=0)
    survey = np.mean([np.diag(points[row.name].covariance_grid) for row in rows], axis=0)
    distance = np.linalg.norm(off, axis=1)
    rmse_e, rmse_n, rmse_z = (float(np.sqrt(v)) for v in mean_square)
    return RoleSummary(
        count=len(rows),
        rmse_e_m=rmse_e,
        rmse_n_m=rmse_n,
        rmse_z_m=rmse_z,
        rmse_h_m=_root(mean_square[:2]),
        rmse_3d_m=_root(mean_square),
        survey_h_m=_root(survey[:2]),
        survey_z_m=_root(survey[2:]),
        survey_3d_m=_root(survey),
        total_h_m=_root(mean_square[:2] + survey[:2]),
        total_z_m=_root(mean_square[2:] + survey[2:]),
        total_3d_m=_root(mean_square + survey),
        bias_e_m=float(off[:, 0].mean()),
        bias_n_m=float(off[:, 1].mean()),
        bias_z_m=float(off[:, 2].mean()),
        max_h_m=float(np.hypot(off[:, 0], off[:, 1]).max()),
        max_3d_m=float(distance.max()),
        worst=rows[int(distance.argmax())].name,
    )


def _root(mean_squares: F64) -> float:
    return float(np.sqrt(mean_squares.sum()))
