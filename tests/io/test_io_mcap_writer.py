"""Many messages at once must give the bytes of one after the other."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from mineloc.io.mcap_writer import McapWriter


def written(portions: list[tuple[np.ndarray, np.ndarray]], *, at_once: bool, **options: object) -> bytes:
    stream = BytesIO()
    writer = McapWriter(stream, profile="ros2", library="test", **options)
    channels = [writer.add_channel(f"/{k}", "std_msgs/msg/String", "string data", {}) for k in range(2)]
    for k, (stamps, rows) in enumerate(portions):
        channel = channels[k % 2]
        if at_once:
            writer.add_messages(channel, stamps, rows, group="g")
            continue
        for stamp, row in zip(stamps.tolist(), rows, strict=True):
            writer.add_message(channel, stamp, memoryview(row), group="g")
    writer.finish({}, [])
    return stream.getvalue()


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**16),
    counts=st.lists(st.integers(0, 40), min_size=1, max_size=5),
    size=st.integers(1, 200),
    step_ns=st.integers(0, 400),
    chunk_bytes=st.integers(50, 3000),
    compression=st.sampled_from(["none", "lz4"]),
)
def test_messages_at_once_give_the_bytes_of_one_after_the_other(
    seed: int, counts: list[int], size: int, step_ns: int, chunk_bytes: int, compression: str
) -> None:
    rng = np.random.default_rng(seed)
    portions = []
    for count in counts:
        # portions may begin before the last one ended: another topic, or a clock that is late
        start = int(rng.integers(0, 4000))
        stamps = start + np.cumsum(rng.integers(0, step_ns + 1, count))
        portions.append((stamps.astype(np.int64), rng.integers(0, 256, (count, size), dtype=np.uint8)))
    options = {"chunk_bytes": chunk_bytes, "chunk_span_ns": 1000, "compression": compression}
    together = written(portions, at_once=True, **options)
    if compression == "none":
        assert together == written(portions, at_once=False, **options)
    messages = [
        (channel.topic, m.log_time, m.publish_time, m.sequence, m.data)
        for _, channel, m in make_reader(BytesIO(together), validate_crcs=True).iter_messages(log_time_order=False)
    ]
    counted = [0, 0]
    expected = []
    for k, (stamps, rows) in enumerate(portions):
        for stamp, row in zip(stamps.tolist(), rows, strict=True):
            expected.append((f"/{k % 2}", stamp, stamp, counted[k % 2], row.tobytes()))
            counted[k % 2] += 1
    assert messages == expected


def test_negative_times_are_refused() -> None:
    writer = McapWriter(BytesIO(), profile="ros2", library="test")
    channel = writer.add_channel("/a", "std_msgs/msg/String", "string data", {})
    with pytest.raises(ValueError, match="negative"):
        writer.add_messages(channel, np.array([-1]), np.zeros((1, 3), np.uint8))
    writer.abort()
