"""The pose factor graph (paper A, eq. 3-7): keyframes, and what was measured about them.

Conventions are gtsam's and the project's: `[rotation, translation]`, perturbation on the right. The optimum does not
depend on them; paper A's Jacobians, left and translation first, do (METHOD 7.6).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import F64, Fix, Keyframe, RelativePose
from mineloc.graph.measurements import PointFix
from mineloc.graph.noise import anchor_covariance, edge_noise, positive_definite

Kind = Literal["prior", "gravity", "relative", "fix", "point_fix", "loop"]
ROBUST: frozenset[Kind] = frozenset({"fix", "point_fix", "loop"})


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """One factor, as gtsam has it and as we speak about it.

    Attributes:
        kind: what was measured.
        keyframes: whom it concerns.
        covariance: of its residual, without the robust kernel.
        gtsam_factor: the factor itself; robust kernel and all.
    """

    kind: Kind
    keyframes: tuple[int, ...]
    covariance: F64
    gtsam_factor: Any


class PoseGraph:
    """Collects keyframes and measurements. `batch.solve` smooths it, `causal.CausalEstimate` follows it.

    Attributes:
        config: noise and kernels.
        factors: what was added, in order.
        initial: (4, 4) first guesses of `T_map_lidar`, one a keyframe: the first pose and odometry from there.
        weak_edges: how many relative poses had a direction that only the limit of their σ holds.
    """

    def __init__(self, config: GraphConfig) -> None:
        self.config = config
        self.factors: list[Factor] = []
        self.initial: list[F64] = []
        self.weak_edges = 0

    def __len__(self) -> int:
        return len(self.initial)

    def add_first(self, keyframe: Keyframe, *, T_map_lidar: F64 | None = None, covariance: F64 | None = None) -> None:
        """The first keyframe.

        Args:
            keyframe: index 0.
            T_map_lidar: where it is; without it the map is the odometry's frame.
            covariance: (6, 6) of that; without it the map is defined by this pose.

        Raises:
            ValueError: it is not the first, or the covariance is none.
        """
        if self.initial or keyframe.index != 0:
            raise ValueError("the first keyframe is added once, and has index 0")
        pose = keyframe.T_odom_lidar if T_map_lidar is None else T_map_lidar
        noise = anchor_covariance(pose, self.config) if covariance is None else positive_definite(covariance)
        gravity = self._gravity(keyframe)
        model = gtsam.noiseModel.Gaussian.Covariance(noise)
        self.initial.append(pose)
        self._add("prior", (0,), noise, gtsam.PriorFactorPose3(0, _pose3(pose), model))
        self.factors += gravity

    def add_another(self, keyframe: Keyframe, *, T_map_lidar: F64, covariance: F64 | None = None) -> None:
        """The first keyframe of another flight; loops and fixes must tie it to the others.

        Args:
            keyframe: its index is the number of keyframes so far.
            T_map_lidar: (4, 4) where it is believed to be.
            covariance: (6, 6) of that, `[rotation, translation]`; `joined_m` and `joined_deg` by default.

        Raises:
            ValueError: the index does not continue, or "up" is no direction.
        """
        if keyframe.index != len(self) or not self.initial:
            raise ValueError(f"keyframe {keyframe.index} begins a flight after {len(self)} keyframes")
        turn, shift = np.radians(self.config.joined_deg), self.config.joined_m
        noise = np.diag([turn**2] * 3 + [shift**2] * 3) if covariance is None else positive_definite(covariance)
        gravity = self._gravity(keyframe)
        self.initial.append(T_map_lidar)
        model = gtsam.noiseModel.Gaussian.Covariance(noise)
        self._add("prior", (keyframe.index,), noise, gtsam.PriorFactorPose3(keyframe.index, _pose3(T_map_lidar), model))
        self.factors += gravity

    def add_next(self, keyframe: Keyframe, relative: RelativePose) -> None:
        """The next keyframe and the motion that leads to it.

        Args:
            keyframe: its index is the number of keyframes so far.
            relative: from the one before; Z_ij = T_i⁻¹ T_j (METHOD D1).

        Raises:
            ValueError: indices do not continue, the information is no information matrix, or "up" no direction.
        """
        if keyframe.index != len(self) or (relative.i, relative.j) != (len(self) - 1, len(self)):
            raise ValueError(f"keyframe {keyframe.index}, edge {relative.i}-{relative.j} after {len(self)} keyframes")
        noise = edge_noise(relative.information, self.config)
        gravity = self._gravity(keyframe)
        self.weak_edges += noise.is_weak
        self.initial.append(se3.rigid(self.initial[-1] @ relative.T_i_j))
        self._add_between("relative", relative, noise.covariance)
        self.factors += gravity

    def add_loop(self, relative: RelativePose) -> None:
        """A motion between keyframes that are not neighbours: a place seen again. Robust.

        Raises:
            ValueError: a keyframe is not there, both are the same, or the information is no information matrix.
        """
        self._check(relative.i, relative.j)
        if relative.i == relative.j:
            raise ValueError(f"a loop from keyframe {relative.i} to itself")
        self._add_between("loop", relative, edge_noise(relative.information, self.config).covariance)

    def replace_loops(self, loops: Iterable[RelativePose]) -> None:
        """These loop closures in place of all that were added before.

        Raises:
            ValueError: as `add_loop`.
        """
        self.factors = [factor for factor in self.factors if factor.kind != "loop"]
        for loop in loops:
            self.add_loop(loop)

    def replace_point_fixes(self, fixes: Iterable[PointFix]) -> None:
        """These point fixes in place of all that were added before.

        Raises:
            ValueError: as `add_point_fix`.
        """
        self.factors = [factor for factor in self.factors if factor.kind != "point_fix"]
        for fix in fixes:
            self.add_point_fix(fix)

    def add_fix(self, fix: Fix) -> None:
        """Pose of a keyframe in the map. Robust.

        Raises:
            ValueError: not trusted, without a positive definite covariance, or its keyframe is not there.
        """
        self._check(fix.keyframe)
        if not fix.trusted or fix.T_map_lidar is None or fix.covariance is None:
            raise ValueError("a fix must be trusted and have a covariance to enter the graph")
        model = self._robust(positive_definite(fix.covariance))
        factor = gtsam.PriorFactorPose3(fix.keyframe, _pose3(fix.T_map_lidar), model)
        self._add("fix", (fix.keyframe,), fix.covariance, factor)

    def add_point_fix(self, fix: PointFix) -> None:
        """A known point seen from a keyframe, A(22): `T t_l - C`. Robust.

        Raises:
            ValueError: its keyframe is not there, or its covariance is none.
        """
        self._check(fix.keyframe)
        model = self._robust(positive_definite(fix.covariance))
        factor = gtsam.GPSFactorArm(fix.keyframe, fix.point_map, fix.point_lidar, model)
        self._add("point_fix", (fix.keyframe,), fix.covariance, factor)

    def kernel_width(self, dimension: int) -> float:
        """Cauchy's k for a whitened residual, whose length grows with the root of its dimension."""
        return self.config.cauchy_k * float(np.sqrt(dimension))

    def gtsam_graph(self, *, since: int = 0, widened: float = 1.0) -> Any:
        """The factors from the `since`-th on, for a solver; robust kernels `widened` times as wide."""
        out = gtsam.NonlinearFactorGraph()
        for factor in self.factors[since:]:
            known = factor.gtsam_factor
            if widened != 1.0 and factor.kind in ROBUST:
                known = known.cloneWithNewNoiseModel(self._robust(factor.covariance, widened=widened))
            out.push_back(known)
        return out

    def _add_between(self, kind: Kind, relative: RelativePose, covariance: F64) -> None:
        gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
        model = self._robust(covariance) if kind in ROBUST else gaussian
        factor = gtsam.BetweenFactorPose3(relative.i, relative.j, _pose3(relative.T_i_j), model)
        self._add(kind, (relative.i, relative.j), covariance, factor)

    def _gravity(self, keyframe: Keyframe) -> list[Factor]:
        if keyframe.up_lidar is None or not self.config.use_gravity:
            return []
        sigma = np.radians(self.config.gravity_sigma_deg)
        factor = gtsam.AttitudeFactorPose3(
            keyframe.index,
            gtsam.Unit3(np.array([0.0, 0.0, 1.0])),
            gtsam.noiseModel.Isotropic.Sigma(2, sigma),
            gtsam.Unit3(_unit(keyframe.up_lidar)),
        )
        return [Factor("gravity", (keyframe.index,), np.eye(2) * sigma**2, factor)]

    def _robust(self, covariance: F64, *, widened: float = 1.0) -> Any:
        gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
        if not self.config.robust:
            return gaussian
        kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(widened * self.kernel_width(len(covariance)))
        return gtsam.noiseModel.Robust.Create(kernel, gaussian)

    def _check(self, *keyframes: int) -> None:
        for index in keyframes:
            if not 0 <= index < len(self):
                raise ValueError(f"keyframe {index} of {len(self)}")

    def _add(self, kind: Kind, keyframes: tuple[int, ...], covariance: F64, factor: Any) -> None:
        self.factors.append(Factor(kind, keyframes, covariance, factor))


def values_of(poses: Sequence[F64]) -> Any:
    """gtsam's Values with the index of the keyframe for a key."""
    values = gtsam.Values()
    for index, pose in enumerate(poses):
        values.insert(index, _pose3(pose))
    return values


def poses_of(values: Any, count: int) -> F64:
    """(count, 4, 4) poses of keys 0 … count - 1."""
    return np.array([values.atPose3(index).matrix() for index in range(count)]).reshape(-1, 4, 4)


def _unit(direction: F64) -> F64:
    length = float(np.linalg.norm(direction))
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"no direction: {direction}")
    return direction / length


def _pose3(T: F64) -> Any:
    return gtsam.Pose3(T)
