"""A simulated flight as a stream: sweeps, inertial samples and the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc.config import SimulateConfig
from mineloc.data import Calibration, FlightInfo, ImuSamples, Sweep, Trajectory
from mineloc.sim.imu import Imu, ImuNoise, lever
from mineloc.sim.lidar import LidarModel, lidar_model
from mineloc.sim.drone import drone_motion
from mineloc.sim.motion import Vibration
from mineloc.sim.path import fly_line, passable
from mineloc.sim.roadways import RoadwayGraph
from mineloc.sim.scene import Scene
from mineloc.sim.schedule import Limits, Schedule, schedule
from mineloc.sim.shots import RangeErrors, aim, firings_of, measure
from mineloc.sim.tour import plan_tour

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

START_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """What arrives within one revolution of the LiDAR.

    Attributes:
        sweep: one revolution, points in the lidar frame at each point's own time.
        imu: the samples during that revolution.
        truth: `T_map_body` at 100 Hz during that revolution.
    """

    sweep: Sweep
    imu: ImuSamples
    truth: Trajectory


class SimulatedFlight:
    """A flight through a mine that never took place.

    Args:
        scene: the mine's surface.
        graph: its roadways.
        config: drone, sensors and noise.
        site: name of the mine.

    Raises:
        SimulationError: the mine cannot be flown.
    """

    def __init__(self, scene: Scene, graph: RoadwayGraph, config: SimulateConfig, *, site: str) -> None:
        self.scene = scene
        self.graph = graph
        self.config = config
        self.lidar: LidarModel = lidar_model(config.sensor)
        self.calibration = Calibration(
            T_body_lidar=lever(0.4, 1.5, -0.3, (0.05, 0.0, 0.12)),
            T_body_imu=lever(-0.5, 0.3, 0.8, (-0.04, 0.03, 0.02)),
        )
        tour_rng, sway_rng, shake_rng = (_rng(config.seed, stream) for stream in (1, 2, 3))
        graph = passable(graph, scene, clearance_m=config.clearance_m)
        self.tour = plan_tour(graph, config.length_m * 1.1, tour_rng)
        legs = cut(fly_line(graph, self.tour, scene, clearance_m=config.clearance_m), config.length_m)
        limits = Limits(config.speed_mps, config.accel_mps2, np.deg2rad(config.yaw_rate_degps), config.hover_s)
        self.plan = schedule(legs, limits)
        vibration = Vibration.of_rotors(config.vibration_mps2, np.deg2rad(config.vibration_degps), shake_rng)
        self.motion = drone_motion(self.plan, scene, vibration, sway_m=config.sway_m, clearance_m=config.clearance_m, rng=sway_rng)
        self.sweeps = int(self.motion.end_s * config.lidar_hz) - 1
        self.info = FlightInfo(
            flight=f"{site}-{config.seed}",
            site=site,
            drone="simulated multirotor",
            lidar=self.lidar.name,
            imu=f"simulated MEMS {config.imu_hz:g} Hz",
            start_utc="2026-01-01T00:00:00Z",
            calibration="exact",
            source="simulated",
        )

    def pose(self, stamps_ns: I64) -> F64:
        """(n, 4, 4) true `T_map_body` at any times of the flight."""
        return self.motion.pose(self._seconds(stamps_ns))

    def packets(self) -> Iterator[Packet]:
        """The flight, one revolution after the other; the same every time it is asked for."""
        config = self.config
        noise = ImuNoise(
            gyro_density=np.deg2rad(config.gyro_noise_degps_rthz),
            gyro_bias_radps=np.deg2rad(config.gyro_bias_degps),
            gyro_walk=np.deg2rad(config.gyro_walk_degps2_rthz),
            accel_density=config.accel_noise_mps2_rthz,
            accel_bias_mps2=config.accel_bias_mps2,
            accel_walk=config.accel_walk_mps3_rthz,
        )
        imu = Imu(
            self.motion, self.calibration.T_body_imu, noise, rate_hz=config.imu_hz, start_ns=START_NS, rng=_rng(config.seed, 4)
        )
        period_ns = round(1e9 / config.lidar_hz)
        for revolution in range(self.sweeps):
            end_ns = START_NS + (revolution + 1) * period_ns
            stamps = np.arange(-(-revolution * period_ns // 10_000_000), -(-(revolution + 1) * period_ns // 10_000_000))
            stamps = START_NS + stamps * 10_000_000
            yield Packet(self._sweep(revolution), imu.until(end_ns), Trajectory(stamps, self.pose(stamps)))

    def _seconds(self, stamps_ns: I64) -> F64:
        return (stamps_ns - START_NS) * 1e-9

    def _sweep(self, revolution: int) -> Sweep:
        config = self.config
        firings = firings_of(self.lidar, revolution, config.lidar_hz)
        period = self.lidar.firing_period_s(config.lidar_hz)
        poses = self.motion.pose(np.append(firings.time_s, firings.time_s[-1] + period)) @ self.calibration.T_body_lidar
        poses[:, :3, 3] -= self.scene.origin_m
        shots = aim(self.lidar, firings, poses, config.lidar_hz)
        hits = self.scene.cast(shots.rays)
        errors = RangeErrors(
            self.lidar.sigma_m, config.grazing_noise, config.loss, config.dust, config.dust_depth_m
        )
        returns = measure(self.lidar, shots, hits.range_m, hits.normals, errors, _rng(config.seed, 5, revolution))
        seen = returns.seen
        points = shots.origins_lidar[seen] + returns.range_m[seen, None] * shots.directions_lidar[seen]
        offsets = shots.offsets_ns[seen]
        # stamp_ns is the first point that came back, not the first shot
        first = int(offsets[0]) if len(offsets) else 0
        return Sweep(
            stamp_ns=START_NS + round(firings.time_s[0] * 1e9) + first,
            points_lidar=points.astype(np.float32),
            offsets_ns=offsets - first,
            ring=shots.ring[seen],
            intensity=returns.intensity[seen],
            period_ns=round(1e9 / config.lidar_hz),
        )


def _rng(*key: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(key))


def cut(legs: list[F64], length_m: float) -> list[F64]:
    """The first `length_m` metres of the legs."""
    out: list[F64] = []
    left = length_m
    for leg in legs:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(leg, axis=0), axis=1))])
        count = int(np.searchsorted(along, left))
        if count > 10:
            out.append(leg[:count])
        left -= along[-1]
        if left <= 0:
            break
    return out

