"""One wrong recognition must not bend the trajectory: which fixes odometry and the others outvote (METHOD 7.2).

On the graph of all keyframes graduated non-convexity takes half a minute; on the condensed one, where the odometry
between two fixes is one factor, a fraction of a second. From equal weights it now and then ends with no fix at all, so
it begins with those that agree pair by pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import F64, Bool, Fix, Keyframe, RelativePose
from mineloc.graph.noise import positive_definite
from mineloc.graph.relative_uncertainty import RelativeUncertainty

_LEAST = 3
"""Of two fixes that contradict each other nobody can say which is wrong."""
_PAIR_SIGMAS = 3.0


def outvoted_fixes(
    keyframes: Sequence[Keyframe], edges: Sequence[RelativePose | None], fixes: Sequence[Fix], config: GraphConfig
) -> list[Fix]:
    """The fixes, those that most others contradict by odometry refused.

    Mangelson et al., *Pairwise consistent measurement set maximization*, ICRA 2018, for the beginning; then Yang et
    al., *Graduated non-convexity for robust spatial perception*, RA-L 2020, with truncated least squares.

    Args:
        keyframes: of one flight, without a gap.
        edges: what leads to each of them, None for the first.
        fixes: of those keyframes; the trusted ones vote.
        config: `relative_max_m`, `relative_max_deg`, `outvote_probability`.
    """
    voting = [k for k, fix in enumerate(fixes) if fix.trusted]
    if len(voting) < _LEAST:
        return list(fixes)
    voting.sort(key=lambda k: fixes[k].keyframe)
    odometry = RelativeUncertainty(config)
    for keyframe, edge in zip(keyframes, edges, strict=True):
        odometry.add(keyframe.T_odom_lidar, edge)
    chosen = [fixes[k] for k in voting]
    weights = _weights(chosen, odometry, consistent_set(pairwise_agreement(chosen, odometry)), config)
    out = list(fixes)
    for k, weight in zip(voting, weights, strict=True):
        scores = {**fixes[k].scores, "vote": float(weight)}
        if weight < 0.5:
            reason = f"outvoted by {int((weights >= 0.5).sum())} other recognitions and odometry (weight {weight:.2f})"
            out[k] = replace(fixes[k], trusted=False, reason=reason, scores=scores)
        else:
            out[k] = replace(fixes[k], scores=scores)
    return out


def pairwise_agreement(fixes: Sequence[Fix], odometry: RelativeUncertainty) -> Bool:
    """(n, n) whether the motion between two fixes is the odometry's, within three sigmas a component.

    Args:
        fixes: trusted, by rising keyframe.
        odometry: of all keyframes.
    """
    poses, covariances = _poses(fixes), _covariances(fixes)
    keyframes = np.array([fix.keyframe for fix in fixes])
    agree = np.eye(len(fixes), dtype=np.bool_)
    for a in range(len(fixes) - 1):
        others = slice(a + 1, None)
        expected, spread = odometry.along(int(keyframes[a]), keyframes[others])
        back = se3.inverse(expected)
        error = se3.log(se3.rigid(back @ se3.inverse(poses[a]) @ poses[others]))
        carried = se3.adjoint(back)
        spread = spread + covariances[others] + carried @ covariances[a] @ np.swapaxes(carried, 1, 2)
        squared = np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[:, :, None])[:, :, 0])
        agree[a, others] = agree[others, a] = squared <= 6 * _PAIR_SIGMAS**2
    return agree


def consistent_set(agree: Bool) -> Bool:
    """(n,) a set in which all agree with all: whoever contradicts most others goes first."""
    left = np.ones(len(agree), np.bool_)
    while left.any():
        contradicted = (~agree & left).sum(axis=1) * left
        worst = int(contradicted.argmax())
        if contradicted[worst] == 0:
            break
        left[worst] = False
    return left


def _weights(fixes: Sequence[Fix], odometry: RelativeUncertainty, start: Bool, config: GraphConfig) -> F64:
    """(n,) in [0, 1], of the fixes in the order of their keyframes."""
    keyframes = sorted({fix.keyframe for fix in fixes})
    node = {keyframe: k for k, keyframe in enumerate(keyframes)}
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first = int(start.argmax())
    anchor = odometry.between(fixes[first].keyframe, keyframes[0])
    guess = se3.rigid(_poses(fixes)[first] @ anchor.T_i_j)
    values.insert(0, gtsam.Pose3(guess))
    for k, (before, here) in enumerate(pairwise(keyframes), start=1):
        moved = odometry.between(before, here)
        graph.push_back(gtsam.BetweenFactorPose3(k - 1, k, gtsam.Pose3(moved.T_i_j), _gaussian(moved.covariance)))
        guess = se3.rigid(guess @ moved.T_i_j)
        values.insert(k, gtsam.Pose3(guess))
    for fix, T, covariance in zip(fixes, _poses(fixes), _covariances(fixes), strict=True):
        graph.push_back(gtsam.PriorFactorPose3(node[fix.keyframe], gtsam.Pose3(T), _gaussian(covariance)))
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    # odometry is never in doubt here
    known = len(keyframes) - 1
    params.setKnownInliers(list(range(known)))
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    optimizer.setInlierCostThresholdsAtProbability(config.outvote_probability)
    optimizer.setWeights(np.concatenate([np.ones(known), start.astype(np.float64)]))
    optimizer.optimize()
    return np.asarray(optimizer.getWeights(), dtype=np.float64)[known:]


def _poses(fixes: Sequence[Fix]) -> F64:
    return np.array([fix.T_map_lidar for fix in fixes])


def _covariances(fixes: Sequence[Fix]) -> F64:
    return np.array([fix.covariance for fix in fixes])


def _gaussian(covariance: F64) -> Any:
    symmetric = 0.5 * (covariance + covariance.T)
    return gtsam.noiseModel.Gaussian.Covariance(positive_definite(symmetric))
