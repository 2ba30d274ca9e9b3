"""What places look like from a keyframe: its levelled sweep as Scan Context, its neighbourhood as a submap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mineloc import se3
from mineloc.config import LoopsConfig, ScanContextConfig
from mineloc.data import F32, F64, Keyframe
from mineloc.mapping.submaps import Submap, submap_of
from mineloc.places.scan_context import scan_context


def levelled(T_map_lidar: F64) -> F64:
    """(4, 4) rotation that levels the lidar's coordinates and keeps its heading: x stays ahead."""
    ahead = T_map_lidar[:3, 0]
    back = se3.exp(np.array([0.0, 0.0, -np.arctan2(ahead[1], ahead[0]), 0.0, 0.0, 0.0]))
    return back @ se3.from_rt(T_map_lidar[:3, :3], np.zeros(3))


def context_of(keyframe: Keyframe, T_map_lidar: F64, config: ScanContextConfig) -> F32:
    """Scan Context of a keyframe, levelled by its pose in a levelled map."""
    return scan_context(se3.apply(levelled(T_map_lidar), keyframe.points_lidar), config)


def submap_around(keyframes: Sequence[Keyframe], root: int, config: LoopsConfig) -> Submap:
    """The submap of a keyframe and its neighbours on both sides, placed by odometry.

    Neighbours of another flight, whose odometry is not the root's, lie far away and are left out by the reach.

    Args:
        keyframes: of a flight, in order.
        root: index in `keyframes`.
    """
    n = config.submap_keyframes
    members = keyframes[max(0, root - n) : root + n + 1]
    T_root_odom = se3.inverse(keyframes[root].T_odom_lidar)
    return submap_of(
        [keyframe.points_lidar for keyframe in members],
        np.array([T_root_odom @ keyframe.T_odom_lidar for keyframe in members]),
        voxel_m=config.submap_voxel_m,
        reach_m=config.submap_reach_m,
        normal_radius_m=config.normal_radius_m,
    )
