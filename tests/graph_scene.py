"""A tour between intersections, measured with the noise that the factors believe in."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mineloc import se3
from mineloc.config import GraphConfig
from mineloc.data import Fix, Keyframe, RelativePose
from mineloc.graph.causal import CausalEstimate
from mineloc.graph.measurements import PointFix
from mineloc.graph.pose_graph import PoseGraph

SIGMA = np.r_[np.radians([0.03, 0.03, 0.04]), [0.04, 0.03, 0.03]]  # METHOD 7.2, one metre
NO_POINTS = np.zeros((0, 3), np.float32)


@dataclass
class Tour:
    """`truth` (n, 4, 4) a metre apart; `visits` [(keyframe, intersection)]; the last keyframe is a visit."""

    truth: np.ndarray
    visits: list[tuple[int, int]]
    places: np.ndarray
    rng: np.random.Generator
    graph: PoseGraph = field(default_factory=lambda: PoseGraph(GraphConfig()))
    causal: list[np.ndarray] = field(default_factory=list)


def tour(*, visits: int, spacing_m: int, seed: int) -> Tour:
    rng = np.random.default_rng(seed)
    places = np.array([[i * spacing_m, j * spacing_m, 2.0 * ((i + j) % 2)] for i in range(3) for j in range(3)], float)
    here, before, points, seen = 0, -1, [places[0]], []
    for _ in range(visits):
        i, j = divmod(here, 3)
        around = [a * 3 + b for a, b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)) if 0 <= a < 3 and 0 <= b < 3]
        there = int(rng.choice([k for k in around if k != before]))
        step = (places[there] - places[here]) / spacing_m
        points += [places[here] + step * k for k in range(1, spacing_m + 1)]
        seen.append((len(points) - 1, there))
        before, here = here, there
    path = np.array(points)
    heading = np.gradient(path, axis=0)
    xi = np.zeros((len(path), 6))
    xi[:, 2] = np.arctan2(heading[:, 1], heading[:, 0])
    xi[:, :2] = rng.normal(size=(len(path), 2)) * 0.03
    truth = se3.exp(xi)
    truth[:, :3, 3] = path
    return Tour(truth, seen, places, rng)


def measure(
    scene: Tour,
    config: GraphConfig | None = None,
    *,
    wrong: int = 0,
    sigma_m: float = 0.15,
    gravity: bool = False,
    as_pose: bool = False,
    causal: bool = False,
) -> Tour:
    """Fill the graph; `wrong` of the visits name another intersection."""
    rng, truth = scene.rng, scene.truth
    graph = scene.graph = PoseGraph(config or GraphConfig())
    follow = CausalEstimate(graph) if causal else None
    misled = set(rng.choice(len(scene.visits), wrong, replace=False).tolist())
    known = {k: (place, v in misled) for v, (k, place) in enumerate(scene.visits)}
    T_odom = truth[0]
    for k in range(len(truth)):
        up = truth[k, :3, :3].T @ [0, 0, 1.0] + rng.normal(size=3) * np.radians(1.0) if gravity else None
        if k == 0:
            graph.add_first(Keyframe(0, 0, T_odom, NO_POINTS, up))
        else:
            motion = se3.inverse(truth[k - 1]) @ truth[k] @ se3.exp(rng.normal(size=6) * SIGMA)
            T_odom = T_odom @ motion
            graph.add_next(
                Keyframe(k, k * 10**9, T_odom, NO_POINTS, up), RelativePose(k - 1, k, motion, np.diag(SIGMA**-2))
            )
        if k in known:
            place, is_wrong = known[k]
            other = int(rng.choice([p for p in range(len(scene.places)) if p != place]))
            shift = scene.places[other] - scene.places[place] if is_wrong else np.zeros(3)
            _add_visit(graph, k, truth[k], shift, sigma_m, rng, as_pose=as_pose)
        if follow is not None:
            scene.causal.append(follow.update())
    return scene


def _add_visit(graph: PoseGraph, k: int, truth, shift, sigma_m: float, rng, *, as_pose: bool) -> None:
    if as_pose:
        sigma = np.r_[np.radians([0.5] * 3), [sigma_m] * 3]
        T = truth @ se3.exp(rng.normal(size=6) * sigma)
        T[:3, 3] += shift
        graph.add_fix(Fix(k, k, T, np.diag(sigma**2), True))
        return
    seen = rng.normal(size=3) * 4
    place = se3.apply(truth, seen[None])[0] + shift
    graph.add_point_fix(PointFix(k, place, seen + rng.normal(size=3) * sigma_m, np.eye(3) * sigma_m**2))


def rmse_m(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((poses[:, :3, 3] - truth[:, :3, 3]) ** 2, axis=1))))
