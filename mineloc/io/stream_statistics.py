"""Medians and counts of long streams in constant memory."""

from __future__ import annotations

import numpy as np

from mineloc.data import F64, I64

_GROWTH = 1.02
_SHORTEST_NS = 1_000.0
_BINS = 1200


class IntervalHistogram:
    """Times between messages in bins that grow by 2 %, from 1 µs to some six hours.

    The mean of a bin is exact, so the median of a steady rate is, too.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self._sums_ns = np.zeros(_BINS)
        self.longest_ns = 0

    def add(self, intervals_ns: I64) -> None:
        """Count (n,) positive intervals."""
        if not len(intervals_ns):
            return
        place = np.log(np.maximum(intervals_ns, _SHORTEST_NS) / _SHORTEST_NS) / np.log(_GROWTH)
        at = np.minimum(place.astype(np.int64), _BINS - 1)
        np.add.at(self._counts, at, 1)
        np.add.at(self._sums_ns, at, intervals_ns)
        self.longest_ns = max(self.longest_ns, int(intervals_ns.max()))

    @property
    def median_ns(self) -> float:
        """NaN without intervals."""
        total = int(self._counts.sum())
        if not total:
            return float("nan")
        at = int(np.searchsorted(np.cumsum(self._counts), (total + 1) // 2))
        return float(self._sums_ns[at] / self._counts[at])

    def longer_than(self, limit_ns: float) -> tuple[int, float]:
        """How many intervals are longer, and their sum in nanoseconds; bins count as their mean."""
        filled = self._counts > 0
        means = np.divide(self._sums_ns, self._counts, out=np.zeros(_BINS), where=filled)
        longer = filled & (means > limit_ns)
        return int(self._counts[longer].sum()), float(self._sums_ns[longer].sum())


class Sampler:
    """An evenly thinned sample of a stream: every k-th value, k doubling whenever the sample is full."""

    def __init__(self, size: int = 8192) -> None:
        self._kept = np.zeros(size)
        self._filled = 0
        self._stride = 1
        self._seen = 0
        self.smallest = float("inf")
        self.largest = float("-inf")

    def add(self, values: F64) -> None:
        """Take (n,) values, finite."""
        if not len(values):
            return
        self.smallest = min(self.smallest, float(values.min()))
        self.largest = max(self.largest, float(values.max()))
        picked = values[-self._seen % self._stride :: self._stride]
        self._seen += len(values)
        while len(picked):
            room = len(self._kept) - self._filled
            self._kept[self._filled : self._filled + len(picked[:room])] = picked[:room]
            self._filled += len(picked[:room])
            picked = picked[room:]
            if self._filled == len(self._kept):
                self._halve()
                picked = picked[::2]

    def add_one(self, value: float) -> None:
        """Take one value, finite."""
        self.smallest = min(self.smallest, value)
        self.largest = max(self.largest, value)
        if self._seen % self._stride == 0:
            self._keep(value)
        self._seen += 1

    def _keep(self, value: float) -> None:
        self._kept[self._filled] = value
        self._filled += 1
        if self._filled == len(self._kept):
            self._halve()

    def _halve(self) -> None:
        self._kept[: self._filled // 2] = self._kept[::2].copy()
        self._filled //= 2
        self._stride *= 2

    def quantile(self, share: float) -> float:
        """NaN without values."""
        return float(np.quantile(self._kept[: self._filled], share)) if self._filled else float("nan")

    @property
    def median(self) -> float:
        """NaN without values."""
        return self.quantile(0.5)
