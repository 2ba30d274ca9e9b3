"""Images of a recording into the flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np

from mineloc.data import CameraModel, DepthImage, GreyImage
from mineloc.errors import IngestError
from mineloc.io.camera_images import camera_of_json, decode_grey
from mineloc.io.findings import Finding
from mineloc.io.flight_layout import CAMERA_KEY
from mineloc.io.flight_writer import FlightWriter
from mineloc.io.intake import ABSURD, Unreadable
from mineloc.io.recording import RawMessage
from mineloc.io.topic_monitor import TopicMonitor

Picture = TypeVar("Picture", DepthImage, GreyImage)


class ImageIntake(Generic[Picture]):
    """Image messages of any driver to images.

    Args:
        monitor: of the topic.
        camera: geometry of the images.
        decode: `ros_images.depth_image` or `.grey_image`.
        write: `FlightWriter.add_depth` or `.add_grey`.
    """

    def __init__(
        self,
        monitor: TopicMonitor,
        camera: CameraModel,
        decode: Callable[[object, CameraModel], Picture],
        write: Callable[[Picture], None],
    ) -> None:
        self.monitor = monitor
        self.unreadable = Unreadable()
        self._camera = camera
        self._decode = decode
        self._write = write

    @property
    def findings(self) -> Sequence[Finding]:
        """See `Intake`."""
        return ()

    def take(self, raw: RawMessage) -> None:
        """Take the next image; see `Intake`."""
        try:
            image = self._decode(raw.message, self._camera)
            if self.monitor.take_one(image.stamp_ns, raw.log_ns, image.stamp_ns):
                self._write(image)
        except (IngestError, *ABSURD) as error:
            self.unreadable.add(error, raw.topic)

    def flush(self) -> None:
        """See `Intake`."""
        self.monitor.catch_up()


class CanonicalGreyIntake:
    """Grey images of a canonical flight into another, as they stand; each is decoded once, to know that it can be.

    Args:
        monitor: of the topic.
        writer: where they go.
    """

    def __init__(self, monitor: TopicMonitor, writer: FlightWriter) -> None:
        self.monitor = monitor
        self.unreadable = Unreadable()
        self._writer = writer

    @property
    def findings(self) -> Sequence[Finding]:
        """See `Intake`."""
        return ()

    def take(self, raw: RawMessage) -> None:
        """Take the next image; see `Intake`."""
        try:
            image = decode_grey(raw.data, camera_of_json(raw.notes.get(CAMERA_KEY, "")))
            if self.monitor.take_one(image.stamp_ns, raw.log_ns, image.stamp_ns):
                # the chunk that `data` is a part of need not be kept
                data = np.frombuffer(raw.data, np.uint8).copy()
                self._writer.add_raw_grey(data, stamp_ns=image.stamp_ns, camera=image.camera)
        except (IngestError, TypeError, *ABSURD) as error:
            self.unreadable.add(error, raw.topic)

    def flush(self) -> None:
        """See `Intake`."""
        self.monitor.catch_up()
