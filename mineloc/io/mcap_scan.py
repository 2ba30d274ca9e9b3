"""The index of an MCAP file that has none, or a broken one, rebuilt by walking through the whole file.

Every chunk is decompressed and its checksum verified; what does not hold is left out and noted. Where the walk loses
its way (a damaged length, a hole) it goes on at the next chunk whose header is consistent.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_left
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import DataEnd, MessageIndex, Metadata

from mineloc.io.mcap_framing import (
    MAGIC,
    MAX_RECORD_BYTES,
    RECORD_HEADER,
    ChunkHeader,
    RecordError,
    messages_in,
    parse_chunk_header,
    parse_record,
    read_exactly,
    unpack_chunk,
)
from mineloc.io.mcap_index import McapIndex, Segment, parse_summary, read_profile
from mineloc.io.recording import Damage, share_losses

_CHUNK_HEAD_BYTES = 48
_RUN_BYTES = 1 << 20
_WINDOW_BYTES = 8 << 20
_BARE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_FIXED_LENGTHS: dict[int, int] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
_NS = 1e-9


@dataclass(slots=True)
class _Hole:
    """A place from which messages could not be read."""

    offset: int
    what: str
    head: ChunkHeader | None
    messages: int | None = None
    open_ended: bool = False
    stretches: int = 1
    end_ns: int = 0

    def __post_init__(self) -> None:
        self.end_ns = 0 if self.head is None else self.head.end_ns

    def damage(self, starts: list[tuple[int, int]], ends: list[tuple[int, int]]) -> Damage:
        """With the seconds until what follows in the file; (offset, time) of all starts and ends are known."""
        begin = max((t for at, t in ends if at < self.offset), default=None)
        end = min((t for at, t in starts if at > self.offset), default=None)
        if self.head is not None:
            begin = self.head.start_ns
        if self.end_ns:
            end = max(self.end_ns, self.end_ns if end is None else end)
        seconds = None if begin is None or end is None else max(end - begin, 0) * _NS
        seconds = 0.0 if self.messages == 0 else seconds
        more = f" and {self.stretches - 1} unreadable stretches after it" if self.stretches > 1 else ""
        return Damage(self.offset, self.what + more, self.messages, seconds, open_ended=self.open_ended)


def scan(file: BinaryIO, size: int) -> McapIndex:
    """Walk through the file and index every message whose checksum holds.

    Args:
        file: opened for reading, seekable.
        size: its bytes.

    Raises:
        RecordError: the records contradict each other beyond repair (one channel id with two meanings).
    """
    return _Scan(file, size).run()


class _Scan:
    def __init__(self, file: BinaryIO, size: int) -> None:
        self.file = file
        self.size = size
        self.index = McapIndex()
        self.found: dict[int, int] = {}
        self.announced: dict[int, int] | None = None
        self.lost: list[_Hole] = []
        self.run_start: int | None = None
        self.has_bare_messages = False
        self.ended = False
        self.orphan_counts: dict[int, int] | None = None

    def run(self) -> McapIndex:
        try:
            self.index.profile = read_profile(self.file)
        except RecordError:
            self.index.profile = ""  # only the name is lost; if more is, the walk will stumble over it
        position = len(MAGIC)
        while position < self.size and not self.ended:
            position = self._step(position)
        if not self.ended:
            self._close_run(position)
        self._finish()
        return self.index

    def _step(self, position: int) -> int:
        """Take the record at `position`; the position of the next one."""
        try:
            opcode, length = RECORD_HEADER.unpack(read_exactly(self.file, position, RECORD_HEADER.size))
            content = position + RECORD_HEADER.size
            if not Opcode.HEADER <= opcode <= Opcode.DATA_END and opcode < 0x80:
                raise RecordError("bytes that are no record")
            if length > self.size - content:
                raise RecordError(f"the file ends within a {_name(opcode)}")
            self._check_length(opcode, content, length)
        except RecordError as error:
            return self._resume(position, str(error))
        end = content + length
        if opcode in _BARE:
            self._extend_run(position, end)
            return end
        self._close_run(position)
        if opcode == Opcode.CHUNK:
            self._chunk(position, length)
        else:
            self._other(opcode, position, content, length)
        return end

    def _check_length(self, opcode: int, content: int, length: int) -> None:
        """Records that say their length twice must say it alike: a damaged length would skip what follows."""
        head = read_exactly(self.file, content, min(_CHUNK_HEAD_BYTES, length))
        if opcode == Opcode.CHUNK:
            parse_chunk_header(head, length)
        elif opcode == Opcode.MESSAGE_INDEX:
            if length < 6 or int.from_bytes(head[2:6], "little") != length - 6:
                raise RecordError("a damaged message index")
        elif length != _FIXED_LENGTHS.get(opcode, length):
            raise RecordError(f"a damaged {_name(opcode)}")

    def _chunk(self, position: int, length: int) -> None:
        self.orphan_counts = None
        head: ChunkHeader | None = None
        try:
            content = read_exactly(self.file, position + RECORD_HEADER.size, length)
            head = parse_chunk_header(content, length)
            plain = unpack_chunk(head, memoryview(content)[head.data_start :])
            self._count(position, length + RECORD_HEADER.size, plain, head)
        except RecordError as error:
            self.orphan_counts = {}
            self._note(position, f"unreadable chunk ({error})", head=head)

    def _count(self, offset: int, length: int, plain: bytes | memoryview, header: ChunkHeader | None) -> None:
        counts: dict[int, int] = {}
        stamps: list[int] = []
        for channel_id, log_ns, _, _ in messages_in(plain, schemas=self.index.schemas, channels=self.index.channels):
            counts[channel_id] = counts.get(channel_id, 0) + 1
            stamps.append(log_ns)
        if not stamps:
            return
        self.index.segments.append(
            Segment(
                offset,
                length,
                len(plain),
                min(stamps),
                max(stamps),
                is_chunk=header is not None,
                is_compressed=header is not None and bool(header.compression),
                channels=frozenset(counts),
            )
        )
        for channel_id, count in counts.items():
            self.found[channel_id] = self.found.get(channel_id, 0) + count

    def _extend_run(self, position: int, end: int) -> None:
        self.has_bare_messages = True
        if self.run_start is None:
            self.run_start = position
        if end - self.run_start > _RUN_BYTES:
            self._close_run(end)

    def _close_run(self, end: int) -> None:
        if self.run_start is None:
            return
        start, self.run_start = self.run_start, None
        if end > start:
            try:
                self._count(start, end - start, read_exactly(self.file, start, end - start), None)
            except RecordError as error:
                self._note(start, str(error))

    def _other(self, opcode: int, position: int, content: int, length: int) -> None:
        try:
            if opcode == Opcode.MESSAGE_INDEX and self.orphan_counts is not None:
                record = parse_record(MessageIndex, read_exactly(self.file, content, length))
                self._orphans(record.channel_id, len(record.records))
            elif opcode == Opcode.ATTACHMENT:
                self.index.attachments.append((position, length + RECORD_HEADER.size))
            elif opcode == Opcode.METADATA:
                text = parse_record(Metadata, read_exactly(self.file, content, length))
                self.index.metadata[text.name] = text.metadata
            elif opcode == Opcode.DATA_END:
                self._end(position, parse_record(DataEnd, read_exactly(self.file, content, length)))
        except RecordError as error:
            self._note(position, str(error), lost=False)

    def _orphans(self, channel_id: int, count: int) -> None:
        """Messages that the index after an unreadable chunk says were in it."""
        assert self.orphan_counts is not None
        self.orphan_counts[channel_id] = count
        self.lost[-1].messages = sum(self.orphan_counts.values())

    def _end(self, position: int, record: DataEnd) -> None:
        """The data section is over: check its checksum where nothing else guards the messages, read the statistics."""
        self.ended = True
        if self.has_bare_messages and record.data_section_crc and self._crc_until(position) != record.data_section_crc:
            self._note(
                None, "checksum mismatch in the data section: a message outside of a chunk is not as it was", lost=False
            )
        start = position + RECORD_HEADER.size + 4
        try:
            content = read_exactly(self.file, start, min(self.size - start, MAX_RECORD_BYTES))
            end = _footer_end(content)
            statistics = parse_summary(content[: end - RECORD_HEADER.size - 20]).statistics
        except RecordError as error:
            self._note(start, str(error), lost=False)
            return
        if statistics is not None:
            self.announced = dict(statistics.channel_message_counts)
        if content[end : end + len(MAGIC)] != MAGIC:
            self._note(start + end, "the end of the file is missing", lost=False)
        elif (extra := len(content) - end - len(MAGIC)) > 0:
            self._note(start + end + len(MAGIC), f"{extra} bytes after the end, ignored", lost=False)

    def _crc_until(self, end: int) -> int:
        crc = 0
        for offset in range(0, end, _RUN_BYTES):
            crc = zlib.crc32(read_exactly(self.file, offset, min(_RUN_BYTES, end - offset)), crc)
        return crc

    def _resume(self, position: int, what: str) -> int:
        """Note what is wrong at `position` and look for the next chunk."""
        self._close_run(position)
        self.orphan_counts = None
        head = None
        try:
            opcode, length = RECORD_HEADER.unpack(read_exactly(self.file, position, RECORD_HEADER.size))
            if opcode == Opcode.CHUNK:
                content = read_exactly(
                    self.file, position + 9, min(_CHUNK_HEAD_BYTES, self.size - position - RECORD_HEADER.size)
                )
                head = parse_chunk_header(content, length)
        except RecordError:
            head = None
        found = find_chunk(self.file, position + 1, self.size)
        self._note(position, what, head=head, open_ended=found is None)
        return self.size if found is None else found

    def _note(
        self,
        offset: int | None,
        what: str,
        *,
        head: ChunkHeader | None = None,
        lost: bool = True,
        open_ended: bool = False,
    ) -> None:
        if lost:
            self.lost.append(_Hole(offset or 0, what, head, open_ended=open_ended))
        else:
            self.index.damage.append(Damage(offset, what))

    def _finish(self) -> None:
        if not self.ended and not any(hole.open_ended for hole in self.lost):
            self.lost.append(_Hole(self.size, "the file was not finished", None, messages=0, open_ended=True))
        # what begins where, the lost chunks too, so that the seconds of neighbours add up
        starts = [(s.offset, s.start_ns) for s in self.index.segments]
        starts += [(hole.offset, hole.head.start_ns) for hole in self.lost if hole.head is not None]
        ends = [(s.offset, s.end_ns) for s in self.index.segments]
        damage = [hole.damage(starts, ends) for hole in self._merged_holes()]
        holes_s = sum(d.seconds or 0.0 for d in damage if not d.open_ended)
        self.index.damage += [self._estimated(d, holes_s) for d in damage]
        self.index.damage.sort(key=lambda damage: -1 if damage.offset is None else damage.offset)
        self.index.segments.sort(key=lambda segment: (segment.start_ns, segment.offset))
        self.index.counts = self.found
        self._compare_with_statistics()

    def _merged_holes(self) -> list[_Hole]:
        """Holes with nothing readable between them as one, so that no second is counted twice."""
        offsets = sorted(segment.offset for segment in self.index.segments)
        merged: list[_Hole] = []
        for hole in sorted(self.lost, key=lambda h: h.offset):
            last = merged[-1] if merged else None
            if last is None or bisect_left(offsets, hole.offset) > bisect_left(offsets, last.offset):
                merged.append(hole)
                continue
            last.stretches += hole.stretches
            last.end_ns = max(last.end_ns, hole.end_ns)
            last.open_ended |= hole.open_ended
            known = last.messages is not None and hole.messages is not None
            last.messages = (last.messages or 0) + (hole.messages or 0) if known else None
        return merged

    def _estimated(self, damage: Damage, holes_s: float) -> Damage:
        """With the number of messages that the rate outside of all holes gives for the seconds lost."""
        segments = self.index.segments
        if damage.messages is not None or damage.seconds is None or not segments:
            return damage
        span_s = (max(s.end_ns for s in segments) - min(s.start_ns for s in segments)) * _NS - holes_s
        if span_s <= 0:
            return damage
        return replace(damage, messages=round(damage.seconds / span_s * sum(self.found.values())), estimated=True)

    def _compare_with_statistics(self) -> None:
        """Correct the losses by the statistics, which know the sum."""
        if self.announced is not None:
            share_losses(self.index.damage, sum(self.announced.values()) - sum(self.found.values()))


def find_chunk(file: BinaryIO, start: int, size: int) -> int | None:
    """The first offset from `start` on at which a whole chunk with a consistent header begins."""
    overlap = _CHUNK_HEAD_BYTES + RECORD_HEADER.size
    for base in range(start, size, _WINDOW_BYTES):
        window = read_exactly(file, base, min(_WINDOW_BYTES + overlap, size - base))
        for at in _candidates(window):
            length = int.from_bytes(window[at + 1 : at + 9], "little")
            if base + at + RECORD_HEADER.size + length > size:
                continue
            try:
                parse_chunk_header(window[at + RECORD_HEADER.size : at + overlap], length)
            except RecordError:
                continue
            return base + at
    return None


def _candidates(window: bytes) -> list[int]:
    """Where the byte of a chunk's opcode is followed by a length below 2^40 and a short name of a compression."""
    data = np.frombuffer(window, np.uint8)
    last = len(data) - _CHUNK_HEAD_BYTES
    if last <= 0:
        return []
    at = np.flatnonzero(data[:last] == Opcode.CHUNK)
    name = RECORD_HEADER.size + struct.calcsize("<QQQI")
    zero = (data[at + 6] | data[at + 7] | data[at + 8] | data[at + name + 1] | data[at + name + 2]) == 0
    return at[zero & (data[at + name] <= 4)].tolist()


def _footer_end(content: bytes) -> int:
    """Where the footer ends in what follows the data section."""
    position = 0
    while position + RECORD_HEADER.size <= len(content):
        opcode, length = RECORD_HEADER.unpack_from(content, position)
        position += RECORD_HEADER.size + length
        if opcode == Opcode.FOOTER and length == 20 and position <= len(content):
            return position
    raise RecordError("the footer is missing")


def _name(opcode: int) -> str:
    return Opcode(opcode).name.lower().replace("_", " ") if opcode in set(Opcode) else "record"
