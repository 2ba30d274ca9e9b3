"""The motion model of a drone with an IMU: strapdown integration between sweeps."""

from __future__ import annotations

import numpy as np

from mineloc import se3
from mineloc.data import F64, I64, ImuSamples
from mineloc.odometry.motion import BodyPath, add_to_pose, exp_so3, pose_deviation
from mineloc.odometry.strapdown import ImuNoise, Known, integrate

GAP_S = 0.05
"""A longer pause between samples is a hole: what happens in it is guessed, not measured."""
BRIDGE_S, TURN_S = 1.5, 0.5
"""Over a shorter hole the samples on both sides are joined; without a sample after it a drone turns on as it did."""
_START_SIGMAS = np.repeat([0.02, 1e-4, 1.0, 0.003, 0.05], 3)


def _measured() -> F64:
    out = np.zeros((12, 15))
    out[:6, :6] = np.eye(6)
    out[6:9, 9:12] = -np.eye(3)  # a bias is taken off the rate
    out[9:12, 6:9] = np.eye(3)
    return out


class ImuMotion:
    """Body = IMU. Errors: [rotation, position, velocity, gyro bias, accelerometer bias], 15 of them; z of odom is up.

    The accelerometer keeps roll and pitch right for the whole flight, which is what stops the z drift of 16-beam
    LiDARs (METHOD 4.1, 7.3).

    Args:
        stamp_ns: time of the first pose.
        T_odom_body: (4, 4) that pose, levelled.
        noise: of the samples.
        gyro_bias_radps: (3,) as far as it is known.
    """

    measured: F64 = _measured()

    def __init__(self, stamp_ns: int, T_odom_body: F64, *, noise: ImuNoise, gyro_bias_radps: F64 | None = None) -> None:
        self._noise = noise
        self._samples = ImuSamples.empty()
        self.stamp_ns = stamp_ns
        self.T_odom_body = T_odom_body
        self.velocity_mps = np.zeros(3)
        self.gyro_bias_radps: F64 = np.zeros(3) if gyro_bias_radps is None else gyro_bias_radps
        self.accel_bias_mps2 = np.zeros(3)
        self.covariance: F64 = np.diag(_START_SIGMAS**2)
        self._predicted = self._state()
        self._before = stamp_ns, self.T_odom_body  # where the last prediction began

    def feed(self, samples: ImuSamples) -> None:
        """Take new samples; older ones than the state needs are dropped, repeated ones ignored."""
        known = int(self._samples.stamps_ns[-1]) if len(self._samples) else -1
        fresh = samples.stamps_ns > known
        stamps = np.concatenate([self._samples.stamps_ns, samples.stamps_ns[fresh]])
        first = max(0, int(np.searchsorted(stamps, self.stamp_ns, side="right")) - 1)
        gyro = np.concatenate([self._samples.gyro_radps, samples.gyro_radps[fresh]])[first:]
        accel = np.concatenate([self._samples.accel_mps2, samples.accel_mps2[fresh]])[first:]
        self._samples = ImuSamples(stamps[first:], gyro, accel)

    def predict(self, start_ns: int, end_ns: int) -> BodyPath:
        """Integrate to `end_ns`. What happens in a hole of the samples is guessed, and the covariance says so."""
        stamps, gyro, accel, known = self._steps(end_ns)
        self._before = self.stamp_ns, self.T_odom_body
        start = self.T_odom_body, self.velocity_mps, self.covariance
        times_s = np.asarray((stamps - self.stamp_ns) * 1e-9, dtype=np.float64)
        moved = integrate(times_s, gyro, accel, known, *start, self._noise)
        poses = moved.poses
        if start_ns < self.stamp_ns:
            # the sweep began a little before the last one ended
            back = -1e-9 * (self.stamp_ns - start_ns)
            first = se3.from_rt(poses[0, :3, :3] @ exp_so3(back * gyro[0]), poses[0, :3, 3] + back * self.velocity_mps)
            stamps = np.concatenate([np.array([start_ns]), stamps])
            poses = np.concatenate([first[None], poses])
        self.velocity_mps, self.covariance = moved.velocity_mps, moved.covariance
        poses[-1] = se3.rigid(poses[-1])
        self.T_odom_body, self.stamp_ns = poses[-1], end_ns
        self._predicted = self._state()
        return BodyPath(stamps, poses)

    def deviation(self) -> F64:
        """(15,) error of the state against the prediction."""
        T, *vectors = self._predicted
        _, *now = self._state()
        return np.concatenate(
            [pose_deviation(self.T_odom_body, T), *(a - b for a, b in zip(now, vectors, strict=True))]
        )

    def add(self, error: F64) -> None:
        """Apply a (15,) error."""
        self.T_odom_body = add_to_pose(self.T_odom_body, error)
        self.velocity_mps = self.velocity_mps + error[6:9]
        self.gyro_bias_radps = self.gyro_bias_radps + error[9:12]
        self.accel_bias_mps2 = self.accel_bias_mps2 + error[12:15]

    def _state(self) -> tuple[F64, F64, F64, F64]:
        return self.T_odom_body, self.velocity_mps, self.gyro_bias_radps, self.accel_bias_mps2

    def _steps(self, end_ns: int) -> tuple[I64, F64, F64, Known]:
        """(m,) nodes up to `end_ns`; mean rate and force of the (m - 1) steps between, and what is known of them."""
        s = self._samples
        inside = (s.stamps_ns > self.stamp_ns) & (s.stamps_ns < end_ns)
        stamps = np.concatenate([np.array([self.stamp_ns]), s.stamps_ns[inside], np.array([end_ns])])
        known = self._known(stamps)
        gyro, accel = np.zeros((len(stamps) - 1, 3)), np.zeros((len(stamps) - 1, 3))
        if len(s):
            x, at = stamps - self.stamp_ns, s.stamps_ns - self.stamp_ns
            for means, measured in ((gyro, s.gyro_radps), (accel, s.accel_mps2)):
                nodes = np.stack([np.interp(x, at, column) for column in measured.T], axis=1)
                means[:] = 0.5 * (nodes[:-1] + nodes[1:])
        gyro, accel = gyro - self.gyro_bias_radps, accel - self.accel_bias_mps2
        short = np.diff(stamps) < TURN_S * 1e9
        gyro[known.blind] = np.where(short[known.blind, None], self._turning(), 0.0)
        return stamps, gyro, accel, known

    def _turning(self) -> F64:
        """(3,) mean rate since the last prediction, as registration saw it."""
        stamp_ns, T = self._before
        turn = pose_deviation(self.T_odom_body, T)[:3]
        return turn / max((self.stamp_ns - stamp_ns) * 1e-9, 1e-3)

    def _known(self, stamps_ns: I64) -> Known:
        """Which of the (m - 1) steps between the nodes lie in a hole of the samples, however short the steps are."""
        at = self._samples.stamps_ns
        if not len(at):
            return Known(np.ones(len(stamps_ns) - 1, np.bool_), np.ones(len(stamps_ns) - 1, np.bool_))
        start, end = stamps_ns[:-1], stamps_ns[1:]
        before = np.searchsorted(at, start, side="right") - 1
        after = np.searchsorted(at, end, side="left")
        open_sided = (before < 0) | (after == len(at))
        since = np.where(before >= 0, at[np.maximum(before, 0)], start)
        until = np.where(after < len(at), at[np.minimum(after, len(at) - 1)], end)
        guessed = (until - since) * 1e-9 > GAP_S
        return Known(guessed, guessed & (open_sided | ((until - since) * 1e-9 > BRIDGE_S)))
