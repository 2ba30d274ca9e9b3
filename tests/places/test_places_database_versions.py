"""Databases of a mine that grows: places keep their numbers and names, parts become the whole."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.config import IntersectionsConfig
from mineloc.data import F64, Intersection, IntersectionDatabase, Sight, WallContour
from mineloc.places.database import database_of
from mineloc.places.database_versions import has_frame_of, merged, renumbered_since, same_places

CONFIG = IntersectionsConfig(contour_bins=36, matrix_rows=4)
GRID = np.array([512_345.678901234, 4_398_765.4321, 2_300.1])
ELSEWHERE = GRID + np.array([-321.7, 88.8, 12.0])
T, X = np.array([0.0, np.pi / 2, np.pi]), np.array([0.0, np.pi / 2, np.pi, 3 * np.pi / 2])


def place(id: int, at: F64 | tuple[float, float, float], *, seed: int | None = None, **changed: object) -> Intersection:
    """A T, its descriptors drawn from a seed."""
    rng = np.random.default_rng(id if seed is None else seed)
    distance = rng.uniform(0.2, 1, 36).astype(np.float32)
    contour = WallContour(distance, np.full(36, Sight.WALL, np.uint8), 8.0, T)
    points = rng.normal(0, 5, (5, 3)).astype(np.float32)
    matrix = rng.uniform(0.1, 1, (4, 36)).astype(np.float32)
    one = Intersection(
        id, f"T {id}", "T", np.array(at, dtype=float), np.eye(3), contour, matrix, points, points, (), 0.5
    )
    return replace(one, **changed)


def of(
    *places: Intersection, sha256: str = "aa", origin: F64 = GRID, is_grid: bool = True, next_id: int | None = None
) -> IntersectionDatabase:
    """A first version, its points told in the frame of `GRID`."""
    shifted = [replace(one, point_map=one.point_map + (GRID - origin)) for one in places]
    known = database_of(shifted, CONFIG, grid_origin_m=origin, is_grid=is_grid, map_sha256=sha256)
    return known if next_id is None else replace(known, lineage=replace(known.lineage, next_id=next_id))


def called(known: IntersectionDatabase) -> dict[int, str]:
    return {one.id: one.name for one in known.intersections}


def since(old: IntersectionDatabase, new: IntersectionDatabase):
    return renumbered_since(old, new, parent="old", apart_m=CONFIG.apart_m)


def merge(a: IntersectionDatabase, b: IntersectionDatabase):
    return merged(a, b, CONFIG, parents=("file a", "file b"))


def assert_same_content(one: IntersectionDatabase, other: IntersectionDatabase) -> None:
    assert called(one) == called(other)
    assert one.twins == other.twins
    assert one.contour_threshold == pytest.approx(other.contour_threshold, abs=1e-12)
    assert np.allclose(one.contour_similarity, other.contour_similarity, atol=1e-12)
    assert np.allclose(one.matrix_similarity, other.matrix_similarity, atol=1e-12)
    for a, b in zip(one.intersections, other.intersections, strict=True):
        assert (a.kind, a.neighbours, a.quality) == (b.kind, b.neighbours, b.quality)
        assert np.allclose(a.point_map, b.point_map, atol=1e-8)
        assert np.array_equal(a.matrix, b.matrix)


def test_a_mine_that_grew_keeps_numbers_and_names_and_gives_fresh_ones() -> None:
    # 9 was retired long ago; 5 is gone now
    old = of(
        place(2, (0, 0, 0), name="Main cross"), place(4, (50, 0, 0)), place(5, (90, 0, 0), name="Old shaft"), next_id=10
    )
    new = of(
        place(0, (200, 0, 0), neighbours=((1, 150.0),)),
        place(1, (51.5, -1, 0.5), neighbours=((0, 150.0), (2, 50.0))),
        place(2, (0.2, 0.1, -0.3), neighbours=((1, 50.0),)),
        place(3, (90, 0, 5.0)),
        sha256="bb",
        origin=ELSEWHERE,
    )
    known, changes = since(old, new)
    assert called(known) == {2: "Main cross", 4: "T 4", 10: "T 10", 11: "T 11"}
    assert (changes.kept, changes.new, changes.retired) == ((2, 4), (10, 11), ((5, "Old shaft"),))
    assert known.by_id(4).neighbours == ((2, 50.0), (10, 150.0))
    assert known.by_id(10).neighbours == ((4, 150.0),)
    # what is known of the places is of today, in today's frame
    assert np.array_equal(known.by_id(2).point_map, new.by_id(2).point_map)
    assert np.array_equal(known.grid_origin_m, ELSEWHERE)
    line = known.lineage
    assert (line.version, line.parents, line.next_id, line.maps) == (2, ("old",), 12, ("bb",))
    # a third version never gives 5 again
    third, changes = since(known, of(place(0, (90, 0, 0)), sha256="cc"))
    assert (called(third), third.lineage.version, third.lineage.next_id) == ({12: "T 12"}, 3, 13)
    assert [id for id, _ in changes.retired] == [2, 4, 10, 11]


def test_what_is_told_of_pairs_follows_the_new_order() -> None:
    rng = np.random.default_rng(1)
    at = [(100.0 * k, 0.0, 0.0) for k in range(5)]
    # 1 and 3 of the new one look alike
    new = of(*[place(k, at[k], seed=1 if k == 3 else k) for k in range(5)], sha256="bb")
    assert new.twins == ((1, 3),)
    order = rng.permutation(5)
    old = of(*[place(id, at[k]) for id, k in enumerate(order)])
    known, _ = since(old, new)
    whole = of(*known.intersections, sha256="bb")
    assert_same_content(known, whole)
    assert known.twins == (tuple(sorted((int(np.argmax(order == 1)), int(np.argmax(order == 3))))),)


def test_a_kind_that_a_person_chose_holds_while_the_shape_does() -> None:
    def grown(one: Intersection) -> Intersection:
        return replace(one, kind="X", name=f"X {one.id}", contour=replace(one.contour, branches_rad=X))

    told = place(0, (0, 0, 0), kind="Y", name="Y 0")
    named = place(1, (50, 0, 0), name="Main cross")
    plain = place(2, (90, 0, 0))
    old = of(told, named, plain)
    again, _ = since(old, of(place(0, (90, 0, 0)), place(1, (50, 0, 0)), place(2, (0, 0, 0)), sha256="bb"))
    assert [(one.name, one.kind) for one in again.intersections] == [("Y 0", "Y"), ("Main cross", "T"), ("T 2", "T")]
    new = of(*[grown(place(k, at)) for k, at in enumerate(((90, 0, 0), (50, 0, 0), (0, 0, 0)))], sha256="bb")
    known, _ = since(old, new)
    assert [(one.name, one.kind) for one in known.intersections] == [("X 0", "X"), ("Main cross", "X"), ("X 2", "X")]


def test_each_place_is_taken_once_by_the_nearest_on_its_level() -> None:
    a = of(place(0, (0, 0, 0)), place(1, (4, 0, 0)), place(2, (50, 0, 0)), place(3, (90, 0, 0)))
    b = of(
        place(5, (2.5, 0, 0)), place(6, (4.1, 0, 0)), place(7, (53.01, 0, 0)), place(8, (90, 0, 2.01)),
        place(9, (92.9, 0, 1.9)), sha256="bb",
    )  # fmt: skip
    assert same_places(a, b, apart_m=3.0) == {6: 1, 5: 0, 9: 3}


def test_maps_without_a_grid_are_not_compared_unless_they_are_one() -> None:
    old = of(place(0, (0, 0, 0)), is_grid=False)
    for other in (of(place(0, (0, 0, 0)), is_grid=False, sha256="bb"), of(place(0, (0, 0, 0)), sha256="bb")):
        for pair in ((old, other), (other, old)):
            with pytest.raises(ValueError, match="frame"):
                since(*pair)
            with pytest.raises(ValueError, match="grid"):
                merge(*pair)
    assert has_frame_of(old, is_grid=False, map_sha256="aa")
    assert since(old, old)[1].kept == (0,)


def test_two_parts_become_one() -> None:
    a = of(
        place(0, (0, 0, 0), neighbours=((1, 50.0),)),
        place(1, (50, 0, 0), neighbours=((0, 50.0),), quality=0.4),
        place(3, (0, 90, 0), name="Pump"),
        next_id=5,
    )
    b = of(
        place(1, (51, 0, 0), seed=77, neighbours=((2, 40.0), (7, 48.0)), quality=0.9, name="Main cross"),
        place(2, (90, 0, 0), neighbours=((1, 41.0),)),
        place(4, (0, 90.5, 0), quality=0.9, name="Sump"),
        place(7, (0.1, 0, 0), neighbours=((1, 48.0),)),
        place(8, (200, 0, 0)),
        sha256="bb",
        origin=ELSEWHERE,
    )
    known, changes = merge(a, b)
    # 2 may have been used by a, 8 cannot; names of people stay, the first part's where both have one
    assert called(known) == {0: "T 0", 1: "Main cross", 3: "Pump", 8: "T 8", 9: "T 9"}
    assert (changes.kept, changes.new, changes.retired) == ((0, 1, 3), (8, 9), ())
    assert changes.renumbered == ((2, 9), (4, 3), (7, 0))
    assert known.by_id(0).neighbours == ((1, 48.0),)
    assert known.by_id(1).neighbours == ((0, 48.0), (9, 40.0))
    assert known.by_id(9).neighbours == ((1, 40.0),)
    # the better one stays, where it is in the grid
    assert np.array_equal(known.by_id(1).matrix, b.by_id(1).matrix)
    assert np.array_equal(known.by_id(0).matrix, a.by_id(0).matrix)
    assert known.by_id(1).point_map == pytest.approx([51, 0, 0], abs=1e-6)
    line = known.lineage
    assert (line.version, line.parents, line.next_id, line.maps) == (2, ("file a", "file b"), 10, ("aa", "bb"))
    assert known.map_sha256 not in line.maps


def test_descriptors_are_compared_at_the_scale_that_they_were_made_with() -> None:
    known = of(place(0, (0, 0, 0)), place(1, (50, 0, 0)))
    other = CONFIG.model_copy(update={"contour_radius_m": 20.0})
    again, _ = merged(known, known, other, parents=("a", "b"))
    assert np.array_equal(again.matrix_similarity, known.matrix_similarity)


@st.composite
def mines(draw: st.DrawFn) -> IntersectionDatabase:
    """Places far apart on two levels, some named, some twins, joined by ways."""
    count = draw(st.integers(0, 6))
    ids = sorted(draw(st.sets(st.integers(0, 40), min_size=count, max_size=count)))
    pairs = [pair for pair in combinations(ids, 2) if draw(st.booleans())]
    ways = {pair: float(draw(st.integers(5, 90))) for pair in pairs}
    found = [
        place(
            id,
            (10.0 * (k // 2), 5.0, 2.5 * (k % 2)),
            seed=draw(st.integers(0, 3)),
            name=draw(st.sampled_from([f"T {id}", "Main cross", ""])),
            kind=draw(st.sampled_from(["T", "T", "X", "bay"])),
            quality=draw(st.sampled_from([0.2, 0.9])),
            neighbours=tuple(sorted((a + b - id, way) for (a, b), way in ways.items() if id in (a, b))),
        )
        for k, id in enumerate(ids)
    ]
    return of(*found, next_id=draw(st.integers(41, 44)))


@settings(deadline=None, max_examples=30)
@given(known=mines())
def test_since_itself_nothing_is_new_and_nothing_gone(known: IntersectionDatabase) -> None:
    again, changes = since(known, known)
    assert_same_content(again, known)
    assert (changes.kept, changes.new, changes.retired) == (tuple(called(known)), (), ())
    assert (again.lineage.version, again.lineage.next_id) == (2, known.lineage.next_id)


@settings(deadline=None, max_examples=30)
@given(known=mines())
def test_merging_with_itself_changes_nothing(known: IntersectionDatabase) -> None:
    again, changes = merge(known, known)
    assert_same_content(again, known)
    assert (changes.new, changes.renumbered, again.lineage.next_id) == ((), (), known.lineage.next_id)
    assert again.lineage.maps == known.lineage.maps


@settings(deadline=None, max_examples=30)
@given(whole=mines(), data=st.data())
def test_halves_become_the_whole_up_to_numbers(whole: IntersectionDatabase, data: st.DataObject) -> None:
    sides = [data.draw(st.sampled_from(["a", "b", "ab"])) for _ in whole.intersections]

    def half(side: str, numbers: dict[int, int], **facts: object) -> IntersectionDatabase:
        there = {one.id for one, on in zip(whole.intersections, sides, strict=True) if side in on}
        part = [
            replace(
                one,
                id=numbers[one.id],
                name=f"{one.kind} {numbers[one.id]}" if one.name == f"{one.kind} {one.id}" else one.name,
                neighbours=tuple(sorted((numbers[to], way) for to, way in one.neighbours if to in there)),
            )
            for one in whole.intersections
            if one.id in there
        ]
        return of(*sorted(part, key=lambda one: one.id), **facts)

    shuffled = data.draw(st.permutations(range(len(whole))))
    other = {one.id: shuffled[k] for k, one in enumerate(whole.intersections)}
    a = half("a", {id: id for id in called(whole)})
    b = half("b", other, sha256="bb", origin=ELSEWHERE)
    known, changes = merge(a, b)
    # back to the whole's numbers, by the places
    names = same_places(whole, known, apart_m=0.01)
    assert len(known) == len(whole) == len(names)
    assert all(names[id] == id for id in changes.kept)
    joined = {on.id: side for on, side in zip(whole.intersections, sides, strict=True)}
    for one in known.intersections:
        expected = whole.by_id(names[one.id])
        # a way is known if a half knows both its ends
        ways = [(to, way) for to, way in expected.neighbours if set(joined[to]) & set(joined[expected.id])]
        assert sorted((names[to], way) for to, way in one.neighbours) == ways
        is_named = expected.name != f"{expected.kind} {expected.id}"
        assert one.name == (expected.name if is_named else f"{expected.kind} {one.id}")
        assert (one.kind, one.quality) == (expected.kind, expected.quality)
        assert np.array_equal(one.matrix, expected.matrix)
    assert {tuple(sorted((names[a], names[b]))) for a, b in known.twins} == set(whole.twins)
    assert known.contour_threshold == pytest.approx(whole.contour_threshold)


def test_a_frame_without_a_grid_is_not_moved() -> None:
    with pytest.raises(ValueError, match="grid"):
        of(place(0, (0, 0, 0)), is_grid=False).in_frame_at(GRID + 1)
    with pytest.raises(ValueError, match="next_id"):
        of(place(3, (0, 0, 0)), next_id=3)
