"""Free space, kinds of surface, roadways and coverage of maps whose truth is known to the cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raster_mine import RasterMine, cloud_of, plan

from mineloc.data import MapCloud, SurfaceKind
from mineloc.mapping.free_space import free_sheet_of_map
from mineloc.mapping.map_coverage import FLOOR, LEFT, RIGHT, ROOF, Coverage, coverage
from mineloc.mapping.roadway_profiles import map_roadways
from mineloc.mapping.surface_kinds import classify
from mineloc.roadways.mapped import MappedRoadways
from mineloc.roadways.sheet import Sheet

GRID = (500_000.0, 7_100_000.0, -350.0)
# a haulage drift 4 m wide from (2, 10) to (38, 10) and a side drift 3 m wide that leaves it at x = 20
TEE = plan((40, 40), (2, 38, 8, 12), (18.5, 21.5, 12, 36))


def _ramp(mask: np.ndarray, rise: float) -> np.ndarray:
    return np.broadcast_to(np.arange(mask.shape[1]) * 0.1 * rise, mask.shape)


@pytest.fixture(scope="module")
def tee() -> MapCloud:
    return cloud_of(RasterMine(TEE, _ramp(TEE, 0.1)), origin_m=GRID)


FLOWN = np.array(GRID) + np.column_stack([np.arange(4, 36.0), np.full(32, 10.0), np.arange(4, 36) * 0.1 + 1.5])


def _roadways(cloud: MapCloud, flown: np.ndarray = FLOWN) -> tuple[Sheet, MappedRoadways]:
    sheet = free_sheet_of_map(cloud, flown)
    return sheet, map_roadways(cloud, sheet, classify(cloud, sheet))


def test_sheet_covers_what_is_open_with_its_floor_and_roof(tee: MapCloud) -> None:
    sheet = free_sheet_of_map(tee, FLOWN)
    # columns through which a wall runs are not open: at most one cell on either side
    assert 0.85 * TEE.sum() < len(sheet) * 4 <= TEE.sum()
    x, y, z = (sheet.floor_points_m(np.arange(len(sheet))) - GRID).T
    assert TEE[(y * 10).astype(int), (x * 10).astype(int)].mean() > 0.995
    np.testing.assert_allclose(z, 0.1 * x, atol=0.06)
    np.testing.assert_allclose(sheet.roof_m - sheet.floor_m, 3.0, atol=0.06)


def test_levels_over_one_another_are_told_apart_and_rock_between_is_no_roadway() -> None:
    lower = RasterMine(plan((30, 30), (2, 28, 13, 17)), np.zeros((300, 300)))
    # 2 m of rock between the roof of one and the floor of the other: a gap tall enough to fly in
    upper = RasterMine(plan((30, 30), (13, 17, 2, 28)), np.full((300, 300), 5.0))
    cloud = cloud_of(lower, upper)
    low, high = np.array([[5.0, 15.0, 1.5]]), np.array([[15.0, 5.0, 6.5]])
    for flown, floor_m in ((low, 0.0), (high, 5.0)):
        sheet, mapped = _roadways(cloud, flown)
        np.testing.assert_allclose(sheet.floor_m, floor_m, atol=0.05)
        assert not mapped.intersections
        assert mapped.length_m == pytest.approx(26 - 4, abs=3)
    both = free_sheet_of_map(cloud, np.concatenate([low, high]))
    assert set(np.unique(np.round(both.floor_m))) == {0.0, 5.0}
    # where nobody flew, the larger part is better than nothing
    nobody = free_sheet_of_map(cloud, np.array([[100.0, 100.0, 0.0]]))
    assert len(nobody) == len(both) // 2


def test_a_hole_in_the_rock_between_two_levels_does_not_join_them() -> None:
    lower = RasterMine(plan((30, 30), (2, 28, 13, 17)), np.zeros((300, 300)))
    upper = RasterMine(plan((30, 30), (13, 17, 2, 28)), np.full((300, 300), 5.0))
    cloud = cloud_of(lower, upper)
    x, y, z = cloud.points_m.T
    # neither the roof below nor the floor above was seen within half a metre
    hole = (np.hypot(x - 15, y - 15) < 0.3) & (z > 2.5) & (z < 5.5)
    sheet = free_sheet_of_map(cloud.keep(~hole), np.array([[5.0, 15.0, 1.5]]))
    np.testing.assert_allclose(sheet.floor_m, 0.0, atol=0.05)
    np.testing.assert_allclose(sheet.roof_m, 3.0, atol=0.05)


def test_a_curtain_of_dust_closes_no_roadway(tee: MapCloud) -> None:
    """A grain that was seen twice hangs in each column from wall to wall, for a metre of the way."""
    x, y = np.meshgrid(np.arange(10.1, 11.0, 0.2), np.arange(8.1, 12, 0.2))
    z = np.random.default_rng(8).uniform(0.8, 2.2, x.size) + 0.1 * x.ravel()
    grains = np.column_stack([x.ravel(), y.ravel(), z]).astype(np.float32)
    dusty = replace(
        tee.keep(np.concatenate([np.arange(len(tee)), np.zeros(len(grains), np.int64)])),
        points_m=np.concatenate([tee.points_m, grains]),
        normals=np.concatenate([tee.normals, np.tile(np.float32([1, 0, 0]), (len(grains), 1))]),
        visits=np.concatenate([tee.visits, np.full(len(grains), 2, np.int32)]),
    )
    assert len(free_sheet_of_map(dusty, FLOWN)) == pytest.approx(len(free_sheet_of_map(tee, FLOWN)), abs=4)


def test_holes_are_closed_and_a_floor_without_its_roof_is_believed_for_a_little(tee: MapCloud) -> None:
    x, y = (tee.points_map - GRID)[:, :2].T
    whole = free_sheet_of_map(tee, FLOWN)
    specks = tee.keep(~((np.hypot((x % 5) - 2.5, (y % 2) - 1) < 0.25) & (tee.surface == SurfaceKind.FLOOR)))
    assert len(free_sheet_of_map(specks, FLOWN)) == pytest.approx(len(whole), abs=5)
    # no roof over the last 8 m of the haulage: 8 cells of 0.2 m more are believed, and not 8 m
    bare = free_sheet_of_map(tee.keep(~((x > 30) & (tee.surface == SurfaceKind.ROOF))), FLOWN)
    end = (bare.floor_points_m(np.arange(len(bare))) - GRID)[:, 0].max()
    assert 31.0 < end < 32.5


def test_kinds_are_those_of_the_truth(tee: MapCloud) -> None:
    sheet = free_sheet_of_map(tee, FLOWN)
    gap = classify(tee, sheet)
    assert (gap.kind == tee.surface).mean() > 0.985
    for kind in (SurfaceKind.FLOOR, SurfaceKind.WALL, SurfaceKind.ROOF):
        assert (gap.kind == kind)[tee.surface == kind].mean() > 0.97
    known = gap.cell >= 0
    assert known.mean() > 0.999
    height = tee.points_map[:, 2] - GRID[2] - 0.1 * (tee.points_map[:, 0] - GRID[0])
    np.testing.assert_allclose(gap.above_floor_m[known], height[known], atol=0.15)
    np.testing.assert_allclose((gap.above_floor_m + gap.below_roof_m)[known], 3.0, atol=0.15)


def test_a_thing_in_the_open_is_neither_floor_nor_wall(tee: MapCloud) -> None:
    """A sign that hangs in the middle of the haulage, too small to be gone round."""
    middle = np.array([10.0, 10.0, 2.2])
    offsets = np.stack(np.meshgrid([0.0], [-0.1, 0, 0.1], [-0.1, 0, 0.1]), axis=-1).reshape(-1, 3)
    # any nine points, moved to where the sign hangs
    n = len(tee)
    points, normals = tee.points_m.copy(), tee.normals.copy()
    points, normals = np.concatenate([points, middle + offsets]), np.concatenate([normals, np.tile([1, 0, 0], (9, 1))])
    hung = replace(
        tee.keep(np.concatenate([np.arange(n), np.zeros(9, np.int64)])),
        points_m=points.astype(np.float32),
        normals=normals.astype(np.float32),
    )
    assert (classify(hung, free_sheet_of_map(hung, FLOWN)).kind[-9:] == SurfaceKind.OTHER).all()


def test_widths_heights_and_the_intersection_are_found(tee: MapCloud) -> None:
    _, mapped = _roadways(tee)
    (node,) = mapped.intersections
    np.testing.assert_allclose((mapped.nodes_m[node] - GRID)[:2], [20, 10], atol=1.0)
    assert mapped.nodes_m[node, 2] - GRID[2] == pytest.approx(2.0, abs=0.15)
    assert mapped.degrees.count(1) == 3
    for road in mapped.roadways:
        x, y = (road.line_m - GRID)[:, :2].T
        # at the faces and at the mouth the line turns into corners, and with it the width
        side, haulage = (y > 16) & (y < 32), (np.abs(x - 20) > 5) & (np.abs(x - 20) < 14)
        np.testing.assert_allclose(road.width_m[side], 3.0, atol=0.05)
        np.testing.assert_allclose(road.width_m[haulage], 4.0, atol=0.05)
        np.testing.assert_allclose(road.height_m, 3.0, atol=0.06)
        np.testing.assert_allclose(road.line_m[:, 2] - GRID[2], 0.1 * x, atol=0.15)
        assert np.abs(road.left_m - road.right_m)[haulage].max(initial=0.0) < 0.45


def _coverage(cloud: MapCloud) -> Coverage:
    return coverage(cloud, _roadways(cloud)[1])


def test_a_whole_map_is_complete_and_shadows_are_told_by_side(tee: MapCloud) -> None:
    mapped = _roadways(tee)[1]
    whole = coverage(tee, mapped)
    # at a corner of the mouth half a step has no wall beside it
    assert whole.complete_share > 0.98
    assert np.nanmin(whole.seen) > 0.9
    # a point in 0.01 m²; what the other roadway's mouth lacks and corners have twice is little
    np.testing.assert_allclose(whole.points_pm2, 100.0, rtol=0.15)
    np.testing.assert_allclose(whole.measured_pm2, 1000.0, rtol=0.15)
    np.testing.assert_allclose(whole.thickness_m, 0.01, rtol=1e-3)
    x, y, z = (tee.points_map - GRID).T
    high = z - 0.1 * x
    wall = (tee.surface == SurfaceKind.WALL) & (high > 0.2) & (high < 2.8)
    # the south wall of the haulage between 22 and 36 m is gone, and a third of its roof
    shadow = (x > 22) & (x < 36) & ((wall & (y < 9)) | ((tee.surface == SurfaceKind.ROOF) & (np.abs(y - 10) < 0.7)))
    dark = coverage(tee.keep(~shadow), mapped)
    lines = [mapped.roadways[k].line_m - GRID for k in dark.roadway]
    east = np.array([line[:, 0].max() > 25 for line in lines])
    assert east.sum() == 1
    side = LEFT if lines[int(np.argmax(east))][-1, 0] < 25 else RIGHT
    assert dark.seen[east, side][0] < 0.3
    assert 0.5 < dark.seen[east, ROOF][0] < 0.85
    assert dark.seen[east, FLOOR][0] > 0.95
    assert dark.complete[east][0] < 0.35
    np.testing.assert_allclose(dark.seen[~east], whole.seen[~east], atol=0.1)
    assert dark.complete_share < whole.complete_share - 0.15


def test_pieces_lie_one_after_the_other(tee: MapCloud) -> None:
    mapped = _roadways(tee)[1]
    found = coverage(tee, mapped, piece_m=5.0)
    for number, road in enumerate(mapped.roadways):
        own = found.roadway == number
        assert own.sum() == round(road.length_m / 5.0)
        np.testing.assert_allclose(found.begin_m[own][1:], found.end_m[own][:-1])
        assert found.end_m[own][-1] == pytest.approx(road.length_m)


def test_nothing_gives_nothing() -> None:
    empty = cloud_of(RasterMine(np.zeros((3, 3), np.bool_), np.zeros((3, 3))))
    sheet, mapped = _roadways(empty, np.zeros((1, 3)))
    assert len(sheet) == 0
    assert not mapped.roadways
    assert np.isnan(coverage(empty, mapped).complete_share)
    # a floor without a roof is a field
    floor = cloud_of(RasterMine(plan((9, 9), (1, 8, 1, 8)), np.zeros((90, 90))))
    field = floor.keep(floor.surface == SurfaceKind.FLOOR)
    assert len(free_sheet_of_map(field, np.array([[4.0, 4.0, 1.0]]))) == 0
