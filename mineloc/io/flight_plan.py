"""What a recording will become: which topic is what, and where the sensors sit."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from mineloc.data import Calibration, FlightInfo
from mineloc.errors import IngestError
from mineloc.io import flight_layout as layout
from mineloc.io.health import HealthFinding
from mineloc.io.image_topics import ImageTopic, find_depth, find_grey, why_left_out
from mineloc.io.recording import Recording, Topic
from mineloc.io.ros import TF_MESSAGE
from mineloc.io.sequence import Sequence
from mineloc.io.static_frames import StaticFrames, frame_name
from mineloc.io.topic_roles import Roles, choose_roles

_TF_STATIC_SPAN_NS = 10_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What a recording will become.

    Attributes:
        roles: which topic is what.
        info, calibration: facts for the flight.
        remarks: where they come from, one finding each.
        earlier: the health record of a recording that is a flight already.
        depth, grey: topics of images that can be used; their cameras are known.
    """

    roles: Roles
    info: FlightInfo
    calibration: Calibration
    remarks: tuple[HealthFinding, ...]
    earlier: Mapping[str, Any] | None
    depth: ImageTopic | None = None
    grey: ImageTopic | None = None


def plan_flight(recording: Recording, told: Sequence) -> Plan:
    """Decide what each topic is and where the sensors sit.

    Args:
        recording: opened.
        told: the sequence file; an empty one if there is none.

    Raises:
        IngestError: ambiguous, missing or undecodable topics.
    """
    roles = choose_roles(recording.path, recording.topics, told.topics)
    remarks = [HealthFinding("topic_assumed", "info", 1, line) for line in roles.assumed]
    facts = _own_facts(recording)
    frames = _static_frames(recording) if facts is None else StaticFrames()
    info = told.flight_info(source=recording.path.name)
    calibration, earlier = told.calibration, None
    images, assumed = _images(recording, told, frames)
    remarks += assumed
    if facts is not None:
        own, calibration, earlier = facts
        remarks = []  # the topics of a flight are what they are called
        info = _override(own, info)
    if "T_body" in told.model_fields_set:
        calibration = told.calibration
    elif facts is None and (found := _static_calibration(recording, roles, frames, images)) is not None:
        calibration, body = found
        line = f"sensors are placed by /tf_static: {body} counts as the body"
        remarks.append(HealthFinding("calibration_from_tf", "info", 1, line))
    used, left_out = _used(images, calibration, told)
    remarks += left_out
    return Plan(roles, info, calibration, tuple(remarks), earlier, used.get("depth"), used.get("grey"))


def _images(recording: Recording, told: Sequence, frames: StaticFrames) -> tuple[list[ImageTopic], list[HealthFinding]]:
    """The topics of depth and grey images, and what had to be assumed."""

    def same_place(one: str, other: str) -> bool:
        T_one_other = frames.between(one, other)
        return T_one_other is not None and np.allclose(T_one_other, np.eye(4), atol=1e-6)

    depth, assumed = find_depth(recording, told.topics.depth)
    usable = depth if depth is not None and depth.known else None
    grey, more = find_grey(recording, told.topics.grey, depth=usable, same_place=same_place)
    return [image for image in (depth, grey) if image is not None], [*assumed, *more]


def _used(
    images: list[ImageTopic], calibration: Calibration, told: Sequence
) -> tuple[dict[str, ImageTopic], list[HealthFinding]]:
    """The images that can be used, by their role, and why others are left out."""
    used: dict[str, ImageTopic] = {}
    findings: list[HealthFinding] = []
    for image in images:
        named = bool(getattr(told.topics, image.role))
        left_out = why_left_out(image, placed=calibration.T_body_camera is not None, told=named)
        if left_out is None:
            used[image.role] = image
        else:
            findings.append(left_out)
    return used, findings


def _own_facts(recording: Recording) -> tuple[FlightInfo, Calibration, Mapping[str, Any]] | None:
    """What a recording that is a flight already says about itself."""
    record = recording.metadata.get(layout.FLIGHT_RECORD)
    if record is None:
        return None
    info, calibration, _, _ = layout.decode_info(recording.path, record)
    text = recording.metadata.get(layout.HEALTH_RECORD, {}).get("json", "{}")
    try:
        health: object = json.loads(text)
    except ValueError:
        health = {}
    return info, calibration, cast("Mapping[str, Any]", health) if isinstance(health, dict) else {}


def _override(own: FlightInfo, told: FlightInfo) -> FlightInfo:
    """The flight's own facts, except where a sequence file says otherwise; the source stays the first one."""
    values = {name: getattr(told, name) or getattr(own, name) for name in FlightInfo.__dataclass_fields__}
    return FlightInfo(**{**values, "source": own.source or told.source})


def _static_frames(recording: Recording) -> StaticFrames:
    frames = StaticFrames()
    names = [t.name for t in recording.topics.values() if t.msgtype == TF_MESSAGE and t.name.endswith("tf_static")]
    if not names:
        return frames
    until_ns: int | None = None
    # latched transforms stand at the beginning; some systems repeat them until the end
    with closing(_stream(recording, names)) as messages:
        for raw in messages:
            until_ns = raw.log_ns + _TF_STATIC_SPAN_NS if until_ns is None else until_ns
            if raw.log_ns > until_ns:
                break
            with suppress(IngestError):  # one that does not decode places nothing
                frames.add(raw.message)
    return frames


def _static_calibration(
    recording: Recording, roles: Roles, frames: StaticFrames, images: list[ImageTopic]
) -> tuple[Calibration, str] | None:
    if frames.empty:
        return None
    # the first is that of depth, if its camera is known: grey images are seen from there too
    camera = next((image.frame for image in images if image.known), "")
    return frames.calibration(_frame_of(recording, roles.lidar), _frame_of(recording, roles.imu), camera)


def _frame_of(recording: Recording, topic: Topic | None) -> str:
    if topic is None:
        return ""
    with closing(_stream(recording, [topic.name])) as messages:
        for raw in messages:
            with suppress(IngestError):
                return frame_name(raw.message.header.frame_id)
    return ""


def _stream(recording: Recording, names: Iterable[str]) -> Any:
    return recording.messages(list(names))
