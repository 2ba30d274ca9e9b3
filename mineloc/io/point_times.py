"""What the point times of a topic mean: unit, absolute or relative, header at the start or the end (METHOD 9.5).

Decided once, on the lowest and highest values of the first sweeps, and then held: a later sweep that does not fit is
a finding, never another rule. Extends rko_lio's rule.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mineloc.errors import IngestError
from mineloc.io.sequence import LidarRules

I64 = NDArray[np.int64]
Column = NDArray[Any]
Unit = Literal["s", "ms", "us", "ns"]

UNIT_NS: dict[Unit, int] = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
_UNITS: tuple[tuple[Unit, int], ...] = tuple(UNIT_NS.items())
_MS = 1_000_000
# A revolution takes 0.02 to 0.25 s; half of the shortest still tells the unit, which are a thousand apart.
_SHORTEST_NS, _LONGEST_NS = 10 * _MS, 250 * _MS
# So few points may well have been measured at once.
_FEW_POINTS = 128
# A float32 clock coarser than this cannot order the points of a sweep.
_COARSEST_NS = 100_000
# Stamps since 1970 in seconds: the header may then be off by more, since drivers stamp on the host.
_EPOCH_S = 1e8


@dataclass(frozen=True, slots=True)
class TimeEvidence:
    """The times of one sweep: what the decision rests on.

    Attributes:
        lowest, highest: values as stored, integers exact.
        header_ns: `header.stamp`.
        is_float32: stored with 24 bits.
        count: number of points with a time.
    """

    lowest: float | int
    highest: float | int
    header_ns: int
    is_float32: bool
    count: int


@dataclass(frozen=True, slots=True)
class TimeRule:
    """How a topic's values become times.

    Attributes:
        source: "none": the sweep is an instant; "field": the points carry times.
        unit: of the values.
        kind: "absolute" since the epoch of the LiDAR's clock, "relative" to something in the sweep.
        anchor: what ties the values to time: "clock" (absolute values as they are), "header" (values count from
            `header.stamp`), "first" or "last" (`header.stamp` is the time of that point).
        header: which end of the sweep `header.stamp` stands at.
    """

    source: Literal["none", "field"]
    unit: Unit = "s"
    kind: Literal["absolute", "relative"] = "relative"
    anchor: Literal["clock", "header", "first", "last"] = "header"
    header: Literal["start", "end"] = "start"

    def describe(self) -> str:
        """One line for people."""
        if self.source == "none":
            return "no point times"
        return f"{self.kind} point times in {self.unit}, header at the {self.header} of the sweep"


def gather(time: Column, header_ns: int) -> TimeEvidence | None:
    """The evidence of one sweep; None when no value is finite."""
    values = time if time.dtype.kind != "f" else time[np.isfinite(time)]
    if not len(values):
        return None
    return TimeEvidence(
        values.min().item(),
        values.max().item(),
        header_ns,
        time.dtype.itemsize == 4 and time.dtype.kind == "f",
        len(values),
    )


def decide(evidence: Sequence[TimeEvidence], rules: LidarRules, *, where: str) -> TimeRule:
    """The rule that most of the sweeps fit; partial sweeps, which fit none, have no say unless all are such.

    Args:
        evidence: of the first sweeps, at least one.
        rules: the sequence file's; what it sets is not inferred.
        where: recording and topic, for errors.

    Raises:
        IngestError: no unit fits, the times lie neither near the header nor near zero, or float32 cannot hold them.
    """
    votes: Counter[TimeRule] = Counter()
    refusals: list[str] = []
    for one in evidence:
        answer = _decide_one(one, rules, where)
        if isinstance(answer, TimeRule):
            votes[answer] += 1
        else:
            refusals.append(answer)
    timed = Counter({rule: n for rule, n in votes.items() if rule.source == "field"})
    if timed:
        return timed.most_common(1)[0][0]
    if refusals:
        raise IngestError(
            where,
            refusals[len(refusals) // 2],
            expected="a sweep of 0.02 to 0.25 s in s, ms, us or ns, beginning or ending at header.stamp",
            todo="set time_unit, time_kind and header in the [lidar] section of a sequence file",
        )
    return TimeRule("none")


def _decide_one(e: TimeEvidence, rules: LidarRules, where: str) -> TimeRule | str:
    """The rule that one sweep fits, or why none."""
    _refuse_coarse(e, where)
    if e.lowest == e.highest:
        return TimeRule("none")
    unit = _unit(float(e.highest) - float(e.lowest), rules)
    if unit is None:
        told = "" if rules.time_unit == "auto" else f" in {rules.time_unit}"
        return f"point times from {e.lowest!r} to {e.highest!r}{told} are not one sweep"
    low, high = to_ns(e.lowest, unit), to_ns(e.highest, unit)
    kind = rules.time_kind if rules.time_kind != "auto" else _kind(low, high, e, unit)
    if kind is None:
        return (
            f"point times from {e.lowest!r} to {e.highest!r} ({unit}) are neither near header.stamp "
            f"{e.header_ns / 1e9:.6f} s nor near zero"
        )
    if kind == "absolute":
        _refuse_coarse(e, where, unit=unit)
        at_end = abs(high - e.header_ns) < min(abs(low - e.header_ns), 500 * _MS)
    else:
        at_end = low < -_MS
    header = rules.header if rules.header != "auto" else ("end" if at_end else "start")
    return TimeRule("field", unit, kind, _anchor(kind, header, low, high, rules), header)


def _anchor(
    kind: str, header: str, low: int, high: int, rules: LidarRules
) -> Literal["clock", "header", "first", "last"]:
    """Where the sequence file says which point the header is the time of, values that count from another are moved."""
    if kind == "absolute" and rules.clock == "lidar":
        return "clock"
    if kind == "relative":
        counts_from = low if header == "start" else high
        if rules.header == "auto" or abs(counts_from) < 10 * _MS:
            return "header"
    return "first" if header == "start" else "last"


def _unit(span: float, rules: LidarRules) -> Unit | None:
    """The only unit in which the span is a sweep's; one that is told has more room, but not for a mistake."""
    told = rules.time_unit
    if told != "auto":
        return told if _MS <= span * UNIT_NS[told] <= 2000 * _MS else None
    # a thousand lies between neighbours, so two never fit
    return next((unit for unit, ns in _UNITS if _SHORTEST_NS <= span * ns <= _LONGEST_NS), None)


def _kind(low: int, high: int, e: TimeEvidence, unit: Unit) -> Literal["absolute", "relative"] | None:
    since_1970 = float(e.highest) * UNIT_NS[unit] > _EPOCH_S * 1e9
    near_start, near_end = (500 * _MS, 500 * _MS) if since_1970 else (_MS, 10 * _MS)
    if abs(low - e.header_ns) < near_start or abs(high - e.header_ns) < near_end:
        return "absolute"
    if abs(low) < _MS or abs(high) < 10 * _MS:
        return "relative"
    return None


def _refuse_coarse(e: TimeEvidence, where: str, *, unit: Unit | None = None) -> None:
    """Refuse absolute times in float32: seconds since 1970 have steps of 128 s there."""
    if not e.is_float32:
        return
    step = float(np.spacing(np.float32(max(abs(e.lowest), abs(e.highest)))))
    since_1970 = unit is None and e.header_ns > _EPOCH_S * 1e9 and abs(e.highest - e.header_ns / 1e9) < 4 * step
    coarse = unit is not None and step * UNIT_NS[unit] > _COARSEST_NS
    if since_1970 or coarse:
        raise IngestError(
            where,
            f"absolute point times in float32 ({e.highest!r}) with steps of {step:g}",
            expected="float64, or times relative to the header",
            todo='record with a driver that does so, or set times = "none" in a sequence file',
        )


def to_ns(value: float | int, unit: Unit) -> int:
    """A single value in integer nanoseconds, without losing digits of a large float."""
    factor = UNIT_NS[unit]
    if isinstance(value, int):
        return value * factor
    whole = int(value)
    return whole * factor + round((value - whole) * factor)


def times_ns(time: Column, header_ns: int, rule: TimeRule) -> tuple[int, I64]:
    """Time of the first point, and nanoseconds of each point after it.

    Args:
        time: (n,) values as stored, finite, n ≥ 1.
        header_ns: `header.stamp`.
        rule: with source "field".
    """
    factor = UNIT_NS[rule.unit]
    lowest = time.min().item()
    # The difference first: it is exact where the values themselves leave no room for nanoseconds.
    if time.dtype.kind == "f":
        since = time.astype(np.float64, copy=False) - lowest
        offsets = np.rint(since * factor if factor != 1 else since).astype(np.int64)
    else:
        offsets = (time.astype(np.int64) - lowest) * factor
    if rule.anchor == "first":
        return header_ns, offsets
    if rule.anchor == "last":
        return header_ns - int(offsets.max()), offsets
    low = to_ns(lowest, rule.unit)
    return (low if rule.anchor == "clock" else header_ns + low), offsets


def contradiction(stamp_ns: int, offsets_ns: I64, header_ns: int, rule: TimeRule, period_ns: int) -> str:
    """Why a sweep does not fit the rule that is held, empty if it does: too long, or far from where the rule began."""
    span_ns = int(offsets_ns.max())
    if span_ns == 0 and len(offsets_ns) > _FEW_POINTS:
        return "all times equal"
    if span_ns > max(3 * period_ns, _LONGEST_NS):
        return f"a sweep of {span_ns / 1e9:g} s"
    start_ns = header_ns if rule.header == "start" else header_ns - period_ns
    if rule.anchor == "header" and abs(stamp_ns - start_ns) > 2 * period_ns:
        return f"relative times from {(stamp_ns - header_ns) / 1e9:g} s"
    return ""
