"""Work that runs beside the caller: reading ahead and writing behind, in order, with bounded memory.

Compression, checksums and file access release the interpreter lock, so one extra core is really used.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from queue import Empty, Full, Queue
from typing import Generic, TypeVar, cast

T = TypeVar("T")

_POLL_S = 0.05


def prefetched(items: Generator[T], *, depth: int) -> Generator[T]:
    """The same items in the same order, produced up to `depth` ahead by a background thread.

    An exception of the producer is raised at its place in the order. Closing the generator early stops the thread.
    """
    ahead: Queue[tuple[bool, object]] = Queue(depth)
    stop = threading.Event()

    def put(entry: tuple[bool, object]) -> None:
        while not stop.is_set():
            try:
                ahead.put(entry, timeout=_POLL_S)
            except Full:
                continue
            return

    def produce() -> None:
        try:
            with closing(items):
                for item in items:
                    put((False, item))
                    if stop.is_set():
                        return
            put((True, None))
        except BaseException as error:  # noqa: BLE001 - handed to the consumer, which raises it
            put((True, error))

    thread = threading.Thread(target=produce, name="mineloc-prefetch", daemon=True)
    thread.start()
    try:
        while True:
            last, entry = ahead.get()
            if not last:
                yield cast("T", entry)
            elif isinstance(entry, BaseException):
                raise entry
            else:
                return
    finally:
        stop.set()
        _drain(ahead)
        thread.join()


def _drain(ahead: Queue[tuple[bool, object]]) -> None:
    with suppress(Empty):
        while True:
            ahead.get_nowait()


class OrderedPipeline(Generic[T]):
    """Prepares items on `workers` threads and hands the results to `consume` on one thread, in the order of submission.

    At most `depth` items wait; `submit` blocks when there are more. The first exception of either side is raised by
    the next `submit` or by `close`, and nothing is consumed after it.
    """

    def __init__(self, consume: Callable[[T], None], *, workers: int, depth: int) -> None:
        self._consume = consume
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="mineloc-prepare")
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="mineloc-write")
        self._written: deque[Future[None]] = deque()
        self._depth = depth
        self._failed = threading.Event()

    def submit(self, prepare: Callable[[], T]) -> None:
        """Queue one item; blocks while `depth` are under way. Raises what an earlier item raised."""
        while len(self._written) >= self._depth:
            self._written.popleft().result()
        prepared = self._pool.submit(prepare)
        self._written.append(self._writer.submit(self._consume_one, prepared))

    def _consume_one(self, prepared: Future[T]) -> None:
        try:
            item = prepared.result()
            if not self._failed.is_set():
                self._consume(item)
        except BaseException:
            self._failed.set()
            raise

    def close(self) -> None:
        """Wait for everything; raises what an item raised."""
        try:
            while self._written:
                self._written.popleft().result()
        finally:
            self.abort()

    def abort(self) -> None:
        """Drop what is queued and stop the threads; raises nothing."""
        self._failed.set()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._writer.shutdown(wait=True, cancel_futures=True)
