"""A flight that begins anywhere: found by two intersections, never by one that has a double."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from plan_scenes import Plan, TwoIntersections, edges_of, flown

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, Fix, IntersectionDatabase, Keyframe, RelativePose
from mineloc.localize.map_tracker import IntersectionTracker, Tracker, contradicts_database, contradicts_map
from mineloc.localize.pose_filter import PoseFilter
from mineloc.localize.recognition import Recognizer
from mineloc.localize.relocalization import RecoveringTracker, Relocalizer
from mineloc.localize.sequence import RoadwaySequence, ways_between
from mineloc.places.database import database_of

CONFIG = Config()


def searched(database: IntersectionDatabase, keyframes: list[Keyframe]) -> Relocalizer:
    """Shown all keyframes of a flight."""

    def track(known: PoseFilter) -> Tracker:
        sequence = RoadwaySequence(database, CONFIG.intersections)
        return IntersectionTracker(Recognizer(CONFIG, database), sequence, CONFIG, known)

    lost = Relocalizer(Recognizer(CONFIG, database), CONFIG, track)
    for keyframe, edge in zip(keyframes, edges_of(keyframes), strict=True):
        lost.follow(keyframe, edge)
    return lost


def doubled(database: IntersectionDatabase) -> IntersectionDatabase:
    """The same mine twice, side by side: nothing that a drone sees tells which it is in."""
    shift = np.array([0.0, 500.0, 0.0])
    first = database.intersections
    again = [
        replace(
            one,
            id=one.id + len(first),
            name=f"{one.kind} {one.id + len(first)}",
            point_map=one.point_map + shift,
            neighbours=tuple((id + len(first), way_m) for id, way_m in one.neighbours),
        )
        for one in first
    ]
    return database_of([*first, *again], CONFIG.intersections, grid_origin_m=np.zeros(3), is_grid=False, map_sha256="")


def test_two_intersections_find_a_flight_and_what_it_saw_before(database: IntersectionDatabase) -> None:
    keyframes, truth = flown(TwoIntersections(), -14.0, 42.0)
    lost = searched(database, keyframes)
    assert lost.filter is not None
    error = se3.inverse(truth[-1]) @ lost.filter.T_map_lidar
    assert np.linalg.norm(error[:3, 3]) < 0.3
    assert np.degrees(se3.angle_rad(error)) < 1.0
    trusted = [fix for fix in lost.fixes if fix.trusted]
    assert {fix.target for fix in trusted} == {"T 0", "X 1"}
    assert len(lost.fixes) == len(keyframes)
    assert [fix.keyframe for fix in lost.fixes] == list(range(len(keyframes)))


def test_one_intersection_is_not_enough(database: IntersectionDatabase) -> None:
    keyframes, _ = flown(TwoIntersections(), -14.0, 14.0)
    lost = searched(database, keyframes)
    assert lost.filter is None
    assert not any(fix.trusted for fix in lost.fixes)
    assert any("1 of 2 intersections (not found yet)" in fix.reason for fix in lost.fixes)


def test_a_mine_that_looks_the_same_elsewhere_leaves_it_open(database: IntersectionDatabase) -> None:
    keyframes, _ = flown(TwoIntersections(), -14.0, 42.0)
    lost = searched(doubled(database), keyframes)
    assert lost.filter is None
    assert not any(fix.trusted for fix in lost.fixes)
    assert any("with 2 of 2 intersections (not found yet)" in fix.reason for fix in lost.fixes)


def test_another_mine_is_never_found(database: IntersectionDatabase) -> None:
    for plan in (Plan((0, 180)), Plan((0, 55, 180)), Plan((0, 72, 144, 216, 288))):
        keyframes, _ = flown(plan, -12.0, 12.0)
        lost = searched(database, keyframes)
        assert lost.filter is None
        assert not any(fix.trusted for fix in lost.fixes)


def fix_of(database: IntersectionDatabase, name: str) -> Fix:
    (one,) = (one for one in database.intersections if one.name == name)
    T: F64 = np.eye(4)
    return Fix(0, 0, T, np.eye(6), True, target=name, scores={"id": float(one.id)})


def test_nobody_gets_from_one_to_another_in_less_than_the_way(database: IntersectionDatabase) -> None:
    assert ways_between(database)[0, 1] == ways_between(database)[1, 0]
    assert 26 < ways_between(database)[0, 1] < 34
    far = doubled(database)
    assert np.isinf(ways_between(far)[0, 2])
    keyframes, _ = flown(Plan((0, 180)), 0.0, 20.0)
    sequence = RoadwaySequence(database, CONFIG.intersections)
    assert sequence.doubt(fix_of(database, "X 1")) == ""
    sequence.accept(fix_of(database, "T 0"))
    assert sequence.doubt(fix_of(database, "T 0")) == ""
    doubt = sequence.doubt(fix_of(database, "X 1"))
    assert doubt.startswith("0 m flown since T 0, at least")
    for edge in edges_of(keyframes)[1:]:
        assert edge is not None
        sequence.carry(edge)
    assert sequence.doubt(fix_of(database, "X 1")) == ""


def soon_lost(after: int) -> Config:
    """A tracker is searched for anew after so few refusals."""
    return CONFIG.model_copy(update={"prior_map": CONFIG.prior_map.model_copy(update={"lost_after": after})})


class Believer:
    """A tracker that never sees anything that fits."""

    def __init__(self, known: PoseFilter) -> None:
        self.filter, self.fixes = known, []

    def follow(self, keyframe: Keyframe, edge: RelativePose | None) -> None:
        if edge is not None:
            self.filter.carry(edge)
        reason = "does not fit"
        self.fixes.append(Fix(keyframe.stamp_ns, keyframe.index, None, None, trusted=False, reason=reason))


def test_a_tracker_that_is_refused_for_long_is_found_anew(database: IntersectionDatabase) -> None:
    def search() -> Relocalizer:
        def track(known: PoseFilter) -> Tracker:
            return IntersectionTracker(
                Recognizer(CONFIG, database), RoadwaySequence(database, CONFIG.intersections), CONFIG, known
            )

        return Relocalizer(Recognizer(CONFIG, database), CONFIG, track)

    keyframes, truth = flown(TwoIntersections(), -14.0, 42.0)
    wrong = truth[0] @ se3.exp(np.array([0, 0, 0.3, 7.0, 2.0, 0]))
    believer = Believer(PoseFilter(wrong, np.diag([0.01] * 3 + [0.25] * 3), CONFIG.graph))
    tracker = RecoveringTracker(believer, search, contradicts_map, soon_lost(3).prior_map)
    for keyframe, edge in zip(keyframes, edges_of(keyframes), strict=True):
        tracker.follow(keyframe, edge)
    assert tracker.filter is not None
    assert np.linalg.norm((se3.inverse(truth[-1]) @ tracker.filter.T_map_lidar)[:3, 3]) < 0.3
    assert [fix.keyframe for fix in tracker.fixes] == list(range(len(keyframes)))
    assert tracker.was_lost
    assert [fix.reason for fix in tracker.fixes[:2]] == ["does not fit"] * 2
    assert {fix.target for fix in tracker.fixes if fix.trusted} == {"T 0", "X 1"}


def by_intersections(
    database: IntersectionDatabase, config: Config, keyframes: list[Keyframe], T_map_lidar: F64
) -> RecoveringTracker:
    """A flight told to begin at a pose, all keyframes shown."""

    def track(known: PoseFilter) -> Tracker:
        sequence = RoadwaySequence(database, config.intersections)
        return IntersectionTracker(Recognizer(config, database), sequence, config, known)

    told = PoseFilter(T_map_lidar, np.diag([np.radians(3.0) ** 2] * 3 + [0.25] * 3), config.graph)
    tracker = RecoveringTracker(
        track(told),
        lambda: Relocalizer(Recognizer(config, database), config, track),
        contradicts_database,
        config.prior_map,
    )
    for keyframe, edge in zip(keyframes, edges_of(keyframes), strict=True):
        tracker.follow(keyframe, edge)
    return tracker


def test_a_wrong_start_is_noticed_by_the_intersections_that_do_not_fit(database: IntersectionDatabase) -> None:
    keyframes, truth = flown(TwoIntersections(), -14.0, 42.0)
    wrong = truth[0] @ se3.exp(np.array([0, 0, 0.0, 30.0, 20.0, 0]))
    stubborn = by_intersections(database, CONFIG, keyframes, wrong)
    assert not any(fix.trusted for fix in stubborn.fixes)
    tracker = by_intersections(database, soon_lost(3), keyframes, wrong)
    assert tracker.was_lost
    assert tracker.filter is not None
    assert np.linalg.norm((se3.inverse(truth[-1]) @ tracker.filter.T_map_lidar)[:3, 3]) < 0.3
    assert {fix.target for fix in tracker.fixes if fix.trusted} == {"T 0", "X 1"}


def test_a_right_start_is_not_searched_for(database: IntersectionDatabase) -> None:
    keyframes, truth = flown(TwoIntersections(), -14.0, 42.0)
    tracker = by_intersections(database, soon_lost(1), keyframes, truth[0])
    assert not tracker.was_lost
    assert {fix.target for fix in tracker.fixes if fix.trusted} == {"T 0", "X 1"}
