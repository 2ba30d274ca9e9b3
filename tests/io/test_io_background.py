from __future__ import annotations

import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.io.background import OrderedPipeline, prefetched


def _threads():
    return {t.name for t in threading.enumerate() if t.name.startswith("mineloc")}


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(), max_size=20), st.integers(1, 5))
def test_prefetched_gives_the_same_items(items, depth):
    assert list(prefetched((i for i in items), depth=depth)) == items


def test_prefetched_raises_at_its_place():
    def source():
        yield 1
        yield 2
        raise KeyError("gone")

    ahead = prefetched(source(), depth=5)
    assert [next(ahead), next(ahead)] == [1, 2]
    with pytest.raises(KeyError, match="gone"):
        next(ahead)
    assert not _threads()


def test_prefetched_stays_within_its_depth_and_stops_when_closed():
    made, closed = [], []

    def source():
        try:
            for i in range(1000):
                made.append(i)
                yield i
        finally:
            closed.append(True)

    ahead = prefetched(source(), depth=3)
    assert next(ahead) == 0
    time.sleep(0.1)
    assert len(made) <= 1 + 3 + 1
    ahead.close()
    assert closed == [True]
    assert not _threads()


def test_the_pipeline_keeps_the_order():
    out: list[int] = []
    pipeline = OrderedPipeline[int](out.append, workers=3, depth=4)

    def prepare(i):
        time.sleep(0.002 * (i % 3))
        return i

    for i in range(30):
        pipeline.submit(lambda i=i: prepare(i))
    pipeline.close()
    assert out == list(range(30))
    assert not _threads()


@pytest.mark.parametrize("where", ["prepare", "consume"])
def test_the_pipeline_raises_once_and_consumes_nothing_after(where):
    out: list[int] = []

    def fail(i):
        raise OSError(28, "disk full")

    def consume(i):
        if where == "consume" and i == 3:
            fail(i)
        out.append(i)

    pipeline = OrderedPipeline[int](consume, workers=2, depth=4)

    def submit_all():
        for i in range(100):
            pipeline.submit(lambda i=i: fail(i) if where == "prepare" and i == 3 else i)

    with pytest.raises(OSError, match="disk full"):
        submit_all()
    pipeline.abort()
    assert out == [0, 1, 2]
    assert not _threads()


def test_an_aborted_pipeline_drops_what_waits():
    release, out = threading.Event(), []
    pipeline = OrderedPipeline[int](out.append, workers=1, depth=10)

    def wait():
        release.wait(5)
        return 0

    for _ in range(5):
        pipeline.submit(wait)
    timer = threading.Timer(0.05, release.set)
    timer.start()
    pipeline.abort()
    timer.join()
    assert out == []
    assert not _threads()
