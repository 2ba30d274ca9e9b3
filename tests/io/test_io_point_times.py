from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mineloc.errors import IngestError
from mineloc.io.point_times import TimeEvidence, TimeRule, contradiction, decide, gather, times_ns, to_ns
from mineloc.io.sequence import LidarRules

H = 1_760_000_000_123_456_789
UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
AUTO = LidarRules()


def _evidence(values, header_ns=H, dtype=np.float64):
    found = gather(np.asarray(values, dtype), header_ns)
    assert found is not None
    return found


def _decide(values, header_ns=H, dtype=np.float64, rules=AUTO):
    return decide([_evidence(values, header_ns, dtype)], rules, where="x.bag: /points")


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 20.0])
@pytest.mark.parametrize(("start", "header"), [(0.0, "start"), (-1.0, "end")])
def test_relative_times_in_every_unit_and_rate(unit, rate_hz, start, header):
    period = 1e9 / rate_hz / UNITS[unit]
    values = start * period + np.linspace(0, 0.999 * period, 100)
    assert _decide(values) == TimeRule("field", unit, "relative", "header", header)
    assert _decide(values, dtype=np.float32) == TimeRule("field", unit, "relative", "header", header)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize(("first_s", "header"), [(0.0, "start"), (-0.0995, "end"), (0.3, "start"), (-0.35, "end")])
def test_absolute_times_in_every_unit(unit, first_s, header):
    values = (H + (first_s + np.linspace(0, 0.0995, 500)) * 1e9) / UNITS[unit]
    assert _decide(values) == TimeRule("field", unit, "absolute", "clock", header)


def test_absolute_times_near_a_header_since_start():
    values = 1234.5 + np.linspace(0, 0.1, 100)
    assert _decide(values, header_ns=1_234_500_300_000).kind == "absolute"
    assert _decide(values, header_ns=1_234_605_000_000).header == "end"
    # half a second is forgiven to stamps since 1970 only
    with pytest.raises(IngestError, match="nor near zero"):
        _decide(values, header_ns=1_234_700_000_000)


@pytest.mark.parametrize("value", [0.0, 0.05, 1.76e9])
def test_equal_times_are_no_times(value):
    assert _decide(np.full(10, value)) == TimeRule("none")


def test_float32_seconds_since_1970_are_refused_with_their_step():
    for span in (0.0, 0.1, 128.0):
        with pytest.raises(IngestError, match=r"float32 \(17600001?\d+\.0\) with steps of 128"):
            _decide(np.array([H / 1e9, H / 1e9 + span], np.float32), dtype=np.float32)
    # seconds since the start of the sensor still have their digits
    assert _decide([500.0, 500.1], header_ns=500 * 10**9, dtype=np.float32).kind == "absolute"
    with pytest.raises(IngestError, match="float32"):
        _decide([50_000.0, 50_000.1], header_ns=50_000 * 10**9, dtype=np.float32)
    # and nanoseconds after the header need no more
    assert _decide([0, 1e8], dtype=np.float32).unit == "ns"


@pytest.mark.parametrize("span", [0.9, 3e-3, 300.0, 3e-6 * 1e9, 5e9])
def test_spans_of_no_unit_are_refused_with_the_values(span):
    with pytest.raises(IngestError, match=rf"{span!r}".replace("+", r"\+")) as info:
        _decide([0.0, span])
    assert "time_unit" in info.value.todo


def test_times_from_the_middle_are_refused_unless_told():
    values = np.linspace(-0.05, 0.05, 100)
    with pytest.raises(IngestError, match="nor near zero"):
        _decide(values)
    rule = _decide(values, rules=LidarRules(time_kind="relative", header="start"))
    stamp, offsets = times_ns(values, H, rule)
    assert (rule.anchor, stamp, offsets.max()) == ("first", H, 100_000_000)


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_a_told_unit_that_cannot_be_is_refused(unit):
    with pytest.raises(IngestError, match=f"in {unit} are not one sweep"):
        _decide([0.0, 0.1], rules=LidarRules(time_unit=unit))


def test_a_told_unit_decides_where_no_unit_fits():
    assert _decide([0.0, 0.9], rules=LidarRules(time_unit="s")).unit == "s"


def test_most_sweeps_win_and_partial_ones_have_no_say():
    full, partial, instant = ([-0.1, 0.0], [-0.1, -0.095], [0.0, 0.0])
    evidence = [_evidence(v) for v in (partial, instant, full, full)]
    assert decide(evidence, AUTO, where="x") == TimeRule("field", "s", "relative", "header", "end")
    assert decide([_evidence(instant)], AUTO, where="x") == TimeRule("none")
    with pytest.raises(IngestError, match=r"-0\.1 to -0\.095"):
        decide([_evidence(partial), _evidence(instant)], AUTO, where="x")


def test_no_finite_time_is_no_evidence():
    assert gather(np.array([np.nan, np.inf]), H) is None
    assert gather(np.array([np.nan, 0.5, 0.25]), H) == TimeEvidence(0.25, 0.5, H, is_float32=False, count=2)


@given(st.integers(0, 2**62), st.sampled_from(sorted(UNITS)))
def test_integers_convert_exactly(value, unit):
    assert to_ns(value, unit) == value * UNITS[unit]


@given(st.integers(-(10**15), 2 * 10**18), st.sampled_from(sorted(UNITS)))
def test_floats_convert_to_their_last_digit(ns, unit):
    value = ns / UNITS[unit]
    assert abs(to_ns(value, unit) - ns) <= np.spacing(abs(value)) * UNITS[unit] + 0.5


@given(
    st.lists(st.integers(0, 100_000_000), min_size=1, max_size=50),
    st.integers(0, 2**31 * 10**9 - 1),
    st.sampled_from(["u4", "f8"]),
    st.sampled_from(["header", "first", "last"]),
)
def test_relative_nanoseconds_come_back_exactly(offsets, header_ns, form, anchor):
    rule = TimeRule("field", "ns", "relative", anchor)
    stamp, found = times_ns(np.array(offsets, form), header_ns, rule)
    expected = np.array(offsets) - min(offsets)
    np.testing.assert_array_equal(found, expected)
    tied = {"header": header_ns + min(offsets), "first": header_ns, "last": header_ns - expected.max()}
    assert stamp == tied[anchor]


@given(st.lists(st.integers(0, 100_000_000), min_size=1, max_size=50), st.integers(0, 2 * 10**18))
def test_absolute_f64_seconds_keep_a_quarter_of_a_microsecond(offsets, start_ns):
    true_ns = [start_ns + o for o in offsets]
    stamp, found = times_ns(np.array([t / 10**9 for t in true_ns]), H, TimeRule("field", "s", "absolute", "clock"))
    assert np.abs(stamp + found - np.array(true_ns)).max() <= 480
    assert found.min() == 0


def test_contradictions():
    rule = TimeRule("field", "ns", "relative")
    many = np.linspace(0, 1e8, 200).astype(np.int64)
    assert contradiction(H, many, H, rule, 10**8) == ""
    assert contradiction(H, np.zeros(3, np.int64), H, rule, 10**8) == ""
    assert contradiction(H, np.zeros(200, np.int64), H, rule, 10**8) == "all times equal"
    assert contradiction(H, many * 10, H, rule, 10**8) == "a sweep of 1 s"
    assert contradiction(H + 10**9, many, H, rule, 10**8) == "relative times from 1 s"
    end = TimeRule("field", "ns", "relative", "header", "end")
    assert contradiction(H - 10**8, many, H, end, 10**8) == ""
