"""Mines that come with mineloc, by name."""

from __future__ import annotations

from functools import partial

import numpy as np

from mineloc.sim.plan import MinePlan, PillarPlan, RoomPlan, RoughnessPlan, roadway


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


def hall() -> MinePlan:
    """A building: a pillared hall of 30 m by 20 m, corridors around it, flat floors, smooth walls, loops everywhere.

    Made after M2DGR's hall sequences (METHOD 2.5). Nothing in it is symmetrical, so no two places look the same.
    """
    walk = partial(roadway, width_m=2.6, height_m=2.8, arch=0.0)
    niches = [(-6.5, 2.0), (-6.5, 15.5), (3.0, -6.5), (11.5, -6.5), (29.0, -6.5), (36.5, 1.5), (36.5, 17.0)]
    niches += [(1.5, 26.5), (16.0, 26.5), (20.5, 26.5), (31.0, 26.5)]
    return MinePlan(
        name="hall",
        roughness=RoughnessPlan(wall_m=0.015, longest_m=4.0, fine_m=0.005, floor=0.1),
        roadway=(
            # corridors around the hall
            walk([(-5, -5, 0), (35, -5, 0), (35, 25, 0), (-5, 25, 0)], closed=True),
            # through the hall along its length, from door to door past the pillars
            walk([(-5, 6, 0), (4, 6, 0), (12, 10, 0), (24, 13, 0), (35, 13, 0)]),
            # through it across
            walk([(21, -5, 0), (21, 3, 0), (24, 13, 0), (17, 17, 0), (8, 17, 0), (8, 25, 0)]),
            # round under its walls
            walk([(4, 6, 0), (9, 3, 0), (21, 3, 0), (27, 6, 0), (24, 13, 0)]),
            walk([(4, 6, 0), (3, 13, 0), (8, 17, 0), (12, 10, 0)]),
            # to an office
            walk([(35, 5, 0), (44, 5, 0), (48, 8, 0)]),
        ),
        room=(
            RoomPlan(centre_m=(15, 10, 0), length_m=30, width_m=20, height_m=4.6),
            RoomPlan(centre_m=(19, 21, 0), length_m=6, width_m=3, height_m=3.0),
            RoomPlan(centre_m=(-0.5, 13, 0), length_m=2, width_m=5, height_m=3.0),
            RoomPlan(centre_m=(47, 7, 0), length_m=7, width_m=8, height_m=2.8),
            *(RoomPlan(centre_m=(x, y, 0), length_m=1.4, width_m=1.4, height_m=2.2) for x, y in niches),
        ),
        pillar=(
            PillarPlan(centre_m=(8, 9.5, 0)),
            PillarPlan(centre_m=(15, 6.5, 0)),
            PillarPlan(centre_m=(18, 13, 0)),
            PillarPlan(centre_m=(25, 8.5, 0)),
            PillarPlan(centre_m=(12, 14, 0), length_m=1.2, heading_deg=30),
            PillarPlan(centre_m=(28, 17.5, 0), length_m=3.0, width_m=1.2, height_m=1.1),
            PillarPlan(centre_m=(2, 2, 0), length_m=1.0, width_m=2.4, height_m=2.1),
        ),
    )


BUILTIN = {"demo": demo, "straight": straight, "loop": loop, "hall": hall}
