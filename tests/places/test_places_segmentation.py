"""Intersections of a map's free space: drawn as a sheet of cells, found with their kinds and neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from plan_scenes import drawn, mapped, walls_of

from mineloc.config import IntersectionsConfig
from mineloc.data import Intersection
from mineloc.places.database import database_of
from mineloc.places.segmentation import intersections_of, kind_of
from mineloc.places.sheet_grid import sheet_grid
from mineloc.places.virtual_views import self_recognition, visible

CONFIG = IntersectionsConfig()


@pytest.fixture(scope="module")
def found() -> list[Intersection]:
    sheet = drawn()
    return intersections_of(sheet, walls_of(sheet), mapped(sheet), CONFIG)


def test_both_are_found_where_they_are_with_their_kinds(found: list[Intersection]) -> None:
    assert [one.kind for one in found] == ["T", "X"]
    assert found[0].point_map == pytest.approx([0, 0, 0], abs=0.5)
    assert found[1].point_map == pytest.approx([30, 0, 0], abs=0.5)
    assert np.degrees(found[0].contour.branches_rad) == pytest.approx([0, 90, 180], abs=10) or found[0].degree == 3
    assert found[1].degree == 4


def test_both_recognise_themselves_from_most_views_and_a_double_is_told(found: list[Intersection]) -> None:
    assert all(one.quality >= 0.6 for one in found)
    sheet = drawn()
    start = int(np.hypot(*(sheet.floor_points_m(np.arange(len(sheet)))[:, :2] - [30.0, 0.0]).T).argmin())
    grid = sheet_grid(sheet, start, np.array([30.0, 0.0, 0.0]), CONFIG)
    crossing = found[1].contour
    assert self_recognition(grid, np.zeros(2), 1, [crossing, crossing], CONFIG) == 0.0  # its double comes first
    assert self_recognition(grid, np.array([9.0, 0.0]), 0, [crossing], CONFIG) == 0.0  # there is none


def test_a_view_ends_at_the_first_wall() -> None:
    sheet = drawn()
    start = int(np.hypot(*sheet.floor_points_m(np.arange(len(sheet)))[:, :2].T).argmin())
    grid = sheet_grid(sheet, start, np.zeros(3), CONFIG)
    seen = visible(grid, np.array([[-10.0, 0.0]]), reach_m=20.0)
    rows, columns = grid.cells_of(np.array([[-10.0, 0.0], [5.0, 0.0], [0.0, 10.0], [-14.0, 0.0]]))
    assert seen.sight[rows, columns].tolist() == [2, 2, 0, 2]
    assert set(np.unique(seen.sight[seen.sight != grid.sight])) == {0}
    assert not visible(grid, np.array([[0.0, -8.0]]), reach_m=20.0).sight.any()


def test_they_are_neighbours_by_the_way_between(found: list[Intersection]) -> None:
    for one, other in ((found[0], found[1]), (found[1], found[0])):
        ((id, length_m),) = one.neighbours
        assert id == other.id
        assert length_m == pytest.approx(30, abs=2)


def test_the_cloud_lies_around_the_point(found: list[Intersection]) -> None:
    for one in found:
        reach = np.linalg.norm(one.points_m[:, :2], axis=1)
        assert 14.0 < reach.max() <= CONFIG.cloud_radius_m + 0.01
        assert len(one.normals) == len(one.points_m) > 500
        assert (one.matrix > 0).mean() > 0.05
        assert one.contour.walls > 60


def test_a_database_of_two_unlike_ones_has_no_twins_and_of_one_place_twice_has(found: list[Intersection]) -> None:
    facts = {"grid_origin_m": np.zeros(3), "is_grid": False, "map_sha256": ""}
    known = database_of(found, CONFIG, **facts)
    assert known.twins == ()
    assert known.contour_similarity[0, 1] < known.contour_threshold
    again = [found[0], found[1], *[_renumbered(found[1], 7)]]
    assert database_of(again, CONFIG, **facts).twins == ((1, 7),)


def _renumbered(one: Intersection, id: int) -> Intersection:
    values = {name: getattr(one, name) for name in Intersection.__dataclass_fields__}
    return Intersection(**{**values, "id": id})


def test_a_grid_of_a_sheet_has_walls_around_its_open_cells_and_one_level() -> None:
    sheet = drawn()
    start = int(np.hypot(*sheet.floor_points_m(np.arange(len(sheet)))[:, :2].T).argmin())
    grid = sheet_grid(sheet, start, np.zeros(3), CONFIG)
    rows, columns = grid.cells_of(np.array([[0.0, 0.0], [0.0, -2.1], [0.0, -6.0], [10.0, 0.0]]))
    assert grid.sight[rows, columns].tolist() == [2, 1, 0, 2]
    with pytest.raises(ValueError, match="cells"):
        sheet_grid(sheet, start, np.zeros(3), CONFIG.model_copy(update={"cell_m": 0.3}))


@pytest.mark.parametrize(
    ("bearings_deg", "kind"),
    [
        ((10, 100, 190), "T"),
        ((0, 120, 240), "Y"),
        ((0, 150, 210), "Y"),
        ((0, 90, 180, 270), "X"),
        (range(0, 360, 72), "other"),
    ],
)
def test_the_kind_follows_from_the_bearings(bearings_deg, kind: str) -> None:
    for turn in (0, 77, 180, 300):
        assert kind_of(np.radians((np.array(bearings_deg) + turn) % 360)) == kind
