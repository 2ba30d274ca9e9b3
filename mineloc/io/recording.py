"""What every kind of recording offers: its topics, its messages one by one, and what is damaged in it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import NoReturn, Protocol, Self

from mineloc.errors import IngestError

Decoder = Callable[[bytes | memoryview], object]


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording.

    Attributes:
        name: "/velodyne_points".
        msgtype: ROS 2 style, "sensor_msgs/msg/PointCloud2"; the schema's own name when it is not a ROS type.
        count: number of messages that the file can deliver, as far as its index says; None if only reading tells.
        encoding: how the messages are serialised, "cdr" or "ros1"; others are listed but cannot be decoded.
        schema_encoding: "ros2msg", "ros1msg", "ros2idl" …
    """

    name: str
    msgtype: str
    count: int | None
    encoding: str
    schema_encoding: str


@dataclass(frozen=True, slots=True)
class Damage:
    """Something in the file that is not as it was written.

    Attributes:
        offset: byte in the file, None where no single place is wrong.
        what: what was found there.
        messages: number of messages lost; None if nobody can tell.
        seconds: time lost between the messages around it; None if nobody can tell.
        estimated: whether `messages` is computed from the rates of what could be read.
        open_ended: whether more is missing of which nothing is known (the end of a truncated file).
    """

    offset: int | None
    what: str
    messages: int | None = 0
    seconds: float | None = 0.0
    estimated: bool = False
    open_ended: bool = False

    @property
    def lost_something(self) -> bool:
        """Whether messages are missing because of it, or may be."""
        return self.open_ended or self.messages is None or self.messages > 0

    def describe(self) -> str:
        """One line: the place, what is wrong, what it cost."""
        place = "" if self.offset is None else f"at byte {self.offset}: "
        tail = "; what came after is unknown" if self.open_ended else ""
        if self.messages is None:
            return f"{place}{self.what}; an unknown number of messages lost{tail}"
        if self.messages == 0:
            return f"{place}{self.what}; no message lost{tail}"
        at_least = "at least " if self.open_ended else ""
        note = " (estimated)" if self.estimated else ""
        seconds = "" if self.seconds is None else f", {self.seconds:.3g} s"
        return f"{place}{self.what}; {at_least}{self.messages} messages{note}{seconds} lost{tail}"


class RawMessage:
    """One message as it is stored, decoded when asked.

    Attributes:
        topic, msgtype, encoding: as in `Topic`.
        log_ns: when the recorder received it; the order of the file.
        publish_ns: when it was sent, as far as the recorder knew; else as `log_ns`.
        data: the serialised bytes, a view that is valid as long as it is held.
        notes: what the file says about the channel, such as its quality of service.
    """

    __slots__ = ("_decode", "data", "encoding", "log_ns", "msgtype", "notes", "publish_ns", "topic")

    def __init__(
        self,
        topic: Topic,
        log_ns: int,
        publish_ns: int,
        data: bytes | memoryview,
        decode: Decoder,
        notes: Mapping[str, str],
    ) -> None:
        self.topic = topic.name
        self.msgtype = topic.msgtype
        self.encoding = topic.encoding
        self.log_ns = log_ns
        self.publish_ns = publish_ns
        self.data = data
        self.notes = notes
        self._decode = decode

    @property
    def message(self) -> object:
        """The decoded rosbags message (decoded anew at every access).

        Raises:
            IngestError: the bytes do not fit the schema.
        """
        return self._decode(self.data)


class Recording(Protocol):
    """A file or folder of messages, opened. Use as a context manager."""

    @property
    def path(self) -> Path:
        """Where it lies."""
        ...

    @property
    def kind(self) -> str:
        """ "mcap", "rosbag1" or "rosbag2"."""
        ...

    @property
    def profile(self) -> str:
        """The MCAP profile, empty for others."""
        ...

    @property
    def total_bytes(self) -> int:
        """Size on disk."""
        ...

    @property
    def topics(self) -> Mapping[str, Topic]:
        """By name."""
        ...

    @property
    def damage(self) -> Sequence[Damage]:
        """What is known to be wrong so far; complete once `messages` has run to its end."""
        ...

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """Named records of text; empty for all but MCAP."""
        ...

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of some topics, in the order of their log times, as a stream.

        Raises:
            IngestError: a topic cannot be decoded, the file cannot be read.
        """
        ...

    def attachments(self) -> Iterator[tuple[str, str, bytes]]:
        """Name, media type and bytes of each attachment whose checksum holds."""
        ...

    def close(self) -> None:
        """Release the file."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def share_losses(damage: list[Damage], missing: int) -> None:
    """Give places of which nobody knows how many messages they cost their share of a known sum, by their seconds.

    Args:
        damage: changed in place; entries whose number is known exactly stay.
        missing: messages lost at all places together.
    """
    vague = [i for i, d in enumerate(damage) if d.messages is None or d.estimated]
    left = max(missing - sum(d.messages or 0 for i, d in enumerate(damage) if i not in vague), 0)
    if not vague:
        if left:
            damage.append(Damage(None, "messages that the statistics announce are not in the file", left, None))
        return
    weights = [damage[i].seconds or 0.0 for i in vague]
    total = sum(weights)
    given, reached = 0, 0.0
    for i, weight in zip(vague, weights, strict=True):
        reached += weight / total if total else 1 / len(vague)
        messages = round(left * reached) - given
        given += messages
        damage[i] = replace(damage[i], messages=messages, estimated=len(vague) > 1)


def refuse(path: Path | str, error: Exception, doing: str) -> NoReturn:
    """Turn whatever a parser raised over a damaged or hostile file into the one kind of error that leaves `io`.

    Raises:
        IngestError: always.
    """
    if isinstance(error, IngestError):
        raise error
    if isinstance(error, PermissionError):
        raise IngestError(path, "no permission to read it", todo="check the permissions of the file") from error
    if isinstance(error, OSError) and error.errno is not None:
        raise IngestError(
            path, f"cannot be read while {doing} ({error.strerror})", todo="check the disk, copy the file again"
        ) from error
    detail = f"{type(error).__name__}: {str(error)[:200]}" if str(error) else type(error).__name__
    raise IngestError(
        path, f"damaged or not a recording, found while {doing} ({detail})", todo="copy the file again from the drone"
    ) from error
