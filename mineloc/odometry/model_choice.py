"""Which motion model a flight has: inertial when up is known, constant velocity before that and when lost."""

from __future__ import annotations

import numpy as np

from mineloc import se3
from mineloc.config import OdometryConfig
from mineloc.data import F64, ImuSamples, Sweep
from mineloc.odometry.constant_velocity import ConstantVelocity
from mineloc.odometry.imu_motion import ImuMotion
from mineloc.odometry.levelling import FEWEST, UpFinder, check_force, levelled, standing
from mineloc.odometry.motion import MotionModel
from mineloc.odometry.strapdown import ImuNoise


class ModelChoice:
    """Makes the motion model of a flight, and changes it.

    A drone that stands when its IMU is first heard is levelled at once. One that flies goes by constant velocity until
    LiDAR and accelerometer together say where up is. Then the model's own odom frame becomes level; the one in which
    poses are told stays what it was.

    Args:
        config: noise.
        T_lidar_imu: where the IMU sits.

    Attributes:
        motion: the model, None before the first sweep. Its body is the IMU if it is inertial, else the LiDAR.
        T_body_lidar: (4, 4) from LiDAR to that body.
        T_told_odom: (4, 4) from the model's odom frame to the one in which poses are told.
    """

    def __init__(self, config: OdometryConfig, T_lidar_imu: F64) -> None:
        self._config, self._T_lidar_imu = config, T_lidar_imu
        self._finder = UpFinder()
        self._is_checked = False
        self.motion: MotionModel | None = None
        self.T_body_lidar: F64 = np.eye(4)
        self.T_told_odom: F64 = np.eye(4)

    @property
    def T_odom_lidar(self) -> F64:
        """(4, 4) pose of the LiDAR in the model's own odom frame."""
        assert self.motion is not None
        return self.motion.T_odom_body @ self.T_body_lidar

    @property
    def T_told_lidar(self) -> F64:
        """(4, 4) pose of the LiDAR as it is told."""
        return self.T_told_odom @ self.T_odom_lidar

    @property
    def up_lidar(self) -> F64 | None:
        """(3,) direction of up in LiDAR coordinates, None while it is not known."""
        return self.T_odom_lidar[2, :3] if isinstance(self.motion, ImuMotion) else None

    def begin(self, sweep: Sweep, imu: ImuSamples) -> MotionModel:
        """The model for a sweep, which has its samples.

        Raises:
            FlightError: the IMU does not measure gravity.
        """
        is_heard = self._config.use_imu and len(imu) >= FEWEST
        if is_heard and not self._is_checked:
            check_force(imu)
            self._is_checked = True
        if self.motion is None:
            self.motion = self._first(sweep, imu, is_heard=is_heard)
        if isinstance(self.motion, ImuMotion):
            self.motion.feed(imu)
        return self.motion

    def follow(self, imu: ImuSamples) -> bool:
        """The sweep has been registered: if up is not known, look for it.

        Returns:
            Whether the model has changed, and its odom frame with it, in which no map can be used.
        """
        before = self.motion
        if not self._config.use_imu or not isinstance(before, ConstantVelocity):
            return False
        self._finder.follow(before, imu, self._T_lidar_imu)
        up_odom = self._finder.up_odom(before)
        if up_odom is None:
            return False
        self.motion = self._inertial(before, up_odom)
        self.motion.feed(imu)
        return True

    def give_up(self) -> None:
        """The model lost its way: begin anew from the pose as told, at rest, as if nothing were known of up."""
        assert self.motion is not None
        T, self.T_told_odom = self.T_told_lidar, np.eye(4)
        self.T_body_lidar = np.eye(4)
        motion = self._constant_velocity(self.motion.stamp_ns)
        motion.T_odom_body = T
        self.motion, self._finder = motion, UpFinder()

    def _first(self, sweep: Sweep, imu: ImuSamples, *, is_heard: bool) -> MotionModel:
        found = standing(imu) if is_heard else None
        if found is None:
            return self._constant_velocity(sweep.stamp_ns - 1)
        self.T_body_lidar = se3.inverse(self._T_lidar_imu)
        T = levelled(np.eye(4), found.up_imu)
        return ImuMotion(sweep.stamp_ns - 1, T, noise=self._noise(), gyro_bias_radps=found.gyro_bias_radps)

    def _inertial(self, before: ConstantVelocity, up_odom: F64) -> ImuMotion:
        T_odom_imu = before.T_odom_body @ self._T_lidar_imu
        T = levelled(T_odom_imu, T_odom_imu[:3, :3].T @ up_odom)
        motion = ImuMotion(before.stamp_ns, T, noise=self._noise())
        turn = T @ se3.inverse(T_odom_imu)
        motion.velocity_mps = turn[:3, :3] @ before.velocity_mps
        self.T_told_odom = self.T_told_odom @ se3.inverse(turn)
        self.T_body_lidar = se3.inverse(self._T_lidar_imu)
        return motion

    def _constant_velocity(self, stamp_ns: int) -> ConstantVelocity:
        c = self._config
        return ConstantVelocity(stamp_ns, angular_radps2=c.angular_radps2, linear_mps2=c.linear_mps2)

    def _noise(self) -> ImuNoise:
        c = self._config
        return ImuNoise(c.gyro_radps, c.accel_mps2, c.gyro_walk_radps2, c.accel_walk_mps3)
