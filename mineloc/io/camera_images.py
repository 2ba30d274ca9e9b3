"""Camera images as messages of a canonical flight, and back: depth exactly to the millimetre, grey as JPEG.

Frame: `camera`, optical (x right, y down, z ahead). Stamps are the time of exposure.
"""

from __future__ import annotations

import io
import json
from dataclasses import asdict
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mineloc.data import CameraModel, DepthImage, GreyImage
from mineloc.io.cdr_layout import CdrLayout, Part, Text, fixed_layout, rows, stamps_ns
from mineloc.io.ros import CAMERA_INFO, STORE, stamp_parts

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

FRAME = "camera"
STEPS_PER_M = 1000
"""Steps of a depth image (METHOD 9.3, z16)."""
_MOST_STEPS = 2**16 - 1
_JPEG_QUALITY = 95
_HEADER: list[Part] = [("sec", "<i4", 1), ("nanosec", "<u4", 1), ("frame", Text(FRAME), 1)]


@lru_cache(maxsize=8)
def depth_layout(width_px: int, height_px: int) -> CdrLayout:
    """sensor_msgs/Image 16UC1 of one size."""
    return fixed_layout(
        [
            *_HEADER,
            ("height", "<u4", 1),
            ("width", "<u4", 1),
            ("encoding", Text("16UC1"), 1),
            ("is_bigendian", "u1", 1),
            ("step", "<u4", 1),
            ("size", "<u4", 1),
            ("depth_mm", "<u2", width_px * height_px),
        ]
    )


@lru_cache(maxsize=1)
def _grey_head() -> CdrLayout:
    """sensor_msgs/CompressedImage up to the bytes of the picture."""
    return fixed_layout([*_HEADER, ("format", Text("jpeg"), 1), ("size", "<u4", 1)])


def depth_steps(depth_m: F32) -> U16:
    """Whole millimetres; 0 where a depth is unknown, not finite, or beyond 65.535 m."""
    steps = np.rint(np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0) * np.float32(STEPS_PER_M))
    return np.where((steps > 0) & (steps <= _MOST_STEPS), steps, 0).astype(np.uint16)


def encode_depth(image: DepthImage) -> U8:
    """(size,) bytes of an Image 16UC1 in millimetres, 0 where unknown.

    Raises:
        ValueError: a stamp that cannot be written.
    """
    camera = image.camera
    record = depth_layout(camera.width_px, camera.height_px).new(1)
    record["sec"], record["nanosec"] = stamp_parts(image.stamp_ns)
    record["height"], record["width"] = camera.height_px, camera.width_px
    record["step"], record["size"] = 2 * camera.width_px, 2 * camera.width_px * camera.height_px
    record["depth_mm"] = depth_steps(image.depth_m).reshape(-1)
    return rows(record)[0]


def decode_depth(data: bytes | memoryview, camera: CameraModel) -> DepthImage:
    """The image in a message written by `encode_depth`: its depths to the next millimetre.

    Raises:
        ValueError: not such a message, or of another size.
    """
    records = depth_layout(camera.width_px, camera.height_px).view(data)
    sizes = tuple(int(value) for value in records[["height", "width", "size"]][0])
    if sizes != (camera.height_px, camera.width_px, 2 * camera.width_px * camera.height_px):
        raise ValueError(f"an image of {sizes[:2]} pixels from a camera of {camera.height_px, camera.width_px}")
    steps = records["depth_mm"].reshape(camera.height_px, camera.width_px)
    return DepthImage(int(stamps_ns(records)[0]), np.divide(steps, STEPS_PER_M, dtype=np.float32), camera)


def encode_grey(image: GreyImage) -> U8:
    """(size,) bytes of a CompressedImage, JPEG of quality 95.

    Raises:
        ValueError: a stamp that cannot be written.
    """
    picture = io.BytesIO()
    Image.fromarray(image.pixels).save(picture, format="jpeg", quality=_JPEG_QUALITY)
    head = _grey_head().new(1)
    head["sec"], head["nanosec"] = stamp_parts(image.stamp_ns)
    head["size"] = picture.tell()
    return np.concatenate([rows(head)[0], np.frombuffer(picture.getbuffer(), np.uint8)])


def decode_grey(data: bytes | memoryview, camera: CameraModel) -> GreyImage:
    """The image in a message written by `encode_grey`, with what JPEG made of it.

    Raises:
        ValueError: not such a message, or of another size.
    """
    made = _grey_head()
    view = memoryview(data)
    head, picture = made.view(view[: made.dtype.itemsize]), view[made.dtype.itemsize :]
    if len(head) != 1 or int(head["size"][0]) != len(picture):
        raise ValueError("not a canonical picture")
    try:
        with Image.open(io.BytesIO(picture), formats=["JPEG"]) as opened:
            size = opened.size
            pixels = np.asarray(opened) if size == (camera.width_px, camera.height_px) else np.zeros((0, 0), np.uint8)
    except Exception as error:
        # Pillow raises a dozen kinds of errors over bytes that are no picture
        raise ValueError(f"a picture that cannot be decoded ({error})") from error
    if not pixels.size:
        raise ValueError(f"{size[0]} x {size[1]} pixels of a camera of {camera.width_px} x {camera.height_px}")
    return GreyImage(int(stamps_ns(head)[0]), pixels, camera)


def encode_camera_info(camera: CameraModel, stamp_ns: int) -> U8:
    """(size,) bytes of the CameraInfo of images without distortion."""
    types = STORE.types
    k = [camera.fx_px, 0.0, camera.cx_px, 0.0, camera.fy_px, camera.cy_px, 0.0, 0.0, 1.0]
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*stamp_parts(stamp_ns)), FRAME)
    message = types[CAMERA_INFO](
        header,
        camera.height_px,
        camera.width_px,
        "plumb_bob",
        np.zeros(5),
        np.array(k),
        np.eye(3).ravel(),
        np.array(p),
        0,
        0,
        types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    )
    return np.frombuffer(STORE.serialize_cdr(message, CAMERA_INFO), np.uint8)


def decode_camera_info(data: bytes | memoryview) -> CameraModel:
    """The geometry in a serialised CameraInfo; its distortion is not looked at."""
    return camera_of(STORE.deserialize_cdr(data, CAMERA_INFO))


def camera_of(message: object, *, rectified: bool = False) -> CameraModel:
    """The geometry in a decoded CameraInfo; its distortion is not looked at.

    Args:
        message: of ROS 1 or 2.
        rectified: of the images that image_proc makes, which have the geometry of P.

    Raises:
        ValueError: it is that of no camera.
    """
    info = cast("Any", message)
    k, p = (info.k, info.p) if hasattr(info, "k") else (info.K, info.P)  # ROS 1 has capitals
    fx, fy, cx, cy = (p[0], p[5], p[2], p[6]) if rectified else (k[0], k[4], k[2], k[5])
    return CameraModel(int(info.width), int(info.height), float(fx), float(fy), float(cx), float(cy))


def camera_json(camera: CameraModel) -> str:
    """The geometry as text, for a channel's metadata: it is known before the first image is read."""
    return json.dumps(asdict(camera))


def camera_of_json(text: str) -> CameraModel:
    """The geometry that `camera_json` wrote.

    Raises:
        ValueError, TypeError: it is none.
    """
    return CameraModel(**json.loads(text))
