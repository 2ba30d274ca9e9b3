from __future__ import annotations

from pathlib import Path

import driver_clouds as drivers
import numpy as np
import pytest
from driver_clouds import EPOCH_NS, PERIOD_NS, vlp16_sweep

from mineloc.errors import IngestError
from mineloc.io.point_times import TimeRule
from mineloc.io.ros import POINT_CLOUD2, STORE
from mineloc.io.sequence import LidarRules
from mineloc.io.sweep_decoder import LEARNED_FROM, SweepDecoder

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"

TRUTH = [vlp16_sweep(EPOCH_NS + i * PERIOD_NS, seed=i) for i in range(LEARNED_FROM + 2)]


def _decode(messages, rules=None):
    decoder = SweepDecoder(rules or LidarRules(), where="test.bag: /points")
    out = [d for i, m in enumerate(messages) for d in decoder.decode(m, log_ns=i)] + decoder.finish()
    return out, decoder


def _keys(points):
    return np.ascontiguousarray(points).view("S12")[:, 0]


def _names(decoder):
    return {f.name: f.count for f in decoder.findings}


# driver, tolerance of the times in ns, rule found, rings as in truth
TIMED = [
    (drivers.velodyne, 5, TimeRule("field", "s", "relative", "header", "end"), True),
    (lambda s: drivers.velodyne(s, header_at_end=False), 5, TimeRule("field", "s", "relative"), True),
    (drivers.velodyne_organised, 5, TimeRule("field", "s", "relative"), True),
    (drivers.robosense, 240, TimeRule("field", "s", "absolute", "clock"), True),
    (lambda s: drivers.robosense(s, f=True), 240, TimeRule("field", "s", "absolute", "clock"), True),
    (drivers.ouster, 0, TimeRule("field", "ns", "relative"), True),
    (lambda s: drivers.ouster(s, ring_form="u1"), 0, TimeRule("field", "ns", "relative"), True),
    (drivers.livox, 0, TimeRule("field", "ns", "absolute", "clock"), False),
    (drivers.hesai, 240, TimeRule("field", "s", "absolute", "clock"), True),
    (drivers.pcl, 5, TimeRule("field", "s", "relative"), True),
    (drivers.microseconds, 1000, TimeRule("field", "us", "relative"), True),
]


@pytest.mark.parametrize(("driver", "tolerance_ns", "rule", "rings"), TIMED)
def test_every_driver_with_times_gives_the_same_sweeps(driver, tolerance_ns, rule, rings):
    messages = [driver(sweep) for sweep in TRUTH]
    decoded, decoder = _decode(messages)
    assert decoder.time_rule == rule
    assert len(decoded) == len(TRUTH)
    for i, (one, truth, message) in enumerate(zip(decoded, TRUTH, messages, strict=True)):
        sweep = one.sweep
        assert one.log_ns == i
        assert one.message_points == len(truth) == message.width * message.height
        assert one.header_ns == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        # which truths survived: the driver may have blanked some
        kept = np.isin(_keys(truth.points_lidar), _keys(sweep.points_lidar))
        expected = truth.keep(kept)
        first = int(expected.offsets_ns[0])
        assert abs(sweep.stamp_ns - (truth.stamp_ns + first)) <= tolerance_ns
        assert np.abs(sweep.offsets_ns - (expected.offsets_ns - first)).max() <= 2 * tolerance_ns
        assert sweep.offsets_ns.min() == 0
        np.testing.assert_array_equal(sweep.points_lidar, expected.points_lidar)
        np.testing.assert_array_equal(sweep.intensity, expected.intensity)
        assert sweep.period_ns == PERIOD_NS
        if rings:
            np.testing.assert_array_equal(sweep.ring, expected.ring)
        else:
            assert sweep.ring is None
    dropped = sum(len(t) - len(d.sweep) for t, d in zip(TRUTH, decoded, strict=True))
    found = _names(decoder)
    assert found.get("points_not_finite", 0) + found.get("points_at_origin", 0) == dropped
    assert ("header_at_end" in found) == (rule.header == "end")


@pytest.mark.parametrize("driver", [drivers.gazebo, drivers.robosense_plain])
def test_no_times_is_declared_and_rings_are_recovered(driver):
    decoded, decoder = _decode([driver(sweep) for sweep in TRUTH])
    assert decoder.time_rule == TimeRule("none")
    for one, truth in zip(decoded, TRUTH, strict=True):
        assert not one.sweep.has_point_times
        assert one.sweep.stamp_ns == one.sweep.end_ns == truth.stamp_ns
        np.testing.assert_array_equal(one.sweep.ring, truth.ring)
    assert ("point_times_equal" in _names(decoder)) == (driver is drivers.gazebo)
    assert ("rings_recovered" in _names(decoder)) == (driver is drivers.robosense_plain)


def test_times_from_the_angle_only_when_asked():
    messages = [drivers.robosense_plain(sweep) for sweep in TRUTH]
    decoded, decoder = _decode(messages, LidarRules(times="azimuth"))
    for one, truth in zip(decoded, TRUTH, strict=True):
        # the angle knows the column, not the laser in it
        assert np.abs(one.sweep.offsets_ns - truth.offsets_ns).max() < PERIOD_NS / 200
    assert _names(decoder)["azimuth_times"] == len(TRUTH)
    ring_major, decoder = _decode([drivers.velodyne_organised(s) for s in TRUTH], LidarRules(times="azimuth"))
    assert not any(d.sweep.has_point_times for d in ring_major)
    assert _names(decoder)["azimuth_times_refused"] == len(TRUTH)


def test_partial_first_sweep_has_no_say():
    messages = [drivers.velodyne(TRUTH[0].keep(np.arange(6000, 6400)))] + [drivers.velodyne(s) for s in TRUTH[1:]]
    decoded, decoder = _decode(messages)
    assert decoder.time_rule == TimeRule("field", "s", "relative", "header", "end")
    assert len(decoded[0].sweep) == 400
    assert abs(decoded[0].sweep.stamp_ns - TRUTH[0].stamp_ns - int(TRUTH[0].offsets_ns[6000])) <= 5


def test_a_partial_sweep_later_is_no_contradiction():
    messages = [drivers.velodyne(s) for s in TRUTH] + [drivers.velodyne(TRUTH[-1].keep(np.arange(3)))]
    decoded, decoder = _decode(messages)
    assert decoded[-1].sweep.has_point_times
    assert "time_contradiction" not in _names(decoder)


def test_a_sweep_in_another_unit_is_a_finding_not_another_rule():
    other = TRUTH[-1]
    messages = [drivers.ouster(s) for s in TRUTH[:-1]] + [drivers.pcl(other)]
    decoded, decoder = _decode(messages)
    assert decoder.time_rule == TimeRule("field", "ns", "relative")
    assert _names(decoder)["time_contradiction"] == 1
    assert not decoded[-1].sweep.has_point_times
    assert decoded[-1].sweep.stamp_ns == other.stamp_ns
    # and the other way round: nanoseconds read as seconds
    decoded, decoder = _decode([drivers.pcl(s) for s in TRUTH[:-1]] + [drivers.ouster(other)])
    assert _names(decoder)["time_contradiction"] == 1
    assert not decoded[-1].sweep.has_point_times


def test_times_that_appear_or_vanish_later_are_findings():
    _, decoder = _decode([drivers.gazebo(s) for s in TRUTH[:-1]] + [drivers.pcl(TRUTH[-1])])
    assert _names(decoder)["time_contradiction"] == 1
    decoded, decoder = _decode([drivers.pcl(s) for s in TRUTH[:-1]] + [drivers.gazebo(TRUTH[-1])])
    assert _names(decoder)["time_contradiction"] == 1
    assert not decoded[-1].sweep.has_point_times


def test_unsynchronised_clock():
    uptime_ns = 1_234 * 10**9
    messages = []
    for truth in TRUTH:
        late = vlp16_sweep(truth.stamp_ns - EPOCH_NS + uptime_ns)
        message = drivers.robosense(late)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(truth.stamp_ns, 10**9)
        messages.append(message)
    with pytest.raises(IngestError, match=r"neither near header\.stamp"):
        _decode(messages)
    decoded, decoder = _decode(messages, LidarRules(time_kind="absolute"))
    assert abs(decoded[0].sweep.stamp_ns - uptime_ns) < 1000
    assert _names(decoder)["clock_offset"] == len(TRUTH)
    decoded, decoder = _decode(messages, LidarRules(time_kind="absolute", clock="header"))
    assert [d.sweep.stamp_ns for d in decoded] == [t.stamp_ns for t in TRUTH]
    assert "clock_offset" not in _names(decoder)
    decoded, _ = _decode(messages, LidarRules(time_kind="absolute", clock="header", header="end"))
    assert [d.sweep.end_ns for d in decoded] == [t.stamp_ns for t in TRUTH]


def test_the_sequence_file_may_say_that_positive_times_belong_to_a_header_at_the_end():
    decoded, _ = _decode([drivers.pcl(s) for s in TRUTH], LidarRules(header="end"))
    assert [d.sweep.end_ns for d in decoded] == [t.stamp_ns for t in TRUTH]


def test_sweeps_without_returns_are_counted_and_left_out():
    nothing = drivers.velodyne(TRUTH[0])
    nan = drivers.cloud(EPOCH_NS, {"x": np.full(9, np.nan), "y": np.zeros(9), "z": np.zeros(9)}, drivers.XYZ, 12)
    empty = drivers.cloud(EPOCH_NS, {"x": np.zeros(0), "y": np.zeros(0), "z": np.zeros(0)}, drivers.XYZ, 12)
    zeros = drivers.cloud(EPOCH_NS, {"x": np.zeros(7), "y": np.zeros(7), "z": np.zeros(7)}, drivers.XYZ, 12)
    decoded, decoder = _decode([nan, empty, zeros, nothing])
    assert len(decoded) == 1
    assert decoded[0].log_ns == 3
    assert _names(decoder) | {"points_not_finite": 9, "points_at_origin": 7, "empty_sweeps": 3} == _names(decoder)
    decoded, decoder = _decode([empty])
    assert decoded == []
    assert decoder.time_rule is None


def test_points_without_a_finite_time_go_with_their_rings():
    truth = TRUTH[0]
    seconds = truth.offsets_ns * 1e-9
    seconds[5::9] = np.nan
    columns = drivers.xyz(truth) | {"ring": truth.ring, "time": seconds}
    message = drivers.cloud(truth.stamp_ns, columns, [*drivers.XYZ, ("ring", 12, "u2"), ("time", 16, "f8")], 24)
    decoded, decoder = _decode([message])
    kept = truth.keep(np.isfinite(seconds))
    np.testing.assert_array_equal(decoded[0].sweep.points_lidar, kept.points_lidar)
    np.testing.assert_array_equal(decoded[0].sweep.ring, kept.ring)
    assert _names(decoder)["points_without_time"] == np.isnan(seconds).sum()


@pytest.mark.parametrize(
    ("header_step_ns", "rate_hz", "expected_ns"),
    [(PERIOD_NS, None, PERIOD_NS), (3 * PERIOD_NS, None, PERIOD_NS), (PERIOD_NS, 20.0, 50_000_000)],
)
def test_the_period_is_told_or_measured_even_when_messages_are_missing(header_step_ns, rate_hz, expected_ns):
    sweeps = [vlp16_sweep(EPOCH_NS + i * header_step_ns) for i in range(4)]
    decoded, _ = _decode([drivers.pcl(s) for s in sweeps], LidarRules(rate_hz=rate_hz))
    assert {d.sweep.period_ns for d in decoded} == {expected_ns}


def test_the_period_of_sweeps_without_times_comes_from_the_headers():
    sweeps = [vlp16_sweep(EPOCH_NS + i * 200_300_000) for i in range(4)]
    decoded, _ = _decode([drivers.gazebo(s) for s in sweeps])
    assert {d.sweep.period_ns for d in decoded} == {200_000_000}


def test_missing_fields_that_the_sequence_file_asks_for():
    messages = [drivers.robosense_plain(s) for s in TRUTH]
    with pytest.raises(IngestError, match="no time field"):
        _decode(messages, LidarRules(times="field"))
    with pytest.raises(IngestError, match="no ring field"):
        _decode(messages, LidarRules(rings="field"))
    with pytest.raises(IngestError, match="no field offset_us"):
        _decode(messages, LidarRules(time_field="offset_us"))
    decoded, _ = _decode([drivers.velodyne(s) for s in TRUTH], LidarRules(times="none", rings="none"))
    assert decoded[0].sweep.offsets_ns is None
    assert decoded[0].sweep.ring is None


@pytest.mark.data
def test_real_robosense_like_message():
    path = DATA / "recordings" / "cloudini_pointcloud2_cdr.bin"
    if not path.exists():
        pytest.skip("../shared/data is absent")
    message = STORE.deserialize_cdr(path.read_bytes(), POINT_CLOUD2)
    (decoded,), decoder = _decode([message])
    sweep = decoded.sweep
    assert decoder.time_rule == TimeRule("field", "s", "absolute", "clock")
    assert decoded.message_points == 64_000
    # 4578 points at (0, 0, 0); 32 beams counted from the top; a 20 Hz revolution in 49.8 ms
    assert len(sweep) == 64_000 - 4_578
    assert sweep.stamp_ns == decoded.header_ns == 1_714_506_077_250_967_979
    assert 49_000_000 < sweep.end_ns - sweep.stamp_ns < 50_000_000
    assert sweep.period_ns == 50_000_000
    elevation = np.arctan2(sweep.points_lidar[:, 2], np.hypot(*sweep.points_lidar[:, :2].T))
    medians = [float(np.median(elevation[sweep.ring == ring])) for ring in range(32)]
    assert (np.diff(medians) > 0).all()
    assert (np.diff(sweep.offsets_ns) >= 0).all()
    raw = np.frombuffer(message.data, np.uint8).reshape(-1, 26)
    np.testing.assert_array_equal(
        np.sort(raw[:, :4].copy().view("<f4")[:, 0])[-5:], np.sort(sweep.points_lidar[:, 0])[-5:]
    )


@pytest.mark.data
def test_real_rings_and_times_are_recovered_without_their_fields():
    path = DATA / "recordings" / "cloudini_pointcloud2_cdr.bin"
    if not path.exists():
        pytest.skip("../shared/data is absent")
    message = STORE.deserialize_cdr(path.read_bytes(), POINT_CLOUD2)
    (truth,), _ = _decode([message])
    message.fields = message.fields[:4]
    (found,), decoder = _decode([message], LidarRules(times="azimuth", rate_hz=20.0))
    assert _names(decoder)["rings_recovered"] == 1
    # two orders of time: compare point by point
    a, b = (d.sweep.keep(np.argsort(_keys(d.sweep.points_lidar), kind="stable")) for d in (truth, found))
    np.testing.assert_array_equal(a.points_lidar, b.points_lidar)
    far = np.linalg.norm(a.points_lidar, axis=1) > 2.0
    assert np.mean(a.ring[far] == b.ring[far]) > 0.999
    error_ns = np.abs(a.offsets_ns - b.offsets_ns)
    assert np.quantile(error_ns, 0.99) < 0.01 * 50_000_000
