"""Reading a canonical flight: facts at once, measurements as streams."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Generator
from pathlib import Path
from types import TracebackType
from typing import cast

import numpy as np
from mcap.records import Channel

from mineloc.data import Calibration, DepthImage, FlightInfo, GreyImage, ImuSamples, Sweep, Trajectory
from mineloc.errors import FlightError, IngestError
from mineloc.io import camera_images, canonical
from mineloc.io import flight_layout as layout
from mineloc.io.background import prefetched
from mineloc.io.cdr_layout import CdrLayout
from mineloc.io.mcap_chunks import RawRecord, ordered_messages, read_attachment, read_summary
from mineloc.io.ros import COMPRESSED_IMAGE, IMAGE, IMU, ODOMETRY, POINT_CLOUD2, POSE_STAMPED

# Decoded this far ahead of the consumer: a few megabytes.
_AHEAD = 4
# Small messages decoded at a time.
_PORTION = 2000
# A sweep waits this long for inertial samples that do not come.
_PATIENCE_NS = 300_000_000

_Decoded = Sweep | DepthImage | GreyImage
_Item = _Decoded | RawRecord
_DECODED = {layout.POINTS: POINT_CLOUD2, layout.DEPTH: IMAGE, layout.GREY: COMPRESSED_IMAGE}


class FlightReader:
    """Reads one flight file. Every checksum is checked; memory does not grow with the flight.

    Attributes:
        path: the file.
        info: who flew what, where and when.
        calibration: where the sensors sit.
        health: what ingest found out; empty when it was not ingested (simulated).
        sweep_count, depth_count, grey_count: number of sweeps, depth images and grey images.
        first_ns, last_ns: times of the first and the last measurement.

    Raises:
        IngestError: not a canonical flight, or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            self._stream = self.path.open("rb")
        except OSError as error:
            raise IngestError(path, error.strerror or "cannot be read", todo="check the path") from None
        try:
            self._load()
        except BaseException:
            self._stream.close()
            raise

    def _load(self) -> None:
        summary, reader = read_summary(self.path, self._stream)
        try:
            records = {record.name: record.metadata for record in reader.iter_metadata()}
        except Exception as error:
            raise IngestError(
                self.path, f"metadata are damaged ({type(error).__name__})", todo="run mineloc ingest again"
            ) from error
        if layout.FLIGHT_RECORD not in records:
            raise IngestError(
                self.path,
                f"no {layout.FLIGHT_RECORD} record",
                expected="a canonical flight",
                todo="run mineloc ingest first",
            )
        facts = layout.decode_info(self.path, records[layout.FLIGHT_RECORD])
        self.info: FlightInfo = facts[0]
        self.calibration: Calibration = facts[1]
        self.first_ns, self.last_ns = facts[2:]
        health = records.get(layout.HEALTH_RECORD, {}).get("json", "{}")
        self.health = cast("dict[str, object]", json.loads(health))
        self._summary = summary
        self.sweep_count = self._count(layout.POINTS)
        self.depth_count = self._count(layout.DEPTH)
        self.grey_count = self._count(layout.GREY)

    def __enter__(self) -> FlightReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last measurement."""
        return (self.last_ns - self.first_ns) * 1e-9

    def sweeps(self, start_ns: int | None = None, end_ns: int | None = None) -> Generator[Sweep]:
        """The sweeps that start in `[start_ns, end_ns)`, read ahead by a background thread.

        Raises:
            FlightError: a sweep does not start later than the one before.
            IngestError: a damaged chunk.
        """
        return cast("Generator[Sweep]", self._between(layout.POINTS, start_ns, end_ns))

    def depth_images(self, start_ns: int | None = None, end_ns: int | None = None) -> Generator[DepthImage]:
        """The depth images taken in `[start_ns, end_ns)`, read ahead by a background thread; none without a camera.

        Raises:
            FlightError: an image is not later than the one before.
            IngestError: a damaged chunk.
        """
        return cast("Generator[DepthImage]", self._between(layout.DEPTH, start_ns, end_ns))

    def grey_images(self, start_ns: int | None = None, end_ns: int | None = None) -> Generator[GreyImage]:
        """The grey images taken in `[start_ns, end_ns)`, read ahead by a background thread; none without a camera.

        Raises:
            FlightError: an image is not later than the one before.
            IngestError: a damaged chunk.
        """
        return cast("Generator[GreyImage]", self._between(layout.GREY, start_ns, end_ns))

    def _between(self, topic: str, start_ns: int | None, end_ns: int | None) -> Generator[_Decoded]:
        for item in prefetched(self._items(topic, start_ns=start_ns, end_ns=end_ns), depth=_AHEAD):
            decoded = cast("_Decoded", item)
            if end_ns is not None and decoded.stamp_ns >= end_ns:
                return
            if start_ns is None or decoded.stamp_ns >= start_ns:
                yield decoded

    def imu(self) -> ImuSamples:
        """All inertial samples.

        Raises:
            FlightError: their times do not increase.
            IngestError: a damaged chunk, or samples in a layout that mineloc does not write.
        """
        parts = [self._decode_imu(records) for records in self._portions(layout.IMU_TOPIC)]
        if not parts:
            return ImuSamples.empty()
        return ImuSamples(
            np.concatenate([part.stamps_ns for part in parts]),
            np.concatenate([part.gyro_radps for part in parts]),
            np.concatenate([part.accel_mps2 for part in parts]),
        )

    def reference(self) -> Trajectory | None:
        """The reference `T_map_body`, None when the flight has none.

        Raises:
            FlightError: its times do not increase.
            IngestError: a damaged chunk, or poses in a layout that mineloc does not write.
        """
        return self._poses(layout.POSE, canonical.pose_layout(layout.MAP), POSE_STAMPED, layout.MAP)

    def odometry(self) -> Trajectory | None:
        """The odometry that came with the recording, `T_odom_body`; None when there was none."""
        made = canonical.odometry_layout(layout.ODOM_FRAME, layout.BODY)
        return self._poses(layout.ODOM, made, ODOMETRY, layout.ODOM_FRAME)

    def steps(self) -> Generator[tuple[Sweep, ImuSamples]]:
        """Every sweep with its inertial samples, in one pass, read ahead by a background thread.

        Each sample is given once, with the first sweep that needs it: the samples of a step are those after the ones
        of the step before, up to the first at or after `sweep.end_ns`. They end earlier only where the flight has no
        sample within 0.3 s after that.

        Raises:
            FlightError: time goes backwards or repeats.
            IngestError: a damaged chunk.
        """
        return prefetched(self._steps(), depth=_AHEAD)

    def _steps(self) -> Generator[tuple[Sweep, ImuSamples]]:
        held: deque[Sweep] = deque()
        samples: list[RawRecord] = []
        felt_ns = -1  # time of the latest sample
        for item in cast("Generator[Sweep | RawRecord]", self._items(layout.POINTS, layout.IMU_TOPIC)):
            now_ns = item.end_ns if isinstance(item, Sweep) else item.log_ns
            while held and now_ns > held[0].end_ns + _PATIENCE_NS:
                yield held.popleft(), self._decode_imu(samples)
                samples = []
            if isinstance(item, Sweep):
                held.append(item)
            else:
                samples.append(item)
                felt_ns = item.log_ns
            while held and felt_ns >= held[0].end_ns:
                yield held.popleft(), self._decode_imu(samples)
                samples = []
        for sweep in held:
            yield sweep, self._decode_imu(samples)
            samples = []

    def attachment(self, name: str) -> bytes:
        """The content of an attached file.

        Raises:
            KeyError: no such attachment.
            IngestError: damaged.
        """
        for index in self._summary.attachment_indexes:
            if index.name == name:
                return read_attachment(self.path, self._stream, index).data
        raise KeyError(name)

    @property
    def attachment_names(self) -> tuple[str, ...]:
        """Names of the attached files."""
        return tuple(index.name for index in self._summary.attachment_indexes)

    def _channels(self, topic: str) -> list[Channel]:
        return [c for c in self._summary.channels.values() if c.topic == topic]

    def _count(self, topic: str) -> int:
        counts = self._summary.statistics.channel_message_counts if self._summary.statistics else {}
        return sum(counts.get(c.id, 0) for c in self._channels(topic))

    def _items(self, *topics: str, start_ns: int | None = None, end_ns: int | None = None) -> Generator[_Item]:
        """Messages of the topics in order of log time, sweeps and images decoded."""
        channels = {c.id: c for topic in topics for c in self._channels(topic)}
        chunks = [
            index
            for index in self._summary.chunk_indexes
            if not channels.keys().isdisjoint(index.message_index_offsets)
            and (start_ns is None or index.message_end_time >= start_ns)
        ]
        last_ns: dict[str, int] = {}
        for record in ordered_messages(self.path, chunks, channels):
            channel = channels[record.channel]
            item = self._decoded(record, channel)
            now_ns = item.log_ns if isinstance(item, RawRecord) else item.stamp_ns
            before_ns = last_ns.get(channel.topic)
            if before_ns is not None and now_ns <= before_ns:
                raise self._disorder(channel.topic, before_ns, now_ns)
            last_ns[channel.topic] = now_ns
            yield item
            if end_ns is not None and now_ns >= end_ns:
                return

    def _portions(self, topic: str) -> Generator[list[RawRecord]]:
        """The messages of a topic, so many at a time that their chunks can be forgotten soon."""
        portion: list[RawRecord] = []
        for item in self._items(topic):
            portion.append(cast("RawRecord", item))
            if len(portion) >= _PORTION:
                yield portion
                portion = []
        if portion:
            yield portion

    def _decoded(self, record: RawRecord, channel: Channel) -> _Item:
        topic, facts = channel.topic, channel.metadata
        if topic not in _DECODED:
            return record
        try:
            if topic == layout.POINTS:
                return canonical.decode_sweep(record.data, period_ns=int(facts[layout.PERIOD_KEY]))
            camera = camera_images.camera_of_json(facts[layout.CAMERA_KEY])
            decode = camera_images.decode_depth if topic == layout.DEPTH else camera_images.decode_grey
            return decode(record.data, camera)
        except Exception as error:
            raise self._foreign(topic, _DECODED[topic]) from error

    def _decode_imu(self, records: list[RawRecord]) -> ImuSamples:
        if not records:
            return ImuSamples.empty()
        try:
            return canonical.decode_imu([r.data for r in records])
        except ValueError as error:
            raise self._foreign(layout.IMU_TOPIC, IMU) from error

    def _poses(self, topic: str, made: CdrLayout, msgtype: str, parent: str) -> Trajectory | None:
        parts: list[Trajectory] = []
        for records in self._portions(topic):
            try:
                data = [r.data for r in records]
                parts.append(canonical.decode_poses(data, made, parent=parent, child=layout.BODY))
            except ValueError as error:
                raise self._foreign(topic, msgtype) from error
        if not parts:
            return None
        stamps = np.concatenate([part.stamps_ns for part in parts])
        return Trajectory(stamps, np.concatenate([part.poses for part in parts]), parent, layout.BODY)

    def _disorder(self, topic: str, before_ns: int, now_ns: int) -> FlightError:
        what = "repeats" if now_ns == before_ns else "goes backwards"
        return FlightError(
            self.path,
            f"time {what} on {topic}: {now_ns} ns after {before_ns} ns",
            expected="increasing times",
            todo="run mineloc ingest on the recording again",
        )

    def _foreign(self, topic: str, what: str) -> IngestError:
        return IngestError(
            self.path,
            f"{topic} holds a {what} that mineloc did not write",
            expected="a canonical flight",
            todo="run mineloc ingest first",
        )
