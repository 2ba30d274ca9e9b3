"""Mines that come with mineloc, by name."""

from __future__ import annotations

import numpy as np

from mineloc.sim.plan import MinePlan, RoughnessPlan, roadway


def demo() -> MinePlan:
    """Rough drifts in two panels with a ramp between: 455 m, four loops, T, Y and X intersections, 4 m of grade."""
    return MinePlan(
        name="demo",
        roughness=RoughnessPlan(wall_m=0.10, longest_m=2.0, shortest_m=0.5, fine_m=0.025),
        roadway=(
            # haulage drift, gently curved
            roadway([(0, 0, 0), (20, 1, 0), (42, 5, 0.2), (64, 6, 0.4), (88, 2, 0.6)], width_m=4.4, height_m=3.4),
            # cross-cut north: T at both ends
            roadway([(42, 5, 0.2), (40, 22, 0.6), (41, 40, 1.2)], width_m=3.8, height_m=3.1),
            # leaves the haulage obliquely: Y
            roadway([(20, 1, 0), (28, 14, 0.2), (40, 22, 0.6)], width_m=3.6, height_m=3.0),
            # north drift
            roadway([(12, 44, 1.2), (41, 40, 1.2), (62, 38, 2.0), (86, 34, 3.4)], width_m=4.0, height_m=3.2),
            # crosses the haulage (X) and climbs to the north drift: the ramp
            roadway([(66, -22, -0.6), (64, 6, 0.4), (74, 20, 2.0), (86, 34, 3.4)], width_m=4.0, height_m=3.2),
            # east loop
            roadway([(88, 2, 0.6), (104, 12, 1.8), (102, 28, 3.2), (86, 34, 3.4)], width_m=4.2, height_m=3.3),
            # west loop
            roadway([(12, 44, 1.2), (-3, 33, 0.8), (13, 22, 0.0), (28, 14, 0.2)], width_m=3.6, height_m=3.0),
            # blind drifts
            roadway([(104, 12, 1.8), (122, 7, 1.8)], width_m=3.6, height_m=3.0),
            roadway([(66, -22, -0.6), (52, -31, -0.8), (30, -27, -1.0)], width_m=3.8, height_m=3.0),
        ),
    )


def straight() -> MinePlan:
    """A straight, smooth tunnel of 200 m without an intersection: nothing tells where along it one is."""
    return MinePlan(
        name="straight",
        roughness=RoughnessPlan(wall_m=0.0, fine_m=0.0),
        roadway=(roadway([(0, 0, 0), (200, 0, 0)], width_m=4.0, height_m=3.0),),
    )


def loop() -> MinePlan:
    """One rough drift that comes back to where it began, 188 m round, with a stub to start from."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = [(30 * float(np.cos(a)), 30 * float(np.sin(a)), 1.0 - float(np.cos(a))) for a in angle]
    return MinePlan(
        name="loop",
        roadway=(
            roadway(ring, width_m=4.0, height_m=3.2, closed=True),
            roadway([(30, 0, 0), (48, -6, 0)], width_m=4.0, height_m=3.2),
        ),
    )


BUILTIN = {"demo": demo, "straight": straight, "loop": loop}
