"""From corrected keyframes to a pose for every sweep."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mineloc import se3
from mineloc.data import F64, I64, Trajectory


def spread(odometry: Trajectory, keyframe_stamps_ns: I64, keyframe_poses: F64) -> Trajectory:
    """Correct every odometry pose by the keyframes around it, without jumps.

    A pose is carried by relative odometry from the keyframe before and from the one after, and blended by its time
    between them; at a keyframe it is the keyframe's. Before the first and after the last, one of them counts alone.

    Args:
        odometry: `T_odom_lidar` of the sweeps.
        keyframe_stamps_ns: (k,) rising, k ≥ 1, each a stamp of `odometry`.
        keyframe_poses: (k, 4, 4) corrected `T_map_lidar`.

    Returns:
        `T_map_lidar` at the stamps of `odometry`.

    Raises:
        ValueError: no keyframes, or a keyframe that is no pose of the odometry.
    """
    at = np.searchsorted(odometry.stamps_ns, keyframe_stamps_ns)
    if not len(at) or at[-1] >= len(odometry) or bool((odometry.stamps_ns[at] != keyframe_stamps_ns).any()):
        raise ValueError("every keyframe must be a pose of the odometry")
    after = np.searchsorted(keyframe_stamps_ns, odometry.stamps_ns, side="left")
    before = np.clip(after - 1, 0, len(at) - 1)
    after = np.clip(after, 0, len(at) - 1)
    # T_map_odom of each keyframe; applied to the sweep's own pose it carries the relative motion along
    corrections = keyframe_poses @ se3.inverse(odometry.poses[at])
    from_before, from_after = corrections[before] @ odometry.poses, corrections[after] @ odometry.poses
    gap = np.maximum(keyframe_stamps_ns[after] - keyframe_stamps_ns[before], 1)
    u = np.clip((odometry.stamps_ns - keyframe_stamps_ns[before]) / gap, 0.0, 1.0)
    return Trajectory(odometry.stamps_ns, _blend(from_before, from_after, u), parent="map", child=odometry.child)


def _blend(a: F64, b: F64, u: F64) -> F64:
    """Poses (n, 4, 4) a share u (n,) of the way from a to b: lerp and slerp."""
    turn = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]).as_rotvec()
    rotation = a[:, :3, :3] @ Rotation.from_rotvec(u[:, None] * turn).as_matrix()
    return se3.from_rt(rotation, (1.0 - u)[:, None] * a[:, :3, 3] + u[:, None] * b[:, :3, 3])
