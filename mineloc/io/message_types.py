"""Decoders for messages, made by rosbags from the definitions that the recording itself carries."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from mineloc.errors import IngestError
from mineloc.io.recording import Decoder, Topic

# Definitions come from untrusted files and are compiled to code: the longest honest one (visualization_msgs) has 20 kB,
# and no message that we decode has a fixed array longer than a covariance.
_MAX_DEFINITION_BYTES = 1 << 18
_MAX_FIXED_ARRAY = 4096
_FIXED_ARRAY = re.compile(r"\[\s*([0-9a-zA-Z+]+)\s*\]")
_ENCODINGS = {("cdr", "ros2msg"), ("cdr", "ros2idl"), ("ros1", "ros1msg")}


def ros_type_name(name: str) -> str:
    """`sensor_msgs/PointCloud2` and `sensor_msgs/msg/PointCloud2` both as the latter; other names as they are."""
    parts = name.split("/")
    return normalize_msgtype(name) if len(parts) in (2, 3) and all(parts) else name


def make_decoder(path: Path, topic: Topic, definition: str) -> Decoder:
    """A function from serialised bytes to rosbags messages.

    Args:
        path: of the recording, for errors.
        topic: which topic; its encodings choose the decoder.
        definition: the schema's text; empty means "as in ROS 2 Humble".

    Raises:
        IngestError: the encoding is not a ROS one, the definition is damaged or does not define the type.
    """
    where = f"{path}: {topic.name}"
    if (topic.encoding, topic.schema_encoding) not in _ENCODINGS:
        raise IngestError(
            where,
            f"{topic.msgtype} in encoding {topic.encoding or 'none'} with schema {topic.schema_encoding or 'none'}",
            expected="ROS 2 messages (cdr, ros2msg) or ROS 1 messages (ros1, ros1msg)",
            todo="convert the recording, or record ROS messages",
        )
    try:
        store = _store_for(topic, definition)
        same = _is_standard(store, topic)
    except Exception as error:
        raise IngestError(
            where,
            f"the definition of {topic.msgtype} is damaged ({type(error).__name__})",
            expected="a message definition",
            todo="copy the file again, or record it anew",
        ) from error
    if not same:
        raise IngestError(
            where,
            f"{topic.msgtype} is defined otherwise than ROS does",
            expected="the standard message",
            todo="record the standard message, or rename the type",
        )
    return _decoder(where, topic, store)


def _store_for(topic: Topic, definition: str) -> Typestore:
    if definition:
        return _compiled(topic.msgtype, topic.schema_encoding, definition)
    store = _standard(topic.encoding)
    store.get_msgdef(topic.msgtype)
    return store


def _is_standard(store: Typestore, topic: Topic) -> bool:
    """Whether a type that ROS itself defines has ROS's fields; what ROS does not know may be anything."""
    standard = _standard(topic.encoding)
    if topic.msgtype not in standard.fielddefs:
        return True
    return all(
        name not in standard.fielddefs or list(fields) == list(standard.fielddefs[name][1])
        for name, (_, fields) in store.fielddefs.items()
    )


def _decoder(where: str, topic: Topic, store: Typestore) -> Decoder:
    msgtype = topic.msgtype
    decode = store.deserialize_ros1 if topic.encoding == "ros1" else store.deserialize_cdr

    def checked(data: bytes | memoryview) -> object:
        try:
            return decode(data, msgtype)
        except (SerdeError, LookupError, ArithmeticError, ValueError, TypeError, AssertionError, MemoryError) as error:
            raise IngestError(
                where, f"a message of {len(data)} bytes is not a whole {msgtype}", expected="messages as in the schema"
            ) from error

    return checked


@lru_cache(maxsize=2)
def _standard(encoding: str) -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)


# Parsing and compiling take longer than reading a short recording; all recordings of a fleet have the same definitions.
@lru_cache(maxsize=32)
def _compiled(msgtype: str, schema_encoding: str, definition: str) -> Typestore:
    if len(definition) > _MAX_DEFINITION_BYTES:
        raise ValueError("too long")
    for size in _FIXED_ARRAY.findall(definition):
        if not size.isdigit() or int(size) > _MAX_FIXED_ARRAY:
            raise ValueError("array too long")
    store = get_typestore(Stores.EMPTY)
    if schema_encoding == "ros2idl":
        separator = "=" * 80 + "\n"
        parts = [part.split("\n", 1)[-1] for part in definition.split(separator) if part]
        for text in parts if definition.startswith(separator) else [definition]:
            store.register(get_types_from_idl(text))
    else:
        store.register(get_types_from_msg(definition, msgtype))
    store.get_msgdef(msgtype)
    return store
