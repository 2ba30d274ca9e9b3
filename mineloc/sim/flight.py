"""A simulated flight as a stream: sweeps, inertial samples, depth images and the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc.config import SimulateConfig
from mineloc.data import Calibration, DepthImage, FlightInfo, ImuSamples, Sweep, Trajectory
from mineloc.errors import SimulationError
from mineloc.roadways.graph import RoadwayGraph
from mineloc.sim.camera_mount import camera_mounting
from mineloc.sim.drone import drone_motion
from mineloc.sim.flown_camera import FlownCamera
from mineloc.sim.imu import Imu, ImuNoise, mounting
from mineloc.sim.lidar import LidarModel, lidar_model
from mineloc.sim.machine import Machine, in_front
from mineloc.sim.mine import Mine
from mineloc.sim.motion import Vibration
from mineloc.sim.path import fly_line, passable
from mineloc.sim.scene import Scene
from mineloc.sim.schedule import Limits, schedule
from mineloc.sim.shots import RangeErrors, Returns, Shots, aim, firings_of, measure, points_of
from mineloc.sim.tour import Step, plan_tour

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

START_NS = 1_767_225_600_000_000_000  # 2026-01-01T00:00:00Z
TRUTH_NS = 10_000_000
# inertial samples and truth go on a little after the last sweep: its last point lies between two of them
AFTER_NS = 20_000_000

# what a random stream is for
_TOUR, _SWAY, _VIBRATION, _IMU, _RANGES, _LOSS = range(1, 7)


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """What arrives within one revolution of the LiDAR.

    Attributes:
        sweep: one revolution, points in the lidar frame at each point's own time; None if it was lost.
        imu: the samples during that revolution.
        truth: `T_map_body` at 100 Hz during that revolution.
        depth: the depth images taken during that revolution.
    """

    sweep: Sweep | None
    imu: ImuSamples
    truth: Trajectory
    depth: tuple[DepthImage, ...] = ()


class SimulatedFlight:
    """A flight through a mine that never took place.

    Everything that chance decides has its own generator, seeded by `config.seed` and what it is for: the same
    configuration gives the same flight, whatever the number of threads.

    Args:
        mine: where.
        config: drone, sensors and noise.
        start: node of the mine's roadway graph to start from; None: an end, by chance.

    Raises:
        SimulationError: the mine cannot be flown.
    """

    def __init__(self, mine: Mine, config: SimulateConfig, *, start: int | None = None) -> None:
        self.mine = mine
        self.config = config
        self.lidar: LidarModel = lidar_model(config.sensor)
        self.calibration = Calibration(
            T_body_lidar=mounting(0.4, 1.5, -0.3, (0.05, 0.0, 0.12)),
            T_body_imu=mounting(-0.5, 0.3, 0.8, (-0.04, 0.03, 0.02)),
            T_body_camera=camera_mounting() if config.camera or config.tags else None,
        )
        scene, clearance = mine.scene, config.clearance_m
        self.graph = passable(mine.graph, scene, clearance_m=clearance)
        # rounding corners and blind ends shortens the line by some percent
        self.tour = plan_tour(self.graph, config.length_m * 1.15 + 20.0, _rng(config.seed, _TOUR), start=start)
        legs = cut(fly_line(self.graph, self.tour, scene, clearance_m=clearance), config.length_m)
        self.tour = _flown(self.graph, self.tour, config.length_m)
        check_enclosed(scene, legs[0])
        limits = Limits(config.speed_mps, config.accel_mps2, np.deg2rad(config.yaw_rate_degps), config.hover_s)
        vibration = Vibration.of_rotors(
            config.vibration_mps2, np.deg2rad(config.vibration_degps), _rng(config.seed, _VIBRATION)
        )
        self.motion = drone_motion(
            schedule(legs, limits),
            scene,
            vibration,
            sway_m=config.sway_m,
            clearance_m=clearance,
            rng=_rng(config.seed, _SWAY),
        )
        self.machine = Machine(self.motion, scene) if config.machine else None
        self.camera = self._carry_camera() if config.camera else None
        self.sweeps = int(self.motion.end_s * config.lidar_hz) - 1
        self.lost = missing(self.sweeps, config.sweep_loss, _rng(config.seed, _LOSS))
        self.info = FlightInfo(
            flight=f"{mine.name}-{config.seed}",
            site=mine.name,
            drone="simulated multirotor",
            lidar=self.lidar.name,
            imu=f"simulated MEMS {config.imu_hz:g} Hz",
            start_utc="2026-01-01T00:00:00Z",
            calibration="exact",
            source="simulated",
        )

    def pose(self, stamps_ns: I64) -> F64:
        """(n, 4, 4) true `T_map_body` at any times of the flight."""
        return self.motion.pose((stamps_ns - START_NS).astype(np.float64) * 1e-9)

    def _carry_camera(self) -> FlownCamera:
        T_body_camera = camera_mounting()
        return FlownCamera(
            self.mine.scene,
            self.config,
            lambda stamps_ns: self.pose(stamps_ns) @ T_body_camera,
            start_ns=START_NS,
            machine=self.machine,
        )

    def packets(self) -> Iterator[Packet]:
        """The flight, one revolution after the other; the same every time it is asked for."""
        config = self.config
        imu = Imu(
            self.motion,
            self.calibration.T_body_imu,
            _imu_noise(config),
            rate_hz=config.imu_hz,
            start_ns=START_NS,
            rng=_rng(config.seed, _IMU),
        )
        period_ns = round(1e9 / config.lidar_hz)
        for revolution in range(self.sweeps):
            begin_ns, end_ns = revolution * period_ns, (revolution + 1) * period_ns
            if revolution == self.sweeps - 1:
                end_ns += AFTER_NS
            stamps = START_NS + np.arange(-(-begin_ns // TRUTH_NS), -(-end_ns // TRUTH_NS), dtype=np.int64) * TRUTH_NS
            yield Packet(
                None if self.lost[revolution] else self.sweep(revolution),
                imu.until(START_NS + end_ns),
                Trajectory(stamps, self.pose(stamps)),
                () if self.camera is None else tuple(self.camera.between(START_NS + begin_ns, START_NS + end_ns)),
            )

    def sweep(self, revolution: int) -> Sweep:
        """One revolution of the LiDAR, counted from 0."""
        config, lidar = self.config, self.lidar
        firings = firings_of(lidar, revolution, config.lidar_hz)
        after = firings.time_s[-1] + lidar.firing_period_s(config.lidar_hz)
        poses = self.motion.pose(np.append(firings.time_s, after)) @ self.calibration.T_body_lidar
        poses[:, :3, 3] -= self.mine.scene.origin_m
        shots = aim(lidar, firings, poses, config.lidar_hz)
        hits = self.mine.scene.cast(shots.rays)
        place = self.machine.pose(float(firings.time_s[0])) if self.machine else None
        if place is not None:
            place[:3, 3] -= self.mine.scene.origin_m
            hits = in_front(hits, shots.rays, place)
        errors = RangeErrors(lidar.sigma_m, config.grazing_noise, config.loss, config.dust, config.dust_depth_m)
        returns = measure(lidar, shots, hits, errors, _rng(config.seed, _RANGES, revolution))
        return _as_sweep(shots, returns, START_NS + round(firings.time_s[0] * 1e9), round(1e9 / config.lidar_hz))

    def true_depth(self, stamp_ns: int) -> DepthImage:
        """What an error-free depth camera would see at any time of the flight; 0 where nothing is.

        Raises:
            ValueError: the configuration has no camera.
        """
        return self._need_camera().truth(stamp_ns)

    def depth_image(self, index: int) -> DepthImage:
        """One measured depth image, counted from 0.

        Raises:
            ValueError: the configuration has no camera.
        """
        return self._need_camera().image(index)

    def _need_camera(self) -> FlownCamera:
        if self.camera is None:
            raise ValueError("this flight has no depth camera: simulate.camera")
        return self.camera


def _as_sweep(shots: Shots, returns: Returns, start_ns: int, period_ns: int) -> Sweep:
    seen = np.flatnonzero(returns.seen)
    offsets = shots.offsets_ns[seen]
    # stamp_ns is the first point that came back, not the first shot
    first = int(offsets[0]) if len(offsets) else 0
    return Sweep(
        stamp_ns=start_ns + first,
        points_lidar=points_of(shots, seen, returns.range_m),
        offsets_ns=offsets - first,
        ring=shots.ring[seen],
        intensity=returns.intensity[seen],
        period_ns=period_ns,
    )


def _rng(*key: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(key))


def _flown(graph: RoadwayGraph, tour: list[Step], length_m: float) -> list[Step]:
    """The steps of a tour that begin before its cut."""
    begin = np.concatenate([[0.0], np.cumsum([graph.roadways[step.roadway].length_m for step in tour])])
    return [step for step, at in zip(tour, begin[:-1], strict=True) if at < length_m]


def _imu_noise(config: SimulateConfig) -> ImuNoise:
    return ImuNoise(
        gyro_density=np.deg2rad(config.gyro_noise_degps_rthz),
        gyro_bias_radps=np.deg2rad(config.gyro_bias_degps),
        gyro_walk=np.deg2rad(config.gyro_walk_degps2_rthz),
        accel_density=config.accel_noise_mps2_rthz,
        accel_bias_mps2=config.accel_bias_mps2,
        accel_walk=config.accel_walk_mps3_rthz,
    )


def missing(sweeps: int, share: float, rng: np.random.Generator) -> Bool:
    """(n,) which sweeps are lost: runs of three on average (a two-state chain), the first never."""
    leave = 1.0 / 3.0
    enter = min(leave * share / (1.0 - share), 1.0)
    chance = rng.random(sweeps)
    out = np.zeros(sweeps, np.bool_)
    for i in range(1, sweeps):
        out[i] = chance[i] >= leave if out[i - 1] else chance[i] < enter
    return out


def check_enclosed(scene: Scene, line_m: F64) -> None:
    """Refuse a mine of which the LiDAR would see little.

    Raises:
        SimulationError: more than half of all directions along the line meet nothing.
    """
    angle = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(36)])
    points = line_m[:: max(1, len(line_m) // 50)]
    origins = np.repeat(points, len(around), axis=0)
    met = np.isfinite(scene.ranges_m(origins, np.tile(around, (len(points), 1)))).mean()
    if met < 0.5:
        raise SimulationError(
            "mine",
            f"open in {1 - met:.0%} of all directions",
            expected="walls around the roadways",
            todo="check the mesh",
        )


def cut(legs: list[F64], length_m: float) -> list[F64]:
    """The first `length_m` metres of the legs; a last piece under a metre is left out."""
    out: list[F64] = []
    left = length_m
    for leg in legs:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(leg, axis=0), axis=1))])
        count = int(np.searchsorted(along, left))
        if count > 10 or not out:
            out.append(leg[: max(count, 2)])
        left -= along[-1]
        if left <= 0:
            break
    return out
