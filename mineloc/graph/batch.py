"""All keyframes at once: the smoothed estimate, its covariances, and how well it fits what was measured."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import gtsam
import numpy as np

from mineloc.data import F64, Bool
from mineloc.graph.pose_graph import ROBUST, Kind, PoseGraph, poses_of, values_of

_WIDTHS = (64.0, 16.0, 4.0)
_EARLY_TOLERANCE = 1e-3
_LAST_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class Fit:
    """How one kind of factor fits the solution, without robust kernels.

    Attributes:
        count: factors of the kind.
        dimension: of the residual of each.
        chi2: sum of the squared whitened residuals; about `count * dimension` minus the freedom of the poses when
            the noise is as modelled.
        worst: largest whitened residual of a factor, in σ.
        outvoted: how many of them `Solution.outvoted` names.
    """

    kind: Kind
    count: int
    dimension: int
    chi2: float
    worst: float
    outvoted: int

    @property
    def chi2_per_dof(self) -> float:
        """`chi2` a residual component; 1 when the noise is as modelled and the poses are well determined."""
        return self.chi2 / (self.count * self.dimension)

    def to_dict(self) -> dict[str, str | int | float]:
        """Plain values by name."""
        return {**asdict(self), "chi2_per_dof": self.chi2_per_dof}


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The smoothed estimate.

    Attributes:
        poses: (n, 4, 4) `T_map_lidar` of the keyframes.
        covariances: (n, 6, 6) marginals, `[rotation, translation]`, right perturbation.
        fits: one entry a kind of factor.
        distances: (f,) whitened residual of every factor of the graph, in its order, in σ.
        outvoted: (f,) factors that their robust kernel left less than a tenth of their weight.
        iterations: steps of the solver.
        weak_edges: relative poses with a direction that only the limit of their σ holds.
    """

    poses: F64
    covariances: F64
    fits: tuple[Fit, ...]
    distances: F64
    outvoted: Bool
    iterations: int
    weak_edges: int


def solve(graph: PoseGraph, *, initial: F64 | None = None) -> Solution:
    """Levenberg-Marquardt over all factors, A(7).

    Robust kernels begin wide and are narrowed step by step (graduated non-convexity, Yang et al. 2020): a narrow one
    would call every fix an outlier that odometry is still far from, and never take it back.

    Args:
        graph: at least one keyframe.
        initial: (n, 4, 4) first guesses; odometry without.

    Raises:
        ValueError: an empty graph, or `initial` of another length.
    """
    if not len(graph):
        raise ValueError("a graph without keyframes")
    if initial is not None and len(initial) != len(graph):
        raise ValueError(f"{len(initial)} first guesses for {len(graph)} keyframes")
    values = values_of(graph.initial if initial is None else list(initial))
    iterations = 0
    is_robust = graph.config.robust and any(factor.kind in ROBUST for factor in graph.factors)
    for width in (*_WIDTHS, 1.0) if is_robust else (1.0,):
        params = gtsam.LevenbergMarquardtParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")
        params.setMaxIterations(graph.config.max_iterations)
        params.setRelativeErrorTol(_LAST_TOLERANCE if width == 1.0 else _EARLY_TOLERANCE)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph.gtsam_graph(widened=width), values, params)
        values = optimizer.optimize()
        iterations += optimizer.iterations()
    distances = _distances(graph, values)
    outvoted = distances > _outvoting(graph)
    return Solution(
        poses=poses_of(values, len(graph)),
        covariances=_marginals(graph, values),
        fits=_fits(graph, distances, outvoted),
        distances=distances,
        outvoted=outvoted,
        iterations=iterations,
        weak_edges=graph.weak_edges,
    )


def _marginals(graph: PoseGraph, values: Any) -> F64:
    """gtsam's `Marginals` knows Cholesky alone, for which a flight of some thousand keyframes is indeterminate."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    isam = gtsam.ISAM2(params)
    isam.update(graph.gtsam_graph(), values)
    return np.array([isam.marginalCovariance(index) for index in range(len(graph))])


def _distances(graph: PoseGraph, values: Any) -> F64:
    """Whitened residuals; the factor's own would already be weighted by its kernel."""
    out = np.empty(len(graph.factors))
    for k, factor in enumerate(graph.factors):
        residual = factor.gtsam_factor.unwhitenedError(values)
        out[k] = residual @ np.linalg.solve(factor.covariance, residual)
    return np.sqrt(np.maximum(out, 0.0))


def _outvoting(graph: PoseGraph) -> F64:
    """(f,) distances from which on a factor counts for less than a tenth: Cauchy's weight is 1 / (1 + (d / k)²)."""
    if not graph.config.robust:
        return np.full(len(graph.factors), np.inf)
    return np.array(
        [3.0 * graph.kernel_width(len(f.covariance)) if f.kind in ROBUST else np.inf for f in graph.factors]
    )


def _fits(graph: PoseGraph, distances: F64, outvoted: Bool) -> tuple[Fit, ...]:
    dimension: dict[Kind, int] = {factor.kind: len(factor.covariance) for factor in graph.factors}
    fits: list[Fit] = []
    for kind, size in dimension.items():
        mask = np.array([factor.kind == kind for factor in graph.factors])
        d = distances[mask]
        fits.append(Fit(kind, len(d), size, float(d @ d), float(d.max()), int(outvoted[mask].sum())))
    return tuple(fits)
