"""Reading an MCAP file by its chunk index: every checksum checked, one chunk in memory at a time.

The mcap library's readers parse one record field at a time and do not look at the summary's checksum; a flight is
read often, so this goes straight from the index to the message bytes.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections.abc import Collection, Generator, Iterable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, AttachmentIndex, ChunkIndex
from mcap.summary import Summary

from mineloc.errors import IngestError

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
# uncompressed size, its CRC, length of the compression's name; after opcode, length and two times
_CHUNK = struct.Struct("<QII")
_CHUNK_SIZE_AT = 1 + 8 + 8 + 8
_FOOTER_BYTES = 1 + 8 + 8 + 8 + 4 + 8
# A canonical chunk is 1 MiB or one sweep; more than this is a damaged or hostile size.
_MAX_CHUNK_BYTES = 1 << 28


@dataclass(frozen=True, slots=True, order=True)
class RawRecord:
    """One message as it stands in the file; `data` points into its unpacked chunk."""

    log_ns: int
    chunk_offset: int
    offset: int
    channel: int
    data: memoryview


def read_summary(path: Path, stream: BinaryIO) -> tuple[Summary, SeekingReader]:
    """The checked summary of an indexed MCAP file, and the library's reader for its metadata.

    Raises:
        IngestError: not an MCAP file, cut off, or a summary whose checksum is wrong.
    """
    try:
        reader = SeekingReader(stream, validate_crcs=True, record_size_limit=_MAX_CHUNK_BYTES)
        _check_summary(path, stream)
        summary = reader.get_summary()
    except IngestError:
        raise
    except Exception as error:
        raise _damaged(path, "is not a whole MCAP file", error) from error
    if summary is None or summary.statistics is None:
        raise IngestError(path, "has no summary", todo="run mineloc ingest first")
    return summary, reader


def _check_summary(path: Path, stream: BinaryIO) -> None:
    size = stream.seek(0, 2)
    stream.seek(max(0, size - _FOOTER_BYTES))
    tail = stream.read()
    opcode, length, start, _, crc = struct.unpack_from("<BQQQI", tail)
    if opcode != Opcode.FOOTER or length != 20 or tail[-8:] != b"\x89MCAP0\r\n":
        raise IngestError(path, "is cut off", expected="a footer at the end", todo="run mineloc ingest to recover it")
    if start == 0 or crc == 0:
        return
    stream.seek(start)
    if zlib.crc32(stream.read(size - start - 8 - 4)) != crc:
        raise IngestError(path, "the summary is damaged (checksum)", todo="run mineloc ingest to recover it")


def read_attachment(path: Path, stream: BinaryIO, index: AttachmentIndex) -> Attachment:
    """An attachment, its checksum checked.

    Raises:
        IngestError: damaged.
    """
    stream.seek(index.offset)
    raw = stream.read(index.length)
    try:
        record = Attachment.read(ReadDataStream(BytesIO(raw[9:])))
        crc = struct.unpack_from("<I", raw, len(raw) - 4)[0]
    except Exception as error:
        raise _damaged(path, f"attachment {index.name} is damaged", error) from error
    if crc not in (0, zlib.crc32(raw[9:-4])):
        raise IngestError(path, f"attachment {index.name} is damaged (checksum)", todo="run mineloc ingest again")
    return record


def ordered_messages(path: Path, chunks: Iterable[ChunkIndex], channels: Collection[int]) -> Generator[RawRecord]:
    """The messages of some channels in order of log time (ties in file order), from chunks in order of their start.

    Raises:
        IngestError: a damaged chunk, with its place.
    """
    waiting: list[RawRecord] = []
    with path.open("rb") as stream:
        for index in sorted(chunks, key=lambda c: (c.message_start_time, c.chunk_start_offset)):
            while waiting and waiting[0].log_ns < index.message_start_time:
                yield heapq.heappop(waiting)
            for record in _read_chunk(path, stream, index):
                if record.channel in channels:
                    heapq.heappush(waiting, record)
        while waiting:
            yield heapq.heappop(waiting)


def _read_chunk(path: Path, stream: BinaryIO, index: ChunkIndex) -> list[RawRecord]:
    where = f"chunk at byte {index.chunk_start_offset}"
    try:
        stream.seek(index.chunk_start_offset)
        raw = stream.read(index.chunk_length)
        if len(raw) != index.chunk_length or raw[0] != Opcode.CHUNK:
            raise IngestError(path, f"{where} is missing", todo="run mineloc ingest to recover the rest")
        size, crc, name_length = _CHUNK.unpack_from(raw, _CHUNK_SIZE_AT)
        name_at = _CHUNK_SIZE_AT + _CHUNK.size
        data_at = name_at + name_length + 8
        data = _unpack(memoryview(raw)[data_at:], raw[name_at : data_at - 8].decode(), size)
        if crc not in (0, zlib.crc32(data)):
            raise IngestError(path, f"{where} is damaged (checksum)", todo="run mineloc ingest to recover the rest")
        return _messages(data, index.chunk_start_offset)
    except IngestError:
        raise
    except Exception as error:
        # see read_summary
        raise _damaged(path, f"{where} is damaged", error) from error


def _unpack(packed: memoryview, compression: str, size: int) -> bytes | memoryview:
    if size > _MAX_CHUNK_BYTES:
        raise ValueError(f"claims {size} bytes")
    if compression == "lz4":
        data = lz4.frame.decompress(packed)
    elif compression == "zstd":
        data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    elif compression == "":
        data = packed
    else:
        raise ValueError(f"compression {compression!r}")
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes instead of {size}")
    return data


def _messages(data: bytes | memoryview, chunk_offset: int) -> list[RawRecord]:
    out: list[RawRecord] = []
    view, at = memoryview(data), 0
    while at < len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        body, at = at + 9, at + 9 + length
        if at > len(data):
            raise ValueError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            channel, _, log_ns, _ = _MESSAGE.unpack_from(data, body)
            out.append(RawRecord(log_ns, chunk_offset, body, channel, view[body + 22 : at]))
    return out


def _damaged(path: Path, found: str, error: Exception) -> IngestError:
    return IngestError(path, f"{found} ({type(error).__name__})", todo="run mineloc ingest to recover what is whole")
