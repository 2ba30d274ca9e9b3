"""The tables of a map folder: those of a run, with the flight in front."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from mineloc.localize.reconstruction import Reconstruction
from mineloc.mapping.map_coverage import Coverage
from mineloc.stages.run_tables import FIXES, KEYFRAMES, fixes_table, pose_columns, sigmas

_FLIGHT = {"flight": pl.String()}
MAP_KEYFRAMES = pl.Schema({**_FLIGHT, **{k: v for k, v in KEYFRAMES.items() if not k.startswith("odom_")}})
MAP_FIXES = pl.Schema({**_FLIGHT, **FIXES})


def keyframes_table(flights: Sequence[str], found: Reconstruction) -> pl.DataFrame:
    """The keyframes of all flights (`MAP_KEYFRAMES`): smoothed lidar poses in the map and their σ."""
    parts: list[pl.DataFrame] = []
    for k, name in enumerate(flights):
        stamps = np.array([keyframe.stamp_ns for keyframe in found.keyframes[k]])
        trajectory = found.trajectories[k]
        spread = [sigmas(T, c) for T, c in zip(found.poses[k], found.covariances[k], strict=True)]
        columns = {
            "flight": [name] * len(stamps),
            "index": [keyframe.index for keyframe in found.keyframes[k]],
            "stamp_ns": stamps,
            "path_m": trajectory.path_m[np.searchsorted(trajectory.stamps_ns, stamps)],
            **pose_columns(found.poses[k]),
            **dict(zip(("sigma_xy_m", "sigma_z_m", "sigma_yaw_deg"), np.array(spread).T, strict=True)),
        }
        parts.append(pl.DataFrame(columns, schema=MAP_KEYFRAMES))
    return pl.concat(parts)


def fixes_tables(flights: Sequence[str], found: Reconstruction) -> pl.DataFrame:
    """Every candidate for a loop closure of all flights (`MAP_FIXES`)."""
    return pl.concat(
        [
            fixes_table(fixes).select(pl.lit(name).alias("flight"), pl.all())
            for name, fixes in zip(flights, found.fixes, strict=True)
        ]
    )


def coverage_table(found: Coverage) -> pl.DataFrame:
    """What is seen of every piece of roadway; what is unknown is null."""
    seen = found.seen.reshape(-1, 4)
    return pl.DataFrame(
        {
            "roadway": found.roadway,
            "begin_m": found.begin_m,
            "end_m": found.end_m,
            **{f"{side}_seen": seen[:, k] for k, side in enumerate(("floor", "left", "right", "roof"))},
            "complete": found.complete,
            "points_pm2": found.points_pm2,
            "measured_pm2": found.measured_pm2,
            "thickness_m": found.thickness_m,
        }
    ).with_columns(pl.col(pl.Float64, pl.Float32).fill_nan(None))
