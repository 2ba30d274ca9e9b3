"""From corrected keyframes to a pose for every sweep."""

from __future__ import annotations

import numpy as np

from mineloc import se3
from mineloc.data import F64, I64, Trajectory


def spread(odometry: Trajectory, keyframe_stamps_ns: I64, keyframe_poses: F64) -> Trajectory:
    """Lay the odometry between the keyframes, without jumps.

    Between two keyframes the motion that odometry saw is carried on from the earlier and back from the later one; the
    pose goes over from the first to the second with the time. At a keyframe it is that keyframe's pose. Before the
    first and after the last there is only one to lean on.

    Args:
        odometry: `T_odom_lidar` of every sweep; every keyframe is one of them.
        keyframe_stamps_ns: (k,) strictly increasing.
        keyframe_poses: (k, 4, 4) corrected `T_map_lidar`.

    Returns:
        `T_map_lidar` of every sweep.

    Raises:
        ValueError: no keyframes, or a keyframe that is no sweep.
    """
    row = _rows(odometry, keyframe_stamps_ns, keyframe_poses)
    correction = keyframe_poses @ se3.inverse(odometry.poses[row])
    sweep = np.arange(len(odometry))
    before = np.clip(np.searchsorted(row, sweep, side="right") - 1, 0, len(row) - 1)
    after = np.minimum(before + 1, len(row) - 1)
    forward = correction[before] @ odometry.poses
    backward = correction[after] @ odometry.poses
    t, begin, end = odometry.stamps_ns, keyframe_stamps_ns[before], keyframe_stamps_ns[after]
    share = np.clip((t - begin) / np.maximum(end - begin, 1), 0.0, 1.0)
    poses = forward @ se3.exp(share[:, None] * se3.log(se3.inverse(forward) @ backward))
    return Trajectory(t, poses, parent="map", child=odometry.child)


def _rows(odometry: Trajectory, keyframe_stamps_ns: I64, keyframe_poses: F64) -> I64:
    if not len(keyframe_stamps_ns) or len(keyframe_stamps_ns) != len(keyframe_poses):
        raise ValueError(f"{len(keyframe_stamps_ns)} keyframes, {len(keyframe_poses)} poses")
    row = np.searchsorted(odometry.stamps_ns, keyframe_stamps_ns)
    found = np.minimum(row, len(odometry) - 1)
    if not (odometry.stamps_ns[found] == keyframe_stamps_ns).all() or (np.diff(keyframe_stamps_ns) <= 0).any():
        raise ValueError("every keyframe must be a sweep, in rising order")
    return row
