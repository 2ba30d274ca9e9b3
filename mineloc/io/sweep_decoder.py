"""From the PointCloud2 messages of one topic to sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mineloc.data import Sweep
from mineloc.errors import IngestError
from mineloc.io import point_times, rings
from mineloc.io.findings import Finding, FindingCounter
from mineloc.io.point_times import TimeRule
from mineloc.io.pointcloud2 import RawCloud, read_cloud, returns
from mineloc.io.rings import RingRule
from mineloc.io.sequence import LidarRules

I64 = NDArray[np.int64]
U16 = NDArray[np.uint16]

# The rules are decided on so many messages that have returns.
LEARNED_FROM = 5
_USUAL_RATES_HZ = (5.0, 10.0, 15.0, 20.0, 25.0)


@dataclass(frozen=True, slots=True, eq=False)
class DecodedSweep:
    """A sweep with what its message said.

    Attributes:
        sweep: points that are returns, in firing order.
        header_ns: `header.stamp`.
        log_ns: the recording's time of the message, as handed in.
        message_points: number of points in the message, before any was dropped.
    """

    sweep: Sweep
    header_ns: int
    log_ns: int
    message_points: int


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """The returns of one message; `cells` are their indices in it, None when none was dropped."""

    cloud: RawCloud
    cells: I64 | None
    log_ns: int
    message_points: int


@dataclass(frozen=True, slots=True, eq=False)
class _Rules:
    times: TimeRule
    rings: RingRule
    period_ns: int


class SweepDecoder:
    """Turns the clouds of one topic into sweeps, by rules that are decided on the first messages and then held.

    The first few messages are held back until the rules are decided, so `decode` may return nothing and later several
    sweeps at once; call `finish` after the last message. Messages without a single return give no sweep.

    Args:
        rules: the sequence file's `[lidar]` section.
        where: recording and topic, for errors and findings.
    """

    def __init__(self, rules: LidarRules, *, where: str) -> None:
        self._told = rules
        self._where = where
        self._found = FindingCounter()
        self._held: list[_Held] = []
        self._rules: _Rules | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was dropped, recovered, assumed or contradicted so far."""
        return self._found.findings

    @property
    def time_rule(self) -> TimeRule | None:
        """What the point times mean; None before it is decided."""
        return None if self._rules is None else self._rules.times

    @property
    def ring_rule(self) -> RingRule | None:
        """How the points get their ring; None before it is decided."""
        return None if self._rules is None else self._rules.rings

    @property
    def period_ns(self) -> int | None:
        """Nominal duration of a revolution; None before it is decided."""
        return None if self._rules is None else self._rules.period_ns

    def decode(self, message: object, *, log_ns: int) -> list[DecodedSweep]:
        """Take one decoded rosbags PointCloud2.

        Raises:
            IngestError: a cloud that cannot be read, or whose times fit no rule.
        """
        held = self._read(message, log_ns)
        if held is None:
            return []
        if self._rules is not None:
            return [self._sweep(held, self._rules)]
        self._held.append(held)
        return self.finish() if len(self._held) >= LEARNED_FROM else []

    def finish(self) -> list[DecodedSweep]:
        """The sweeps still held back; raises as `decode` does."""
        if not self._held:
            return []
        self._rules = self._decide(self._held)
        held, self._held = self._held, []
        return [self._sweep(one, self._rules) for one in held]

    def _read(self, message: object, log_ns: int) -> _Held | None:
        told = self._told
        cloud = read_cloud(message, where=self._where, time_field=told.time_field, ring_field=told.ring_field)
        mask, not_finite, at_origin, without_time = returns(cloud)
        self._found.add("points_not_finite", "points with NaN or infinite coordinates were dropped", count=not_finite)
        self._found.add("points_at_origin", "points at (0, 0, 0), no return, were dropped", count=at_origin)
        self._found.add("points_without_time", "points without a finite time were dropped", count=without_time)
        kept = cloud if mask is None else cloud.keep(mask)
        if not len(kept):
            self._found.add("empty_sweeps", f"message at {cloud.header_ns} ns has no return and gives no sweep")
            return None
        return _Held(kept, None if mask is None else np.flatnonzero(mask), log_ns, len(cloud))

    def _decide(self, held: Sequence[_Held]) -> _Rules:
        times = self._decide_times(held)
        rules = _Rules(times, self._decide_rings(held), self._period_ns(held, times))
        self._found.add("point_times", times.describe())
        if times.source == "field" and times.header == "end":
            self._found.add("header_at_end", "header.stamp is the time of the sweep's end")
        if rules.rings.detail:
            self._found.add(_ring_finding(rules.rings), rules.rings.detail)
        return rules

    def _decide_times(self, held: Sequence[_Held]) -> TimeRule:
        if self._told.times in ("none", "azimuth"):
            return TimeRule("none", header="end" if self._told.header == "end" else "start")
        gathered = [point_times.gather(h.cloud.time, h.cloud.header_ns) for h in held if h.cloud.time is not None]
        evidence = [one for one in gathered if one is not None]
        if not evidence:
            if self._told.times == "field":
                raise IngestError(
                    self._where, "no time field", expected="a field with point times", todo="name it in time_field"
                )
            return TimeRule("none")
        rule = point_times.decide(evidence, self._told, where=self._where)
        if rule.source == "none":
            self._found.add("point_times_equal", f"the point times do not differ ({evidence[0].lowest!r}): ignored")
        return rule

    def _decide_rings(self, held: Sequence[_Held]) -> RingRule:
        told = self._told
        if told.rings == "none":
            return RingRule("none")
        clouds = [h.cloud for h in held]
        points = [cloud.points for cloud in clouds]
        fields = [cloud.ring for cloud in clouds if cloud.ring is not None]
        if told.rings != "elevation" and len(fields) == len(clouds):
            numbers = np.concatenate(fields).astype(np.int64)
            return rings.rule_for_numbers(numbers, np.concatenate(points), source="field", count=told.ring_count)
        if told.rings == "field":
            raise IngestError(
                self._where, "no ring field", expected="a field with ring numbers", todo="name it in ring_field"
            )
        cells = [np.arange(len(h.cloud)) if h.cells is None else h.cells for h in held]
        return rings.rule_for_missing(points, [cloud.shape for cloud in clouds], cells, count=told.ring_count)

    def _period_ns(self, held: Sequence[_Held], times: TimeRule) -> int:
        """The nominal duration of a revolution: told, or from the headers, or from the point times."""
        if self._told.rate_hz is not None:
            return round(1e9 / self._told.rate_hz)
        steps = np.diff([h.cloud.header_ns for h in held])
        measured = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        if times.source == "field":
            spans = [
                int(point_times.times_ns(h.cloud.time, 0, times)[1].max()) for h in held if h.cloud.time is not None
            ]
            longest = float(max(spans, default=0))
            # headers give a multiple of the period where messages are missing
            if longest and not 0 < measured < 1.6 * longest:
                measured = longest
        if not measured:
            return round(1e9 / 10.0)
        usual = min(_USUAL_RATES_HZ, key=lambda hz: abs(measured * hz / 1e9 - 1))
        return round(1e9 / usual) if abs(measured * usual / 1e9 - 1) < 0.05 else round(measured)

    def _sweep(self, held: _Held, rules: _Rules) -> DecodedSweep:
        cloud = held.cloud
        ring = rings.apply_rule(rules.rings, cloud.points, cloud.ring, held.cells, cloud.shape)
        stamp_ns, offsets = self._times(cloud, rules)
        sweep = Sweep(stamp_ns, cloud.points, offsets, ring, cloud.intensity, rules.period_ns)
        if offsets is not None and not bool((offsets[1:] >= offsets[:-1]).all()):
            sweep = sweep.keep(np.argsort(offsets, kind="stable"))
        return DecodedSweep(sweep, cloud.header_ns, held.log_ns, held.message_points)

    def _times(self, cloud: RawCloud, rules: _Rules) -> tuple[int, I64 | None]:
        """Stamp and offsets; the offsets of a sweep that contradicts the rule are not used."""
        rule, period_ns = rules.times, rules.period_ns
        start_ns = cloud.header_ns - (period_ns if rule.header == "end" else 0)
        if rule.source == "none":
            if self._told.times == "azimuth":
                return start_ns, self._azimuth_times(cloud, period_ns)
            if self._told.times == "auto" and cloud.time is not None and cloud.time.min() != cloud.time.max():
                self._found.add(
                    "time_contradiction", f"sweep at {cloud.header_ns} ns has differing point times: ignored"
                )
            return start_ns, None
        if cloud.time is None:
            self._found.add("time_contradiction", f"sweep at {cloud.header_ns} ns has no time field")
            return start_ns, None
        stamp_ns, offsets = point_times.times_ns(cloud.time, cloud.header_ns, rule)
        why = point_times.contradiction(stamp_ns, offsets, cloud.header_ns, rule, period_ns)
        if why:
            self._found.add("time_contradiction", f"sweep at {cloud.header_ns} ns: {why}; used without point times")
            return start_ns, None
        ahead_ns = stamp_ns - start_ns
        if abs(ahead_ns) > period_ns:
            self._found.add("clock_offset", f"the LiDAR's clock is {ahead_ns / 1e9:+.3f} s from header.stamp")
        return stamp_ns, offsets

    def _azimuth_times(self, cloud: RawCloud, period_ns: int) -> I64 | None:
        fraction = rings.azimuth_fraction(cloud.points)
        if fraction is None:
            self._found.add("azimuth_times_refused", "points are not in firing order: no times from the angle")
            return None
        self._found.add("azimuth_times", "point times were made from the angle")
        return np.asarray(np.rint(fraction * period_ns), dtype=np.int64)


def _ring_finding(rule: RingRule) -> str:
    if rule.source == "none":
        return "no_rings"
    return "rings_recovered" if rule.source == "elevation" else "rings_renamed"
