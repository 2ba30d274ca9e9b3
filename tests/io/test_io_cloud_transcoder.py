"""The short way from a driver's cloud to a canonical one must give the bytes of the long way, or decline."""

from __future__ import annotations

from dataclasses import replace

import driver_clouds as drivers
import numpy as np
import pytest
from driver_clouds import EPOCH_NS, PERIOD_NS, vlp16_sweep
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.io import canonical
from mineloc.io.cloud_transcoder import CanonicalView, CloudTranscoder, learn
from mineloc.io.ros import POINT_CLOUD2, STORE
from mineloc.io.sequence import LidarRules
from mineloc.io.sweep_decoder import LEARNED_FROM, SweepDecoder

SWEEPS = [vlp16_sweep(EPOCH_NS + i * PERIOD_NS, columns=64, seed=i) for i in range(LEARNED_FROM + 3)]


def _at_start(sweep):
    return drivers.velodyne(sweep, header_at_end=False)


def _swapped(sweep):
    """A driver whose fields stand elsewhere than ours."""
    columns = drivers.xyz(sweep) | {"ring": sweep.ring, "t": sweep.offsets_ns, "intensity": sweep.intensity}
    fields = [("ring", 0, "u1"), ("t", 4, "u4"), ("x", 8, "f4"), ("y", 12, "f4"), ("z", 16, "f4")]
    return drivers.cloud(sweep.stamp_ns, columns, [*fields, ("intensity", 24, "f4")], 32)


SHORT = [drivers.velodyne, _at_start, drivers.robosense, drivers.hesai, drivers.pcl, _swapped]
LONG = [drivers.robosense_plain, drivers.velodyne_organised, drivers.ouster, drivers.microseconds, drivers.gazebo]


def _learned(driver, rules=None) -> tuple[SweepDecoder, CloudTranscoder | None]:
    rules = rules or LidarRules()
    decoder = SweepDecoder(rules, where="test")
    for sweep in SWEEPS[:LEARNED_FROM]:
        decoder.decode(driver(sweep), log_ns=0)
    return decoder, learn(decoder, rules, driver(SWEEPS[0]))


@pytest.mark.parametrize("driver", SHORT, ids=lambda d: d.__name__)
def test_short_way_gives_the_bytes_of_the_long_way(driver) -> None:
    decoder, transcoder = _learned(driver)
    assert transcoder is not None
    for sweep in SWEEPS[LEARNED_FROM:]:
        message = driver(sweep)
        cloud = transcoder.transcode(message)
        (decoded,) = decoder.decode(message, log_ns=0)
        assert cloud is not None
        assert bytes(cloud.data) == bytes(canonical.encode_sweep(decoded.sweep))
        assert (cloud.stamp_ns, cloud.end_ns) == (decoded.sweep.stamp_ns, decoded.sweep.end_ns)
        assert cloud.header_ns == decoded.header_ns
        np.testing.assert_array_equal(cloud.points, decoded.sweep.points_lidar)


@pytest.mark.parametrize("driver", LONG, ids=lambda d: d.__name__)
def test_clouds_that_need_decisions_go_the_long_way(driver) -> None:
    _, transcoder = _learned(driver)
    assert transcoder is None or transcoder.transcode(driver(SWEEPS[-1])) is None


@pytest.mark.parametrize("rules", [LidarRules(times="none"), LidarRules(rings="none")], ids=["no times", "no rings"])
def test_what_the_sequence_file_drops_is_dropped(rules) -> None:
    decoder, transcoder = _learned(_at_start, rules)
    message = _at_start(SWEEPS[-1])
    (decoded,) = decoder.decode(message, log_ns=0)
    assert transcoder is not None
    cloud = transcoder.transcode(message)
    assert cloud is not None
    assert bytes(cloud.data) == bytes(canonical.encode_sweep(decoded.sweep))


def _with(message, column: str, index: int, value: float):
    field = next(f for f in message.fields if f.name == column)
    data = message.data.copy()
    at = index * message.point_step + field.offset
    data[at : at + 4] = np.array([value], "<f4").view(np.uint8)
    return replace(message, data=data)


@pytest.mark.parametrize(
    ("column", "value"), [("x", np.nan), ("z", np.inf), ("time", np.nan), ("time", 0.05), ("time", -0.3)]
)
def test_a_cloud_unlike_the_others_is_declined(column: str, value: float) -> None:
    _, transcoder = _learned(_at_start)
    assert transcoder is not None
    message = _at_start(SWEEPS[-1])
    assert transcoder.transcode(message) is not None
    assert transcoder.transcode(_with(message, column, 3, value)) is None


def test_points_at_the_origin_are_declined_and_a_zero_coordinate_is_not() -> None:
    _, transcoder = _learned(_at_start)
    assert transcoder is not None
    on_axis = _with(_with(_at_start(SWEEPS[-1]), "x", 5, 0.0), "y", 5, 0.0)
    assert transcoder.transcode(on_axis) is not None
    assert transcoder.transcode(_with(on_axis, "z", 5, 0.0)) is None


def test_another_layout_sizes_that_lie_and_empty_clouds_are_declined() -> None:
    _, transcoder = _learned(_at_start)
    assert transcoder is not None
    message = _at_start(SWEEPS[-1])
    assert transcoder.transcode(_swapped(SWEEPS[-1])) is None
    assert transcoder.transcode(replace(message, width=message.width + 1)) is None
    assert transcoder.transcode(replace(message, width=0, data=message.data[:0])) is None
    assert transcoder.transcode(replace(message, is_bigendian=True)) is None


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**16), late_ns=st.integers(-(10**8), 10**8), unit=st.sampled_from(["s", "ms", "us", "ns"]))
def test_any_times_give_the_same_bytes(seed: int, late_ns: int, unit: str) -> None:
    form = "u4" if unit == "ns" else "f4"
    per = {"s": 1e-9, "ms": 1e-6, "us": 1e-3, "ns": 1}[unit]

    def driver(sweep):
        columns = drivers.xyz(sweep) | {"t": np.sort(np.asarray(sweep.offsets_ns * per))}
        return drivers.cloud(sweep.stamp_ns, columns, [*drivers.XYZ, ("t", 12, form)], 16)

    decoder, transcoder = _learned(driver, LidarRules(rings="none"))
    message = driver(vlp16_sweep(EPOCH_NS + 10 * PERIOD_NS + late_ns, columns=40, seed=seed))
    assert transcoder is not None
    cloud = transcoder.transcode(message)
    (decoded,) = decoder.decode(message, log_ns=0)
    assert cloud is not None
    assert bytes(cloud.data) == bytes(canonical.encode_sweep(decoded.sweep))


@pytest.mark.parametrize("drop", [(), ("ring",), ("offsets_ns",), ("ring", "intensity", "offsets_ns")], ids=str)
def test_canonical_clouds_are_recognised(drop) -> None:
    sweep = replace(SWEEPS[0], **dict.fromkeys(drop))
    data = canonical.encode_sweep(sweep)
    cloud = CanonicalView()(data, STORE.deserialize_cdr(data, POINT_CLOUD2))
    assert cloud is not None
    assert (cloud.stamp_ns, cloud.end_ns) == (sweep.stamp_ns, sweep.end_ns)
    assert bytes(cloud.data) == bytes(data)
    np.testing.assert_array_equal(cloud.points, sweep.points_lidar)


def test_clouds_that_are_not_canonical_are_not_taken_for_it() -> None:
    data = canonical.encode_sweep(SWEEPS[0])
    message = STORE.deserialize_cdr(data, POINT_CLOUD2)
    assert CanonicalView()(data, _at_start(SWEEPS[0])) is None
    assert CanonicalView()(data, _with(message, "y", 2, np.nan)) is None
    assert CanonicalView()(data, replace(message, is_dense=False)) is None
    assert CanonicalView()(data, replace(message, width=3)) is None
    assert CanonicalView()(data, replace(message, header=replace(message.header, frame_id="velodyne"))) is None
