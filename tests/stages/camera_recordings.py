"""Recordings with a LiDAR and cameras as RealSense drivers name and fill their topics, of very small images."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import driver_clouds as drivers
import numpy as np
import recording_files as files
from PIL import Image
from recording_files import CLOUD, ROS2, START_NS, STEP_NS, TF

from mineloc.data import CameraModel
from mineloc.io.health import Health
from mineloc.io.ros import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from mineloc.stages.ingest import ingest

CAMERA = CameraModel(10, 6, 8.0, 8.5, 4.5, 2.5)
FRAME = "camera_depth_optical_frame"
TOPIC, INFO = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"


def millimetres(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 9000, (6, 10)).astype(np.uint16)


def colours(seed: int) -> np.ndarray:
    """(6, 10, 3) red, green, blue that vary smoothly, as JPEG likes them."""
    u, v = np.meshgrid(np.arange(10), np.arange(6))
    return np.stack([40 + 12 * u + seed, 200 - 15 * v, 90 + 5 * u + 8 * v], axis=-1).astype(np.uint8)


def image(
    stamp_ns: int, values: np.ndarray, encoding: str, *, pad: int = 0, big: bool = False, frame: str = FRAME
) -> Any:
    values = values.astype(values.dtype.newbyteorder(">" if big else "<"))
    rows = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
    data = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
    at = files.header(ROS2.types, stamp_ns, frame)
    return ROS2.types[IMAGE](at, *values.shape[:2], encoding, int(big), data.shape[1], data.ravel())


def jpeg(stamp_ns: int, values: np.ndarray, *, frame: str = FRAME) -> Any:
    picture = io.BytesIO()
    Image.fromarray(values).save(picture, format="jpeg", quality=95, subsampling=0)
    data = np.frombuffer(picture.getvalue(), np.uint8)
    return ROS2.types[COMPRESSED_IMAGE](files.header(ROS2.types, stamp_ns, frame), "bgr8; jpeg compressed bgr8", data)


def camera_info(
    stamp_ns: int,
    *,
    distortion: float = 0.0,
    width: int = 10,
    frame: str = FRAME,
    p: tuple[float, ...] = (0.0,) * 12,
) -> Any:
    types = ROS2.types
    k = np.array([8.0, 0, 4.5, 0, 8.5, 2.5, 0, 0, 1])
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    at = files.header(types, stamp_ns, frame)
    d = np.full(5, distortion)
    return types[CAMERA_INFO](at, 6, width, "plumb_bob", d, k, np.eye(3).ravel(), np.array(p), 0, 0, region)


def depths(count: int = 5, *, topic: str = TOPIC, encoding: str = "16UC1", **options: Any) -> list[files.Entry]:
    out: list[files.Entry] = []
    for i in range(count):
        mm = millimetres(i)
        values = mm if encoding != "32FC1" else np.where(mm == 0, np.nan, mm / 1000).astype(np.float32)
        stamp = START_NS + 30_000_000 + i * STEP_NS
        out.append((topic, IMAGE, stamp + 1000, image(stamp, values, encoding, **options)))
    return out


def infos(topic: str = INFO, **options: Any) -> list[files.Entry]:
    return [(topic, CAMERA_INFO, START_NS + i, camera_info(START_NS + i, **options)) for i in range(2)]


def base() -> list[files.Entry]:
    made = [drivers.vlp16_sweep(START_NS + i * STEP_NS, columns=40, seed=i) for i in range(6)]
    return [("/points", CLOUD, s.end_ns + 1, drivers.velodyne(s)) for s in made]


def placed(child: str = FRAME, *more: tuple[str, str, tuple[float, ...]]) -> list[files.Entry]:
    edges = [("base_link", "velodyne", (0, 0, 1)), ("base_link", "lidar", (0, 0, 1)), ("lidar", child, (0.2, 0, -0.1))]
    return [("/tf_static", TF, START_NS - 1, files.transforms(START_NS, *edges, *more))]


def run(tmp_path: Path, *groups: list[files.Entry], told: str = "") -> tuple[Path, Health]:
    """Ingest the entries, in order of their log times; a new flight replaces the one before."""
    entries = sorted((entry for group in groups for entry in group), key=lambda entry: entry[2])
    path = files.write_mcap(tmp_path / "recording.mcap", entries)
    sequence = None
    if told:
        sequence = tmp_path / "sequence.toml"
        sequence.write_text(told)
    out = tmp_path / "flight.mcap"
    out.unlink(missing_ok=True)
    return out, ingest(path, out=out, sequence=sequence).health
