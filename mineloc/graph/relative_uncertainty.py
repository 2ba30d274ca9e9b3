"""What is known of one keyframe from another: along the odometry between them, or across a loop closure.

First-order propagation (METHOD 7.2, condensed graph), but in the frame of the map: there the covariances of the edges
of a chain simply add up, so that the one between any two keyframes is a difference of two sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import F64, I64, Bool, RelativePose
from mineloc.graph.noise import edge_noise


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where keyframe j is expected, seen from keyframe i.

    Attributes:
        T_i_j: (4, 4).
        covariance: (6, 6) `[rotation, translation]`, right perturbation of j.
    """

    T_i_j: F64
    covariance: F64

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position, all axes together."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))


class RelativeUncertainty:
    """Grows with the flight: `add` each keyframe, `close` each loop that was accepted.

    What it tells is the better of two ways: the odometry chain, or one loop closure with the odometry before and
    after it. Ways over several closures are not looked for: the covariance is an upper bound.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        # grown by doubling; the sums are of the edges' covariances, left perturbation in the odometry frame
        self._poses: F64 = np.zeros((64, 4, 4))
        self._sums: F64 = np.zeros((64, 6, 6))
        self._count = 0
        self._loops: list[RelativePose] = []
        self._across: list[F64] = []

    def __len__(self) -> int:
        return self._count

    def add(self, T_odom_lidar: F64, relative: RelativePose | None) -> None:
        """The next keyframe by odometry alone, and the edge that leads to it; None begins another flight.

        Another flight's odometry frame must be the first one's, as well as it is known (`joined_m`, `joined_deg`).

        Raises:
            ValueError: the information of the edge is no information matrix.
        """
        n = self._count
        if n == len(self._poses):
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
            self._sums = np.concatenate([self._sums, np.zeros_like(self._sums)])
        self._poses[n] = T_odom_lidar
        if n:
            edge = self._between_flights(n) if relative is None else self._moved(n, relative)
            self._sums[n] = self._sums[n - 1] + edge
        self._count += 1

    def close(self, loop: RelativePose) -> None:
        """A loop closure: from now on ways lead across it.

        Raises:
            ValueError: its information is no information matrix.
        """
        self._across.append(self._moved(loop.j, loop))
        self._loops.append(loop)

    def between(self, i: int, j: int) -> Prediction:
        """The better prediction of T_i_j."""
        to_j = se3.adjoint(se3.inverse(self._poses[j]))
        ways = self._apart(np.array([i]), np.array([j]))
        if self._loops:
            a, b = np.array([(loop.i, loop.j) for loop in self._loops]).T
            across = np.array(self._across)
            forward = self._apart(np.full(len(a), i), a) + across + self._apart(b, np.full(len(b), j))
            backward = self._apart(np.full(len(b), i), b) + across + self._apart(a, np.full(len(a), j))
            ways = np.concatenate([ways, forward, backward])
        ways = to_j @ ways @ to_j.T
        best = int(np.einsum("nii->n", ways[:, 3:, 3:]).argmin())
        return Prediction(self._along(best, i, j), ways[best])

    def along(self, i: int, j: I64) -> tuple[F64, F64]:
        """(n, 4, 4) T_i_j and (n, 6, 6) covariance, as `Prediction`, of several keyframes by odometry alone."""
        T = se3.rigid(se3.inverse(self._poses[i])[None] @ self._poses[j])
        to_j = se3.adjoint(se3.inverse(self._poses[j]))
        return T, to_j @ self._apart(np.full(len(j), i), j) @ np.swapaxes(to_j, 1, 2)

    def consistent(self, one: RelativePose, others: Sequence[RelativePose]) -> Bool:
        """(n,) whether pairs of loop closures agree by the odometry alone: a cycle must come back to where it began.

        Mangelson et al., *Pairwise consistent measurement set maximization*, ICRA 2018. A pair agrees when the cycle's
        error is within three standard deviations a component, of the two closures and the odometry between.
        """
        return self._consistent(one, self._moved(one.j, one), others, self._noise_of(others))

    def agreement(self, loops: Sequence[RelativePose]) -> Bool:
        """(n, n) whether each two of the closures agree, as `consistent`."""
        noise = self._noise_of(loops)
        rows = [self._consistent(loop, own, loops, noise) for loop, own in zip(loops, noise, strict=True)]
        return np.array(rows, np.bool_).reshape(len(loops), len(loops))

    def _noise_of(self, loops: Sequence[RelativePose]) -> F64:
        return np.array([self._moved(loop.j, loop) for loop in loops]).reshape(-1, 6, 6)

    def _consistent(self, one: RelativePose, noise: F64, others: Sequence[RelativePose], their_noise: F64) -> Bool:
        if not others:
            return np.zeros(0, np.bool_)
        i, j = np.array([(loop.i, loop.j) for loop in others]).T
        T = np.array([loop.T_i_j for loop in others])
        own = self._poses
        # j -> i -> i' -> j' -> j
        cycle = se3.inverse(one.T_i_j) @ (se3.inverse(own[one.i]) @ own[i]) @ T @ (se3.inverse(own[j]) @ own[one.j])
        spread = self._apart(i, np.full(len(i), one.i)) + self._apart(j, np.full(len(j), one.j))
        spread = spread + noise + their_noise
        to_j = se3.adjoint(se3.inverse(own[one.j]))
        error = se3.log(se3.rigid(cycle))
        whitened = np.linalg.solve(to_j @ spread @ to_j.T, error[:, :, None])[:, :, 0]
        return np.einsum("ni,ni->n", error, whitened) <= 6 * 3.0**2

    def _along(self, way: int, i: int, j: int) -> F64:
        if way == 0:
            return se3.rigid(se3.inverse(self._poses[i]) @ self._poses[j])
        turn, k = divmod(way - 1, len(self._loops))
        loop = self._loops[k]
        a, b, T_a_b = (loop.j, loop.i, se3.inverse(loop.T_i_j)) if turn else (loop.i, loop.j, loop.T_i_j)
        there = se3.inverse(self._poses[i]) @ self._poses[a]
        return se3.rigid(there @ T_a_b @ se3.inverse(self._poses[b]) @ self._poses[j])

    def _moved(self, j: int, relative: RelativePose) -> F64:
        """The covariance of an edge to keyframe j as one of a left perturbation in the odometry frame."""
        moved = se3.adjoint(self._poses[j])
        return moved @ edge_noise(relative.information, self._config).covariance @ moved.T

    def _between_flights(self, j: int) -> F64:
        turn, shift = np.radians(self._config.joined_deg), self._config.joined_m
        moved = se3.adjoint(self._poses[j])
        return moved @ np.diag([turn**2] * 3 + [shift**2] * 3) @ moved.T

    def _apart(self, a: I64, b: I64) -> F64:
        """(n, 6, 6) what the edges between keyframes a and b add up to."""
        return self._sums[np.maximum(a, b)] - self._sums[np.minimum(a, b)]
