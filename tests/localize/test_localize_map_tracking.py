"""A whole flight in a map, from a start that is told: what becomes of it when the start is wrong."""

from __future__ import annotations

import numpy as np
import pytest
from plan_scenes import TwoIntersections, edges_of, flown

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64, Calibration, ImuSamples, IntersectionDatabase, Keyframe, OdometryStep, Sweep
from mineloc.localize.localization import FlightData, Localization
from mineloc.localize.map_tracking import MapTracking, Prior, Start
from mineloc.progress import quiet


class Replay:
    """A front end that makes a keyframe of every sweep, known beforehand."""

    def __init__(self, keyframes: list[Keyframe]) -> None:
        self._rest = list(zip(keyframes, edges_of(keyframes), strict=True))

    def step(self, sweep: Sweep, imu: ImuSamples) -> OdometryStep:
        del sweep, imu
        keyframe, known = self._rest.pop(0)
        return OdometryStep(keyframe.stamp_ns, keyframe.T_odom_lidar, True, keyframe=keyframe, relative_pose=known)


def localized(database: IntersectionDatabase, off_m: float) -> tuple[Localization, F64]:
    """A flight through both intersections, told to begin so far beside where it does."""
    keyframes, truth = flown(TwoIntersections(), -14.0, 42.0)
    config = Config()
    config = config.model_copy(update={"prior_map": config.prior_map.model_copy(update={"lost_after": 3})})
    told = se3.from_rt(np.eye(3), np.array([0.0, off_m, 0.0])) @ truth[0]
    covariance = np.diag([np.radians(3.0) ** 2] * 3 + [0.25] * 3)
    prior = Prior(Start(told, covariance), database=database)
    points = np.ones((1, 3), np.float32)
    sweeps = [(Sweep(one.stamp_ns, points), ImuSamples.empty()) for one in keyframes]
    flight = FlightData(sweeps, Calibration())
    return MapTracking(config, Replay(keyframes), prior, by="intersections").run(flight, quiet), truth


def test_a_flight_is_where_it_was_told_to_begin(database: IntersectionDatabase) -> None:
    found, truth = localized(database, 0.0)
    assert found.start_off_m is None
    error = found.smoothed.positions_m - truth[:, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.3


def test_a_wrong_start_is_refuted_and_told(database: IntersectionDatabase) -> None:
    found, truth = localized(database, 35.0)
    assert found.start_off_m == pytest.approx(35.0, abs=0.3)
    # the whole flight is right afterwards, what was believed online until it was found is not
    error = np.linalg.norm(found.smoothed.positions_m - truth[:, :3, 3], axis=1)
    assert error.max() < 0.3
    online = np.linalg.norm(found.online.positions_m - truth[:, :3, 3], axis=1)
    assert online[0] > 30.0
    assert online[-1] < 0.3
