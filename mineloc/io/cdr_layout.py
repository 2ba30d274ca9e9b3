"""Messages of fixed size as numpy records: thousands are encoded or decoded at once, where one at a time is too slow.

Little-endian CDR: a four-byte encapsulation, then the fields in order, each aligned to its own size counted from
after the encapsulation; text is a length (with its final NUL) and its bytes. A message is of fixed size when its
texts are known. The tests hold every layout to the rosbags serializer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Records = NDArray[np.void]

_ENCAPSULATION = b"\x00\x01\x00\x00"


@dataclass(frozen=True, slots=True)
class Text:
    """A string field of known content."""

    value: str


# name, then a numpy scalar format and how many of it, or a known text
Part = tuple[str, str | Text, int]


@dataclass(frozen=True, slots=True)
class CdrLayout:
    """One fixed-size message: the record type and a record with the constant bytes in place."""

    dtype: np.dtype[np.void]
    template: Records

    def new(self, n: int) -> Records:
        """(n,) records, all fields zero except texts and lengths."""
        return np.repeat(self.template, n)

    def view(self, data: bytes | bytearray | memoryview) -> Records:
        """The records in back-to-back messages, without copying.

        Raises:
            ValueError: the length is no multiple of the message size, or a constant byte differs.
        """
        if len(data) % self.dtype.itemsize:
            raise ValueError(f"{len(data)} bytes are no multiple of {self.dtype.itemsize}")
        records = np.frombuffer(data, self.dtype)
        for name in self.dtype.names or ():
            if name.startswith("_") and not bool((records[name] == self.template[name]).all()):
                raise ValueError(f"constant field {name} differs")
        return records


def fixed_layout(parts: Sequence[Part]) -> CdrLayout:
    """The layout of a message whose fields are `parts`, in order. Texts become constant fields named `_…`."""
    names: list[str] = ["_encapsulation"]
    formats: list[Any] = ["<u4"]
    offsets: list[int] = [0]
    constants: dict[str, object] = {"_encapsulation": int.from_bytes(_ENCAPSULATION, "little")}
    at = 4

    def add(name: str, form: Any, align: int, size: int) -> None:
        nonlocal at
        at += -(at - 4) % align
        names.append(name)
        formats.append(form)
        offsets.append(at)
        at += size

    for name, form, count in parts:
        if isinstance(form, Text):
            raw = form.value.encode() + b"\0"
            add(f"_{name}_length", "<u4", 4, 4)
            add(f"_{name}", f"V{len(raw)}", 1, len(raw))
            constants[f"_{name}_length"] = len(raw)
            constants[f"_{name}"] = np.void(raw)
        else:
            size = np.dtype(form).itemsize
            add(name, (form, (count,)) if count > 1 else form, size, size * count)
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at})
    template = np.zeros(1, dtype)
    for name, value in constants.items():
        template[name] = value
    return CdrLayout(dtype, template)


def rows(records: Records) -> NDArray[np.uint8]:
    """(n, itemsize) bytes of the records; a row is one message."""
    return np.ascontiguousarray(records).view(np.uint8).reshape(len(records), records.dtype.itemsize)


def stamps_ns(records: Records) -> NDArray[np.int64]:
    """(n,) `header.stamp` of records with the fields `sec` and `nanosec`."""
    return records["sec"].astype(np.int64) * 1_000_000_000 + records["nanosec"].astype(np.int64)
