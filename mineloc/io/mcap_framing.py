"""MCAP framing: records, chunks with their checksum, and the messages inside. No length that a file claims is believed.

The specification is https://mcap.dev/spec. Framing is done here rather than with the mcap library's stream reader
because recovery needs byte offsets and limits, and because a message costs that reader some twenty `struct` calls. The
content of all records but chunks and messages is parsed by `mcap.records`.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple, TypeVar, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Schema

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEADER = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<QQQII")
_U64 = struct.Struct("<Q")
_MESSAGE_FIELDS = 22
_LATEST_NS = 2**63 - 1
_CHUNK_FIXED_BYTES = _CHUNK.size + _U64.size
MAX_RECORD_BYTES = 256 << 20

R = TypeVar("R", bound=McapRecord)
D = TypeVar("D", Schema, Channel)


class RecordError(Exception):
    """A stretch of an MCAP file is not what it should be; the message says how. Never leaves `io`."""


@dataclass(frozen=True, slots=True)
class ChunkHeader:
    """What a chunk says about itself.

    Attributes:
        start_ns, end_ns: log times of its first and last message.
        uncompressed_bytes: size after decompression.
        crc: CRC-32 of the uncompressed bytes; 0 says that there is none.
        compression: "zstd", "lz4" or "".
        data_start: where the data begins in the record's content.
    """

    start_ns: int
    end_ns: int
    uncompressed_bytes: int
    crc: int
    compression: str
    data_start: int


class MessageRecord(NamedTuple):
    """One message in a chunk: `data` is a view of the chunk's bytes. A tuple, because there are hundreds a second."""

    channel_id: int
    log_ns: int
    publish_ns: int
    data: memoryview


def read_exactly(file: BinaryIO, offset: int, length: int) -> bytes:
    """`length` bytes from `offset`.

    Raises:
        RecordError: the file ends before, the length is beyond any limit, or the disk fails.
    """
    if length > MAX_RECORD_BYTES:
        raise RecordError(f"a record of {length} bytes (the limit is {MAX_RECORD_BYTES})")
    try:
        file.seek(offset)
        data = file.read(length)
    except OSError as error:
        raise RecordError(f"the disk fails ({error.strerror})") from error
    if len(data) != length:
        raise RecordError("the file ends within a record")
    return data


def read_into(file: BinaryIO, offset: int, length: int, buffer: bytearray) -> memoryview:
    """As `read_exactly`, into the beginning of `buffer`; the view is valid until the buffer is used again."""
    if length > len(buffer):
        raise RecordError(f"a record of {length} bytes (the limit is {MAX_RECORD_BYTES})")
    view = memoryview(buffer)[:length]
    try:
        file.seek(offset)
        got = file.readinto(view)  # type: ignore[attr-defined]  # BinaryIO does not declare it, every file has it
    except OSError as error:
        raise RecordError(f"the disk fails ({error.strerror})") from error
    if got != length:
        raise RecordError("the file ends within a record")
    return view


def parse_record(kind: type[R], content: bytes | memoryview) -> R:
    """The content of a record (without opcode and length) by the mcap library's own parser.

    Raises:
        RecordError: the content is not such a record.
    """
    try:
        # `read` of each record kind is a static method that McapRecord does not declare
        record = kind.read(ReadDataStream(io.BytesIO(content)))  # type: ignore[attr-defined]
    except Exception as error:  # the library answers damaged records with thirteen kinds of exception
        raise RecordError(f"a damaged {kind.__name__.lower()} record ({type(error).__name__})") from error
    return cast("R", record)


def parse_chunk_header(content: bytes | memoryview, record_bytes: int) -> ChunkHeader:
    """The fields before a chunk's data.

    Args:
        content: at least the beginning of the record's content.
        record_bytes: the length that the record claims for its content; must fit the sizes within.

    Raises:
        RecordError: the sizes contradict each other, the compression is unknown.
    """
    try:
        start_ns, end_ns, uncompressed, crc, name_bytes = _CHUNK.unpack_from(content)
        name = bytes(content[_CHUNK.size : _CHUNK.size + min(name_bytes, 8)])
        (data_bytes,) = _U64.unpack_from(content, _CHUNK.size + name_bytes)
    except struct.error:
        raise RecordError("a damaged header") from None
    if name not in (b"", b"lz4", b"zstd"):
        raise RecordError("a damaged header, or an unknown compression,")
    if _CHUNK_FIXED_BYTES + name_bytes + data_bytes != record_bytes or (not name and uncompressed != data_bytes):
        raise RecordError("a damaged header")
    return ChunkHeader(start_ns, end_ns, uncompressed, crc, name.decode(), _CHUNK_FIXED_BYTES + name_bytes)


def unpack_chunk(header: ChunkHeader, data: bytes | memoryview) -> bytes | memoryview:
    """Decompress a chunk's data and check its CRC.

    Raises:
        RecordError: the data do not decompress to the announced size, or the checksum differs.
    """
    if header.uncompressed_bytes > MAX_RECORD_BYTES:
        raise RecordError(f"{header.uncompressed_bytes} bytes (the limit is {MAX_RECORD_BYTES})")
    plain = _decompress(header, data)
    if len(plain) != header.uncompressed_bytes:
        raise RecordError(f"{len(plain)} bytes instead of {header.uncompressed_bytes}")
    if header.crc and zlib.crc32(plain) != header.crc:
        raise RecordError("checksum mismatch")
    return plain


def _decompress(header: ChunkHeader, data: bytes | memoryview) -> bytes | memoryview:
    size = max(header.uncompressed_bytes, 1)
    try:
        if header.compression == "lz4":
            # the frame may announce more than the chunk does: only `max_length` is allocated
            return cast("bytes", lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
        if header.compression == "zstd":
            announced = zstandard.frame_content_size(data)
            if announced not in (-1, header.uncompressed_bytes):
                raise RecordError(f"{announced} bytes instead of {header.uncompressed_bytes}")
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except (RuntimeError, EOFError, ValueError, zstandard.ZstdError, MemoryError) as error:
        raise RecordError(f"undecipherable {header.compression} data") from error
    return data


def messages_in(
    plain: bytes | memoryview,
    *,
    schemas: dict[int, Schema] | None = None,
    channels: dict[int, Channel] | None = None,
) -> Iterator[MessageRecord]:
    """The messages of one uncompressed chunk, or of a run of records outside of chunks, in the file's order.

    Args:
        plain: the records one after another.
        schemas, channels: where to put the schemas and channels that come along; None skips them.

    Raises:
        RecordError: the records do not fill the bytes, or define one id in two ways.
    """
    view = memoryview(plain)
    end = len(view)
    position = 0
    while position < end:
        if position + RECORD_HEADER.size > end:
            raise RecordError("a record that ends after its chunk")
        opcode, length = RECORD_HEADER.unpack_from(view, position)
        start = position + RECORD_HEADER.size
        if length > end - start:
            raise RecordError("a record that ends after its chunk")
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE_FIELDS:
                raise RecordError("a message record without its header")
            _, _, channel_id, _, log_ns, publish_ns = _MESSAGE.unpack_from(view, position)
            if log_ns > _LATEST_NS:
                raise RecordError("a message after the year 2262")
            yield MessageRecord(channel_id, log_ns, publish_ns, view[start + _MESSAGE_FIELDS : start + length])
        elif opcode == Opcode.SCHEMA and schemas is not None:
            _define(schemas, parse_record(Schema, view[start : start + length]))
        elif opcode == Opcode.CHANNEL and channels is not None:
            _define(channels, parse_record(Channel, view[start : start + length]))
        position = start + length


def _define(known: dict[int, D], record: D) -> None:
    if known.setdefault(record.id, record) != record:
        raise RecordError(f"a second, different {type(record).__name__.lower()} {record.id}")
