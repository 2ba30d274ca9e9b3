"""A place whose walls were cut back: rock pushed away from a vertical axis, smoothly, on a mesh fine enough for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mineloc.errors import SimulationError

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

LONGEST_EDGE_M = 0.5
# where triangles would turn over
WHERE_TURNED_M = (0.25, 0.125, 0.06, 0.03, 0.015)
# the axis itself stays: floor and roof are stretched near it, not torn
CORE_M = 1.5
# full so far above and below the place, nothing beyond twice that: other levels stay
LEVEL_M = 5.0


def widen(
    vertices_m: F64, triangles: I64, place_m: F64, radius_m: float, by_m: float, *, where: str = "widened"
) -> tuple[F64, I64]:
    """Push a mesh away from the vertical axis through a place, horizontally; heights stay.

    The push is full from 1.5 m to half of the radius and falls to zero at the radius as cos². With `by_m` at most a
    quarter of the radius it maps space onto itself in order; triangles follow it without turning over when they are
    small enough, so they are made smaller where one does.

    Args:
        vertices_m: (n, 3) in the map frame.
        triangles: (m, 3).
        place_m: (3,) on the axis; 10 m above and below it nothing moves.
        radius_m: within which rock moves, horizontally.
        by_m: how far.
        where: the configuration key, for messages.

    Returns:
        (n + k, 3) vertices, the first n in their order and those outside as they were, and (m + j, 3) triangles.

    Raises:
        ValueError: `by_m` is more than a quarter of the radius, or not positive.
        SimulationError: triangles so thin that they turn over at any size.
    """
    if not 0 < by_m <= radius_m / 4:
        raise ValueError(f"by_m = {by_m}: more than 0 and at most a quarter of the radius, {radius_m / 4}")
    fine_m, finer = _subdivided(vertices_m, triangles, lambda a, b: _long(a, b, place_m, radius_m))
    for longest_m in WHERE_TURNED_M:
        pushed = _pushed(fine_m, place_m, radius_m, by_m)
        turned = _turned(fine_m, pushed, finer)
        if not len(turned):
            return pushed, finer
        fine_m, finer = _subdivided(fine_m, finer, _near(fine_m[turned].mean(axis=1), longest_m))
    raise SimulationError(
        where,
        "triangles that turn over",
        expected="a mesh without slivers",
        todo="repair the mesh, or choose a smaller by_m or a larger radius_m",
    )


def _pushed(points_m: F64, place_m: F64, radius_m: float, by_m: float) -> F64:
    """(n, 3) where points go."""
    away = points_m[:, :2] - place_m[:2]
    distance = np.linalg.norm(away, axis=1)
    push = by_m * _share(distance, np.abs(points_m[:, 2] - place_m[2]), radius_m)
    moves = push > 0
    out = points_m.copy()
    out[moves, :2] += away[moves] / distance[moves, None] * push[moves, None]
    return out


def _share(distance_m: F64, height_m: F64, radius_m: float) -> F64:
    """(n,) share of the push at a distance from the axis and a height over or under the place, 0 to 1."""
    plateau = radius_m / 2
    rise = np.sin(np.pi / 2 * np.clip(distance_m / min(CORE_M, plateau), 0, 1))
    fall = np.cos(np.pi / 2 * np.clip((distance_m - plateau) / (radius_m - plateau), 0, 1)) ** 2
    level = np.cos(np.pi / 2 * np.clip(height_m / LEVEL_M - 1, 0, 1)) ** 2
    inside = (distance_m < radius_m) & (height_m < 2 * LEVEL_M)
    return np.where(inside, rise * fall * level, 0.0)


def _turned(before_m: F64, after_m: F64, triangles: I64) -> I64:
    """(k, 3) triangles that face the other way than before."""
    moved = triangles[(before_m != after_m).any(axis=1)[triangles].any(axis=1)]
    normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in (before_m[moved], after_m[moved])]
    return moved[np.einsum("ni,ni->n", *normals) < 0]


def _subdivided(vertices_m: F64, triangles: I64, too_long: Callable[[F64, F64], Bool]) -> tuple[F64, I64]:
    """Halve edges that are too long until none is; new vertices come behind the old ones.

    Whether an edge is halved depends on where its ends are alone, so neighbours agree, even where a file gives every
    triangle vertices of its own.
    """
    while True:
        after = np.roll(triangles, -1, axis=1)
        long = np.stack([too_long(vertices_m[triangles[:, k]], vertices_m[after[:, k]]) for k in range(3)], axis=1)
        if not long.any():
            return vertices_m, triangles
        sides = np.sort(np.column_stack([triangles[long], after[long]]), axis=1)
        edges, edge_of = np.unique(sides, axis=0, return_inverse=True)
        middle = np.full(triangles.shape, -1, np.int64)
        middle[long] = len(vertices_m) + edge_of.ravel()
        vertices_m = np.concatenate([vertices_m, vertices_m[edges].mean(axis=1)])
        triangles = _split(triangles, middle)


def _long(a_m: F64, b_m: F64, place_m: F64, radius_m: float) -> Bool:
    """(n,) edges that are too long and may pass where rock moves."""
    length = np.linalg.norm(b_m - a_m, axis=1)
    off = (a_m + b_m) / 2 - place_m
    near = np.hypot(off[:, 0], off[:, 1]) < radius_m + length / 2
    return near & (np.abs(off[:, 2]) < 2 * LEVEL_M + length / 2) & (length > LONGEST_EDGE_M)


def _near(centres_m: F64, longest_m: float) -> Callable[[F64, F64], Bool]:
    """Tells edges that are longer than that near one of (k, 3) places."""
    tree = KDTree(centres_m)

    def too_long(a_m: F64, b_m: F64) -> Bool:
        long = np.linalg.norm(b_m - a_m, axis=1) > longest_m
        away, _ = tree.query((a_m[long] + b_m[long]) / 2, distance_upper_bound=LONGEST_EDGE_M)
        long[long] = np.isfinite(away)
        return long

    return too_long


def _split(triangles: I64, middle: I64) -> I64:
    """Triangles with (m, 3) vertices in the middle of their sides ab, bc, ca (-1: none), wound as before."""
    count = (middle >= 0).sum(axis=1)
    out = [triangles[count == 0]]
    # turned so that the first side is halved and, of two, the last is not
    turn = np.where(count == 2, (np.argmin(middle >= 0, axis=1) + 1) % 3, np.argmax(middle >= 0, axis=1))
    order = (np.arange(3) + turn[:, None]) % 3
    (a, b, c), (ab, bc, ca) = np.take_along_axis(triangles, order, 1).T, np.take_along_axis(middle, order, 1).T
    pieces = {
        1: ((a, ab, c), (ab, b, c)),
        2: ((ab, b, bc), (a, ab, bc), (a, bc, c)),
        3: ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
    }
    for halved, parts in pieces.items():
        out += [np.stack(part, axis=1)[count == halved] for part in parts]
    return np.concatenate(out)
