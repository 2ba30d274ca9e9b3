"""Which topics of a recording hold depth and grey images that a flight can use, and why others are left out.

A flight has one camera frame: grey images are taken where the depth images are seen from, if there are any.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np

from mineloc.data import CameraModel
from mineloc.errors import IngestError
from mineloc.io.camera_images import camera_of
from mineloc.io.health import HealthFinding
from mineloc.io.intake import ABSURD
from mineloc.io.recording import Recording, Topic
from mineloc.io.ros import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from mineloc.io.ros_images import is_depth, is_picture
from mineloc.io.static_frames import frame_name
from mineloc.io.topic_roles import NONE

Role = Literal["depth", "grey"]
SamePlace = Callable[[str, str], bool]

# Colour images have the same type; a depth image is named so by every driver (METHOD 9.3).
_DEPTH_NAME = re.compile(r"depth")
_COMPRESSED = "/compressed"
_WANTED = {"depth": "Image, 16UC1 or 32FC1", "grey": "Image (mono8, rgb8, bgr8) or CompressedImage (JPEG)"}


@dataclass(frozen=True, slots=True)
class ImageTopic:
    """A topic of images.

    Attributes:
        role: what they are.
        topic: as recorded.
        frame: of the images, optical.
        camera: from the CameraInfo beside it; None where there is none.
        distorted: whether that CameraInfo tells of a distortion.
    """

    role: Role
    topic: Topic
    frame: str
    camera: CameraModel | None
    distorted: bool

    @property
    def known(self) -> bool:
        """Whether it is known which way each pixel looks."""
        return self.camera is not None and not self.distorted


def find_depth(recording: Recording, told: str) -> tuple[ImageTopic | None, list[HealthFinding]]:
    """The topic of depth images, and what had to be assumed.

    Args:
        recording: opened.
        told: the sequence file's `topics.depth`.

    Raises:
        IngestError: the topic that the sequence file names is not there or holds no depth images.
    """
    topics = [t for t in recording.topics.values() if t.msgtype == IMAGE and t.count != 0]
    named = [t for t in topics if (t.name == told if told else _DEPTH_NAME.search(t.name.lower()))]
    found = [] if told == NONE else _those(recording, "depth", named, is_depth)
    _need_told(recording, "depth", told, found)
    return _only("depth", found)


def find_grey(
    recording: Recording, told: str, *, depth: ImageTopic | None, same_place: SamePlace
) -> tuple[ImageTopic | None, list[HealthFinding]]:
    """The topic of grey or colour images, and what had to be assumed.

    Args:
        recording: opened.
        told: the sequence file's `topics.grey`.
        depth: the depth images that are used; None if there are none.
        same_place: whether two frames lie in each other.

    Raises:
        IngestError: the topic that the sequence file names is not there or holds no such images.
    """
    topics = [t for t in recording.topics.values() if t.msgtype in (IMAGE, COMPRESSED_IMAGE) and t.count != 0]
    names = {t.name for t in topics}
    # one camera often sends its images both ways
    twice = {t.name for t in topics if t.name.endswith(_COMPRESSED) and t.name.removesuffix(_COMPRESSED) in names}
    if told:
        named = [t for t in topics if t.name == told]
    else:  # depth in false colours is no picture
        named = [t for t in topics if t.name not in twice and not _DEPTH_NAME.search(t.name.lower())]
    found = [] if told == NONE else _those(recording, "grey", named, is_picture)
    _need_told(recording, "grey", told, found)
    if depth is None:
        return _only("grey", found)
    beside = [image for image in found if same_place(image.frame, depth.frame)]
    if found and not beside:
        names_of = ", ".join(f"{image.topic.name} ({image.frame})" for image in found)
        line = f"{names_of} left out: depth is seen from {depth.frame}; record depth aligned to colour for both"
        return None, [HealthFinding("grey_left_out", "warning" if told else "info", len(found), line)]
    return _only("grey", beside)


def why_left_out(image: ImageTopic, *, placed: bool, told: bool) -> HealthFinding | None:
    """What keeps the images out of the flight, and what to do; None if nothing does.

    Args:
        image: found.
        placed: whether it is known where the camera sits.
        told: whether the sequence file names the topic.
    """
    if image.camera is None:
        why = f"no CameraInfo on {_info_name(image.topic)}; record it too"
    elif image.distorted:
        why = f"{_info_name(image.topic)} tells of a distortion; record rectified images (image_rect)"
    elif not placed:
        frame = image.frame or "its frame"
        why = f"nothing places {frame} on the drone; record /tf_static or put [T_body.camera] into a sequence file"
    else:
        return None
    # nobody asks for colour; depth is there to be used
    severity = "warning" if told or image.role == "depth" else "info"
    return HealthFinding(f"{image.role}_left_out", severity, 1, f"{image.topic.name} is left out: {why}")


def _those(
    recording: Recording, role: Role, topics: Iterable[Topic], fits: Callable[[object], bool]
) -> list[ImageTopic]:
    """The topics whose first message is of the right kind."""
    out: list[ImageTopic] = []
    for topic in topics:
        first = _first(recording, topic.name)
        if first is not None and fits(first):
            out.append(ImageTopic(role, topic, frame_name(first.header.frame_id), *_camera(recording, topic)))
    return out


def _need_told(recording: Recording, role: Role, told: str, found: list[ImageTopic]) -> None:
    if told in ("", NONE) or found:
        return
    there = [t.name for t in recording.topics.values() if t.msgtype in (IMAGE, COMPRESSED_IMAGE)]
    raise IngestError(
        recording.path,
        f"no {role} images on {told}, which the sequence file names as {role}",
        expected=", ".join(there) or f"a topic of type {_WANTED[role]}",
        todo=f"correct {role} in [topics] of the sequence file",
    )


def _only(role: Role, found: list[ImageTopic]) -> tuple[ImageTopic | None, list[HealthFinding]]:
    if len(found) > 1:
        names = ", ".join(image.topic.name for image in found)
        line = f"no {role} images are taken: it could be any of {names}; a sequence file can name it"
        return None, [HealthFinding("topic_assumed", "info", 1, line)]
    return (found[0] if found else None), []


def _info_name(topic: Topic) -> str:
    return topic.name.removesuffix(_COMPRESSED).rpartition("/")[0] + "/camera_info"


def _camera(recording: Recording, topic: Topic) -> tuple[CameraModel | None, bool]:
    """The geometry beside a topic of images, and whether they are distorted."""
    info = recording.topics.get(_info_name(topic))
    message = None if info is None or info.msgtype != CAMERA_INFO else _first(recording, info.name)
    with suppress(*ABSURD):
        if message is not None:
            d, p = (message.d, message.p) if hasattr(message, "d") else (message.D, message.P)  # ROS 1 has capitals
            # image_proc makes images with the geometry of P; drivers that never rectify leave it empty
            rectified = "rect" in topic.name.removesuffix(_COMPRESSED).rpartition("/")[2] and p[0] > 0
            return camera_of(message, rectified=rectified), not rectified and bool(np.any(np.asarray(d) != 0.0))
    return None, False


def _first(recording: Recording, name: str) -> Any:
    """The first message of a topic that decodes; None without one."""
    # a topic that cannot be read is none of images; if it matters, whoever takes it will say so
    with suppress(IngestError), closing(cast("Any", recording.messages([name]))) as messages:
        for raw in messages:
            with suppress(IngestError):
                return raw.message
    return None
