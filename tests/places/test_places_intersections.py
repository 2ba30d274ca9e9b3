"""Free space, branches, invariant point and descriptors on drawn roadways and on laws that hold for any."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_scenes import Plan
from scipy.ndimage import uniform_filter

from mineloc import se3
from mineloc.config import IntersectionsConfig
from mineloc.data import F64, Sight, WallContour
from mineloc.places.branches import (
    Branch,
    Junction,
    find_junctions,
    invariant_point,
    ring,
    ring_plainly,
    runs_on,
    runs_plainly,
)
from mineloc.places.clearance import clearance_of, clearance_plainly
from mineloc.places.contour_matrix import contour_matrix, matrix_likeness
from mineloc.places.free_grid import FreeGrid, PlanView, free_grid, plan_view, plan_view_plainly
from mineloc.places.wall_contour import (
    branches_fit,
    contour_likeness,
    likeness_curve,
    likeness_curve_plainly,
    wall_contour,
)

CONFIG = IntersectionsConfig()
SHAPES = {
    "T90": (0, 90, 180),
    "T70": (0, 70, 180),
    "Y120": (0, 120, 240),
    "Y40": (0, 160, 200),
    "X90": (0, 90, 180, 270),
    "X60": (0, 60, 180, 240),
    "five": (0, 72, 144, 216, 288),
}


def at(x_m: float, y_m: float, yaw_deg: float = 0.0) -> F64:
    T = se3.exp(np.array([0, 0, np.radians(yaw_deg), 0, 0, 0]))
    T[:2, 3] = x_m, y_m
    return T


def flown_grid(plan: Plan, way: list[F64], seed: int = 0) -> FreeGrid:
    """Free space as known at the last of some poses of a flight."""
    rng = np.random.default_rng(seed)
    views = [plan_view(plan.sweep(T[:2, 3], 0.0, rng), T[:2, 3], CONFIG) for T in way]
    return free_grid(views, way[-1][:2, 3], CONFIG)


def along_x(start_m: float, end_m: float) -> list[F64]:
    return [at(x, 0.0) for x in np.arange(start_m, end_m + 0.5, 1.0)]


def seen(plan: Plan, way: list[F64], seed: int = 0) -> list[Junction]:
    return find_junctions(flown_grid(plan, way, seed), CONFIG)


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10_000), x=st.floats(-500, 500), y=st.floats(-500, 500))
def test_the_kernel_votes_as_plain_numpy_does(seed: int, x: float, y: float) -> None:
    rng = np.random.default_rng(seed)
    config = CONFIG.model_copy(update={"range_m": 6.0})
    cloud = rng.normal(0, 3, (int(rng.integers(0, 200)), 3)).astype(np.float32)
    fast, plain = (make(cloud, np.array([x, y]), config) for make in (plan_view, plan_view_plainly))
    for cells, others in ((fast.open_cells, plain.open_cells), (fast.wall_cells, plain.wall_cells)):
        # a place on the line between two cells may round either way
        assert len({*map(tuple, cells.tolist())} ^ {*map(tuple, others.tolist())}) <= 2
        assert len({*map(tuple, cells.tolist())}) == len(cells)


def test_most_keyframes_decide_what_a_cell_is() -> None:
    def cells(*places: tuple[int, int]) -> np.ndarray:
        return np.array(places, np.int32).reshape(-1, 2)

    config = CONFIG.model_copy(update={"half_m": 1.0})
    views = [
        PlanView(cells((0, 0), (0, 1), (2, 3)), cells((0, 2))),
        PlanView(cells((0, 0), (0, 2), (900, 0)), cells((0, 1))),
        PlanView(cells((0, 2)), cells((0, 1))),
    ]
    grid = free_grid(views, np.array([0.03, -0.02]), config)
    assert grid.sight.shape == (11, 11)
    assert grid.origin_m == pytest.approx([-1.03, -0.98])
    row, column = grid.cells_of(np.array([[-0.03, 0.02], [0.17, 0.02], [0.37, 0.02], [0.57, 0.42]]))
    assert grid.sight[row, column].tolist() == [Sight.OPEN, Sight.WALL, Sight.OPEN, Sight.OPEN]
    assert (grid.sight != Sight.UNKNOWN).sum() == 4


@settings(deadline=None, max_examples=80)
@given(filled=st.lists(st.booleans(), min_size=4, max_size=40), gap=st.integers(0, 3))
def test_runs_on_a_ring_are_those_of_numpy(filled: list[bool], gap: int) -> None:
    def covered(runs: np.ndarray) -> set[tuple[int, int]]:
        return {(first % len(filled), end - first) for first, end in runs.tolist()}

    ring_of = np.array(filled)
    assert covered(runs_on(ring_of, gap)) == covered(runs_plainly(ring_of, gap))


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10_000), rows=st.integers(3, 40), columns=st.integers(3, 40), smooth=st.integers(1, 9))
def test_clearance_and_rings_are_those_of_scipy(seed: int, rows: int, columns: int, smooth: int) -> None:
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(rows, columns))
    is_open = np.asarray(uniform_filter(noise, smooth)) > rng.uniform(-0.3, 0.3) / smooth
    here = float(rng.uniform(0, rows)), float(rng.uniform(0, columns))
    how = {"window": 5, "least": 1.2, "within": 18.0}
    fast, plain = clearance_of(is_open, here, **how), clearance_plainly(is_open, here, **how)
    assert (fast.free == plain.free).all()
    if not plain.free.all():  # without any wall there is no distance to one
        assert fast.cells == pytest.approx(plain.cells)
        assert (fast.peaks == plain.peaks).all()
    radius = float(rng.uniform(1, 15))
    assert (ring(plain.free, *here, radius, 1.0, 90) == ring_plainly(plain.free, *here, radius, 1.0, 90)).all()


def way_through(shape: str, start_m: float, end_m: float) -> list[F64]:
    """From `start_m` (negative: on the last roadway) to `end_m` (on the first one), heading along the way."""
    into, out = SHAPES[shape][-1], SHAPES[shape][0]
    way: list[F64] = []
    for s in np.arange(start_m, end_m + 0.5, 1.0):
        bearing = into if s < 0 else out
        x, y = abs(s) * np.cos(np.radians(bearing)), abs(s) * np.sin(np.radians(bearing))
        way.append(at(x, y, bearing + 180.0 if s < 0 else bearing))
    return way


@pytest.mark.parametrize("shape", SHAPES)
def test_an_intersection_flown_through_has_its_branches_and_its_point(shape: str) -> None:
    plan = Plan(SHAPES[shape])
    points, counts, none = [], [], 0
    for seed, end_m in enumerate((-1.0, 0.0, 1.0, 2.0, 3.0)):
        way = way_through(shape, -8.0, end_m)
        assert plan.is_open(np.array([T[:2, 3] for T in way])).all()
        places = [(one, one.point_m + way[-1][:2, 3]) for one in seen(plan, way, seed)]
        near = [(one, place) for one, place in places if np.linalg.norm(place) < 2.5]
        none += not near
        points += [place for _, place in near[:1]]
        counts += [len(one.branches) for one, _ in near[:1]]
    assert none <= 1
    # two roadways that part at 40 degrees are one for six metres: their point is not where it was drawn, but repeats
    assert np.median(np.linalg.norm(points, axis=1)) < (2.0 if shape == "Y40" else 0.5)
    assert np.linalg.norm(np.std(points, axis=0)) < 0.5
    assert np.median(counts) == len(SHAPES[shape])


def test_bearings_are_those_of_the_roadways() -> None:
    (junction,) = seen(Plan(SHAPES["T70"]), along_x(-8, 1))
    assert np.degrees(junction.branches_rad) == pytest.approx([0, 70, 180], abs=12) or np.degrees(
        junction.branches_rad
    ) == pytest.approx([70, 180, 360], abs=12)


@pytest.mark.parametrize("seed", range(15))
def test_a_roadway_without_branches_has_no_intersection(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bend = float(rng.uniform(-40, 40))
    plan = Plan((0, 180 + bend), width_m=float(rng.uniform(2.5, 6)), rough_m=0.2, length_m=40)
    for x in rng.uniform(3, 12, 2):
        assert seen(plan, along_x(x - 3, x), seed) == []


def test_a_dead_end_and_a_room_are_none() -> None:
    assert seen(Plan((0,), length_m=12.0), along_x(3, 10)) == []
    assert find_junctions(FreeGrid(0.2, np.array([-5.0, -5.0]), np.full((51, 51), Sight.OPEN, np.uint8)), CONFIG) == []
    assert find_junctions(FreeGrid(0.2, np.array([-5.0, -5.0]), np.zeros((51, 51), np.uint8)), CONFIG) == []


@given(seed=st.integers(0, 1000), x=st.floats(-3, 3), y=st.floats(-3, 3), count=st.integers(3, 5))
def test_lines_through_one_point_meet_there(seed: int, x: float, y: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    bearings = np.sort(np.arange(count) * 2 * np.pi / count + rng.uniform(-0.3, 0.3, count))
    ways = np.column_stack([np.cos(bearings), np.sin(bearings)])
    branches = tuple(Branch(float(b), np.array([x, y]) + 4 * way, 3.0) for b, way in zip(bearings, ways, strict=True))
    point, covariance = invariant_point(branches, np.array([x, y]), CONFIG)
    assert point == pytest.approx([x, y], abs=1e-9)
    assert np.linalg.eigvalsh(covariance).min() > 0


def contour(seed: int) -> WallContour:
    rng = np.random.default_rng(seed)
    smooth = 0.5 + 0.3 * np.sin(np.linspace(0, 2 * np.pi, 180, endpoint=False) * rng.integers(2, 5) + rng.uniform(0, 6))
    sight = rng.choice([Sight.WALL, Sight.OPEN, Sight.UNKNOWN], 180, p=[0.7, 0.2, 0.1]).astype(np.uint8)
    noise = rng.normal(0, 0.03, 180)
    distance = np.where(sight == Sight.WALL, np.clip(smooth + noise, 0.05, 1.0), 0.0).astype(np.float32)
    return WallContour(distance, sight, CONFIG.contour_radius_m, np.array([0.5, 2.0, 4.0]))


def turned(one: WallContour, bins: int) -> WallContour:
    branches = np.sort((one.branches_rad + 2 * np.pi * bins / 180) % (2 * np.pi))
    return WallContour(np.roll(one.distance, bins), np.roll(one.sight, bins), one.radius_m, branches)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 1000), other=st.integers(0, 1000))
def test_the_compiled_curve_is_the_plain_one(seed: int, other: int) -> None:
    a, b = contour(seed), contour(other)
    assert likeness_curve(a, b, CONFIG) == pytest.approx(likeness_curve_plainly(a, b, CONFIG), abs=0.01)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), bins=st.integers(0, 179))
def test_a_turn_is_found_with_its_sign(seed: int, bins: int) -> None:
    a = contour(seed)
    found = contour_likeness(turned(a, bins), a, CONFIG)
    assert found.similarity == pytest.approx(1.0, abs=1e-6)
    off = (found.yaw_rad - np.radians(2 * bins) + np.pi) % (2 * np.pi) - np.pi
    assert abs(off) < np.radians(1.0)
    assert branches_fit(turned(a, bins).branches_rad, a.branches_rad, found.yaw_rad, within_rad=0.1)
    assert not branches_fit(turned(a, bins).branches_rad, a.branches_rad, found.yaw_rad + 0.6, within_rad=0.1)


def test_contours_that_share_too_little_are_not_alike() -> None:
    a = contour(1)
    sight = np.zeros(180, np.uint8)
    sight[:20] = Sight.OPEN
    nothing = WallContour(np.zeros(180, np.float32), sight, a.radius_m, np.zeros(0))
    assert contour_likeness(a, nothing, CONFIG).similarity == 0.0
    with pytest.raises(ValueError, match="other sizes"):
        contour_likeness(a, WallContour(a.distance[:90], a.sight[:90], a.radius_m, np.zeros(0)), CONFIG)


def described(shape: str, way: list[F64], seed: int) -> WallContour:
    grid = flown_grid(Plan(SHAPES[shape]), way, seed)
    junction = min(find_junctions(grid, CONFIG), key=lambda one: float(np.linalg.norm(one.point_m)))
    return wall_contour(grid, junction.point_m, junction.branches_rad, CONFIG)


def test_an_intersection_is_more_like_itself_from_elsewhere_than_like_others() -> None:
    """Stored when flown through in one way; seen again when flown through in the other."""
    stored = {shape: described(shape, way_through(shape, -8.0, 2.0), seed=1) for shape in SHAPES}
    around = se3.exp(np.array([0, 0, np.pi, 0, 0, 0]))
    right = 0
    for shape in SHAPES:
        back = [T @ around for T in reversed(way_through(shape, -2.0, 8.0))]
        again = described(shape, back, seed=2)
        ranked = sorted(stored, key=lambda name: -contour_likeness(stored[name], again, CONFIG).similarity)
        right += ranked[0] == shape
        # where two roadways part at 40 degrees the point moves with the view (METHOD 5.2: a tenth are below 0.49)
        least = 0.5 if shape == "Y40" else 0.6
        assert contour_likeness(stored[shape], again, CONFIG).similarity > least, shape
    assert right >= 6


@given(seed=st.integers(0, 1000), bins=st.integers(-90, 90))
@settings(deadline=None, max_examples=20)
def test_a_matrix_turns_with_its_points(seed: int, bins: int) -> None:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, 6000)
    r = 3.0 + np.sin(3 * angle) + rng.normal(0, 0.02, 6000)
    points = np.column_stack([r * np.cos(angle), r * np.sin(angle), rng.uniform(0, 3, 6000)])
    yaw = np.radians(2 * bins)
    T = se3.exp(np.array([0, 0, yaw, 1.0, -2.0, 0.0]))
    a = contour_matrix(se3.apply(T, points), T[:2, 3], 0.0, CONFIG)
    b = contour_matrix(points, np.zeros(2), 0.0, CONFIG)
    assert matrix_likeness(a, b, yaw, CONFIG) > 0.9
    assert matrix_likeness(a, b, yaw + np.radians(60), CONFIG) < 0.6
    assert matrix_likeness(a, np.zeros_like(b), yaw, CONFIG) == 0.0
