"""The tables of a run folder: their schemas, and how poses, fixes and covariances become columns."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

import numpy as np
import polars as pl

from mineloc import se3
from mineloc.data import F64, Fix, Intersection

_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_SIGMAS = ("sigma_xy_m", "sigma_z_m", "sigma_yaw_deg")

SWEEPS = pl.Schema(
    {
        "stamp_ns": pl.Int64(),
        "trusted": pl.Boolean(),
        "reason": pl.String(),
        "inlier_ratio": pl.Float64(),
        "residual_m": pl.Float64(),
        "points_used": pl.Int64(),
        "degeneracy_score": pl.Float64(),
        "is_degenerate": pl.Boolean(),
        "weak_x": pl.Float64(),
        "weak_y": pl.Float64(),
        "weak_z": pl.Float64(),
    }
)
KEYFRAMES = pl.Schema(
    {
        "index": pl.Int64(),
        "stamp_ns": pl.Int64(),
        "path_m": pl.Float64(),
        **{name: pl.Float64() for name in _POSE},
        **{f"odom_{name}": pl.Float64() for name in _POSE},
        **{name: pl.Float64() for name in _SIGMAS},
    }
)
POINTS = pl.Schema({"keyframe": pl.Int32(), "x_m": pl.Float32(), "y_m": pl.Float32(), "z_m": pl.Float32()})
FIXES = pl.Schema(
    {
        "stamp_ns": pl.Int64(),
        "keyframe": pl.Int64(),
        "trusted": pl.Boolean(),
        "reason": pl.String(),
        "target": pl.String(),
        **{name: pl.Float64() for name in _POSE},
        **{name: pl.Float64() for name in _SIGMAS},
        "scores": pl.String(),
    }
)
INTERSECTIONS = pl.Schema(
    {
        "id": pl.Int64(),
        "name": pl.String(),
        "kind": pl.String(),
        "x_m": pl.Float64(),
        "y_m": pl.Float64(),
        "z_m": pl.Float64(),
    }
)
# Columns that may not be null: without them a row says nothing.
_ALWAYS = ("stamp_ns", "trusted", "reason", "index", "keyframe", *_POSE)


def poses_of(table: pl.DataFrame, *, prefix: str = "") -> F64:
    """(n, 4, 4) transforms from the pose columns of a table (`x_m … qw`, or `odom_x_m …`)."""
    columns = [table[prefix + name].to_numpy() for name in _POSE]
    if table.is_empty():
        return np.zeros((0, 4, 4))
    return se3.from_xyzw(np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1))


def pose_columns(poses: F64, *, prefix: str = "") -> dict[str, F64]:
    """The pose columns of a table for (n, 4, 4) transforms."""
    if len(poses) == 0:
        return {prefix + name: np.zeros(0) for name in _POSE}
    position, xyzw = se3.to_xyzw(poses)
    return dict(zip((prefix + name for name in _POSE), [*position.T, *xyzw.T], strict=True))


def fixes_table(fixes: Sequence[Fix]) -> pl.DataFrame:
    """The recognitions of a run as a table (`FIXES`): no pose and no covariance are nulls, scores are JSON."""
    rows: list[dict[str, object]] = []
    for fix in fixes:
        row: dict[str, object] = {
            "stamp_ns": fix.stamp_ns,
            "keyframe": fix.keyframe,
            "trusted": fix.trusted,
            "reason": fix.reason,
            "target": fix.target,
            "scores": json.dumps({k: v if math.isfinite(v) else None for k, v in sorted(fix.scores.items())}),
        }
        if fix.T_map_lidar is not None:
            row |= {k: float(v[0]) for k, v in pose_columns(fix.T_map_lidar[None]).items()}
            if fix.covariance is not None:
                row |= dict(zip(_SIGMAS, sigmas(fix.T_map_lidar, fix.covariance), strict=True))
        rows.append(row)
    return pl.DataFrame([{name: row.get(name) for name in FIXES} for row in rows], schema=FIXES)


def intersections_table(intersections: Sequence[Intersection]) -> pl.DataFrame:
    """What a run knew of the intersections of its map (`INTERSECTIONS`)."""
    points = np.array([one.point_map for one in intersections]).reshape(-1, 3)
    return pl.DataFrame(
        {
            "id": [one.id for one in intersections],
            "name": [one.name for one in intersections],
            "kind": [one.kind for one in intersections],
            **dict(zip(("x_m", "y_m", "z_m"), points.T, strict=True)),
        },
        schema=INTERSECTIONS,
    )


def sigmas(T_map_lidar: F64, covariance: F64) -> tuple[float, float, float]:
    """Horizontal (m, both axes together), vertical (m) and yaw (deg) standard deviation in the map frame.

    Args:
        T_map_lidar: (4, 4).
        covariance: (6, 6) `[rotation, translation]`, right perturbation, so in the lidar frame.
    """
    r = T_map_lidar[:3, :3]
    position = r @ covariance[3:, 3:] @ r.T
    rotation = r @ covariance[:3, :3] @ r.T
    return (
        float(np.sqrt(max(position[0, 0] + position[1, 1], 0.0))),
        float(np.sqrt(max(position[2, 2], 0.0))),
        float(np.degrees(np.sqrt(max(rotation[2, 2], 0.0)))),
    )


def checked(table: pl.DataFrame, schema: pl.Schema, name: str) -> pl.DataFrame:
    """The table in the schema's column order and types, NaN as null.

    Raises:
        ValueError: a column is missing, unknown, of another kind, or null where a row needs it.
    """
    missing = [column for column in schema if column not in table.columns]
    extra = [column for column in table.columns if column not in schema]
    if missing or extra:
        raise ValueError(f"{name}: missing columns {missing}, unknown columns {extra}")
    table = table.select(schema.names())
    for column, kind in schema.items():
        found = table.schema[column]
        if found.is_float() != kind.is_float() and found != pl.Null:
            raise ValueError(f"{name}.{column} is {found}, not {kind}")
    try:
        table = table.cast(schema).with_columns(pl.col(pl.Float32, pl.Float64).fill_nan(None))
    except pl.exceptions.PolarsError as error:
        raise ValueError(f"{name}: {error}") from None
    for column in _never_null(name, schema):
        if table[column].null_count():
            raise ValueError(f"{name}.{column} has nulls")
    return table


def _never_null(name: str, schema: pl.Schema) -> list[str]:
    # a recognition that was refused early has no pose
    return [c for c in schema if c in _ALWAYS and not (name == "fixes" and c in _POSE)]
