"""An MCAP file written chunk by chunk, compressed and checksummed beside the caller.

The records are the mcap library's own; its `Writer` is not used because it compresses on the caller's thread and lets
a chunk grow past its size by one message. Schemas and channels stand before the first chunk, so that a damaged chunk
never takes them along.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from mineloc.data import I64
from mineloc.io.background import OrderedPipeline

U8 = NDArray[np.uint8]
MAGIC = b"\x89MCAP0\r\n"

_MESSAGE = struct.Struct("<BQHIQQ")
_HEADS = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<u8"),
        ("publish_ns", "<u8"),
    ]
)
_CHUNK_TIMES = struct.Struct("<BQQQQII")
# On point clouds, zstd 3 costs four times as much as 1 for a tenth of the size, and lz4 without this acceleration
# twice as much for a fiftieth; both then hold up ingest.
_ZSTD_LEVEL = 1
_LZ4_LEVEL = -2
# Measured ranges are noise to lz4: where a part of a chunk does not shrink below this share, the chunk is stored as it
# is, which saves a third of the time of writing and of every later reading.
_WORTH_IT = 0.9
_TRIED_BYTES = 8 << 10
# More pieces than this (a sweep has two) are joined before they are written.
_FEW_PIECES = 8
_WORKERS = 2
_DEPTH = 6


@dataclass(slots=True)
class _Chunk:
    """A chunk being filled: the pieces that make up its records, and where the messages start."""

    pieces: list[bytes | memoryview] = field(default_factory=list)
    size: int = 0
    start_ns: int = 0
    end_ns: int = 0
    index: dict[int, list[tuple[int, int]]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Ready:
    """A chunk ready for the disk; `data` in pieces, `size` bytes together."""

    chunk: _Chunk
    crc: int
    compression: str
    data: Sequence[bytes | memoryview]
    size: int


class McapWriter:
    """Streams messages into an MCAP file.

    Messages are kept apart in groups (a chunk holds one group), so that a reader of the inertial samples need not
    unpack the clouds.

    Args:
        stream: binary file, written from its current start.
        compression: "zstd", "lz4" (chunks that it does not shrink stay as they are) or "none".
        chunk_bytes: largest uncompressed chunk, unless one message alone is larger.
        chunk_span_ns: longest time between the first and the last message of a chunk.
    """

    def __init__(
        self,
        stream: BinaryIO,
        *,
        profile: str,
        library: str,
        compression: str = "lz4",
        chunk_bytes: int = 1 << 20,
        chunk_span_ns: int = 1_000_000_000,
    ) -> None:
        if compression not in ("zstd", "lz4", "none"):
            raise ValueError(f"compression {compression!r}: one of zstd, lz4, none")
        self._stream = stream
        self._compression = "" if compression == "none" else compression
        self._chunk_bytes = chunk_bytes
        self._chunk_span_ns = chunk_span_ns
        self._at = 0
        self._open: dict[str, _Chunk] = {}
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._pipeline = OrderedPipeline[_Ready | bytes](self._put, workers=_WORKERS, depth=_DEPTH)
        self._write(MAGIC + _record(Header(profile, library)))

    def add_channel(self, topic: str, msgtype: str, schema: str, metadata: Mapping[str, str]) -> int:
        """Declare a topic of ROS 2 messages and return its channel id. Must precede its first message."""
        records: list[McapRecord] = []
        if msgtype not in self._schemas:
            self._schemas[msgtype] = Schema(len(self._schemas) + 1, schema.encode(), "ros2msg", msgtype)
            records.append(self._schemas[msgtype])
        channel = Channel(len(self._channels) + 1, topic, "cdr", dict(metadata), self._schemas[msgtype].id)
        self._channels[channel.id] = channel
        records.append(channel)
        data = b"".join(map(_record, records))
        self._pipeline.submit(lambda: data)
        return channel.id

    def add_message(
        self, channel: int, log_ns: int, data: bytes | memoryview, *, publish_ns: int | None = None, group: str = ""
    ) -> None:
        """Append one message. `data` is kept until its chunk is written and must not change.

        Raises:
            ValueError: a negative time, which MCAP cannot hold.
            OSError: the disk refused an earlier chunk.
        """
        if log_ns < 0:
            raise ValueError(f"log time {log_ns} ns is negative")
        size = _MESSAGE.size + len(data)
        chunk = self._open.get(group)
        if chunk is not None and (
            chunk.size + size > self._chunk_bytes or log_ns - chunk.start_ns > self._chunk_span_ns
        ):
            self._close_chunk(group)
            chunk = None
        if chunk is None:
            chunk = self._open[group] = _Chunk(start_ns=log_ns, end_ns=log_ns)
        sequence = self._counts[channel] & 0xFFFFFFFF
        publish = log_ns if publish_ns is None else publish_ns
        chunk.index.setdefault(channel, []).append((log_ns, chunk.size))
        chunk.pieces.append(_MESSAGE.pack(Opcode.MESSAGE, size - 9, channel, sequence, log_ns, publish))
        chunk.pieces.append(data)
        chunk.size += size
        chunk.start_ns = min(chunk.start_ns, log_ns)
        chunk.end_ns = max(chunk.end_ns, log_ns)
        self._counts[channel] += 1

    def add_messages(self, channel: int, logs_ns: I64, rows: U8, *, group: str = "") -> None:
        """Append (n, size) messages with rising log times: the same bytes as one `add_message` each, ten times faster.

        Raises:
            ValueError: a negative time.
            OSError: the disk refused an earlier chunk.
        """
        n, size = rows.shape
        if not n:
            return
        if logs_ns[0] < 0:
            raise ValueError(f"log time {logs_ns[0]} ns is negative")
        framed = np.empty((n, _MESSAGE.size + size), np.uint8)
        framed[:, _MESSAGE.size :] = rows
        heads = framed[:, : _MESSAGE.size].view(_HEADS)[:, 0]
        heads["opcode"], heads["length"], heads["channel"] = Opcode.MESSAGE, _MESSAGE.size + size - 9, channel
        heads["sequence"] = (self._counts[channel] + np.arange(n)) & 0xFFFFFFFF
        heads["log_ns"] = heads["publish_ns"] = logs_ns
        self._counts[channel] += n
        at = 0
        while at < n:
            at = self._fill_chunk(channel, logs_ns, framed, at, group)

    def _fill_chunk(self, channel: int, logs_ns: I64, framed: U8, at: int, group: str) -> int:
        """Put as many messages from `at` on into the open chunk as belong there; the first that does not."""
        size, first = framed.shape[1], int(logs_ns[at])
        chunk = self._open.get(group)
        start_ns = first if chunk is None else min(first, chunk.start_ns)
        room = (self._chunk_bytes - (0 if chunk is None else chunk.size)) // size
        in_time = int(np.searchsorted(logs_ns, start_ns + self._chunk_span_ns, side="right"))
        if chunk is not None and (room < 1 or first - chunk.start_ns > self._chunk_span_ns):
            self._close_chunk(group)
            return at
        if chunk is None:
            chunk = self._open[group] = _Chunk(start_ns=first, end_ns=first)
        stop = max(min(at + room, in_time, len(framed)), at + 1)
        offsets = range(chunk.size, chunk.size + (stop - at) * size, size)
        chunk.index.setdefault(channel, []).extend(zip(logs_ns[at:stop].tolist(), offsets, strict=True))
        chunk.pieces.append(framed[at:stop].reshape(-1).data)
        chunk.size += (stop - at) * size
        chunk.start_ns = start_ns
        chunk.end_ns = max(chunk.end_ns, int(logs_ns[stop - 1]))
        return stop

    def _close_chunk(self, group: str) -> None:
        chunk = self._open.pop(group)
        self._pipeline.submit(lambda: self._prepare(chunk))

    def _prepare(self, chunk: _Chunk) -> _Ready:
        pieces: Sequence[bytes | memoryview] = chunk.pieces
        if len(pieces) > _FEW_PIECES:
            pieces = [b"".join(pieces)]
        crc = 0
        for piece in pieces:
            crc = zlib.crc32(piece, crc)
        packed: bytes | None = None
        if self._compression == "lz4" and _shrinks(pieces):
            packed = bytes(lz4.frame.compress(b"".join(pieces), compression_level=_LZ4_LEVEL))
        elif self._compression == "zstd":
            packed = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(b"".join(pieces))
        if packed is None:
            return _Ready(chunk, crc, "", pieces, chunk.size)
        return _Ready(chunk, crc, self._compression, [packed], len(packed))

    def _put(self, item: _Ready | bytes) -> None:
        if isinstance(item, bytes):
            self._write(item)
            return
        chunk, name = item.chunk, item.compression.encode()
        length = 8 + 8 + 8 + 4 + 4 + len(name) + 8 + item.size
        head = _CHUNK_TIMES.pack(Opcode.CHUNK, length, chunk.start_ns, chunk.end_ns, chunk.size, item.crc, len(name))
        start = self._at
        self._write(head + name + struct.pack("<Q", item.size))
        for piece in item.data:
            self._write(piece)
        index = ChunkIndex(
            chunk_length=self._at - start,
            chunk_start_offset=start,
            compression=item.compression,
            compressed_size=item.size,
            message_end_time=chunk.end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.start_ns,
            uncompressed_size=chunk.size,
        )
        index_start = self._at
        for channel, entries in chunk.index.items():
            index.message_index_offsets[channel] = self._at
            self._write(_record(MessageIndex(channel, entries)))
        index.message_index_length = self._at - index_start
        self._chunks.append(index)

    def _write(self, data: bytes | memoryview) -> None:
        self._stream.write(data)
        self._at += len(data)

    def finish(self, metadata: Mapping[str, Mapping[str, str]], attachments: list[Attachment]) -> None:
        """Write what is open, then metadata, attachments and the summary. The stream stays open."""
        for group in list(self._open):
            self._close_chunk(group)
        self._pipeline.close()
        for name, values in metadata.items():
            record = _record(Metadata(name, dict(values)))
            self._metadata.append(MetadataIndex(self._at, len(record), name))
            self._write(record)
        for a in attachments:
            record = _record(a)
            index = AttachmentIndex(self._at, len(record), a.log_time, a.create_time, len(a.data), a.name, a.media_type)
            self._attachments.append(index)
            self._write(record)
        self._write(_record(DataEnd(0)))
        self._write_summary()

    def abort(self) -> None:
        """Stop the threads; the file is left incomplete."""
        self._pipeline.abort()

    def _write_summary(self) -> None:
        start, data, offsets = self._at, b"", b""
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self._chunks)),
            (Opcode.ATTACHMENT_INDEX, list(self._attachments)),
            (Opcode.METADATA_INDEX, list(self._metadata)),
        ]
        for opcode, records in groups:
            if records:
                group = b"".join(map(_record, records))
                offsets += _record(SummaryOffset(opcode, start + len(data), len(group)))
                data += group
        # The CRC covers the summary and the footer up to the CRC itself.
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, start + len(data))
        crc = zlib.crc32(data + offsets + footer)
        self._write(data + offsets + _record(Footer(start, start + len(data), crc)) + MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _shrinks(pieces: Sequence[bytes | memoryview]) -> bool:
    """Whether lz4 is worth its time, from the middle of the largest piece: the same bytes give the same answer."""
    largest = max(pieces, key=len)
    middle = len(largest) // 2
    part = largest[max(0, middle - _TRIED_BYTES // 2) : middle + _TRIED_BYTES // 2]
    return len(lz4.frame.compress(part, compression_level=_LZ4_LEVEL)) < _WORTH_IT * len(part)


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
