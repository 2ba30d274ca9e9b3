"""Survey control from observation to solved graph, on flights whose odometry drifts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mineloc import se3
from mineloc.config import ControlConfig, GraphConfig
from mineloc.data import ControlPoint, Keyframe, Observation, RelativePose, Trajectory
from mineloc.graph.batch import solve
from mineloc.graph.pose_graph import PoseGraph
from mineloc.localize.control import (
    GridReference,
    graph_with_control,
    judge,
    local_origin,
    place_in_grid,
    residuals,
)
from mineloc.localize.sightings import FlownPoses, carry_to_keyframes
from mineloc.mapping.control import verdict_of

GRID = np.array([500_321.0, 7_100_654.0, -350.0])
YAW = 1.9
CONFIG, GRAPH = ControlConfig(), GraphConfig()
SWEEPS = 4  # a metre
STEP = np.r_[np.radians([0.01, 0.01, 0.015]), [0.01, 0.005, 0.005]]  # of a metre of odometry, a third of METHOD 7.2's
START_NS = 1_790_000_000_000_000_000
PERIOD_NS = 100_000_000


def _T_grid_map() -> np.ndarray:
    T = se3.exp(np.array([0, 0, YAW, 0, 0, 0.0]))
    T[:3, 3] = GRID
    return T


@dataclass
class Flight:
    """Truth `T_map_lidar` and odometry of every sweep; every fourth sweep is a keyframe."""

    truth: np.ndarray
    odometry: Trajectory
    name: str
    motions: np.ndarray

    @property
    def keyframes(self) -> np.ndarray:
        return np.arange(0, len(self.truth), SWEEPS)

    def flown(self, *, first: int = 0, frame: str = "", at: np.ndarray | None = None) -> FlownPoses:
        rows = self.keyframes
        poses = self.odometry.poses[rows] if at is None else at
        return FlownPoses(self.name, self.odometry, self.odometry.stamps_ns[rows], poses, first, frame)


def _fly(length_m: int, *, seed: int, name: str = "one", noise: float = 1.0, start_ns: int = START_NS) -> Flight:
    """A winding flight that ends far from its start; odometry begins in its own frame."""
    rng = np.random.default_rng(seed)
    s = np.arange(length_m * SWEEPS + 1) / SWEEPS
    heading = 0.8 * np.sin(s / 60.0) + np.pi / 2 * (s > length_m / 2)
    xi = np.zeros((len(s), 6))
    xi[:, 2] = heading + 0.2 * np.sin(s)
    xi[:, 1] = 0.05 * np.sin(s / 2)
    truth = se3.exp(xi)
    step = np.column_stack([np.cos(heading), np.sin(heading), 0.02 * np.sin(s / 40)]) / SWEEPS
    truth[:, :3, 3] = np.cumsum(step, axis=0)
    motions = (
        se3.inverse(truth[:-1]) @ truth[1:] @ se3.exp(rng.normal(size=(len(s) - 1, 6)) * STEP * noise / np.sqrt(SWEEPS))
    )
    poses = [_levelled_start(truth[0])]
    for motion in motions:
        poses.append(se3.rigid(poses[-1] @ motion))
    stamps = start_ns + np.arange(len(s), dtype=np.int64) * PERIOD_NS
    return Flight(truth, Trajectory(stamps, np.array(poses), "odom", "lidar"), name, motions)


def _levelled_start(T: np.ndarray) -> np.ndarray:
    """The odometry's first pose: level as the truth, but with heading and position of its own."""
    turn = se3.exp(np.array([0, 0, -1.1, 0, 0, 0.0]))
    out = turn @ T
    out[:3, 3] = 0.0
    return out


def _survey(flight: Flight, *, count: int, seed: int, each: int = 4, checks: bool = True, prefix: str = "T"):
    """Targets to the side along the flight and noisy observations of them; every third is a check point."""
    rng = np.random.default_rng(seed + 100)
    points, seen = [], []
    for k, middle in enumerate(np.linspace(20, len(flight.truth) - 21, count).astype(int)):
        where = se3.apply(flight.truth[middle], np.array([[0.3, 2.5 * (-1) ** k, 0.5]]))[0]
        surveyed = se3.apply(_T_grid_map(), where[None])[0] + rng.normal(size=3) * 0.005
        role = "check" if checks and k % 3 == 2 else "control"
        points.append(ControlPoint(f"{prefix}{k}", surveyed, 0.005, 0.005, role))
        for row in middle + rng.permutation(np.arange(-16, 17))[:each]:
            stamp = int(flight.odometry.stamps_ns[row])
            T = flight.truth[row]
            at = se3.apply(se3.inverse(T), where[None])[0] + rng.normal(size=3) * 0.01
            seen.append(Observation.picked(f"{prefix}{k}", flight.name, stamp, at, sigma_m=0.01))
    return points, seen


def _graph(
    flight: Flight,
    reference: GridReference,
    config: GraphConfig = GRAPH,
    *,
    claimed: float = 1.0,
    up: tuple[float, float, float] = (0, 0, 1),
) -> PoseGraph:
    """Edges claim `claimed` times the error that they have; `up` is what the IMU says, in the map."""
    graph = PoseGraph(config)
    placement = reference.placements[0]
    assert placement.T_local_map is not None
    rows = flight.keyframes
    for k, row in enumerate(rows):
        up_lidar = flight.truth[row, :3, :3].T @ np.array(up)
        keyframe = Keyframe(k, int(flight.odometry.stamps_ns[row]), flight.odometry.poses[row], _NONE, up_lidar)
        if k == 0:
            first = placement.T_local_map @ flight.odometry.poses[0]
            graph.add_first(keyframe, T_map_lidar=first, covariance=placement.anchor_covariance)
        else:
            T = se3.rigid(se3.inverse(flight.odometry.poses[rows[k - 1]]) @ flight.odometry.poses[row])
            graph.add_next(keyframe, RelativePose(k - 1, k, T, np.diag((claimed * STEP) ** -2.0)))
    for fix in reference.point_fixes():
        graph.add_point_fix(fix)
    return graph


_NONE = np.zeros((0, 3), np.float32)


def _error_m(flight: Flight, reference: GridReference, poses: np.ndarray) -> np.ndarray:
    """(k,) distances of keyframes from the truth, in the mine grid."""
    truth = se3.apply(_T_grid_map(), flight.truth[flight.keyframes, :3, 3])
    return np.linalg.norm(poses[:, :3, 3] + reference.origin_grid - truth, axis=1)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return _fly(300, seed=1)


def test_observations_are_carried_to_the_keyframe_they_are_nearest_to() -> None:
    exact = _fly(60, seed=0, noise=0.0)
    points, seen = _survey(exact, count=3, seed=0, each=12)
    carried, unused = carry_to_keyframes(points, seen, [exact.flown(first=100)], CONFIG)
    assert unused == ()
    assert [s.observation for s in carried] == seen
    for sighting, observation in zip(carried, seen, strict=True):
        row = int(np.searchsorted(exact.odometry.stamps_ns, observation.stamp_ns))
        key = exact.keyframes[sighting.keyframe - 100]
        assert abs(key - row) <= SWEEPS / 2
        there = se3.apply(exact.truth[key], sighting.point_lidar[None])
        np.testing.assert_allclose(there, se3.apply(exact.truth[row], observation.point_lidar[None]), atol=1e-9)
        extra = np.trace(sighting.covariance_lidar) - np.trace(observation.covariance_lidar)
        assert extra == pytest.approx(0.0, abs=1e-15) if key == row else extra > 3 * (0.01 * 0.24) ** 2
    assert {s.keyframe * SWEEPS % SWEEPS for s in carried} == {0}


def test_a_sighting_s_stated_sigma_covers_the_odometry_between() -> None:
    noisy = _fly(200, seed=2)
    points, seen = _survey(noisy, count=6, seed=2, each=30)
    carried, _ = carry_to_keyframes(points, seen, [noisy.flown()], CONFIG)
    T = noisy.truth[noisy.keyframes]
    off = np.array(
        [
            se3.apply(T[s.keyframe], s.point_lidar[None])[0]
            - se3.apply(se3.inverse(_T_grid_map()), points[s.point].position_grid[None])[0]
            for s in carried
        ]
    )
    sigma = np.array([np.hypot(s.sigma_m, 0.005) for s in carried])
    assert 0.7 < np.sqrt((off**2).mean() / (sigma**2).mean()) < 1.3


def test_observations_without_a_keyframe_are_told_with_the_reason() -> None:
    one, other = _fly(60, seed=0), _fly(60, seed=1, name="other", start_ns=START_NS + 10**13)
    points, seen = _survey(one, count=2, seed=0, each=1)
    here, first = seen[0], int(one.odometry.stamps_ns[0])
    kept = np.r_[0:100, 110 : len(one.truth)]
    odometry = replace(one.odometry, stamps_ns=one.odometry.stamps_ns[kept], poses=one.odometry.poses[kept])
    torn = FlownPoses("one", odometry, odometry.stamps_ns[:5], odometry.poses[:5])
    flights = [one.flown(), other.flown()]

    def reason(flights: list[FlownPoses], **changes: object) -> str:
        carried, unused = carry_to_keyframes(points, [replace(here, **changes)], flights, CONFIG)  # type: ignore[arg-type]
        assert len(carried) + len(unused) == 1
        return unused[0].reason if unused else ""

    assert reason(flights) == ""
    assert reason(flights, flight="third") == "flight 'third' is not among them"
    assert (
        reason(flights, stamp_ns=first - 2_500_000) == f"no sweeps at {first - 2_500_000} ns: 0.003 s before the first"
    )
    assert "after the last" in reason(flights[:1], stamp_ns=first + 10**12)
    assert reason(flights, flight="", stamp_ns=first + 10**12).endswith("between two flights")
    assert reason([torn], stamp_ns=first + 10_450_000_000).startswith("odometry has a gap of 1.1 s")
    # without a name the time tells the flight, unless two flew at once
    assert reason(flights, flight="") == ""
    assert reason([one.flown(), replace(one.flown(), flight="twin")], flight="").startswith("2 flights were in the air")
    with pytest.raises(ValueError, match="not surveyed: T9"):
        carry_to_keyframes(points, [replace(here, target="T9")], flights, CONFIG)


def test_control_points_put_the_map_in_the_mine_grid(flight: Flight) -> None:
    points, seen = _survey(flight, count=12, seed=1)
    reference = place_in_grid(points, seen, [flight.flown()], config=CONFIG, graph=GRAPH)
    np.testing.assert_array_equal(reference.origin_grid, [500_000, 7_100_000, -1000])
    assert not reference.left_out.any()
    fixes = reference.point_fixes()
    assert len(fixes) == 8 * 4  # check points make no factor
    assert all(np.abs(fix.point_map).max() < 2000 for fix in fixes)
    start = reference.placements[0].T_local_map @ flight.odometry.poses[flight.keyframes]
    before = _error_m(flight, reference, start)
    assert before.max() > 0.3  # lower bound: there is something to correct
    poses = solve(_graph(flight, reference)).poses
    between = slice(5, 260)  # the last target, near the end, is a check point
    after = _error_m(flight, reference, poses)[between]
    assert after.max() < 0.15
    assert np.sqrt((after**2).mean()) < 0.06
    judged = judge(reference, poses)
    assert not judged.left_out.any()
    table = residuals(judged, poses)
    assert table.control is not None
    assert table.check is not None
    assert (table.control.count, table.check.count, table.outliers, table.unseen) == (8, 4, (), ())
    # adjusted points fit to their noise, independent ones as well as the map is
    assert table.control.rmse_3d_m < 0.02
    assert 0.005 < table.check.rmse_3d_m < 0.08
    assert verdict_of(table, tolerance_m=0.1).value == "pass"


@pytest.mark.parametrize("by", [[5.0, 0, 0], [0, 0, -5.0], [1.0, 1.0, 0.0]])
def test_one_wrong_target_among_eight_is_named_and_does_not_bend_the_map(flight: Flight, by: list[float]) -> None:
    points, seen = _survey(flight, count=8, seed=5, checks=False)
    points[4] = replace(points[4], position_grid=points[4].position_grid + by)
    reference = place_in_grid(points, seen, [flight.flown()], config=CONFIG, graph=GRAPH)
    first = solve(_graph(flight, reference)).poses
    judged = judge(reference, first)
    assert judged.misfits == ("T4",)
    assert [s.point for s, out in zip(judged.sightings, judged.left_out, strict=True) if out] == [4] * 4
    final = solve(_graph(flight, judged)).poses
    assert _error_m(flight, judged, final).max() < 0.2
    # one that was never seen could not do less
    without = place_in_grid(points, [o for o in seen if o.target != "T4"], [flight.flown()], config=CONFIG, graph=GRAPH)
    unseen = solve(_graph(flight, without)).poses
    assert np.linalg.norm((final - unseen)[:, :3, 3], axis=1).max() < 0.001
    table = residuals(judge(judged, final), final)
    assert table.outliers == ("T4",)
    assert table.rows[4].distance_m == pytest.approx(np.linalg.norm(by), abs=0.2)
    # lower bound: believed without a robust kernel it bends the map at its place
    trusting = GRAPH.model_copy(update={"robust": False})
    believed = replace(reference, left_out=np.zeros_like(reference.left_out))
    assert _error_m(flight, believed, solve(_graph(flight, believed, trusting)).poses).max() > 0.6 * np.linalg.norm(by)


def test_an_accelerometer_s_bias_does_not_make_the_map_sag() -> None:
    """The front end's edges are better than they claim, so that gravity decides how the map hangs between targets."""
    good = _fly(300, seed=1, noise=0.1)
    points, seen = _survey(good, count=4, seed=9, checks=False)
    reference = place_in_grid(points, seen, [good.flown()], config=CONFIG, graph=GRAPH)

    def error_m(config: GraphConfig) -> float:
        biased = (0.004, 0.004, 1.0)  # a third of a degree, in all keyframes
        poses = solve(_graph(good, reference, config, claimed=4.0, up=biased)).poses
        return float(_error_m(good, reference, poses)[10:290].max())

    control = graph_with_control(GRAPH, CONFIG)
    assert control == GRAPH.model_copy(update={"gravity_sigma_deg": 20.0})
    # a third of a degree over half of the 80 m between targets is 23 cm; edges hold most of that, not all
    assert error_m(GRAPH) > 0.05
    assert error_m(control) < 0.03


def test_what_was_left_out_wrongly_is_taken_back(flight: Flight) -> None:
    points, seen = _survey(flight, count=8, seed=6, checks=False)
    reference = place_in_grid(points, seen, [flight.flown()], config=CONFIG, graph=GRAPH)
    left_out = np.zeros(len(seen), np.bool_)
    left_out[13] = True
    doubted = replace(reference, left_out=left_out)
    assert len(doubted.point_fixes()) == len(seen) - 1
    poses = solve(_graph(flight, doubted)).poses
    assert not judge(doubted, poses).left_out.any()


def test_many_sightings_of_a_target_do_not_outgrow_its_survey(flight: Flight) -> None:
    points, seen = _survey(flight, count=3, seed=7, each=20, checks=False)
    reference = place_in_grid(points, seen, [flight.flown()], config=CONFIG, graph=GRAPH)
    information = np.zeros((3, 3))
    pick = 0.0
    for fix, sighting in zip(reference.point_fixes(), reference.sightings, strict=True):
        if sighting.point == 1:
            information += np.linalg.inv(fix.covariance)
            pick += 1.0 / (np.trace(sighting.covariance_lidar) / 3)
    together = np.linalg.inv(information)
    np.testing.assert_allclose(np.diag(together), 0.005**2 + 1.0 / pick, rtol=0.1)
    assert np.sqrt(together[0, 0]) > 0.005


def test_flights_with_frames_of_their_own_meet_in_one_grid() -> None:
    one, two = _fly(150, seed=3), _fly(150, seed=4, name="two", start_ns=START_NS + 10**13)
    points, seen = _survey(one, count=5, seed=3, checks=False)
    more, again = _survey(two, count=4, seed=4, checks=False, prefix="U")
    flights = [one.flown(), two.flown(first=151)]
    reference = place_in_grid(points + more, seen + again, flights, config=CONFIG, graph=GRAPH)
    for flight, placement in zip((one, two), reference.placements, strict=True):
        assert placement.T_local_map is not None
        rows = flight.keyframes
        start = placement.T_local_map @ flight.odometry.poses[rows]
        assert _error_m(flight, reference, start).max() < 0.3
        assert placement.anchor_covariance is not None
        # loose in position and heading, not in tilt
        assert np.sqrt(np.linalg.eigvalsh(placement.anchor_covariance[3:, 3:])) == pytest.approx([10.0] * 3)
        tilt = np.degrees(np.sqrt(np.linalg.eigvalsh(placement.anchor_covariance[:3, :3])))
        assert tilt == pytest.approx([0.5, 0.5, 10.0])
    assert {fix.keyframe >= 151 for fix in reference.point_fixes()} == {True, False}
    assert max(fix.keyframe for fix in reference.point_fixes()) < 302


def test_a_flight_with_one_target_is_placed_only_with_others_of_its_frame() -> None:
    one, two = _fly(150, seed=3), _fly(150, seed=4, name="two", start_ns=START_NS + 10**13)
    points, seen = _survey(one, count=2, seed=3, checks=False)
    only = [o for o in seen if o.target == "T0"]
    other = [replace(o, flight="two", stamp_ns=o.stamp_ns + 10**13) for o in seen if o.target == "T1"]
    apart = place_in_grid(points, only + other, [one.flown(), two.flown(first=151)], config=CONFIG, graph=GRAPH)
    assert [p.T_local_map for p in apart.placements] == [None, None]
    assert apart.placements[1].reason == "one control target was seen (T1): the heading is open, two are needed"
    # its fixes are there all the same, as bad as their worst direction: loops may place the flight
    assert len(apart.point_fixes()) == 8
    exact = [f.flown(frame="joined", first=i, at=f.truth[f.keyframes]) for f, i in ((one, 0), (two, 151))]
    seen_by_two = [
        replace(o, point_lidar=se3.apply(se3.inverse(two.truth[k]), se3.apply(one.truth[k], o.point_lidar[None]))[0])
        for o in other
        for k in [int((o.stamp_ns - START_NS - 10**13) // PERIOD_NS)]
    ]
    joined = place_in_grid(points, only + seen_by_two, exact, config=CONFIG, graph=GRAPH)
    assert joined.placements[0].T_local_map is not None
    np.testing.assert_array_equal(joined.placements[0].T_local_map, joined.placements[1].T_local_map)
    T = _T_grid_map()
    T[:3, 3] -= joined.origin_grid
    assert np.linalg.norm(joined.placements[0].T_local_map[:3, 3] - T[:3, 3]) < 0.1


def test_the_local_origin_depends_on_the_survey_alone() -> None:
    points, _ = _survey(_fly(60, seed=0), count=4, seed=0)
    np.testing.assert_array_equal(local_origin(points, step_m=100.0), [500_300, 7_100_600, -400])
    np.testing.assert_array_equal(local_origin(points[::-1], step_m=1000.0), [500_000, 7_100_000, -1000])


def test_no_observations_is_an_answer_and_no_survey_is_a_mistake(flight: Flight) -> None:
    points, _ = _survey(flight, count=4, seed=0)
    reference = place_in_grid(points, [], [flight.flown()], config=CONFIG, graph=GRAPH)
    assert reference.placements[0].reason == "no control target was seen"
    assert reference.point_fixes() == []
    poses = flight.truth[flight.keyframes]
    assert judge(reference, poses) is reference
    assert residuals(reference, poses).unseen == ("T0", "T1", "T2", "T3")
    with pytest.raises(ValueError, match="targets"):
        place_in_grid([], [], [flight.flown()], config=CONFIG, graph=GRAPH)
