"""Plans: TOML, DXF and built-in mines; where lines meet; the rock made of them."""

from __future__ import annotations

from pathlib import Path

import ezdxf
import numpy as np
import open3d as o3d
import pytest

from mineloc.errors import ConfigError, FormatError, SimulationError
from mineloc.sim.builtin import BUILTIN
from mineloc.sim.dxf import read_dxf
from mineloc.sim.mine import Mine, load_mine
from mineloc.sim.plan import MinePlan, RoughnessPlan, plan_graph, read_plan, roadway
from mineloc.sim.rock import NOISE_SIGMA, _noise, _surface_nets, rock_mesh

SMOOTH = RoughnessPlan(wall_m=0.0, fine_m=0.0)


def _degrees(plan: MinePlan) -> list[int]:
    return sorted(len(roads) for roads in plan_graph(plan).at_node())


def test_lines_that_cross_or_end_on_one_another_meet() -> None:
    across = MinePlan(roadway=(roadway([(0, 0, 0), (40, 0, 0)]), roadway([(20, -20, 0.3), (20, 20, 0.3)])))
    assert _degrees(across) == [1, 1, 1, 1, 4]
    onto = MinePlan(roadway=(roadway([(0, 0, 0), (40, 0, 0)]), roadway([(20, 1.2, 0), (20, 20, 0)])))
    assert _degrees(onto) == [1, 1, 1, 3]
    ends = MinePlan(roadway=(roadway([(0, 0, 0), (40, 0, 0)]), roadway([(40, 0, 0), (40, 30, 0)])))
    assert _degrees(ends) == [1, 1, 2]
    over = MinePlan(roadway=(roadway([(0, 0, 0), (40, 0, 0)]), roadway([(20, -20, 6), (20, 20, 6)])))
    assert _degrees(over) == [1, 1, 1, 1]
    beside = MinePlan(roadway=(roadway([(0, 0, 0), (40, 0, 0)]), roadway([(20, 8, 0), (20, 20, 0)])))
    assert _degrees(beside) == [1, 1, 1, 1]
    figure_eight = MinePlan(roadway=(roadway([(0, 0, 0), (20, 20, 0), (20, 0, 0), (0, 20, 0)]),))
    assert _degrees(figure_eight) == [1, 1, 4]


def test_graph_keeps_lengths_and_heights() -> None:
    plan = BUILTIN["demo"]()
    graph = plan_graph(plan)
    drawn = sum(float(np.linalg.norm(np.diff(road.line_m, axis=0), axis=1).sum()) for road in plan.roadway)
    assert graph.length_m == pytest.approx(drawn, rel=0.01)
    for index, node in enumerate(graph.nodes_m):
        for road in graph.at_node()[index]:
            ends = graph.roadways[road].line_m[[0, -1]]
            assert np.linalg.norm(ends - node, axis=1).min() < 1e-9


def test_built_in_mines_are_as_promised() -> None:
    graph = plan_graph(BUILTIN["demo"]())
    degree = [len(roads) for roads in graph.at_node()]
    assert 400 <= graph.length_m <= 500
    assert len(graph.intersections) >= 6
    assert max(degree) == 4
    assert len(graph.roadways) - len(graph.nodes_m) + 1 >= 3  # loops
    assert np.ptp(graph.nodes_m[:, 2]) > 3.0
    assert _degrees(BUILTIN["straight"]()) == [1, 1]
    assert _degrees(BUILTIN["loop"]()) == [1, 3]


def test_plan_file_is_read_and_wrong_ones_are_named(tmp_path: Path) -> None:
    path = tmp_path / "north.toml"
    path.write_text(
        'name = "north"\nseed = 3\n[roughness]\nwall_m = 0.05\n'
        "[[roadway]]\npoints_m = [[0, 0, 0], [30, 0, 1]]\nwidth_m = 5\n"
        "[[roadway]]\npoints_m = [[15, 0, 0.5], [15, 25, 0]]\nheight_m = 2.8\n"
    )
    plan = read_plan(path)
    assert (plan.name, plan.seed, plan.roughness.wall_m, plan.roadway[0].width_m) == ("north", 3, 0.05, 5.0)
    assert _degrees(plan) == [1, 1, 1, 3]
    for text, match in (
        ("name = 1 2", "not TOML"),
        ("name = 'x'", "roadway"),
        ("[[roadway]]\npoints_m = [[0, 0, 0]]", "points_m"),
        ("[[roadway]]\npoints_m = [[0, 0, 0], [1, 0, 0]]\nwidth = 3", "unknown key"),
        ("[[roadway]]\npoints_m = [[0, 0, 0], [9, 0, 0]]\n[roughness]\nlongest_m = 0.4", "roughness"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=match):
            read_plan(path)


def test_dxf_centre_lines_honour_unit_layers_and_heights(tmp_path: Path) -> None:
    path = tmp_path / "mine.dxf"
    drawing = ezdxf.new(units=ezdxf.units.MM)
    space = drawing.modelspace()
    drawing.layers.add("L1")
    drawing.layers.add("L2").off()
    space.add_polyline3d([(0, 0, 0), (40_000, 0, 1000)], dxfattribs={"layer": "L1"})
    space.add_line((20_000, 0, 500), (20_000, 30_000, 500), dxfattribs={"layer": "L1"})
    space.add_lwpolyline([(0, 0), (0, 30_000)], dxfattribs={"layer": "L1", "elevation": 0})
    space.add_line((0, 0, 0), (0, -90_000, 0), dxfattribs={"layer": "L2"})
    space.add_text("north", dxfattribs={"layer": "L1"})
    drawing.saveas(path)
    plan = read_dxf(path, width_m=4.5, height_m=3.0)
    assert len(plan.roadway) == 3
    assert plan.name == "mine"
    assert plan_graph(plan).length_m == pytest.approx(100, abs=0.1)
    assert _degrees(plan) == [1, 1, 1, 2, 3]
    assert plan.roadway[0].points_m[1] == pytest.approx((40.0, 0.0, 1.0))
    assert plan.roadway[0].width_m == 4.5
    curved = ezdxf.new(units=ezdxf.units.M)
    curved.modelspace().add_arc((0, 0, 2), 30, 0, 90)
    curved.saveas(path)
    arc = np.array(read_dxf(path, width_m=4, height_m=3).roadway[0].points_m)
    np.testing.assert_allclose(np.linalg.norm(arc[:, :2], axis=1), 30, atol=0.02)
    assert 30 - np.linalg.norm((arc[1:, :2] + arc[:-1, :2]) / 2, axis=1).min() < 0.11


def test_dxf_without_lines_or_not_at_all_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.dxf"
    ezdxf.new().saveas(path)
    with pytest.raises(FormatError, match="no line"):
        read_dxf(path, width_m=4, height_m=3)
    path.write_text("hello")
    with pytest.raises(FormatError, match="not a DXF file"):
        read_dxf(path, width_m=4, height_m=3)
    with pytest.raises(FormatError, match="not a DXF file"):
        read_dxf(tmp_path / "none.dxf", width_m=4, height_m=3)


def test_unknown_mine_is_refused() -> None:
    with pytest.raises(SimulationError, match="demo, straight, loop, hall"):
        load_mine("nowhere")


# --- the rock


def _mesh(vertices: np.ndarray, triangles: np.ndarray) -> o3d.geometry.TriangleMesh:
    return o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles))


def test_surface_nets_make_a_closed_sphere() -> None:
    n, cell, radius = 30, 0.25, 2.6
    first = np.array([-15, -15, -15])
    grid = (np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1) + first) * cell
    names, vertices, quads = _surface_nets(np.linalg.norm(grid, axis=-1) - radius, first, cell)
    index = np.searchsorted(np.sort(names), quads)
    order = np.argsort(names)
    triangles = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])
    mesh = _mesh(vertices[order], triangles)
    assert mesh.is_watertight()
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), radius, atol=0.02)
    a, b, c = (vertices[order][triangles[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    # negative: the triangles face the free space inside
    assert volume == pytest.approx(-4 / 3 * np.pi * radius**3, rel=0.02)


def test_smooth_tunnel_has_the_profile_that_was_drawn() -> None:
    plan = MinePlan(roughness=SMOOTH, roadway=(roadway([(0, 0, 5), (30, 0, 5)], width_m=4.0, height_m=3.0),))
    vertices, triangles = rock_mesh(plan)
    mesh = _mesh(vertices, triangles)
    assert mesh.is_watertight()
    middle = vertices[(vertices[:, 0] > 3) & (vertices[:, 0] < 27)]
    side, up = np.abs(middle[:, 1]), middle[:, 2] - 5
    assert up.min() == pytest.approx(0.0, abs=0.02)
    assert up.max() == pytest.approx(3.0, abs=0.05)
    wall = middle[(up > 0.4) & (up < 1.8)]
    np.testing.assert_allclose(np.abs(wall[:, 1]), 2.0, atol=0.03)
    spring = 3.0 * 0.65
    arch = up > spring + 0.1
    ellipse = (side[arch] / 2) ** 2 + ((up[arch] - spring) / (3.0 - spring)) ** 2
    np.testing.assert_allclose(ellipse, 1.0, atol=0.08)


def test_walls_are_as_rough_as_asked_and_floors_less() -> None:
    rough = RoughnessPlan(wall_m=0.10, longest_m=2.0, shortest_m=0.5, fine_m=0.0)
    plan = MinePlan(roughness=rough, roadway=(roadway([(0, 0, 0), (90, 0, 0)], width_m=5.0, height_m=4.0),))
    vertices, _ = rock_mesh(plan)
    inner = vertices[(vertices[:, 0] > 3) & (vertices[:, 0] < 87)]
    wall = inner[(inner[:, 2] > 0.8) & (inner[:, 2] < 2.2)]
    off = np.abs(wall[:, 1]) - 2.5
    assert off.std() == pytest.approx(0.10, rel=0.2)
    assert abs(off.mean()) < 0.03
    floor = inner[(np.abs(inner[:, 1]) < 1.5) & (inner[:, 2] < 0.6)]
    assert floor[:, 2].std() == pytest.approx(0.04, rel=0.3)
    # band-limited: the wall is the same 10 cm on, another one 3 m on
    line = wall[(wall[:, 1] > 0) & (np.abs(wall[:, 2] - 1.5) < 0.11)]
    x = np.arange(4, 86, 0.1)
    y = np.interp(x, *line[np.argsort(line[:, 0])][:, :2].T) - 2.5
    assert np.corrcoef(y[:-2], y[2:])[0, 1] > 0.7
    assert abs(np.corrcoef(y[:-30], y[30:])[0, 1]) < 0.3


def test_noise_has_its_deviation_and_no_seam() -> None:
    rng = np.random.default_rng(0)
    p = rng.uniform(-50, 50, (20_000, 3))
    value = np.array([_noise(*q, 7) for q in p])
    assert value.std() == pytest.approx(NOISE_SIGMA, rel=0.03)
    assert abs(value.mean()) < 0.01
    near = np.array([_noise(*(q + 1e-4), 7) for q in p])
    assert np.abs(near - value).max() < 1e-3
    other = np.array([_noise(*q, 8) for q in p])
    assert abs(np.corrcoef(value, other)[0, 1]) < 0.03


def test_intersections_are_open_and_the_mesh_faces_the_inside(demo: Mine) -> None:
    graph, scene = demo.graph, demo.scene
    for node in graph.intersections:
        centre = graph.nodes_m[node] + [0, 0, 1.6]
        for index in graph.at_node()[node]:
            line = graph.roadways[index].line_m
            line = line if graph.roadways[index].a == node else line[::-1]
            along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
            ahead = np.array([np.interp(6.0, along, line[:, k]) for k in range(3)]) + np.array([0, 0, 1.6])
            far = ahead - centre
            distance = float(np.linalg.norm(far))
            assert scene.ranges_m(centre[None], far / distance)[0] > distance
    hits = scene.cast(_inside_rays(demo))
    assert np.isfinite(hits.range_m).all()


def _inside_rays(mine: Mine) -> np.ndarray:
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((5000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    start = mine.graph.nodes_m[mine.graph.intersections[0]] + [0, 0, 1.5] - mine.scene.origin_m
    return np.column_stack([np.broadcast_to(start, (5000, 3)), direction]).astype(np.float32)


def test_same_seed_same_rock_other_seed_another() -> None:
    plan = MinePlan(roadway=(roadway([(0, 0, 0), (12, 0, 0)]),))
    one, same = rock_mesh(plan), rock_mesh(plan)
    np.testing.assert_array_equal(one[0], same[0])
    np.testing.assert_array_equal(one[1], same[1])
    other = rock_mesh(plan.model_copy(update={"seed": 1}))
    assert one[0].shape != other[0].shape or not np.allclose(one[0], other[0])
    # far from the origin of a mine grid it is the same rock, to the rounding of a millimetre
    far = MinePlan(roughness=SMOOTH, roadway=(roadway([(50_000, 90_000, 400), (50_012, 90_000, 400)]),))
    near = MinePlan(roughness=SMOOTH, roadway=(roadway([(0, 0, 0), (12, 0, 0)]),))
    a, b = rock_mesh(far)[0], rock_mesh(near)[0]
    np.testing.assert_allclose(a.min(axis=0) - [50_000, 90_000, 400], b.min(axis=0), atol=2e-3)
