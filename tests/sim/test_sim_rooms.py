"""Rooms and pillars in plans, and the built-in hall."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mineloc.config import SimulateConfig
from mineloc.errors import ConfigError
from mineloc.sim.builtin import BUILTIN
from mineloc.sim.mine import Mine, load_mine, planned_mine
from mineloc.sim.path import fly_line, passable
from mineloc.sim.plan import MinePlan, PillarPlan, RoomPlan, RoughnessPlan, plan_graph, read_plan, roadway
from mineloc.sim.tour import plan_tour

SMOOTH = RoughnessPlan(wall_m=0.0, fine_m=0.0)
# the surface is within half a cell of what was drawn, at edges the whole
TOLERANCE_M = 0.1


@pytest.fixture(scope="module")
def hall() -> Mine:
    return load_mine("hall", threads=1)


@pytest.fixture(scope="module")
def chamber() -> Mine:
    """A room of 12 m by 8 m, 5 m high, turned by 30°, with a pillar and a bench, at the end of a drift."""
    return planned_mine(
        MinePlan(
            roughness=SMOOTH,
            roadway=(roadway([(0, 0, 2), (20, 0, 2)], arch=0.0),),
            room=(RoomPlan(centre_m=(20, 0, 2), length_m=12, width_m=8, height_m=5, heading_deg=30),),
            pillar=(
                PillarPlan(centre_m=(20, 3, 2), length_m=2, width_m=1, heading_deg=90),
                PillarPlan(centre_m=(22, 0, 2), length_m=2, width_m=2, height_m=1),
            ),
        ),
        threads=1,
    )


def _range_m(mine: Mine, start: tuple[float, float, float], heading_deg: float) -> float:
    heading = np.deg2rad(heading_deg)
    return float(mine.scene.ranges_m(np.array([start]), [np.cos(heading), np.sin(heading), 0.0])[0])


def test_a_room_has_the_walls_and_the_roof_that_were_drawn(chamber: Mine) -> None:
    start = (19.0, -1.0, 5.0)  # above the bench
    along, across = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)]), np.array([-np.sin(np.pi / 6), np.cos(np.pi / 6)])
    u, v = np.array([-1.0, -1.0]) @ along, np.array([-1.0, -1.0]) @ across
    for heading, expected in ((30, 6 - u), (210, 6 + u), (300, 4 + v)):
        assert _range_m(chamber, start, heading) == pytest.approx(expected, abs=TOLERANCE_M), heading
    up, down = (chamber.scene.ranges_m(np.array([start]), [0, 0, way])[0] for way in (1, -1))
    assert (up, down) == pytest.approx((2.0, 3.0), abs=TOLERANCE_M)


def test_a_drift_opens_into_the_room(chamber: Mine) -> None:
    # along the drift and through the room, over the bench, to the wall across its length
    assert _range_m(chamber, (2.0, 0.0, 4.0), 0) == pytest.approx(18 + 6 / np.cos(np.pi / 6), abs=0.15)


def test_pillars_stand_to_the_roof_and_benches_do_not(chamber: Mine) -> None:
    # its length lies along y: half a metre to either side along x, one along y
    assert _range_m(chamber, (18.0, 3.0, 3.5), 0) == pytest.approx(1.5, abs=TOLERANCE_M)
    assert _range_m(chamber, (20.0, 0.0, 6.5), 90) == pytest.approx(2.0, abs=TOLERANCE_M)
    down = chamber.scene.ranges_m(np.array([[22.0, 0.0, 5.0]]), [0, 0, -1])[0]
    assert down == pytest.approx(2.0, abs=TOLERANCE_M)
    # closed: every edge is passed once each way
    edges = np.concatenate([chamber.triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    there, back = (np.unique(way, axis=0, return_counts=True) for way in (edges, edges[:, ::-1]))
    assert np.array_equal(there[0], back[0])
    assert there[1].max() == 1


def test_roadways_alone_make_the_graph(chamber: Mine) -> None:
    assert [len(roads) for roads in chamber.graph.at_node()] == [1, 1]


def test_rooms_and_pillars_are_read_from_a_plan(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    road = "[[roadway]]\npoints_m = [[0, 0, 0], [30, 0, 1]]\n"
    path.write_text(
        road + "[[room]]\ncentre_m = [10, 0, 0]\nlength_m = 9\nwidth_m = 8\n[[pillar]]\ncentre_m = [10, 2, 0]\n"
    )
    plan = read_plan(path)
    assert (plan.room[0].height_m, plan.pillar[0].length_m, plan.pillar[0].width_m) == (4.0, 0.8, 0.8)
    for text, match in (
        ("[[room]]\ncentre_m = [1, 0, 0]\nlength_m = 9", "width_m"),
        ("[[room]]\ncentre_m = [1, 0]\nlength_m = 9\nwidth_m = 8", "centre_m"),
        ("[[pillar]]\ncentre_m = [1, 0, 0]\nradius_m = 1", "unknown key"),
        ("[[pillar]]\ncentre_m = [1, 0, 0]\nlength_m = 0", "length_m"),
    ):
        path.write_text(road + text)
        with pytest.raises(ConfigError, match=match):
            read_plan(path)


def test_the_hall_is_as_promised(hall: Mine) -> None:
    graph = plan_graph(BUILTIN["hall"]())
    assert len(graph.roadways) - len(graph.nodes_m) + 1 >= 6  # loops
    assert len(graph.intersections) >= 8
    assert np.ptp(graph.nodes_m[:, 2]) == 0
    # the hall itself, 30 m by 20 m, seen from under its roof past the pillars; a storey of 2.8 m around it
    assert _range_m(hall, (1.0, 18.5, 4.0), 0) == pytest.approx(29.0, abs=0.2)
    assert _range_m(hall, (5.0, 1.0, 4.0), 90) == pytest.approx(19.0, abs=0.2)
    heights = hall.scene.ranges_m(np.array([[5.0, 15.0, 1.0], [-5.0, 15.0, 1.0]]), [0, 0, 1])
    assert heights == pytest.approx([3.6, 1.8], abs=0.1)
    floor = hall.scene.ranges_m(np.column_stack([np.linspace(1, 29, 99), np.full(99, 4.5), np.ones(99)]), [0, 0, -1])
    assert floor == pytest.approx(np.ones(99), abs=0.02)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_drone_flies_through_all_of_the_hall_again_and_again(hall: Mine, seed: int) -> None:
    clearance_m = SimulateConfig().clearance_m
    graph = passable(hall.graph, hall.scene, clearance_m=clearance_m)
    assert len(graph.roadways) == len(hall.graph.roadways)
    tour = plan_tour(graph, 400.0, np.random.default_rng(seed))
    assert {step.roadway for step in tour} == set(range(len(graph.roadways)))
    assert len(tour) > len(graph.roadways) + 3
    for leg in fly_line(graph, tour, hall.scene, clearance_m=clearance_m):
        assert hall.scene.clearance_m(leg).min() > 0.7 * clearance_m
