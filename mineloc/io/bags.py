"""ROS 1 bags and rosbag2 SQLite files as recordings, by rosbags' readers."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, Self

import lz4.frame
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Bag1Reader
from rosbags.rosbag2 import Reader as Bag2Reader

from mineloc.errors import IngestError
from mineloc.io.message_types import make_decoder
from mineloc.io.recording import Damage, Decoder, RawMessage, Topic, refuse

# A bag's chunk is as large as `rosbag record --chunksize` made it, 768 KiB unless told otherwise.
_MAX_CHUNK_BYTES = 512 << 20
_NO_NOTES: Mapping[str, str] = {}
_SCHEMAS = {MessageDefinitionFormat.MSG: "msg", MessageDefinitionFormat.IDL: "idl", MessageDefinitionFormat.NONE: "msg"}


class BagRecording:
    """See `Recording`. Bags have no checksums: what rosbags cannot read is refused as a whole, never read in part.

    Args:
        path: a `.bag`, a `.db3`, or a rosbag2 folder of `.db3` files.
        ros1: whether it is a ROS 1 bag.

    Raises:
        IngestError: not such a file, or a damaged one.
    """

    profile = ""

    def __init__(self, path: Path, *, ros1: bool) -> None:
        self.path = path
        self.kind = "rosbag1" if ros1 else "rosbag2"
        self.metadata: Mapping[str, Mapping[str, str]] = {}
        self.damage: list[Damage] = []
        self._ros1 = ros1
        self._reader: Bag1Reader | Bag2Reader
        try:
            files = path.rglob("*") if path.is_dir() else [path]
            self.total_bytes = sum(file.stat().st_size for file in files)
            self._reader = Bag1Reader(path) if ros1 else Bag2Reader(path)
            self._reader.open()
            if isinstance(self._reader, Bag1Reader):
                _bound_chunks(self._reader)
            self.topics = _list_topics(self._reader.connections, "ros1" if ros1 else "cdr")
        except Exception as error:  # noqa: BLE001  # rosbags answers hostile files with assertions and KeyErrors too
            self._refuse(error, "opening it")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the file."""
        self._reader.close()

    def attachments(self) -> Iterator[tuple[str, str, bytes]]:
        """Bags have none."""
        return iter(())

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of some topics in the order of their log times.

        Raises:
            IngestError: the bag is damaged.
        """
        connections = [c for c in self._reader.connections if c.topic in topics]
        decoders: dict[str, Decoder] = {c.topic: self._decoder(c) for c in connections}
        if not connections:
            return
        stream = self._reader.messages(connections)
        count = 0
        while True:
            try:
                connection, log_ns, data = next(stream)
            except StopIteration:
                return
            except Exception as error:  # noqa: BLE001  # as above
                self._refuse(error, f"reading message {count + 1}")
            count += 1
            # a damaged database may hold anything in any column
            if not isinstance(data, bytes | memoryview) or not isinstance(log_ns, int):  # pyright: ignore[reportUnnecessaryIsInstance]
                self._refuse(ValueError("not a message"), f"reading message {count}")
            yield RawMessage(self.topics[connection.topic], log_ns, log_ns, data, decoders[connection.topic], _NO_NOTES)

    def _decoder(self, connection: Connection) -> Decoder:
        topic = self.topics[connection.topic]
        if connection.msgtype != topic.msgtype:
            raise IngestError(
                f"{self.path}: {topic.name}",
                f"messages of several types ({topic.msgtype}, {connection.msgtype}) on one topic",
                expected="one type a topic",
                todo="record them as topics of their own",
            )
        return make_decoder(self.path, topic, connection.msgdef.data)

    def _refuse(self, error: Exception, doing: str) -> NoReturn:
        text = str(error)
        if self._ros1 and ("not indexed" in text or "index looks damaged" in text):
            raise IngestError(
                self.path,
                "a bag without its index, as a crash or a broken copy leaves it",
                expected="a finished bag",
                todo="run rosbag reindex on it",
            ) from error
        refuse(self.path, error, doing)


def _list_topics(connections: list[Connection], encoding: str) -> dict[str, Topic]:
    topics: dict[str, Topic] = {}
    for c in connections:
        schema = ("ros1" if encoding == "ros1" else "ros2") + _SCHEMAS[c.msgdef.format]
        known = topics.get(c.topic)
        if known is None:
            topics[c.topic] = Topic(c.topic, c.msgtype, c.msgcount, encoding, schema)
        else:
            topics[c.topic] = replace(known, count=(known.count or 0) + c.msgcount)
    return topics


def _bound_chunks(reader: Bag1Reader) -> None:
    """Let no chunk of an untrusted bag grow without limit when it is decompressed."""
    bounded: dict[Any, Callable[[bytes], bytes]] = {bz2.decompress: _bounded_bz2, lz4.frame.decompress: _bounded_lz4}
    for position, chunk in reader.chunks.items():
        reader.chunks[position] = chunk._replace(decompressor=bounded.get(chunk.decompressor, chunk.decompressor))


def _bounded_bz2(data: bytes) -> bytes:
    return _whole(bz2.BZ2Decompressor(), data)


def _bounded_lz4(data: bytes) -> bytes:
    return _whole(lz4.frame.LZ4FrameDecompressor(), data)


def _whole(decompressor: Any, data: bytes) -> bytes:
    plain: bytes = decompressor.decompress(data, max_length=_MAX_CHUNK_BYTES)
    if not decompressor.eof:
        raise ValueError(f"a chunk that is cut, or larger than {_MAX_CHUNK_BYTES} bytes")
    return plain
