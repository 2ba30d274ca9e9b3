"""Where a levelled map lies in the mine grid: heading and position from surveyed targets that were seen in it.

Gravity is known, so four degrees of freedom are left and two targets apart from each other fix them. Gross blunders (a
wrong name, a digit too few) must neither bend the placement nor pass unnamed: every pair of sightings proposes a
placement, the one that most targets agree with is taken (RANSAC, with all pairs in place of random ones), and what
fits it decides by least squares. Odometry drifts, and drift is commoner than blunders: the gate opens, up to what
drift explains, until six of ten targets agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mineloc import se3
from mineloc.data import F64, I64, Bool
from mineloc.data.checks import freeze, need

_MOST_PROPOSALS = 1000
_MANY = 0.6
_WIDER = 3.0
_ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Surveyed targets and where they were seen in a map.

    Attributes:
        names: of the m targets.
        surveyed_grid: (m, 3).
        target: (n,) which target was seen.
        points_map: (n, 3) where.
    """

    names: Sequence[str]
    surveyed_grid: F64
    target: I64
    points_map: F64

    def __post_init__(self) -> None:
        need(self.surveyed_grid.shape == (len(self.names), 3), "surveyed_grid must be (m, 3)")
        need(self.points_map.shape == (len(self.target), 3), "points_map must be (n, 3)")
        freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class GridPlacement:
    """The answer.

    Attributes:
        T_grid_map: (4, 4) yaw and translation, None when the targets do not tell.
        reason: why not; empty otherwise.
        fits: (n,) sightings within the gate.
        misfits: names of the targets most of whose sightings do not fit; with odometry that drifts, a suspicion.
        gate_m: distance within which a sighting fits.
        targets: how many fit.
        rmse_m: of the distances of the sightings that fit, every target counted once.
        sigma_yaw_rad: of the heading, from those distances.
    """

    T_grid_map: F64 | None
    reason: str
    fits: Bool
    misfits: tuple[str, ...] = ()
    gate_m: float = float("nan")
    targets: int = 0
    rmse_m: float = float("nan")
    sigma_yaw_rad: float = float("nan")

    def __post_init__(self) -> None:
        need((self.T_grid_map is None) == bool(self.reason), "either a placement or a reason")
        freeze(self)


def find_grid(seen: Sightings, *, gate_m: float, most_m: float, min_separation_m: float) -> GridPlacement:
    """Place a map on surveyed targets.

    Args:
        seen: sightings; targets without any do not count.
        gate_m: sightings nearer than this to their target always fit.
        most_m: and never, if they are farther than this: what odometry may have drifted by.
        min_separation_m: horizontal distance between two targets that fixes a heading.

    Raises:
        ValueError: `most_m` is less than `gate_m`.
    """
    need(most_m >= gate_m > 0 and min_separation_m > 0, "needs 0 < gate_m <= most_m and min_separation_m > 0")
    present = np.unique(seen.target)
    refusal = _too_few(seen, present, min_separation_m)
    if refusal:
        return GridPlacement(None, refusal, np.zeros(len(seen.target), np.bool_))
    # sums of squares of seven digits lose the millimetres: all within the targets' middle
    middle_grid, middle_map = seen.surveyed_grid[present].mean(axis=0), seen.points_map.mean(axis=0)
    near = replace(seen, surveyed_grid=seen.surveyed_grid - middle_grid, points_map=seen.points_map - middle_map)
    found = _agreed(near, present, gate_m, most_m, min_separation_m)
    if found.T_grid_map is None:
        return replace(found, reason=found.reason + _hint(near, present, gate_m, most_m, min_separation_m))
    T = found.T_grid_map.copy()
    T[:3, 3] += middle_grid - T[:3, :3] @ middle_map
    return replace(found, T_grid_map=T)


def _too_few(seen: Sightings, present: I64, min_separation_m: float) -> str:
    if not len(present):
        return "no control target was seen"
    if len(present) == 1:
        return f"one control target was seen ({seen.names[present[0]]}): the heading is open, two are needed"
    widest = _extent_m(seen.surveyed_grid[present])
    if widest < min_separation_m:
        return (
            f"{len(present)} control targets were seen, all within {widest:.2f} m horizontally: the heading is open, "
            f"{min_separation_m:g} m are needed"
        )
    return ""


def _extent_m(points: F64) -> float:
    """Largest horizontal distance between any two points."""
    x, y = points[:, 0], points[:, 1]
    return float(np.hypot(x[:, None] - x, y[:, None] - y).max(initial=0.0))


def _agreed(seen: Sightings, present: I64, gate_m: float, most_m: float, min_separation_m: float) -> GridPlacement:
    """The placement that most targets agree with, within the smallest gate that enough of them pass."""
    proposals = _proposals(seen, most_m, min_separation_m)
    if not len(proposals):
        return GridPlacement(None, _no_pair(seen, present, most_m), np.zeros(len(seen.target), np.bool_))
    distances = _target_distances(seen, present, proposals)
    gate = gate_m
    while True:
        near = np.minimum(distances, gate).sum(axis=1)
        T, fits = _settled(seen, proposals[int(near.argmin())], gate)
        if _agreeing(seen, present, fits).sum() >= _quorum(len(present)) or gate >= most_m:
            break
        gate = min(2.0 * gate, most_m)
    # odometry that has bent a little bends on where nobody proposed a placement
    gate = min(_WIDER * gate, most_m)
    T, fits = _settled(seen, T, gate)
    return _judged(seen, present, T, fits, gate, min_separation_m)


def _settled(seen: Sightings, T: F64, gate_m: float) -> tuple[F64, Bool]:
    """Least squares over what fits, until that does not change."""
    fits = _distances_m(seen, T[None])[0] <= gate_m
    for _ in range(_ROUNDS):
        if len(np.unique(seen.target[fits])) < 2:
            break
        T = _least_squares(seen, fits)
        before, fits = fits, _distances_m(seen, T[None])[0] <= gate_m
        if (fits == before).all():
            break
    return T, fits


def _agreeing(seen: Sightings, present: I64, fits: Bool) -> Bool:
    """(m,) targets at least half of whose sightings fit."""
    return np.array([fits[seen.target == k].mean() >= 0.5 for k in present], np.bool_)


def _judged(seen: Sightings, present: I64, T: F64, fits: Bool, gate_m: float, min_separation_m: float) -> GridPlacement:
    agrees = _agreeing(seen, present, fits)
    agreeing, others = present[agrees], present[~agrees]
    misfits = tuple(seen.names[int(k)] for k in others)
    if len(others) and (len(agreeing) < 3 or len(agreeing) <= len(present) / 2):
        why = f"only {len(agreeing)} of {len(present)} control targets agree within {gate_m:.2f} m: no telling who errs"
        return GridPlacement(None, why, fits, gate_m=gate_m)
    widest = _extent_m(seen.surveyed_grid[agreeing])
    if widest < min_separation_m:
        why = f"the control targets that agree lie within {widest:.2f} m horizontally, {min_separation_m:g} m needed"
        return GridPlacement(None, why, fits, misfits, gate_m)
    weight = _target_weights(seen, fits)
    distance = _distances_m(seen, T[None])[0][fits]
    rmse = float(np.sqrt(weight @ distance**2 / weight.sum()))
    arm = seen.points_map[fits, :2] - weight @ seen.points_map[fits, :2] / weight.sum()
    sigma_yaw = rmse / np.sqrt(3.0 * (weight @ (arm**2).sum(axis=1)))
    return GridPlacement(T, "", fits, misfits, gate_m, len(agreeing), rmse, float(sigma_yaw))


def _quorum(targets: int) -> int:
    """So many targets must agree: all but a few, and one more than the two that made a proposal."""
    return max(min(targets, 3), int(np.ceil(_MANY * targets)))


def _proposals(seen: Sightings, most_m: float, min_separation_m: float) -> F64:
    """(p, 4, 4) placements on pairs of sightings, evenly thinned where there are too many."""
    i, j = np.triu_indices(len(seen.target), 1)
    in_grid = seen.surveyed_grid[seen.target[j], :2] - seen.surveyed_grid[seen.target[i], :2]
    in_map = seen.points_map[j, :2] - seen.points_map[i, :2]
    apart_grid, apart_map = np.hypot(*in_grid.T), np.hypot(*in_map.T)
    usable = np.flatnonzero((apart_grid >= min_separation_m) & (np.abs(apart_grid - apart_map) <= 2.0 * most_m))
    kept = usable[:: -(-len(usable) // _MOST_PROPOSALS) or 1]
    i, j, in_grid, in_map = i[kept], j[kept], in_grid[kept], in_map[kept]
    yaw = np.arctan2(in_grid[:, 1], in_grid[:, 0]) - np.arctan2(in_map[:, 1], in_map[:, 0])
    rotation = _about_z(yaw)
    middle_grid = (seen.surveyed_grid[seen.target[i]] + seen.surveyed_grid[seen.target[j]]) / 2.0
    middle_map = (seen.points_map[i] + seen.points_map[j]) / 2.0
    return se3.from_rt(rotation, middle_grid - np.einsum("pij,pj->pi", rotation, middle_map))


def _no_pair(seen: Sightings, present: I64, most_m: float) -> str:
    if len(present) > 2:
        return f"no two of {len(present)} control targets are as far apart in the map as in the survey"
    a, b = (int(k) for k in present)
    surveyed = float(np.linalg.norm(seen.surveyed_grid[b, :2] - seen.surveyed_grid[a, :2]))
    mean = [seen.points_map[seen.target == k, :2].mean(axis=0) for k in (a, b)]
    seen_m = float(np.linalg.norm(mean[1] - mean[0]))
    return (
        f"{seen.names[a]} and {seen.names[b]} are {surveyed:.2f} m apart in the survey and {seen_m:.2f} m in the map, "
        f"more than {2.0 * most_m:.2f} m amiss"
    )


def _hint(seen: Sightings, present: I64, gate_m: float, most_m: float, min_separation_m: float) -> str:
    """The commonest mistake of all, where there are enough targets to prove it."""
    if len(present) < 3:
        return ""
    exchanged = replace(seen, surveyed_grid=seen.surveyed_grid[:, [1, 0, 2]])
    found = _agreed(exchanged, present, gate_m, most_m, min_separation_m)
    return "" if found.T_grid_map is None else "; they agree with easting and northing exchanged"


def _distances_m(seen: Sightings, placements: F64) -> F64:
    """(p, n) how far from its target each sighting comes to lie."""
    placed = np.einsum("pij,nj->pni", placements[:, :3, :3], seen.points_map) + placements[:, None, :3, 3]
    return np.linalg.norm(placed - seen.surveyed_grid[seen.target], axis=2)


def _target_distances(seen: Sightings, present: I64, placements: F64) -> F64:
    """(p, m) the median distance of each target's sightings."""
    distance = _distances_m(seen, placements)
    return np.stack([np.median(distance[:, seen.target == k], axis=1) for k in present], axis=1)


def _target_weights(seen: Sightings, fits: Bool) -> F64:
    """Weights of the fitting sightings: every target counts as much as any other."""
    counts = np.bincount(seen.target[fits], minlength=len(seen.names))
    return 1.0 / counts[seen.target[fits]]


def _least_squares(seen: Sightings, fits: Bool) -> F64:
    """(4, 4) yaw and translation that fit best; closed form."""
    weight = _target_weights(seen, fits)
    p, g = seen.points_map[fits], seen.surveyed_grid[seen.target[fits]]
    middle_p, middle_g = weight @ p / weight.sum(), weight @ g / weight.sum()
    p, g = p - middle_p, g - middle_g
    yaw = np.arctan2(weight @ (p[:, 0] * g[:, 1] - p[:, 1] * g[:, 0]), weight @ (p[:, 0] * g[:, 0] + p[:, 1] * g[:, 1]))
    rotation = _about_z(np.array([yaw]))[0]
    return se3.from_rt(rotation, middle_g - rotation @ middle_p)


def _about_z(yaw_rad: F64) -> F64:
    """(n, 3, 3) turns about the vertical."""
    out = np.zeros((len(yaw_rad), 3, 3))
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1], out[:, 2, 2] = c, -s, s, c, 1.0
    return out
