"""A machine that drives ahead of the drone: a box that the LiDAR sees and that is nowhere in the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit
from mineloc.sim.motion import Motion
from mineloc.sim.scene import Hits, Scene

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# a small loader: length, width, height
SIZE_M = np.array([4.0, 1.7, 1.8])
LEAD_S = 5.0
NEAREST_M = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Machine:
    """A loader that is where the drone will be in five seconds, on the floor.

    It is away (in some side drift) while the drone comes nearer to it than five metres: turning round and hovering.

    Attributes:
        motion: the drone's.
        scene: the mine.
    """

    motion: Motion
    scene: Scene

    def pose(self, t_s: float) -> F64 | None:
        """(4, 4) place of the box's centre in the map frame, x ahead; None while it is away."""
        here, there = self.motion.pose(np.array([t_s, min(t_s + LEAD_S, self.motion.end_s)]))
        down = self.scene.ranges_m(there[None, :3, 3], [0.0, 0.0, -1.0])[0]
        if np.linalg.norm(there[:3, 3] - here[:3, 3]) < NEAREST_M or not np.isfinite(down):
            return None
        ahead = there[:2, 0] / np.linalg.norm(there[:2, 0])
        out = np.eye(4)
        out[:2, 0], out[:2, 1] = ahead, [-ahead[1], ahead[0]]
        out[:3, 3] = there[:3, 3] - [0.0, 0.0, down - SIZE_M[2] / 2]
        return out


def in_front(hits: Hits, rays: F32, T_scene_box: F64, size_m: F64 = SIZE_M) -> Hits:
    """The hits with those that a box takes away from the walls.

    Args:
        hits: what (n, 6) rays met without the box.
        rays: origins and directions in the scene's frame.
        T_scene_box: (4, 4) place of the box's centre.
        size_m: (3,).
    """
    ranges, normals = hits.range_m.copy(), hits.normals.copy()
    _take(ranges, normals, rays, T_scene_box, size_m / 2)
    return Hits(ranges, normals)


@njit(cache=True, nogil=True)
def _take(ranges: F32, normals: F32, rays: F32, T: F64, half: F64) -> None:
    for i in range(len(rays)):
        near, far, side = 0.0, np.inf, -1
        for a in range(3):
            # the ray in the box's frame: slabs of Kay and Kajiya 1986
            o = d = 0.0
            for b in range(3):
                o += T[b, a] * (rays[i, b] - T[b, 3])
                d += T[b, a] * rays[i, b + 3]
            if abs(d) < 1e-12:
                if abs(o) > half[a]:
                    far = -1.0
                continue
            enter, leave = (-half[a] - o) / d, (half[a] - o) / d
            if enter > leave:
                enter, leave = leave, enter
            if enter > near:
                near, side = enter, a
            far = min(far, leave)
        if side >= 0 and near <= far and near < ranges[i]:
            ranges[i] = near
            for b in range(3):
                normals[i, b] = T[b, side]
