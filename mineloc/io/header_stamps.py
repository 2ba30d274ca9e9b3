"""`header.stamp` of serialised messages without decoding them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mineloc.data import I64
from mineloc.io.recording import RawMessage
from mineloc.io.ros import TF_MESSAGE


def header_stamps_ns(messages: Sequence[RawMessage]) -> I64:
    """(n,) times of messages of one topic that begin with a Header, or with an array of such (TF: the first).

    ROS 1 writes `seq` where CDR has its encapsulation, so the seconds stand at the same place in both. A message that
    is too short to have a header gives 0.
    """
    if not messages:
        return np.zeros(0, np.int64)
    start = 8 if messages[0].msgtype == TF_MESSAGE else 4
    joined = b"".join(bytes(m.data[start : start + 8]).ljust(8, b"\0") for m in messages)
    big_endian = messages[0].encoding == "cdr" and bytes(messages[0].data[:2]) == b"\x00\x00"
    # ROS 2 has signed, ROS 1 unsigned seconds; they part in 2038
    signed = "i4" if messages[0].encoding == "cdr" else "u4"
    order = ">" if big_endian else "<"
    fields = np.frombuffer(joined, np.dtype([("sec", order + signed), ("nanosec", order + "u4")]))
    return fields["sec"].astype(np.int64) * 1_000_000_000 + fields["nanosec"]
