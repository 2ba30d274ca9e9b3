"""Image messages of any driver: what kind they are, and as depth or grey images."""

from __future__ import annotations

import io
from typing import Any, cast

import numpy as np
from PIL import Image

from mineloc.data import F32, U8, CameraModel, DepthImage, GreyImage
from mineloc.io.camera_images import STEPS_PER_M

DEPTH_FORMATS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings of depth, and their numbers: millimetres if whole, else metres (REP 118)."""
# Pillow's name of what is stored, and how many bytes a pixel has
_GREY_FORMATS = {
    "mono8": ("L", 1),
    "8UC1": ("L", 1),
    "rgb8": ("RGB", 3),
    "bgr8": ("BGR", 3),
    "rgba8": ("RGBX", 4),
    "bgra8": ("BGRX", 4),
}
_JPEG = b"\xff\xd8"


def is_depth(message: object) -> bool:
    """Whether a decoded message is a sensor_msgs/Image with one number of 16 or 32 bits a pixel."""
    return str(getattr(message, "encoding", "")) in DEPTH_FORMATS


def is_picture(message: object) -> bool:
    """Whether a decoded message is an Image in grey or colour, or a CompressedImage that holds a JPEG."""
    if hasattr(message, "encoding"):
        return str(cast("Any", message).encoding) in _GREY_FORMATS
    return bytes(np.asarray(cast("Any", message).data[:2], np.uint8)) == _JPEG


def depth_image(message: object, camera: CameraModel) -> DepthImage:
    """The depth image in a decoded sensor_msgs/Image: 16UC1 in millimetres or 32FC1 in metres (REP 118).

    Raises:
        ValueError: of another kind or size.
    """
    image = cast("Any", message)
    if image.encoding not in DEPTH_FORMATS:
        raise ValueError(f"an image of encoding {image.encoding}")
    dtype = np.dtype((">" if image.is_bigendian else "<") + DEPTH_FORMATS[image.encoding])
    values = _rows(image, camera, dtype.itemsize).view(dtype).astype(np.float32)
    depth: F32 = values if dtype.kind == "f" else values / np.float32(STEPS_PER_M)
    return DepthImage(_stamp_ns(image), np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0)), camera)


def grey_image(message: object, camera: CameraModel) -> GreyImage:
    """The picture in a decoded Image or CompressedImage (JPEG), its colours weighed as ITU-R BT.601 does.

    Raises:
        ValueError: of another kind or size, or a JPEG that cannot be decoded.
    """
    image = cast("Any", message)
    pixels = _uncompressed(image, camera) if hasattr(image, "encoding") else _jpeg(image, camera)
    return GreyImage(_stamp_ns(image), pixels, camera)


def _uncompressed(image: Any, camera: CameraModel) -> U8:
    if image.encoding not in _GREY_FORMATS:
        raise ValueError(f"an image of encoding {image.encoding}")
    stored, pixel_bytes = _GREY_FORMATS[image.encoding]
    rows = _rows(image, camera, pixel_bytes)
    if stored == "L":
        return rows
    size = (camera.width_px, camera.height_px)
    return np.asarray(Image.frombytes("RGB", size, rows.tobytes(), "raw", stored).convert("L"))


def _jpeg(image: Any, camera: CameraModel) -> U8:
    size = (camera.width_px, camera.height_px)
    try:
        with Image.open(io.BytesIO(np.asarray(image.data, np.uint8).data), formats=["JPEG"]) as opened:
            found = opened.size
            opened.draft("L", None)  # its brightness alone, as it is stored
            pixels = np.asarray(opened.convert("L")) if found == size else None
    except Exception as error:
        # Pillow raises a dozen kinds of errors over bytes that are no picture
        raise ValueError(f"a picture that cannot be decoded ({error})") from error
    if pixels is None:
        raise ValueError(f"{found[0]} x {found[1]} pixels of a camera of {size[0]} x {size[1]}")
    return pixels


def _rows(image: Any, camera: CameraModel, pixel_bytes: int) -> U8:
    """(height, width · pixel_bytes) without the bytes that fill rows up."""
    width, height, step = int(image.width), int(image.height), int(image.step)
    data = np.asarray(image.data, np.uint8)
    if (width, height) != (camera.width_px, camera.height_px):
        raise ValueError(f"{width} x {height} pixels of a camera of {camera.width_px} x {camera.height_px}")
    if step < width * pixel_bytes or len(data) < height * step:
        raise ValueError(f"{len(data)} bytes for {height} rows of {step}")
    return np.ascontiguousarray(data[: height * step].reshape(height, step)[:, : width * pixel_bytes])


def _stamp_ns(image: Any) -> int:
    stamp = image.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
