"""An MCAP file as a recording: read by its index when that is whole, else by an index rebuilt from what can be read."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Generator, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from mcap.opcode import Opcode
from mcap.records import Channel

from mineloc.errors import IngestError
from mineloc.io.background import prefetched
from mineloc.io.mcap_framing import (
    MAGIC,
    MAX_RECORD_BYTES,
    RECORD_HEADER,
    RecordError,
    messages_in,
    parse_chunk_header,
    read_exactly,
    read_into,
    unpack_chunk,
)
from mineloc.io.mcap_index import McapIndex, Segment, count_indexed, read_attachment, read_index
from mineloc.io.mcap_scan import scan
from mineloc.io.message_types import make_decoder, ros_type_name
from mineloc.io.recording import Damage, Decoder, RawMessage, Topic, refuse, share_losses

_AHEAD_CHUNKS = 3
# Messages of chunks that overlap in time wait here to be sorted; beyond this they are let go unsorted.
_MAX_WAITING_BYTES = 192 << 20
_NS = 1e-9

# log time, number of the segment, place in it: sorted so, equal times keep the file's order
_Waiting = tuple[int, int, int, RawMessage]
_Wanted = tuple[Topic, Decoder, dict[str, str]]
_Loaded = tuple[Segment, bytes | memoryview | RecordError]


class McapRecording:
    """See `Recording`. Damaged chunks are left out and noted; everything whose checksum holds is delivered.

    Raises:
        IngestError: not an MCAP file, or damaged so that no message can be told from another.
    """

    kind = "mcap"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.total_bytes = path.stat().st_size
        self._file: BinaryIO = path.open("rb")
        try:
            self._index = _load_index(path, self._file, self.total_bytes)
        except BaseException:
            self._file.close()
            raise
        self.profile = self._index.profile
        self.metadata = self._index.metadata
        self.damage: list[Damage] = self._index.damage
        self._conflicts: set[str] = set()
        self._shared = False
        self.topics = self._list_topics()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def attachments(self) -> Iterator[tuple[str, str, bytes]]:
        """Name, media type and bytes of each attachment whose checksum holds; the others become damage."""
        for offset, length in self._index.attachments:
            try:
                record = read_attachment(self._file, offset, length)
            except RecordError as error:
                self._note(Damage(offset, f"{error}, which is lost"))
                continue
            yield record.name, record.media_type, record.data

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of some topics in the order of their log times, chunk by chunk, decompressed a little ahead."""
        wanted = {
            channel.id: (self.topics[channel.topic], self._decoder(channel), channel.metadata)
            for channel in self._index.channels.values()
            if channel.topic in topics
        }
        segments = [s for s in self._index.segments if s.channels is None or not s.channels.isdisjoint(wanted)]
        delivered = dict.fromkeys(wanted, 0)
        waiting: list[_Waiting] = []
        with ExitStack() as stack:
            file = stack.enter_context(self.path.open("rb"))
            chunks = stack.enter_context(closing(prefetched(_load(file, segments), depth=_AHEAD_CHUNKS)))
            for number, (_, plain) in enumerate(chunks):
                try:
                    waiting += _messages_of(number, plain, wanted, delivered)
                except RecordError as error:
                    self._lose(segments[number:], error, set(wanted))
                yield from _release(waiting, _first_time(segments, number + 1))
        self._compare(delivered)

    def _lose(self, segments: list[Segment], error: RecordError, wanted: set[int]) -> None:
        """Note that the first of `segments`, which the index takes for whole, is not; the others follow it in time."""
        segment = segments[0]
        with self.path.open("rb") as file:
            counts = count_indexed(file, segment)
        messages = None if counts is None else sum(counts.get(channel_id, 0) for channel_id in wanted)
        # until the next chunk of the same topics, so that the seconds of neighbours add up
        following = (s.start_ns for s in segments[1:] if not (s.channels or frozenset()).isdisjoint(wanted))
        end_ns = max(segment.end_ns, next(following, segment.end_ns))
        self._note(Damage(segment.offset, f"unreadable chunk ({error})", messages, (end_ns - segment.start_ns) * _NS))

    def _note(self, damage: Damage) -> None:
        if damage not in self.damage:
            self.damage.append(damage)

    def _compare(self, delivered: dict[int, int]) -> None:
        """Hold what came against what the index announces; what is missing without a known place is damage too."""
        if self._index.counts is None:
            return
        missing = sum(max(self._index.counts.get(channel, 0) - count, 0) for channel, count in delivered.items())
        if missing and not self._shared:
            self._shared = True
            share_losses(self.damage, missing)

    def _list_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for channel in sorted(self._index.channels.values(), key=lambda c: c.id):
            schema = self._index.schemas.get(channel.schema_id)
            count = None if self._index.counts is None else self._index.counts.get(channel.id, 0)
            topic = Topic(
                channel.topic,
                ros_type_name(schema.name) if schema is not None else "",
                count,
                channel.message_encoding,
                schema.encoding if schema is not None else "",
            )
            known = topics.get(channel.topic)
            if known is not None:
                if replace(known, count=None) != replace(topic, count=None):
                    self._conflicts.add(channel.topic)
                topic = replace(known, count=None if known.count is None or count is None else known.count + count)
            topics[channel.topic] = topic
        return topics

    def _decoder(self, channel: Channel) -> Decoder:
        if channel.topic in self._conflicts:
            raise IngestError(
                f"{self.path}: {channel.topic}",
                "messages of several types on one topic",
                expected="one type a topic",
                todo="record them as topics of their own",
            )
        schema = self._index.schemas.get(channel.schema_id)
        definition = "" if schema is None else schema.data.decode("utf-8", "replace")
        return make_decoder(self.path, self.topics[channel.topic], definition)


def _load_index(path: Path, file: BinaryIO, size: int) -> McapIndex:
    try:
        if read_exactly(file, 0, min(size, len(MAGIC))) != MAGIC:
            raise IngestError(path, "no MCAP file", expected="an MCAP file", todo="check the path")
        why = ""
        try:
            index = read_index(file, size)
        except RecordError as error:
            index, why = None, str(error)
        if index is None:
            index = scan(file, size)
            if why and not index.damage:
                index.damage.append(Damage(None, why))
    except Exception as error:  # noqa: BLE001  # hostile files: whatever a parser says leaves as one kind of error
        refuse(path, error, "reading its index")
    return index


def _load(file: BinaryIO, segments: Iterable[Segment]) -> Generator[_Loaded]:
    # compressed data are read into the same memory each time: fresh memory costs more than the reading
    buffer = bytearray()
    for segment in segments:
        try:
            if segment.is_compressed:
                if segment.length > len(buffer):
                    buffer = bytearray(min(2 * segment.length, MAX_RECORD_BYTES))
                yield segment, _plain(segment, read_into(file, segment.offset, segment.length, buffer))
            else:
                yield segment, _plain(segment, memoryview(read_exactly(file, segment.offset, segment.length)))
        except RecordError as error:
            yield segment, error


def _plain(segment: Segment, record: memoryview) -> bytes | memoryview:
    if not segment.is_chunk:
        return record
    length = segment.length - RECORD_HEADER.size
    if length < 0 or RECORD_HEADER.unpack_from(record) != (Opcode.CHUNK, length):
        raise RecordError("nothing there but the index says so")
    content = record[RECORD_HEADER.size :]
    header = parse_chunk_header(content, length)
    if bool(header.compression) != segment.is_compressed:
        raise RecordError("a damaged header")
    return unpack_chunk(header, content[header.data_start :])


def _messages_of(
    number: int,
    plain: bytes | memoryview | RecordError,
    wanted: dict[int, _Wanted],
    delivered: dict[int, int],
) -> list[_Waiting]:
    if isinstance(plain, RecordError):
        raise plain
    found: list[_Waiting] = []
    counts: dict[int, int] = {}
    for channel_id, log_ns, publish_ns, data in messages_in(plain):
        known = wanted.get(channel_id)
        if known is not None:
            topic, decode, notes = known
            raw = RawMessage(topic, log_ns, publish_ns, data, decode, notes)
            found.append((log_ns, number, len(found), raw))
            counts[channel_id] = counts.get(channel_id, 0) + 1
    # only now: a chunk that turns out damaged half-way delivers nothing
    for channel_id, count in counts.items():
        delivered[channel_id] += count
    return found


def _first_time(segments: list[Segment], number: int) -> tuple[int, int] | None:
    """Before which time and segment no later segment has messages; None at the end."""
    return (segments[number].start_ns, number) if number < len(segments) else None


def _release(waiting: list[_Waiting], limit: tuple[int, int] | None) -> Iterator[RawMessage]:
    """Take from the waiting messages, sorted, those that no later segment can precede."""
    waiting.sort()
    if limit is None or sum(len(entry[3].data) for entry in waiting) > _MAX_WAITING_BYTES:
        ready = len(waiting)
    else:
        ready = bisect_left(waiting, (*limit, -1))
    yield from [entry[3] for entry in waiting[:ready]]
    del waiting[:ready]
