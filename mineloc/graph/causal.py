"""The estimate at the time: each keyframe as known when it was made (iSAM2)."""

from __future__ import annotations

import gtsam
import numpy as np

from mineloc import se3
from mineloc.data import F64
from mineloc.graph.pose_graph import ROBUST, PoseGraph, poses_of

_RELINEARIZE_EVERY = 10  # updates, when there is nothing but odometry and gravity
_SETTLED = 1e-3  # metres, or of a rotation matrix
_MAX_REPEATS = 10


class CausalEstimate:
    """Follows a `PoseGraph` as it grows.

    Everything that was added to the graph since the last call enters with the next `update`.
    """

    def __init__(self, graph: PoseGraph) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(graph.config.relinearize_threshold)
        params.relinearizeSkip = _RELINEARIZE_EVERY
        params.setFactorization("QR")  # with Cholesky a chain of 700 keyframes can be indeterminate
        self._graph = graph
        self._isam = gtsam.ISAM2(params)
        self._factors = 0
        self._known = 0
        self._newest: F64 = np.eye(4)

    def update(self) -> F64:
        """(4, 4) `T_map_lidar` of the newest keyframe, from what was measured up to now.

        Raises:
            ValueError: the graph has no keyframes.
        """
        graph = self._graph
        if not len(graph):
            raise ValueError("a graph without keyframes")
        values = gtsam.Values()
        for index in range(self._known, len(graph)):
            # odometry from the newest estimate, or from the start
            guess = graph.initial[index] if self._known == 0 else self._carried(index)
            values.insert(index, gtsam.Pose3(guess))
        is_robust = any(factor.kind in ROBUST for factor in graph.factors[self._factors :])
        self._isam.update(graph.gtsam_graph(since=self._factors), values)
        self._factors, self._known = len(graph.factors), len(graph)
        self._newest = self._estimate()
        for _ in range(_MAX_REPEATS if is_robust else 0):
            # each update weighs the robust factors once; they settle only by and by
            before = self._newest
            self._isam.update(force_relinearize=True)
            self._newest = self._estimate()
            if np.abs(self._newest - before).max() < _SETTLED:
                break
        return self._newest

    def poses(self) -> F64:
        """(n, 4, 4) `T_map_lidar` of all keyframes, from what was measured up to the last update."""
        return poses_of(self._isam.calculateEstimate(), self._known)

    def _estimate(self) -> F64:
        return np.asarray(self._isam.calculateEstimatePose3(self._known - 1).matrix())

    def _carried(self, index: int) -> F64:
        initial = self._graph.initial
        return se3.rigid(self._newest @ se3.inverse(initial[self._known - 1]) @ initial[index])
