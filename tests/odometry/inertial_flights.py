"""Flights along a formula through a scene with a formula: sweeps with motion in them, inertial samples, the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from analytic_scenes import RINGS, Scene
from inertial_motions import START_NS, Motion

from mineloc import se3
from mineloc.data import F64, Calibration, ImuSamples, Sweep
from mineloc.odometry.front_end import FrontEnd

PERIOD_NS = 100_000_000
FIRINGS = 720


@dataclass(frozen=True)
class Step:
    """What a front end is given, and what it should say."""

    sweep: Sweep
    imu: ImuSamples
    T_map_lidar: F64


@dataclass(frozen=True)
class Flight:
    """`motion` moves the body; `sweeps` of a 16-beam LiDAR and an ideal 200 Hz IMU are taken along it."""

    scene: Scene
    motion: Motion
    sweeps: int
    calibration: Calibration = field(default_factory=Calibration)
    sigma_m: float = 0.01
    gyro_bias_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accel_bias_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0

    def steps(self) -> Iterator[Step]:
        rng = np.random.default_rng(self.seed)
        imu = self.imu()
        for k in range(self.sweeps):
            sweep = self.sweep(k, rng)
            truth = self.motion.at(np.array([sweep.end_ns]))[0] @ self.calibration.T_body_lidar
            # up to the first sample at or after the sweep's end, as the reader of flights gives them
            begin, end = START_NS + k * PERIOD_NS + 1, START_NS + (k + 1) * PERIOD_NS + 1
            yield Step(sweep, imu.between(begin if k else 0, end), truth)

    def imu(self) -> ImuSamples:
        end_ns = START_NS + (self.sweeps + 1) * PERIOD_NS
        ideal = self.motion.imu(START_NS, end_ns, T_body_imu=self.calibration.T_body_imu)
        return replace(
            ideal,
            gyro_radps=ideal.gyro_radps + np.array(self.gyro_bias_radps),
            accel_mps2=ideal.accel_mps2 + np.array(self.accel_bias_mps2),
        )

    def sweep(self, k: int, rng: np.random.Generator) -> Sweep:
        elevation = np.deg2rad(np.linspace(-15, 15, RINGS))
        azimuth = -np.arange(FIRINGS) * 2 * np.pi / FIRINGS
        stamps = START_NS + k * PERIOD_NS + (np.arange(FIRINGS) * PERIOD_NS) // FIRINGS
        poses = self.motion.at(stamps) @ self.calibration.T_body_lidar
        beams = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth)[:, None],
                np.cos(elevation) * np.sin(azimuth)[:, None],
                np.broadcast_to(np.sin(elevation), (FIRINGS, RINGS)),
            ],
            axis=-1,
        )
        rays = np.einsum("nij,nrj->nri", poses[:, :3, :3], beams).reshape(-1, 3)
        ranges = self.scene(np.repeat(poses[:, :3, 3], RINGS, axis=0), rays) + rng.normal(0, self.sigma_m, len(rays))
        hit = np.isfinite(ranges)
        points = (beams.reshape(-1, 3)[hit] * ranges[hit, None]).astype(np.float32)
        offsets = np.repeat(stamps - stamps[0], RINGS)[hit]
        return Sweep(int(stamps[0]), points, offsets, period_ns=PERIOD_NS)


def errors_of(front_end: FrontEnd, steps: Iterator[Step] | list[Step]) -> tuple[F64, F64]:
    """(n,) metres and (n,) radians between estimate and truth, both against their first pose."""
    told, true = [], []
    for step in steps:
        told.append(front_end.step(step.sweep, step.imu).T_odom_lidar)
        true.append(step.T_map_lidar)
    estimate, truth = (se3.inverse(np.array(poses)[0]) @ np.array(poses) for poses in (told, true))
    off = se3.inverse(truth) @ estimate
    return np.linalg.norm(off[:, :3, 3], axis=1), se3.angle_rad(off)
