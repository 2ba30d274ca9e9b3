"""Opening whatever a drone brings home: MCAP files, ROS 1 bags, rosbag2 files and folders, told by their content."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from mineloc.errors import IngestError
from mineloc.io.bags import BagRecording
from mineloc.io.mcap_framing import MAGIC
from mineloc.io.mcap_recording import McapRecording
from mineloc.io.recording import Damage, RawMessage, Recording, Topic

_ROS1_MAGIC = b"#ROSBAG V"
_SQLITE_MAGIC = b"SQLite format 3\0"
_EXPECTED = "an .mcap, .bag or .db3 file or a rosbag2 folder"


def open_recording(path: Path) -> Recording:
    """Open a recording of any kind; close it, or use it in a `with` statement.

    Args:
        path: a file or a rosbag2 folder.

    Raises:
        IngestError: no such file, empty, of another kind, or damaged beyond recovery.
    """
    path = Path(path)
    if path.is_dir():
        return _open_folder(path)
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except FileNotFoundError:
        raise IngestError(path, "no such file", expected=_EXPECTED, todo="check the path") from None
    except OSError as error:
        raise IngestError(
            path, f"cannot be read ({error.strerror})", todo="check its permissions and the disk"
        ) from error
    if not start:
        raise IngestError(path, "empty (0 bytes)", expected=_EXPECTED, todo="copy it again from the drone")
    if start.startswith(MAGIC):
        return McapRecording(path)
    if start.startswith(_ROS1_MAGIC):
        return BagRecording(path, ros1=True)
    if start.startswith(_SQLITE_MAGIC):
        return BagRecording(path, ros1=False)
    raise IngestError(
        path,
        f"not a recording (begins with {start[:8]!r})",
        expected=_EXPECTED,
        todo="check the path, or copy it again",
    )


def has_end(path: Path) -> bool:
    """Whether what is read last is there, without reading the rest: False of an MCAP file that is still being copied.

    Other kinds do not tell; they count as ended.

    Raises:
        IngestError: it cannot be read.
    """
    parts = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    try:
        return all(_has_end(part) for part in parts)
    except OSError as error:
        raise IngestError(
            path, f"cannot be read ({error.strerror})", todo="check its permissions and the disk"
        ) from error


def _has_end(path: Path) -> bool:
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return True
        file.seek(0, os.SEEK_END)
        file.seek(max(file.tell() - len(MAGIC), 0))
        return file.read() == MAGIC and file.tell() > 2 * len(MAGIC)


def _open_folder(path: Path) -> Recording:
    parts = sorted(path.glob("*.mcap"), key=_natural)
    if parts:
        # our own reader checks and recovers each part; metadata.yaml, which a crash leaves unwritten, is not needed
        return parts_in_sequence(path, parts)
    if any(path.glob("*.db3")) or (path / "metadata.yaml").exists():
        if not (path / "metadata.yaml").exists():
            found = sorted(path.glob("*.db3"), key=_natural)
            if len(found) == 1:
                return BagRecording(found[0], ros1=False)
            raise IngestError(
                path, "no metadata.yaml", expected="a rosbag2 folder", todo="run ros2 bag reindex on the folder"
            )
        return BagRecording(path, ros1=False)
    raise IngestError(path, "a folder without a recording", expected=_EXPECTED, todo="check the path")


def parts_in_sequence(path: Path, parts: list[Path]) -> Recording:
    """The MCAP files of a folder as one recording."""
    if len(parts) == 1:
        return McapRecording(parts[0])
    return _Sequence(path, parts)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Order in which `bag_9` comes before `bag_10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


class _Sequence:
    """Several MCAP files, one after another: what rosbag2 makes when it splits a recording."""

    kind = "mcap"

    def __init__(self, path: Path, parts: list[Path]) -> None:
        self.path = path
        self._stack = ExitStack()
        with ExitStack() as stack:
            self._parts = [stack.enter_context(McapRecording(part)) for part in parts]
            self._stack = stack.pop_all()
        self.total_bytes = sum(part.total_bytes for part in self._parts)
        self.profile = self._parts[0].profile
        self.metadata: dict[str, Mapping[str, str]] = {}
        self.topics: dict[str, Topic] = {}
        for part in self._parts:
            self.metadata.update(part.metadata)
            for topic in part.topics.values():
                self.topics[topic.name] = _merged(part.path, self.topics.get(topic.name), topic)

    @property
    def damage(self) -> list[Damage]:
        """Of all parts, each told by its file's name."""
        return [
            replace(damage, what=f"{damage.what} ({part.path.name})") for part in self._parts for damage in part.damage
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the files."""
        self._stack.close()

    def attachments(self) -> Iterator[tuple[str, str, bytes]]:
        """Of all parts."""
        for part in self._parts:
            yield from part.attachments()

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Part by part, each in the order of its log times."""
        for part in self._parts:
            yield from part.messages(topics)


def _merged(path: Path, known: Topic | None, topic: Topic) -> Topic:
    if known is None:
        return topic
    if replace(known, count=None) != replace(topic, count=None):
        raise IngestError(
            f"{path}: {topic.name}",
            f"{topic.msgtype} here, {known.msgtype} in the files before",
            expected="one type a topic",
            todo="ingest the files one by one",
        )
    return replace(known, count=None if known.count is None or topic.count is None else known.count + topic.count)
