"""A mine that has changed since it was mapped: walls that stop rays and tours, places that are wider, refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest

from mineloc import se3
from mineloc.config import SimulateConfig, load_config
from mineloc.errors import ConfigError, SimulationError
from mineloc.io.flight import FlightReader
from mineloc.sim.changes import CHANGES_FILE, GAP_M, changed_mine
from mineloc.sim.flight import START_NS, SimulatedFlight
from mineloc.sim.mine import Mine, load_mine, planned_mine
from mineloc.sim.plan import MinePlan, RoughnessPlan, roadway
from mineloc.sim.wall import BULGE_M, THICKNESS_M
from mineloc.sim.widening import widen
from mineloc.stages.simulate import simulate

# in the eastern branch of the tee, off its middle and not quite along it
WALL = (30.0, 0.4, 1.2, 5.0)
WIDE = (20.0, 0.0, 1.5, 8.0, 1.2)
FACE_M = THICKNESS_M / 2


@pytest.fixture(scope="module")
def walled(tee: Mine) -> Mine:
    return changed_mine(tee, closed=[WALL], threads=1)


@pytest.fixture(scope="module")
def wider(tee: Mine) -> Mine:
    return changed_mine(tee, widened=[WIDE], threads=1)


def _through(mine: Mine, first_m: np.ndarray, second_m: np.ndarray) -> np.ndarray:
    """(n,) whether straight ways between points are free."""
    step = second_m - first_m
    length = np.linalg.norm(step, axis=1)
    return mine.scene.ranges_m(first_m, step / length[:, None]) >= length


# --- closed


def test_rays_pass_before_there_is_a_wall_and_end_at_it_afterwards(tee: Mine, walled: Mine) -> None:
    # all of the cross-section, floor to roof and wall to wall, from both sides
    left, up = (grid.ravel() for grid in np.meshgrid(np.linspace(-1.9, 1.9, 40), np.linspace(0.1, 3.1, 33)))
    west, east = (np.column_stack([np.full(left.size, x), left, up]) for x in (27.0, 33.0))
    free = _through(tee, west, east)
    assert free.mean() > 0.9
    assert not _through(walled, west, east).any()
    along = np.array([np.cos(np.deg2rad(5.0)), np.sin(np.deg2rad(5.0)), 0.0])
    for start, side in ((west, -1.0), (east, 1.0)):
        range_m = walled.scene.ranges_m(start[free], [-side, 0.0, 0.0])
        hit = start[free] + range_m[:, None] * np.array([-side, 0.0, 0.0])
        stands = side * ((hit - np.array(WALL[:3])) @ along)
        assert np.abs(stands - FACE_M).max() <= BULGE_M + 1e-3
        # rough, not a plane
        assert 0.03 < stands.std() < 0.2
    assert len(walled.vertices_m) < len(tee.vertices_m) + 3000


def test_wall_is_closed_wound_outwards_and_always_the_same(tee: Mine, walled: Mine) -> None:
    count = len(tee.vertices_m)
    np.testing.assert_array_equal(walled.vertices_m[:count], tee.vertices_m)
    own = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(walled.vertices_m[count:]),
        o3d.utility.Vector3iVector(walled.triangles[len(tee.triangles) :] - count),
    )
    assert own.is_watertight()
    corners = np.asarray(own.vertices)[np.asarray(own.triangles)]
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert 1.0 < volume / (4.0 * 3.2 * THICKNESS_M) < 1.8
    # beside another change it looks the same: its place alone decides
    again = changed_mine(tee, closed=[(10.0, 0.0, 1.0, 0.0), WALL], threads=1)
    np.testing.assert_array_equal(again.vertices_m[-len(own.vertices) :], walled.vertices_m[count:])


def test_graph_ends_before_the_wall_on_both_sides(tee: Mine, walled: Mine) -> None:
    assert len(walled.graph.roadways) == len(tee.graph.roadways) + 1
    np.testing.assert_array_equal(walled.graph.nodes_m[: len(tee.graph.nodes_m)], tee.graph.nodes_m)
    assert walled.graph.intersections == tee.graph.intersections
    ends = walled.graph.nodes_m[len(tee.graph.nodes_m) :]
    assert len(ends) == 2
    off = np.sort(ends[:, 0] - WALL[0])
    np.testing.assert_allclose(np.abs(off), FACE_M + BULGE_M + GAP_M, atol=0.25)
    assert off[0] < 0 < off[1]
    for road in walled.graph.roadways:
        np.testing.assert_array_equal(road.line_m[[0, -1]], walled.graph.nodes_m[[road.a, road.b]])
    lost = tee.graph.length_m - walled.graph.length_m
    assert lost == pytest.approx(2 * (FACE_M + BULGE_M + GAP_M), abs=0.4)


def test_no_tour_crosses_the_wall(tee: Mine, walled: Mine) -> None:
    config = SimulateConfig(length_m=90, hover_s=1, seed=3)
    crossed: list[bool] = []
    for mine in (tee, walled):
        flight = SimulatedFlight(mine, config)
        way = flight.pose(np.arange(0, int(flight.motion.end_s * 10)) * 100_000_000 + START_NS)[:, :3, 3]
        crossed.append(bool((way[:, 0].min() < WALL[0] - 1) and (way[:, 0].max() > WALL[0] + 1)))
        assert _through(mine, way[:-1], way[1:]).all()
    assert crossed == [True, False]


def test_wall_in_the_mouth_of_a_branch_leaves_the_main_roadway_alone(tee: Mine) -> None:
    mine = changed_mine(tee, closed=[(20.0, 4.0, 1.2, 90.0)], threads=1)
    # the stub between main roadway and wall is no roadway, and the intersection is none any more
    assert mine.graph.intersections == []
    main = [road for road in mine.graph.roadways if np.abs(road.line_m[:, 1]).max() < 0.1]
    assert sum(road.length_m for road in main) == pytest.approx(40.0, abs=0.1)
    rest = [road for road in mine.graph.roadways if road not in main]
    assert [round(road.length_m) for road in rest] == [13]


def test_ring_is_cut_open() -> None:
    ring = [(12 * float(np.cos(a)), 12 * float(np.sin(a)), 0.0) for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    plan = MinePlan(cell_m=0.3, roughness=RoughnessPlan(wall_m=0, fine_m=0), roadway=(roadway(ring, closed=True),))
    whole = planned_mine(plan, threads=1)
    assert [road.a == road.b for road in whole.graph.roadways] == [True]
    mine = changed_mine(whole, closed=[(-12.0, 0.0, 1.0, 90.0)], threads=1)
    assert len(mine.graph.roadways) == 2
    assert sorted(len(roads) for roads in mine.graph.at_node()) == [1, 1, 2]


# --- widened


def test_walls_are_by_m_farther_away_and_nothing_else_moves(tee: Mine, wider: Mine) -> None:
    x, y, z, radius_m, by_m = WIDE
    # opposite to the branch the wall is 2 m away: where the push is full
    angle = np.deg2rad(np.linspace(-120.0, -60.0, 31))
    rays = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    eye = np.tile([x, y, z], (len(rays), 1))
    grown = wider.scene.ranges_m(eye, rays) - tee.scene.ranges_m(eye, rays)
    np.testing.assert_allclose(grown, by_m, atol=0.06)
    # heights stay
    for point in ([x, y, z], [x + 1.0, y, z]):
        for up in (1.0, -1.0):
            before, after = (mine.scene.ranges_m(np.array([point]), [0, 0, up]) for mine in (tee, wider))
            np.testing.assert_allclose(after, before, atol=0.02)
    count = len(tee.vertices_m)
    outside = np.hypot(tee.vertices_m[:, 0] - x, tee.vertices_m[:, 1] - y) >= radius_m
    np.testing.assert_array_equal(wider.vertices_m[:count][outside], tee.vertices_m[outside])
    np.testing.assert_array_equal(wider.vertices_m[:count, 2], tee.vertices_m[:, 2])
    moved = np.linalg.norm(wider.vertices_m[:count] - tee.vertices_m, axis=1)
    assert by_m - 0.01 < moved.max() <= by_m + 1e-9
    assert len(wider.graph.roadways) == len(tee.graph.roadways)


@pytest.mark.parametrize("soup", [False, True])
def test_large_triangles_are_made_small_first_and_none_turns_over(soup: bool) -> None:
    # a channel of two walls and a floor, two triangles each; as STL gives it, no two share a vertex
    vertices = np.array([[x, y, z] for x in (-30.0, 30.0) for y in (-2.0, 2.0) for z in (0.0, 3.0)])
    triangles = np.array([[0, 5, 4], [0, 1, 5], [2, 6, 7], [2, 7, 3], [0, 6, 2], [0, 4, 6]])
    if soup:
        vertices, triangles = vertices[triangles].reshape(-1, 3), np.arange(18).reshape(-1, 3)
    fine, finer = widen(vertices, triangles, np.array([0.0, 0.0, 1.0]), 6.0, 1.5)
    np.testing.assert_array_equal(fine[: len(vertices)], vertices)
    corners = fine[finer]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(normals, axis=1).min() > 1e-4
    on_floor = np.ptp(corners[:, :, 2], axis=1) < 1e-9
    assert (normals[on_floor & (corners[:, 0, 2] < 0.1), 2] > 0).all()
    assert (normals[~on_floor, 1] * np.sign(-corners[~on_floor, :, 1].mean(axis=1)) > 0).all()
    near = (np.hypot(*corners[:, :, :2].mean(axis=1).T) < 6.0) & ~on_floor
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    assert longest[near].max() < 1.0
    # neighbours agree on what they share: every edge inside belongs to two triangles
    _, same = np.unique(fine.round(9), axis=0, return_inverse=True)
    sides = np.sort(np.stack([finer, np.roll(finer, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    edges, times = np.unique(np.sort(same.ravel()[sides], axis=1), axis=0, return_counts=True)
    assert set(times) == {1, 2}
    places = np.unique(fine.round(9), axis=0)
    rim = places[edges[times == 1]]
    at_end = (np.abs(np.abs(rim[:, :, 0]) - 30.0) < 1e-6).all(axis=1)
    at_top = (np.abs(rim[:, :, 2] - 3.0) < 1e-6).all(axis=1)
    assert (at_end | at_top).all()


def test_a_thin_triangle_that_would_turn_over_is_made_smaller() -> None:
    # a sliver across the push, 0.4 m long and 2 mm high: it follows only in pieces
    vertices = np.array([[2.0, -0.2, 0.0], [2.0, 0.2, 0.0], [1.998, 0.0, 0.0]])
    fine, finer = widen(vertices, np.array([[0, 1, 2]]), np.zeros(3), 4.0, 1.0)
    assert len(finer) > 1
    corners = fine[finer]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()


def test_other_levels_stay(tee: Mine) -> None:
    vertices, _ = widen(tee.vertices_m, tee.triangles, np.array([20.0, 0.0, 15.0]), 8.0, 1.0)
    np.testing.assert_array_equal(vertices[: len(tee.vertices_m)], tee.vertices_m)


# --- both, and what is refused


def test_wall_fills_a_place_that_was_widened(tee: Mine) -> None:
    mine = changed_mine(tee, closed=[(10.0, 0.0, 1.0, 0.0)], widened=[(10.0, 0.0, 1.0, 8.0, 1.5)], threads=1)
    left, up = (grid.ravel() for grid in np.meshgrid(np.linspace(-3.3, 3.3, 40), np.linspace(0.2, 3.0, 20)))
    west, east = (np.column_stack([np.full(left.size, x), left, up]) for x in (8.7, 11.3))
    assert not _through(mine, west, east).any()
    assert mine.scene.ranges_m(np.array([[8.7, 0, 1.0]]), [0, 1.0, 0])[0] > 3.0


@pytest.mark.parametrize(
    ("closed", "widened", "match"),
    [
        ([(30.0, 5.0, 1.0, 0.0)], [], r"simulate\.closed\[0\]: in no roadway: the nearest centre-line is 5\.1 m away"),
        ([WALL, (30.0, 0.0, 9.0, 0.0)], [], r"simulate\.closed\[1\]: in no roadway"),
        ([(20.0, 10.0, 1.0, 0.0)], [], r"the bearing 0°, where the roadway goes along 90°; expected within 45°"),
        ([(20.0, 0.0, 1.0, 0.0)], [], r"simulate\.closed\[0\]: open for over 20 m .*check the bearing"),
        ([], [(20.0, 30.0, 1.0, 8.0, 1.0)], r"simulate\.widened\[0\]: in no roadway"),
        ([], [(10.0, 0.0, 1.0, 1.5, 0.3)], r"simulate\.widened\[0\]: the nearest wall is 2\.0 m away"),
    ],
)
def test_places_that_cannot_be_changed_are_refused(
    tee: Mine, closed: list[Any], widened: list[Any], match: str
) -> None:
    with pytest.raises(SimulationError, match=match):
        changed_mine(tee, closed=closed, widened=widened, threads=1)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("simulate.closed=[30, 0, 1, 0]", "x_m, y_m, z_m, bearing_deg"),
        ("simulate.closed=[[30, 0, 1]]", "x_m, y_m, z_m, bearing_deg"),
        ("simulate.closed=[[30, 0, 1, nan]]", "finite"),
        ("simulate.closed=here", "x_m, y_m, z_m, bearing_deg"),
        ("simulate.widened=[[20, 0, 1, 8]]", "x_m, y_m, z_m, radius_m, by_m"),
        ("simulate.widened=[[20, 0, 1, 8, 2.1]]", "quarter of radius_m"),
        ("simulate.widened=[[20, 0, 1, 8, 0]]", "quarter of radius_m"),
    ],
)
def test_wrong_lists_are_refused(text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        load_config(None, [text])


def _last_sweep(path: Path) -> np.ndarray:
    """(n, 3) its points in the map, where the drone hovers."""
    with FlightReader(path) as reader:
        reference = reader.reference()
        *_, last = reader.sweeps()
        T_body_lidar = reader.calibration.T_body_lidar
    assert reference is not None
    row = int(np.searchsorted(reference.stamps_ns, last.stamp_ns))
    return se3.apply(reference.poses[row] @ T_body_lidar, last.points_lidar.astype(np.float64))


def test_whole_flight_in_a_changed_mine_sees_the_changes_and_tells_them(tmp_path: Path) -> None:
    wall, wide = [18.0, 0.0, 1.5, 0.0], [9.0, 0.0, 1.5, 6.0, 1.5]
    sets = ["length_m=8", "hover_s=1", "speed_mps=4", "lidar_hz=5", "sensor=rs16", "sway_m=0"]
    changes = [f"closed=[{wall}]", f"widened=[{wide}]"]
    seen: list[np.ndarray] = []
    for name, texts in (("then", sets), ("now", sets + changes)):
        out = tmp_path / f"{name}.mcap"
        config = load_config(None, [f"simulate.{text}" for text in texts])
        result = simulate("straight", out=out, start=0, config=config)
        assert result.roadways == (1 if name == "then" else 2)
        seen.append(_last_sweep(out))
    then, now = seen
    behind = [(points[:, 0] > 19.0).sum() for points in seen]
    assert behind[0] > 200 > 0 == behind[1]
    face = (np.abs(now[:, 0] - 17.5) < 0.4) & (np.abs(now[:, 1]) < 1.5)
    assert face.sum() > 5 * ((np.abs(then[:, 0] - 17.5) < 0.4) & (np.abs(then[:, 1]) < 1.5)).sum() + 200
    sides = [np.abs(points[np.abs(points[:, 0] - 9.0) < 1.0, 1]).max() for points in seen]
    assert sides[1] - sides[0] == pytest.approx(1.5, abs=0.15)
    with FlightReader(tmp_path / "now.mcap") as reader:
        assert json.loads(reader.attachment(CHANGES_FILE)) == {"closed": [wall], "widened": [wide]}
    with FlightReader(tmp_path / "then.mcap") as reader:
        assert CHANGES_FILE not in reader.attachment_names


def test_without_changes_the_mine_is_the_same_object() -> None:
    mine = load_mine("straight", threads=1)
    assert changed_mine(mine) is mine
