"""Where the messages of an MCAP file lie, by the file's own summary; one that is not wholly right is refused."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from mineloc.io.mcap_framing import (
    MAGIC,
    MAX_RECORD_BYTES,
    RECORD_HEADER,
    RecordError,
    parse_record,
    read_exactly,
)
from mineloc.io.recording import Damage

_FOOTER_BYTES = RECORD_HEADER.size + 20


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of the file that holds messages: a chunk, or a run of messages outside of chunks.

    Attributes:
        offset: its first byte, at the record's header.
        length: bytes with all record headers.
        plain_bytes: bytes after decompression, as announced.
        start_ns, end_ns: log times of its first and last message.
        is_chunk: False for a run of bare records.
        is_compressed: whether the chunk's data are.
        channels: which channels have messages in it; None if nobody said.
        index_offsets: where each channel's message index lies, empty if there is none.
    """

    offset: int
    length: int
    plain_bytes: int
    start_ns: int
    end_ns: int
    is_chunk: bool = True
    is_compressed: bool = False
    channels: frozenset[int] | None = None
    index_offsets: tuple[int, ...] = ()


@dataclass(slots=True)
class McapIndex:
    """What a reader needs to know before the first message.

    Attributes:
        profile: of the header.
        schemas, channels: by id.
        segments: in the order of their start times.
        counts: messages of each channel; what the statistics announce, else what a scan counted; None if unknown.
        metadata: named text records.
        attachments: offset and length of each attachment record.
        damage: what was found wrong on the way.
    """

    profile: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    segments: list[Segment] = field(default_factory=list[Segment])
    counts: dict[int, int] | None = None
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    attachments: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    damage: list[Damage] = field(default_factory=list[Damage])


@dataclass(slots=True)
class Summary:
    """The records between the data section and the footer."""

    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    chunks: list[ChunkIndex] = field(default_factory=list[ChunkIndex])
    attachments: list[AttachmentIndex] = field(default_factory=list[AttachmentIndex])
    metadata: list[MetadataIndex] = field(default_factory=list[MetadataIndex])
    statistics: Statistics | None = None


def records_in(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of the records that fill some bytes.

    Raises:
        RecordError: they do not fill them.
    """
    position = 0
    while position < len(content):
        if position + RECORD_HEADER.size > len(content):
            raise RecordError("the summary ends within a record")
        opcode, length = RECORD_HEADER.unpack_from(content, position)
        position += RECORD_HEADER.size
        if length > len(content) - position:
            raise RecordError("the summary ends within a record")
        yield opcode, content[position : position + length]
        position += length


def read_index(file: BinaryIO, size: int) -> McapIndex | None:
    """The index as the summary gives it; None if the file has no summary or no chunks to point at.

    Args:
        file: opened for reading, seekable.
        size: its bytes.

    Raises:
        RecordError: end or summary are damaged, or contradict each other: the file must be scanned.
    """
    if size < len(MAGIC) * 2 + _FOOTER_BYTES or read_exactly(file, size - len(MAGIC), len(MAGIC)) != MAGIC:
        raise RecordError("the end of the file is missing")
    summary = _read_summary(file, size)
    if summary is None or not summary.chunks or not _is_self_contained(summary):
        return None
    index = McapIndex(schemas=summary.schemas, channels=summary.channels)
    index.profile = read_profile(file)
    if summary.statistics is not None:
        index.counts = dict(summary.statistics.channel_message_counts)
    index.segments = sorted((_segment(chunk, size) for chunk in summary.chunks), key=lambda s: (s.start_ns, s.offset))
    _check_consistent(index, summary.statistics)
    for entry in summary.metadata:
        record = parse_record(Metadata, _content_at(file, entry.offset, entry.length, Opcode.METADATA))
        index.metadata[record.name] = record.metadata
    index.attachments = [(entry.offset, entry.length) for entry in summary.attachments]
    return index


def read_profile(file: BinaryIO) -> str:
    """The profile of the header record, the first in the file.

    Raises:
        RecordError: there is no header.
    """
    opcode, length = RECORD_HEADER.unpack(read_exactly(file, len(MAGIC), RECORD_HEADER.size))
    if opcode != Opcode.HEADER or length > 1 << 16:
        raise RecordError("no header record at the beginning")
    content = read_exactly(file, len(MAGIC) + RECORD_HEADER.size, length)
    name_bytes = int.from_bytes(content[:4], "little")
    return content[4 : 4 + name_bytes].decode("utf-8", "replace")


def read_attachment(file: BinaryIO, offset: int, length: int) -> Attachment:
    """An attachment whose checksum holds.

    Raises:
        RecordError: it does not, or there is none.
    """
    content = _content_at(file, offset, length, Opcode.ATTACHMENT)
    if len(content) < 4:
        raise RecordError("a damaged attachment")
    crc = int.from_bytes(content[-4:], "little")
    if crc and zlib.crc32(memoryview(content)[:-4]) != crc:
        raise RecordError("checksum mismatch in an attachment")
    return parse_record(Attachment, content)


def count_indexed(file: BinaryIO, segment: Segment) -> dict[int, int] | None:
    """Messages of each channel in a chunk by the message indexes that follow it; None if there are none.

    Used to say what a chunk that cannot be read would have held.
    """
    counts: dict[int, int] = {}
    for offset in segment.index_offsets:
        try:
            opcode, length = RECORD_HEADER.unpack(read_exactly(file, offset, RECORD_HEADER.size))
            if opcode != Opcode.MESSAGE_INDEX:
                return None
            record = parse_record(MessageIndex, read_exactly(file, offset + RECORD_HEADER.size, length))
        except RecordError:
            return None
        counts[record.channel_id] = len(record.records)
    return counts or None


def _content_at(file: BinaryIO, offset: int, length: int, opcode: Opcode) -> bytes:
    record = read_exactly(file, offset, length)
    if len(record) < RECORD_HEADER.size or RECORD_HEADER.unpack_from(record) != (opcode, length - RECORD_HEADER.size):
        raise RecordError(f"no {opcode.name.lower()} where the summary says")
    return record[RECORD_HEADER.size :]


def _read_summary(file: BinaryIO, size: int) -> Summary | None:
    footer_offset = size - len(MAGIC) - _FOOTER_BYTES
    tail = read_exactly(file, footer_offset, _FOOTER_BYTES)
    if RECORD_HEADER.unpack_from(tail) != (Opcode.FOOTER, 20):
        raise RecordError("the footer is damaged")
    footer = parse_record(Footer, tail[RECORD_HEADER.size :])
    if footer.summary_start == 0:
        return None
    if (
        not len(MAGIC) <= footer.summary_start <= footer_offset
        or footer_offset - footer.summary_start > MAX_RECORD_BYTES
    ):
        raise RecordError("the footer is damaged")
    content = read_exactly(file, footer.summary_start, footer_offset - footer.summary_start)
    if footer.summary_crc and zlib.crc32(tail[:-4], zlib.crc32(content)) != footer.summary_crc:
        raise RecordError("checksum mismatch in the summary")
    return parse_summary(content)


def parse_summary(content: bytes) -> Summary:
    """The summary section's records.

    Raises:
        RecordError: a record is damaged.
    """
    summary = Summary()
    for opcode, record in records_in(content):
        if opcode == Opcode.SCHEMA:
            schema = parse_record(Schema, record)
            summary.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse_record(Channel, record)
            summary.channels[channel.id] = channel
        elif opcode == Opcode.CHUNK_INDEX:
            summary.chunks.append(parse_record(ChunkIndex, record))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            summary.attachments.append(parse_record(AttachmentIndex, record))
        elif opcode == Opcode.METADATA_INDEX:
            summary.metadata.append(parse_record(MetadataIndex, record))
        elif opcode == Opcode.STATISTICS:
            summary.statistics = parse_record(Statistics, record)
    return summary


def _segment(chunk: ChunkIndex, size: int) -> Segment:
    if chunk.chunk_start_offset + chunk.chunk_length > size:
        raise RecordError("the summary points beyond the file")
    channels = frozenset(chunk.message_index_offsets) or None
    return Segment(
        offset=chunk.chunk_start_offset,
        length=chunk.chunk_length,
        plain_bytes=chunk.uncompressed_size,
        start_ns=chunk.message_start_time,
        end_ns=chunk.message_end_time,
        is_compressed=bool(chunk.compression),
        channels=channels,
        index_offsets=tuple(chunk.message_index_offsets.values()),
    )


def _is_self_contained(summary: Summary) -> bool:
    # A writer may leave schemas and channels to the chunks; then only a scan finds them.
    used = set[int]().union(*(chunk.message_index_offsets for chunk in summary.chunks))
    if summary.statistics is not None:
        used |= set(summary.statistics.channel_message_counts)
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
    return bool(summary.channels) and used <= set(summary.channels) and schemas <= set(summary.schemas)


def _check_consistent(index: McapIndex, statistics: Statistics | None) -> None:
    if statistics is not None and statistics.chunk_count != len(index.segments):
        raise RecordError(f"the summary lists {len(index.segments)} of {statistics.chunk_count} chunks")
    reach = 0
    for segment in sorted(index.segments, key=lambda s: s.offset):
        if segment.offset < reach:
            raise RecordError("the summary lists chunks that overlap")
        reach = segment.offset + segment.length
