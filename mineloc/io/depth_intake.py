"""Depth images of a recording: which topic has them, what their camera is, and into the flight."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from mineloc.data import F32, CameraModel, DepthImage
from mineloc.errors import IngestError
from mineloc.io.camera_images import STEPS_PER_M, camera_of
from mineloc.io.findings import Finding
from mineloc.io.flight_writer import FlightWriter
from mineloc.io.health import HealthFinding
from mineloc.io.intake import ABSURD, Unreadable
from mineloc.io.recording import RawMessage, Recording, Topic
from mineloc.io.ros import CAMERA_INFO, IMAGE
from mineloc.io.static_frames import frame_name
from mineloc.io.topic_monitor import TopicMonitor
from mineloc.io.topic_roles import NONE

# Colour images have the same type; a depth image is named so by every driver (METHOD 9.3).
_NAME = re.compile(r"depth")
_FORMATS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


@dataclass(frozen=True, slots=True)
class DepthTopic:
    """A topic of depth images.

    Attributes:
        topic: as recorded.
        frame: of the images, optical.
        camera: from the CameraInfo beside it; None where there is none.
        distorted: whether that CameraInfo tells of a distortion.
    """

    topic: Topic
    frame: str
    camera: CameraModel | None
    distorted: bool


def find_depth(recording: Recording, told: str) -> tuple[DepthTopic | None, list[HealthFinding]]:
    """The topic of depth images, and what had to be assumed.

    Args:
        recording: opened.
        told: the sequence file's `topics.depth`.

    Raises:
        IngestError: the topic that the sequence file names is not there or holds no depth images.
    """
    if told == NONE:
        return None, []
    topics = [t for t in recording.topics.values() if t.msgtype == IMAGE and t.count != 0]
    named = [t for t in topics if (t.name == told if told else _NAME.search(t.name.lower()))]
    found = [(t, first) for t in named if (first := _first(recording, t.name)) is not None and _is_depth(first)]
    if told and not found:
        raise IngestError(
            recording.path,
            f"no depth images on {told}, which the sequence file names as depth",
            expected=", ".join(t.name for t in topics) or "a topic of type Image, 16UC1 or 32FC1",
            todo="correct depth in [topics] of the sequence file",
        )
    if len(found) > 1:
        names = ", ".join(topic.name for topic, _ in found)
        line = f"no depth is taken: it could be any of {names}; a sequence file can name it"
        return None, [HealthFinding("topic_assumed", "info", 1, line)]
    if not found:
        return None, []
    topic, first = found[0]
    camera, distorted = _camera(recording, topic)
    return DepthTopic(topic, frame_name(first.header.frame_id), camera, distorted), []


def why_left_out(depth: DepthTopic, *, placed: bool) -> HealthFinding | None:
    """What keeps the images out of the flight; None if nothing does.

    Args:
        depth: found.
        placed: whether it is known where the camera sits.
    """
    if depth.camera is None:
        why = f"no CameraInfo on {_info_name(depth.topic)}"
    elif depth.distorted:
        why = f"{_info_name(depth.topic)} tells of a distortion; rectified images are needed"
    elif not placed:
        why = f"nothing places {depth.frame or 'its frame'}: neither /tf_static nor [T_body.camera] of a sequence file"
    else:
        return None
    return HealthFinding("depth_left_out", "warning", 1, f"{depth.topic.name} is left out: {why}")


class DepthIntake:
    """Image messages to depth images.

    Args:
        monitor: of the topic.
        camera: geometry of the images.
        writer: where they go.
    """

    def __init__(self, monitor: TopicMonitor, camera: CameraModel, writer: FlightWriter) -> None:
        self.monitor = monitor
        self.unreadable = Unreadable()
        self._camera = camera
        self._writer = writer

    @property
    def findings(self) -> Sequence[Finding]:
        """See `Intake`."""
        return ()

    def take(self, raw: RawMessage) -> None:
        """Take the next image; see `Intake`."""
        try:
            image = depth_image(raw.message, self._camera)
            if self.monitor.take_one(image.stamp_ns, raw.log_ns, image.stamp_ns):
                self._writer.add_depth(image)
        except (IngestError, *ABSURD) as error:
            self.unreadable.add(error, raw.topic)

    def flush(self) -> None:
        """See `Intake`."""
        self.monitor.catch_up()


def depth_image(message: object, camera: CameraModel) -> DepthImage:
    """The depth image in a decoded sensor_msgs/Image: 16UC1 in millimetres or 32FC1 in metres (REP 118).

    Raises:
        ValueError: of another kind or size.
    """
    image = cast("Any", message)
    height, width, step = int(image.height), int(image.width), int(image.step)
    if image.encoding not in _FORMATS:
        raise ValueError(f"an image of encoding {image.encoding}")
    dtype = np.dtype((">" if image.is_bigendian else "<") + _FORMATS[image.encoding])
    data = np.asarray(image.data, np.uint8)
    if (width, height) != (camera.width_px, camera.height_px):
        raise ValueError(f"{width} x {height} pixels of a camera of {camera.width_px} x {camera.height_px}")
    if step < width * dtype.itemsize or len(data) < height * step:
        raise ValueError(f"{len(data)} bytes for {height} rows of {step}")
    # rows may be padded
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, : width * dtype.itemsize])
    values = rows.view(dtype).astype(np.float32)
    depth: F32 = values if dtype.kind == "f" else values / np.float32(STEPS_PER_M)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0))
    stamp = image.header.stamp
    return DepthImage(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec), depth, camera)


def _info_name(topic: Topic) -> str:
    return topic.name.rpartition("/")[0] + "/camera_info"


def _camera(recording: Recording, topic: Topic) -> tuple[CameraModel | None, bool]:
    """The geometry beside a topic of images, and whether they are distorted."""
    info = recording.topics.get(_info_name(topic))
    if info is None or info.msgtype != CAMERA_INFO:
        return None, False
    message = _first(recording, info.name)
    if message is None:
        return None, False
    with suppress(*ABSURD):
        return camera_of(message), bool(np.any(np.asarray(message.d if hasattr(message, "d") else message.D) != 0.0))
    return None, False


def _is_depth(message: Any) -> bool:
    return str(message.encoding) in _FORMATS


def _first(recording: Recording, name: str) -> Any:
    """The first message of a topic that decodes; None without one."""
    with closing(cast("Any", recording.messages([name]))) as messages:
        for raw in messages:
            with suppress(IngestError):
                return raw.message
    return None
