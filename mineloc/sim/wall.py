"""A wall of rock that was put across a roadway: as large as the roadway is there, with rough faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mineloc.errors import SimulationError
from mineloc.sim.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

THICKNESS_M = 1.0
WIDEST_M = 20.0
CELL_M = 0.2
ROUGH_M, ROUGH_OVER_M, FINE_M = 0.10, 0.4, 0.02
BULGE_M = 0.25
# how far the wall reaches into the rock: the first of these that leaves no gap behind a nook
INTO_ROCK_M = (0.3, 0.6, 1.0, 1.5, 2.0)
# the faces bulge, so a roadway that widens there must be filled too
REACH_M = THICKNESS_M / 2 + BULGE_M


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """An upright box; its own axes are along the bearing, to the left of it, and up.

    Attributes:
        centre_m: (3,) in the map frame.
        bearing_rad: of the roadway that it blocks, counter-clockwise from x.
        right_m, left_m: its sides, from the centre to the left (`right_m` is negative).
        low_m, high_m: its bottom and top, from the centre up (`low_m` is negative).
    """

    centre_m: F64
    bearing_rad: float
    right_m: float
    left_m: float
    low_m: float
    high_m: float

    @property
    def axes(self) -> F64:
        """(3, 3) rows: along, left, up in the map frame."""
        c, s = np.cos(self.bearing_rad), np.sin(self.bearing_rad)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def grown(self, by_m: float) -> Wall:
        """The same wall, larger on all four sides."""
        sides = self.right_m - by_m, self.left_m + by_m, self.low_m - by_m, self.high_m + by_m
        return Wall(self.centre_m, self.bearing_rad, *sides)


def fit_wall(scene: Scene, place_m: F64, foot_m: F64, bearing_rad: float, *, where: str) -> Wall:
    """The wall through a place, square to a bearing, that fills what can be seen of the roadway's cross-section.

    Args:
        scene: the mine.
        place_m: (3,) in the wall, map frame.
        foot_m: (3,) the point of the roadway's centre-line, on the floor, that is nearest to it.
        bearing_rad: counter-clockwise from x.
        where: the configuration key, for messages.

    Raises:
        SimulationError: no floor or roof there, or no rock on both sides to join.
    """
    along = np.array([np.cos(bearing_rad), np.sin(bearing_rad), 0.0])
    probe = foot_m + ((place_m - foot_m) @ along) * along + np.array([0.0, 0.0, 1.0])
    down, up = (float(scene.ranges_m(probe[None], [0.0, 0.0, z])[0]) for z in (-1.0, 1.0))
    if not np.isfinite(down + up):
        raise SimulationError(
            where, "no floor or roof there", expected="a roadway closed below and above", todo="choose another place"
        )
    centre = probe + np.array([0.0, 0.0, (up - down) / 2])
    seen = _seen(scene, Wall(centre, bearing_rad, 0.0, 0.0, 0.0, 0.0))
    if np.linalg.norm(seen, axis=1).max() > WIDEST_M:
        raise SimulationError(
            where,
            f"open for over {WIDEST_M:.0f} m square to the bearing {np.rad2deg(bearing_rad):g}°",
            expected="rock on all sides",
            todo="check the bearing (it goes along the roadway), or move the wall away from the intersection",
        )
    (right, low), (left, high) = seen.min(axis=0), seen.max(axis=0)
    snug = Wall(centre, bearing_rad, float(right), float(left), float(low), float(high))
    for margin in INTO_ROCK_M:
        wall = snug.grown(margin)
        if _rim_in_rock(scene, wall):
            return wall
    raise SimulationError(
        where,
        f"open behind a wall {left - right:.1f} m wide and {high - low:.1f} m high, or beside another roadway",
        expected=f"{INTO_ROCK_M[0]} m of rock around it",
        todo="move the wall along the roadway",
    )


def _seen(scene: Scene, centre: Wall) -> F64:
    """(n, 2) to the left and up: where rays square to the bearing end, along the wall's thickness."""
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    fan = np.column_stack([np.cos(angle), np.sin(angle)])
    out: list[F64] = []
    for shift in np.linspace(-REACH_M, REACH_M, 7):
        ahead = np.sign(shift) * centre.axes[0]
        if shift and scene.ranges_m(centre.centre_m[None], ahead)[0] <= abs(shift):
            continue
        origins = np.tile(centre.centre_m + shift * centre.axes[0], (len(fan), 1))
        # infinite where nothing is met, and nought times that is no number
        free = np.minimum(scene.ranges_m(origins, fan @ centre.axes[1:]), 2 * WIDEST_M)
        out.append(free[:, None] * fan)
    return np.concatenate(out)


def _rim_in_rock(scene: Scene, wall: Wall) -> bool:
    """Whether the edges of the wall stay on one side of the mine's surface."""
    sides = np.array(
        [
            [wall.right_m, wall.low_m],
            [wall.left_m, wall.low_m],
            [wall.left_m, wall.high_m],
            [wall.right_m, wall.high_m],
        ]
    )
    step = np.roll(sides, -1, axis=0) - sides
    length = np.linalg.norm(step, axis=1)
    for shift in np.linspace(-REACH_M, REACH_M, 7):
        corners = wall.centre_m + shift * wall.axes[0] + sides @ wall.axes[1:]
        if (scene.ranges_m(corners, step / length[:, None] @ wall.axes[1:]) < length).any():
            return False
    return True


def wall_mesh(wall: Wall, rng: np.random.Generator) -> tuple[F64, I64]:
    """Vertices (n, 3) in the map frame and triangles (m, 3) of a wall, closed, wound to face the free space.

    Args:
        wall: its place and size; the faces bulge from it by 0.25 m at most.
        rng: the roughness of the faces: a perfect plane would be a landmark that no mine has.
    """
    left = np.linspace(wall.right_m, wall.left_m, int(np.ceil((wall.left_m - wall.right_m) / CELL_M)) + 1)
    up = np.linspace(wall.low_m, wall.high_m, int(np.ceil((wall.high_m - wall.low_m) / CELL_M)) + 1)
    grid = np.stack(np.meshgrid(left, up, indexing="ij"), axis=-1).reshape(-1, 2)
    shape = len(left), len(up)
    front, back = (np.column_stack([s * (THICKNESS_M / 2 + _bulge(shape, rng)), grid]) for s in (1.0, -1.0))
    vertices = wall.centre_m + np.concatenate([front, back]) @ wall.axes
    index = np.arange(len(grid)).reshape(shape)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    face = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    # once round the rim, counter-clockwise as seen against the bearing
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    after, behind = np.roll(rim, -1), len(grid)
    sides = np.concatenate(
        [np.stack([rim + behind, after + behind, after], axis=1), np.stack([rim + behind, after, rim], axis=1)]
    )
    return vertices, np.concatenate([face, face[:, ::-1] + behind, sides]).astype(np.int64)


def _bulge(shape: tuple[int, int], rng: np.random.Generator) -> F64:
    """(n,) how far a face stands out of its plane: waves of decimetres, and grain."""
    blur = ROUGH_OVER_M / CELL_M
    # a Gaussian of width b leaves 1/(2 b √π) of the deviation of white noise on a plane
    waves = gaussian_filter(rng.standard_normal(shape), blur, mode="reflect") * 2 * blur * np.sqrt(np.pi)
    return np.clip(ROUGH_M * waves + FINE_M * rng.standard_normal(shape), -BULGE_M, BULGE_M).ravel()
