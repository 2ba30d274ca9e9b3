"""The times of one topic, watched message by message: rates, gaps, disorder, clocks."""

from __future__ import annotations

import math

import numpy as np

from mineloc.data import I64, Bool
from mineloc.io.health import HealthFinding, TopicHealth
from mineloc.io.recording import Topic
from mineloc.io.stream_statistics import IntervalHistogram, Sampler

_NS = 1e-9
# A clock that moves by more against the other one was set, it did not drift.
_CLOCK_JUMP_NS = 500_000_000
_UNSYNCHRONISED_S = 1.0
_PORTION = 64


class TopicMonitor:
    """Watches one topic and says which messages keep its times strictly increasing.

    Args:
        role: what the topic is for the flight.
        topic: as recorded.
    """

    def __init__(self, role: str, topic: Topic) -> None:
        self.role = role
        self.topic = topic
        self.messages = 0
        self.used = 0
        self.backwards = 0
        self.duplicates = 0
        self.clock_jumps = 0
        self.first_jump_ns = 0
        self.deepest_ns = 0
        self.deepest_at_ns = 0
        self.first_ns = 0
        self.last_ns = 0
        self.longest_gap_at_ns = 0
        self._waiting: list[tuple[int, int, int]] = []
        self._high_ns: int | None = None
        self._intervals = IntervalHistogram()
        self._delays = Sampler()
        self._last_delay_ns: int | None = None

    def take_one(self, stamp_ns: int, log_ns: int, header_ns: int) -> bool:
        """Look at one message; whether it is later than all before. Not to be mixed with `take`.

        What else there is to see is looked at now and then, for many messages at once.
        """
        self._waiting.append((stamp_ns, log_ns, header_ns))
        later = self._high_ns is None or stamp_ns > self._high_ns
        if later:
            self._high_ns = stamp_ns
        if len(self._waiting) >= _PORTION:
            self.catch_up()
        return later

    def catch_up(self) -> None:
        """Look at what `take_one` put aside."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            stamps, logs, headers = np.array(waiting, dtype=np.int64).T
            self.take(stamps, logs, headers_ns=headers)

    def take(self, stamps_ns: I64, log_ns: I64, *, headers_ns: I64 | None = None) -> Bool:
        """Look at (n,) messages in the order in which they came; which of them are later than all before.

        Args:
            stamps_ns: the times that the flight will have.
            log_ns: recorder's times.
            headers_ns: header times, where they are not the stamps.
        """
        n = len(stamps_ns)
        if not n:
            return np.zeros(0, np.bool_)
        self.messages += n
        before = np.maximum.accumulate(stamps_ns)
        first = stamps_ns[0] - 1 if not self.used else self.last_ns
        before = np.maximum(np.concatenate([[first], before[:-1]]), first)
        keep = stamps_ns > before
        self.duplicates += int(np.count_nonzero(stamps_ns == before))
        self._note_backwards(stamps_ns, before)
        self._note_delays(log_ns - (stamps_ns if headers_ns is None else headers_ns), stamps_ns)
        self._note_intervals(stamps_ns[keep])
        return keep

    def _note_backwards(self, stamps_ns: I64, before: I64) -> None:
        depth = before - stamps_ns
        self.backwards += int(np.count_nonzero(depth > 0))
        at = int(np.argmax(depth))
        if depth[at] > self.deepest_ns:
            self.deepest_ns, self.deepest_at_ns = int(depth[at]), int(stamps_ns[at])

    def _note_delays(self, delays_ns: I64, stamps_ns: I64) -> None:
        self._delays.add(delays_ns.astype(np.float64) * _NS)
        last = delays_ns[0] if self._last_delay_ns is None else self._last_delay_ns
        jumps = np.abs(np.diff(delays_ns, prepend=last)) > _CLOCK_JUMP_NS
        self._last_delay_ns = int(delays_ns[-1])
        if jumps.any():
            if not self.clock_jumps:
                self.first_jump_ns = int(stamps_ns[np.argmax(jumps)])
            self.clock_jumps += int(np.count_nonzero(jumps))

    def _note_intervals(self, kept_ns: I64) -> None:
        if not len(kept_ns):
            return
        if self.used:
            intervals = np.diff(kept_ns, prepend=self.last_ns)
        else:
            self.first_ns = int(kept_ns[0])
            intervals = np.diff(kept_ns)
        if len(intervals):
            longest = int(np.argmax(intervals))
            if intervals[longest] > self._intervals.longest_ns:
                self.longest_gap_at_ns = int(kept_ns[longest - len(intervals)]) - int(intervals[longest])
        self._intervals.add(intervals)
        self.last_ns = int(kept_ns[-1])
        self.used += len(kept_ns)

    def result(self, *, gap_factor: float) -> TopicHealth:
        """What was seen so far; a pause longer than `gap_factor` median intervals is a gap."""
        self.catch_up()
        period_ns = self._intervals.median_ns
        gaps, gap_ns = self._intervals.longer_than(gap_factor * period_ns) if self.used > 1 else (0, 0.0)
        watched = self.messages > 0
        return TopicHealth(
            role=self.role,
            topic=self.topic.name,
            msgtype=self.topic.msgtype,
            messages=self.messages,
            used=self.used,
            first_ns=self.first_ns,
            last_ns=self.last_ns,
            rate_hz=1e9 / period_ns if self.used > 1 else None,
            gaps=gaps,
            missing=max(round(gap_ns / period_ns) - gaps, 0) if gaps else 0,
            longest_gap_s=self._intervals.longest_ns * _NS,
            backwards=self.backwards,
            duplicates=self.duplicates,
            clock_jumps=self.clock_jumps,
            log_delay_median_s=self._delays.median if watched else None,
            log_delay_min_s=self._delays.smallest if watched else None,
            log_delay_max_s=self._delays.largest if watched else None,
        )

    def findings(self, *, gap_factor: float) -> list[HealthFinding]:
        """What is wrong with the times."""
        health = self.result(gap_factor=gap_factor)
        found: list[HealthFinding] = []
        if health.gaps:
            detail = (
                f"{health.gaps} gaps in {health.topic}, {health.missing} messages missing, "
                f"the longest {health.longest_gap_s:.3g} s after {self._since_start(self.longest_gap_at_ns)}"
            )
            found.append(HealthFinding(f"{self.role}_gaps", "warning", health.gaps, detail))
        if health.duplicates:
            detail = f"{health.duplicates} messages on {health.topic} repeat a time and were left out"
            found.append(HealthFinding(f"{self.role}_duplicates", "warning", health.duplicates, detail))
        if health.backwards:
            detail = (
                f"{health.backwards} messages on {health.topic} go back in time, at most by "
                f"{self.deepest_ns * _NS:.3g} s, and were left out"
            )
            found.append(HealthFinding(f"{self.role}_backwards", "warning", health.backwards, detail))
        if health.clock_jumps:
            detail = (
                f"the delay from header to recorder on {health.topic} jumped by more than {_CLOCK_JUMP_NS * _NS:g} s, "
                f"first at {self._since_start(self.first_jump_ns)}: a clock was set, or messages were held up"
            )
            found.append(HealthFinding(f"{self.role}_clock_jumps", "warning", health.clock_jumps, detail))
        delay = health.log_delay_median_s
        if delay is not None and math.isfinite(delay) and abs(delay) > _UNSYNCHRONISED_S:
            detail = f"the recorder's clock is {delay:+.6g} s from the headers of {health.topic}"
            found.append(HealthFinding(f"{self.role}_clock_offset", "warning", health.messages, detail))
        return found

    def _since_start(self, stamp_ns: int) -> str:
        return f"{(stamp_ns - self.first_ns) * _NS:.3f} s of flight"
