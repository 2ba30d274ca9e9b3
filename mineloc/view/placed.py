"""Points of a run put where they were measured: the mine as one cloud, and single sweeps over time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mineloc import se3
from mineloc.config import ViewConfig
from mineloc.data import F64, Sweep, Trajectory
from mineloc.errors import FormatError
from mineloc.io.flight import FlightReader
from mineloc.progress import Progress, quiet
from mineloc.stages.run_folder import RunFolder
from mineloc.sweep.deskew import deskew_poses
from mineloc.sweep.voxel_grid import first_in_voxels

_MAP_VOXEL_M = 0.15
_WALLS_M = np.array([8.0, 8.0, 3.0])
_POINTS_A_SWEEP = 400  # fewer do not look like a sweep


def mine_cloud(clouds: list[tuple[int, F64]], config: ViewConfig, origin_m: F64) -> F64:
    """All clouds as one, (n, 3), at most `map_points`: one point a voxel, then every k-th."""
    if not clouds:
        return np.zeros((0, 3))
    points = np.concatenate([cloud for _, cloud in clouds])
    thin = points[first_in_voxels((points - origin_m).astype(np.float32), _MAP_VOXEL_M)]
    return thin[:: max(1, -(-len(thin) // config.map_points))]


def keyframe_clouds(run: RunFolder, T_frame_map: F64) -> list[tuple[int, F64]]:
    """(stamp, (n, 3) points) of every keyframe with points, placed by the smoothed poses."""
    table = run.points()
    order = table["keyframe"].to_numpy()
    points = table.select("x_m", "y_m", "z_m").to_numpy()
    if bool((np.diff(order) < 0).any()):
        by_keyframe = np.argsort(order, kind="stable")
        order, points = order[by_keyframe], points[by_keyframe]
    index = run.keyframes["index"].to_numpy()
    starts, ends = np.searchsorted(order, index, side="left"), np.searchsorted(order, index, side="right")
    poses = T_frame_map @ run.keyframe_poses
    stamps = run.keyframes["stamp_ns"].to_list()
    return [
        (stamp, se3.apply(pose, points[start:end]))
        for stamp, pose, start, end in zip(stamps, poses, starts, ends, strict=True)
        if end > start
    ]


def thinned(clouds: list[tuple[int, F64]], config: ViewConfig) -> list[tuple[int, F64]]:
    """The clouds with at most `sweep_points` points together: fewer points each first, then fewer clouds."""
    if not clouds:
        return []
    clouds = clouds[:: -(-len(clouds) * _POINTS_A_SWEEP // config.sweep_points)]
    each = max(config.sweep_points // len(clouds), 1)
    return [(stamp, cloud[:: max(1, -(-len(cloud) // each))]) for stamp, cloud in clouds]


def flight_clouds(
    flight: Path, lidar: Trajectory | None, config: ViewConfig, *, progress: Progress = quiet
) -> Iterator[tuple[int, F64]]:
    """(stamp, (n, 3) points) of every n-th sweep of a flight file, each point placed at its own time.

    Args:
        flight: canonical flight.
        lidar: pose of the lidar in the frame of the figure, 2 poses or more; sweeps outside its span are left out.
            None leaves every sweep in the lidar frame.
        config: `sweep_stride`, raised until `sweep_points` suffice.
        progress: told the sweeps that are read.

    Raises:
        FormatError: the flight is of another time than the trajectory.
        IngestError: not a canonical flight, or damaged.
    """
    with FlightReader(flight) as reader:
        if lidar is not None and (reader.first_ns > lidar.stamps_ns[-1] or reader.last_ns < lidar.stamps_ns[0]):
            raise FormatError(flight, "was flown at another time than the run", todo="give the flight of this run")
        fewest = -(-reader.sweep_count * _POINTS_A_SWEEP // config.sweep_points)
        stride = max(config.sweep_stride, fewest)
        each = config.sweep_points // max(-(-reader.sweep_count // stride), 1)
        for number, sweep in enumerate(reader.sweeps()):
            progress(number + 1, reader.sweep_count, "sweeps")
            if number % stride == 0 and len(sweep):
                some = sweep.keep(np.arange(0, len(sweep), max(1, -(-len(sweep) // each))))
                cloud = some.points_lidar.astype(np.float64) if lidar is None else _along(some, lidar)
                if cloud is not None:
                    yield sweep.stamp_ns, cloud


def _along(sweep: Sweep, lidar: Trajectory) -> F64 | None:
    """The points where the lidar was when it fired them; None outside the trajectory's span."""
    if sweep.stamp_ns < lidar.stamps_ns[0] or sweep.end_ns > lidar.stamps_ns[-1]:
        return None
    # the poses around the sweep: interpolation would walk through the whole flight for every sweep
    first = int(np.searchsorted(lidar.stamps_ns, sweep.stamp_ns, side="right")) - 1
    last = int(np.searchsorted(lidar.stamps_ns, sweep.end_ns, side="left"))
    near = slice(max(min(first, len(lidar) - 2), 0), max(last, first + 1) + 1)
    stamps, poses = lidar.stamps_ns[near], lidar.poses[near]
    instant = deskew_poses(sweep, stamps, poses, target_ns=sweep.stamp_ns)
    at = np.array([sweep.stamp_ns], dtype=np.int64)
    return se3.apply(se3.interpolate(stamps, poses, at)[0], instant.points_lidar)


def corners(positions_m: F64) -> tuple[F64, F64]:
    """Lowest and highest (3,) corner around a trajectory and the walls near it: single far points do not count."""
    return positions_m.min(axis=0) - _WALLS_M, positions_m.max(axis=0) + _WALLS_M


def local_origin(positions_m: F64) -> F64:
    """(3,) whole kilometres to subtract: zero in local grids, the large part of a national grid's coordinates."""
    return np.round(np.median(positions_m, axis=0) / 1000.0) * 1000.0
