"""From a mesh to its roadway graph, and the tour through it."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.errors import SimulationError
from mineloc.roadways.graph import Roadway, RoadwayGraph
from mineloc.sim.from_mesh import roadways_of_mesh
from mineloc.sim.mine import Mine, load_mine, planned_mine
from mineloc.sim.path import fly_line, mid_height, passable, resample
from mineloc.sim.plan import MinePlan, RoughnessPlan, roadway
from mineloc.sim.scene import Scene
from mineloc.sim.tour import plan_tour

SMOOTH = RoughnessPlan(wall_m=0.0, fine_m=0.0)


def _found(mine: Mine, triangles: np.ndarray | None = None) -> RoadwayGraph:
    scene = mine.scene if triangles is None else Scene(mine.vertices_m, triangles, threads=1)
    return roadways_of_mesh(scene, mine.vertices_m.min(axis=0), mine.vertices_m.max(axis=0))


def _same_places(a: np.ndarray, b: np.ndarray, within_m: float) -> bool:
    d = np.linalg.norm(a[:, None] - b[None], axis=2)
    return len(a) == len(b) and bool((d.min(axis=0) < within_m).all() and (d.min(axis=1) < within_m).all())


def test_roadways_found_in_the_mesh_are_those_of_its_plan(demo: Mine) -> None:
    found, plan = _found(demo), demo.graph
    assert _same_places(found.nodes_m[found.intersections], plan.nodes_m[plan.intersections], 3.5)
    assert found.length_m == pytest.approx(plan.length_m, rel=0.05)
    # the lines run on the floor, in the middle
    for road in found.roadways:
        height = demo.scene.ranges_m(road.line_m + np.array([0, 0, 1.0]), [0, 0, -1.0])
        np.testing.assert_allclose(height, 1.0, atol=0.4)
        assert demo.scene.clearance_m(mid_height(resample(road.line_m), demo.scene)).min() > 0.8


def test_winding_does_not_matter(tee: Mine) -> None:
    expected = _found(tee)
    assert len(expected.intersections) == 1
    outward = _found(tee, tee.triangles[:, ::-1])
    mixed = tee.triangles.copy()
    mixed[::2] = mixed[::2, ::-1]
    for other in (outward, _found(tee, mixed)):
        assert _same_places(other.nodes_m, expected.nodes_m, 0.5)


def test_roadways_on_two_levels_cross_without_meeting() -> None:
    line = [(0, 0, 0), (44, 0, 0), (44, 24, 3), (20, 24, 5), (20, -20, 9)]
    mine = planned_mine(MinePlan(cell_m=0.3, roughness=SMOOTH, roadway=(roadway(line),)), threads=1)
    assert not mine.graph.intersections
    found = _found(mine)
    assert not found.intersections
    assert found.length_m == pytest.approx(mine.graph.length_m, rel=0.06)
    heights = np.concatenate([road.line_m[:, 2] for road in found.roadways])
    assert heights.max() - heights.min() > 8


def test_meshes_without_roadways_are_refused() -> None:
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    flat = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    i = (np.arange(39)[:, None] * 40 + np.arange(39)).ravel()
    plate = np.concatenate([np.stack([i, i + 1, i + 40], 1), np.stack([i + 1, i + 41, i + 40], 1)])
    with pytest.raises(SimulationError, match="of roadway between floors and roofs"):
        roadways_of_mesh(Scene(flat, plate, threads=1), flat.min(0), flat.max(0))
    low = np.concatenate([flat, flat + np.array([0, 0, 1.0])])
    both = np.concatenate([plate, plate[:, ::-1] + len(flat)])
    with pytest.raises(SimulationError, match="headroom"):
        roadways_of_mesh(Scene(low, both, threads=1), low.min(0), low.max(0))
    high = np.concatenate([flat, flat + np.array([0, 0, 300.0])])
    with pytest.raises(SimulationError, match="centimetres"):
        roadways_of_mesh(Scene(high, both, threads=1), high.min(0), high.max(0))


def test_places_too_narrow_for_a_drone_are_left_out(tee: Mine) -> None:
    pipe = MinePlan(
        cell_m=0.3,
        roughness=SMOOTH,
        roadway=(roadway([(0, 0, 0), (40, 0, 0)]), roadway([(20, 0, 0), (20, 20, 0)], width_m=1.5, height_m=1.8)),
    )
    mine = planned_mine(pipe, threads=1)
    assert len(passable(mine.graph, mine.scene, clearance_m=0.7).roadways) == 3
    wide = passable(mine.graph, mine.scene, clearance_m=1.1)
    # what is left of the pipe is its mouth
    assert sum(road.length_m for road in wide.roadways) < 41
    with pytest.raises(SimulationError, match="no roadway with"):
        passable(tee.graph, tee.scene, clearance_m=3.0)


def test_line_follows_floor_and_roof_and_rounds_corners(tee: Mine) -> None:
    graph = passable(tee.graph, tee.scene, clearance_m=0.7)
    tour = plan_tour(graph, 100, np.random.default_rng(0))
    legs = fly_line(graph, tour, tee.scene, clearance_m=0.7)
    for leg in legs:
        step = np.diff(leg, axis=0)
        assert np.linalg.norm(step, axis=1).max() < 0.12
        turn = np.degrees(np.abs(np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0])))))
        assert turn.max() < 12
        assert tee.scene.clearance_m(leg).min() > 0.7
        up, down = (tee.scene.ranges_m(leg, [0, 0, z]) for z in (1.0, -1.0))
        assert np.median(np.abs(up - down)) < 0.3


def test_line_outside_the_mine_is_refused(tee: Mine) -> None:
    with pytest.raises(SimulationError, match="no floor or roof"):
        mid_height(resample(np.array([[0, 100, 0], [20, 100, 0.0]])), tee.scene)


# --- the tour


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.floats(10, 2000))
def test_tour_is_connected_long_enough_and_turns_only_at_ends(demo: Mine, seed: int, length_m: float) -> None:
    graph = demo.graph
    tour = plan_tour(graph, length_m, np.random.default_rng(seed))
    lengths = [graph.roadways[step.roadway].length_m for step in tour]
    assert sum(lengths) >= length_m > sum(lengths[:-1])
    at_node = graph.at_node()
    for one, other in pairwise(tour):
        a, b = graph.roadways[one.roadway], graph.roadways[other.roadway]
        node = a.b if one.forward else a.a
        assert node == (b.a if other.forward else b.b)
        if one.roadway == other.roadway and one.forward != other.forward:
            assert len(at_node[node]) == 1


def test_long_tour_sees_all_roadways_from_both_sides(demo: Mine) -> None:
    tour = plan_tour(demo.graph, 4 * demo.graph.length_m, np.random.default_rng(0))
    assert {step.roadway for step in tour} == set(range(len(demo.graph.roadways)))
    both = {(step.roadway, step.forward) for step in tour}
    assert len(both) > 1.6 * len(demo.graph.roadways)
    # the first pass wastes little: most of the mine within one and a half times its length
    early = {step.roadway for step in plan_tour(demo.graph, 1.5 * demo.graph.length_m, np.random.default_rng(0))}
    assert len(early) >= 0.85 * len(demo.graph.roadways)


def test_tour_depends_on_its_seed_and_start(demo: Mine) -> None:
    one, same, other = (plan_tour(demo.graph, 600, np.random.default_rng(k)) for k in (0, 0, 1))
    assert one == same != other
    node = demo.graph.intersections[0]
    first = plan_tour(demo.graph, 50, np.random.default_rng(0), start=node)[0]
    road = demo.graph.roadways[first.roadway]
    assert node == (road.a if first.forward else road.b)
    for wrong in (-1, 1000):
        with pytest.raises(SimulationError, match="--start"):
            plan_tour(demo.graph, 50, np.random.default_rng(0), start=wrong)


def test_tour_of_nothing_is_refused_and_pieces_do_not_hang_it() -> None:
    with pytest.raises(SimulationError, match="no roadway"):
        plan_tour(RoadwayGraph(np.zeros((0, 3)), ()), 50, np.random.default_rng(0))
    nodes = np.array([[0, 0, 0], [10, 0, 0], [50, 0, 0], [80, 0, 0.0]])
    apart = RoadwayGraph(nodes, (Roadway(0, 1, nodes[:2]), Roadway(2, 3, nodes[2:])))
    tour = plan_tour(apart, 200, np.random.default_rng(0))
    assert {step.roadway for step in tour} == {1}


# --- real meshes


@pytest.mark.data
def test_edgar_mine_has_its_known_intersections(meshes: Path) -> None:
    mine = load_mine(meshes / "edgar_mine" / "edgar_mine_rough_200k.ply", threads=1)
    reference = json.loads((meshes / "edgar_mine" / "edgar_graph.json").read_text())
    known = np.array([node["xy"] for node in reference["nodes"] if node["degree"] >= 3])
    ours = mine.graph.nodes_m[mine.graph.intersections, :2]
    d = np.linalg.norm(known[:, None] - ours[None], axis=2)
    # which of two near ones are one, and whether a bay is a roadway, is a matter of taste: 41 are known
    assert (d.min(axis=1) < 4.0).sum() >= 39
    assert 40 <= len(ours) <= 52
    assert mine.graph.length_m == pytest.approx(2600, rel=0.06)
    flyable = passable(mine.graph, mine.scene, clearance_m=0.7)
    assert flyable.length_m > 0.97 * mine.graph.length_m
    loops = len(flyable.roadways) - len({node for road in flyable.roadways for node in (road.a, road.b)}) + 1
    assert loops == pytest.approx(9, abs=1)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "intersections", "length_m"),
    [("tunnel_qual/tunnel_qual", 8, 2190), ("simple_tunnel_01/simple_tunnel_01", 0, 610), ("gm_kum/GM-KUM", 4, 147)],
)
def test_other_meshes(meshes: Path, name: str, intersections: int, length_m: float) -> None:
    graph = load_mine(meshes / f"{name}.ply", threads=1).graph
    assert len(graph.intersections) == intersections
    assert graph.length_m == pytest.approx(length_m, rel=0.05)
    if name.startswith("tunnel_qual"):
        heights = graph.nodes_m[:, 2]
        assert heights.max() - heights.min() > 15
