"""PointCloud2 messages as drivers make them, around sweeps of known geometry and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mineloc.data import Sweep
from mineloc.io.ros import POINT_CLOUD2, STORE

DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
EPOCH_NS = 1_760_000_000_123_456_000
PERIOD_NS = 100_000_000


def vlp16_sweep(stamp_ns: int = EPOCH_NS, *, columns: int = 400, seed: int = 0) -> Sweep:
    """A VLP-16 in a rough round roadway of 3 m: firing order, clockwise, every column of 16 by rising elevation.

    Times are whole multiples of 256 ns after the stamp, which every driver's number format can hold.
    """
    rng = np.random.default_rng(seed)
    azimuth = -2 * np.pi * np.arange(columns) / columns
    elevation = np.deg2rad(np.arange(-15, 16, 2))
    r = 3.0 / np.sqrt(np.sin(elevation) ** 2 + (np.cos(elevation) * np.sin(azimuth[:, None])) ** 2 + 0.03)
    r = r + 0.03 * rng.normal(size=r.shape)
    x = r * np.cos(elevation) * np.cos(azimuth)[:, None]
    y = r * np.cos(elevation) * np.sin(azimuth)[:, None]
    points = np.stack([x, y, r * np.sin(elevation)], -1).reshape(-1, 3).astype(np.float32)
    column_ns = 256 * (PERIOD_NS // columns // 256)
    offsets = (np.arange(columns)[:, None] * column_ns + 256 * np.arange(16)).reshape(-1).astype(np.int64)
    ring = np.tile(np.arange(16, dtype=np.uint16), columns)
    intensity = rng.integers(0, 256, len(points)).astype(np.float32)
    return Sweep(stamp_ns, points, offsets, ring, intensity, PERIOD_NS)


def cloud(
    header_ns: int,
    columns: Mapping[str, np.ndarray[Any, Any]],
    fields: Sequence[tuple[str, int, str]],
    step: int,
    *,
    shape: tuple[int, int] | None = None,
    row_padding: int = 0,
    big_endian: bool = False,
    counts: Mapping[str, int] | None = None,
) -> Any:
    """A message with `columns` in fields (name, offset, format); the gaps are filled with 0xAB."""
    n = len(next(iter(columns.values()))) if columns else 0
    height, width = shape or (1, n)
    rows = np.full((height, width * step + row_padding), 0xAB, np.uint8)
    body = np.ascontiguousarray(rows[:, : width * step]).reshape(n, step)
    order = ">" if big_endian else "<"
    for name, offset, form in fields:
        values = np.ascontiguousarray(columns[name], dtype=order + form)
        body[:, offset : offset + values.itemsize] = values.view(np.uint8).reshape(n, values.itemsize)
    rows[:, : width * step] = body.reshape(height, width * step)
    types = STORE.types
    made = [
        types["sensor_msgs/msg/PointField"](name, offset, DATATYPES[form], (counts or {}).get(name, 1))
        for name, offset, form in fields
    ]
    stamp = types["builtin_interfaces/msg/Time"](header_ns // 10**9, header_ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp, "lidar")
    return types[POINT_CLOUD2](header, height, width, made, big_endian, step, rows.shape[1], rows.reshape(-1), True)


def xyz(sweep: Sweep) -> dict[str, np.ndarray[Any, Any]]:
    """The columns that every driver writes."""
    x, y, z = sweep.points_lidar.T
    return {"x": x, "y": y, "z": z}


XYZ = [("x", 0, "f4"), ("y", 4, "f4"), ("z", 8, "f4")]


def velodyne(sweep: Sweep, *, header_at_end: bool = True) -> Any:
    """velodyne_pointcloud: seconds relative to the header, by default the last packet's."""
    header_ns = sweep.end_ns if header_at_end else sweep.stamp_ns
    seconds = (sweep.offsets_ns + sweep.stamp_ns - header_ns) * 1e-9
    columns = xyz(sweep) | {"intensity": sweep.intensity, "ring": sweep.ring, "time": seconds}
    fields = [*XYZ, ("intensity", 12, "f4"), ("ring", 16, "u2"), ("time", 18, "f4")]
    return cloud(header_ns, columns, fields, 22)


def velodyne_organised(sweep: Sweep) -> Any:
    """The same with a row a ring and NaN where nothing came back."""
    seconds = sweep.offsets_ns * 1e-9
    columns = xyz(sweep) | {"intensity": sweep.intensity, "ring": sweep.ring, "time": seconds}
    fields = [*XYZ, ("intensity", 12, "f4"), ("ring", 16, "u2"), ("time", 18, "f4")]
    by_row = {name: values.reshape(-1, 16).T.reshape(-1) for name, values in columns.items()}
    by_row["x"] = by_row["x"].copy()
    by_row["x"][::7] = np.nan
    return cloud(sweep.stamp_ns, by_row, fields, 22, shape=(16, len(sweep) // 16))


def robosense(sweep: Sweep, *, f: bool = False) -> Any:
    """rslidar_sdk XYZIRT: absolute f64 seconds; a row is one firing of 16 lasers. `f`: with the feature byte."""
    seconds = sweep.stamp_ns // 10**9 + (sweep.stamp_ns % 10**9 + sweep.offsets_ns) * 1e-9
    columns = xyz(sweep) | {"intensity": sweep.intensity, "ring": sweep.ring, "timestamp": seconds}
    fields = [*XYZ, ("intensity", 12, "f4"), ("ring", 16, "u2"), ("timestamp", 18, "f8")]
    if f:
        columns["feature"] = np.zeros(len(sweep))
        fields.append(("feature", 26, "u1"))
    return cloud(sweep.stamp_ns, columns, fields, 27 if f else 26, shape=(len(sweep) // 16, 16))


def robosense_plain(sweep: Sweep) -> Any:
    """rslidar_sdk XYZI, the shipped default: no times, no rings."""
    columns = xyz(sweep) | {"intensity": sweep.intensity}
    return cloud(sweep.stamp_ns, columns, [*XYZ, ("intensity", 12, "f4")], 16)


def ouster(sweep: Sweep, *, ring_form: str = "u2") -> Any:
    """ouster-ros original: u32 nanoseconds, ring 0 on top, padding after z, a row a ring, zeros for no return."""
    columns = xyz(sweep) | {"intensity": sweep.intensity, "t": sweep.offsets_ns, "ring": 15 - sweep.ring.astype(int)}
    columns |= {"reflectivity": sweep.intensity, "ambient": sweep.intensity, "range": np.ones(len(sweep))}
    fields = [*XYZ, ("intensity", 16, "f4"), ("t", 20, "u4"), ("reflectivity", 24, "u2"), ("ring", 26, ring_form)]
    fields += [("ambient", 28, "u2"), ("range", 32, "u4")]
    by_row = {name: np.asarray(values).reshape(-1, 16)[:, ::-1].T.reshape(-1) for name, values in columns.items()}
    for axis in "xyz":
        by_row[axis] = by_row[axis].copy()
        by_row[axis][3::11] = 0
    return cloud(sweep.stamp_ns, by_row, fields, 48, shape=(16, len(sweep) // 16))


def livox(sweep: Sweep) -> Any:
    """livox_ros_driver2 xfer 0: absolute nanoseconds as f64; the line is no elevation."""
    line = (np.arange(len(sweep)) // 16) % 4
    columns = xyz(sweep) | {"intensity": sweep.intensity, "tag": np.zeros(len(sweep)), "line": line}
    columns["timestamp"] = (sweep.stamp_ns + sweep.offsets_ns).astype(np.float64)
    fields = [*XYZ, ("intensity", 12, "f4"), ("tag", 16, "u1"), ("line", 17, "u1"), ("timestamp", 18, "f8")]
    return cloud(sweep.stamp_ns, columns, fields, 26)


def hesai(sweep: Sweep) -> Any:
    """Hesai: absolute f64 seconds, another order of fields."""
    seconds = sweep.stamp_ns // 10**9 + (sweep.stamp_ns % 10**9 + sweep.offsets_ns) * 1e-9
    columns = xyz(sweep) | {"intensity": sweep.intensity, "timestamp": seconds, "ring": sweep.ring}
    fields = [*XYZ, ("intensity", 16, "f4"), ("timestamp", 24, "f8"), ("ring", 32, "u2")]
    return cloud(sweep.stamp_ns, columns, fields, 48)


def pcl(sweep: Sweep) -> Any:
    """LIO-SAM's PCL type: padded to 32 bytes, f32 seconds from the header."""
    columns = xyz(sweep) | {"intensity": sweep.intensity, "ring": sweep.ring, "time": sweep.offsets_ns * 1e-9}
    fields = [*XYZ, ("intensity", 16, "f4"), ("ring", 20, "u2"), ("time", 24, "f4")]
    return cloud(sweep.stamp_ns, columns, fields, 32)


def microseconds(sweep: Sweep) -> Any:
    """u32 microseconds under an odd name, big-endian, rows padded."""
    columns = xyz(sweep) | {"reflectivity": sweep.intensity, "channel": sweep.ring}
    columns["offset_time"] = sweep.offsets_ns // 1000
    fields = [("offset_time", 0, "u4"), ("z", 4, "f4"), ("y", 8, "f4"), ("x", 12, "f4")]
    fields += [("channel", 17, "u1"), ("reflectivity", 18, "u1")]
    return cloud(sweep.stamp_ns, columns, fields, 21, shape=(len(sweep) // 16, 16), row_padding=5, big_endian=True)


def gazebo(sweep: Sweep) -> Any:
    """Gazebo's velodyne plugin: an instant sweep, all times zero."""
    columns = xyz(sweep) | {"intensity": sweep.intensity, "ring": sweep.ring, "time": np.zeros(len(sweep))}
    fields = [*XYZ, ("intensity", 12, "f4"), ("ring", 16, "u2"), ("time", 18, "f4")]
    return cloud(sweep.stamp_ns, columns, fields, 22)
