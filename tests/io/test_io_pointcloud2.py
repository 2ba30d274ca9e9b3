from __future__ import annotations

import driver_clouds as drivers
import numpy as np
import pytest
from driver_clouds import XYZ, cloud, vlp16_sweep
from hypothesis import given
from hypothesis import strategies as st

from mineloc.errors import IngestError
from mineloc.io.pointcloud2 import INTENSITY_NAMES, RING_NAMES, TIME_NAMES, read_cloud, returns
from mineloc.io.ros import POINT_CLOUD2, STORE

WHERE = "x.bag: /points"
SWEEP = vlp16_sweep(columns=20)


def _columns(n, seed=0):
    rng = np.random.default_rng(seed)
    return {axis: rng.normal(size=n).astype(np.float32) for axis in "xyz"}


@pytest.mark.parametrize(
    ("names", "attribute"), [(INTENSITY_NAMES, "intensity"), (RING_NAMES, "ring"), (TIME_NAMES, "time")]
)
def test_every_alias_is_read(names, attribute):
    for name in (*names, names[0].upper()):
        columns = _columns(5) | {name: np.arange(5)}
        found = read_cloud(cloud(7, columns, [*XYZ, (name, 12, "u2")], 14), where=WHERE)
        np.testing.assert_array_equal(getattr(found, attribute), np.arange(5))
        others = {"intensity", "ring", "time"} - {attribute}
        assert all(getattr(found, other) is None for other in others)


def test_the_first_alias_wins():
    columns = _columns(5) | {"reflectivity": np.full(5, 1), "intensity": np.full(5, 2)}
    fields = [*XYZ, ("reflectivity", 12, "u2"), ("intensity", 14, "u2")]
    assert read_cloud(cloud(7, columns, fields, 16), where=WHERE).intensity.tolist() == [2] * 5


def test_named_fields_come_before_aliases():
    columns = _columns(5) | {"t": np.full(5, 1), "dt_us": np.arange(5), "ring": np.zeros(5), "Beam": np.arange(5)}
    fields = [*XYZ, ("t", 12, "u4"), ("dt_us", 16, "u4"), ("ring", 20, "u1"), ("Beam", 21, "u1")]
    found = read_cloud(cloud(7, columns, fields, 22), where=WHERE, time_field="dt_us", ring_field="Beam")
    assert found.time.tolist() == found.ring.tolist() == [0, 1, 2, 3, 4]
    assert found.time_name == "dt_us"


FORMS = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]


@st.composite
def _layouts(draw):
    """Any order of fields, any types, gaps between them, rows with padding, both byte orders."""
    names = draw(st.permutations(["x", "y", "z", "intensity", "ring", "time", "junk"]))
    at, fields = draw(st.integers(0, 3)), []
    for name in names:
        form = draw(st.sampled_from(["f4", "f8"] if name in "xyz" else FORMS))
        fields.append((name, at, form))
        at += np.dtype(form).itemsize + draw(st.integers(0, 5))
    shape = (draw(st.integers(1, 4)), draw(st.integers(0, 6)))
    return fields, at, shape, draw(st.integers(0, 9)) if shape[0] > 1 else 0, draw(st.booleans())


@given(_layouts(), st.integers(0, 2**32 - 1))
def test_any_layout_round_trips(layout, seed):
    fields, step, shape, padding, big_endian = layout
    n = shape[0] * shape[1]
    rng = np.random.default_rng(seed)
    columns = {name: rng.integers(0, 100, n).astype(form) for name, _, form in fields}
    message = cloud(12_000_000_345, columns, fields, step, shape=shape, row_padding=padding, big_endian=big_endian)
    found = read_cloud(message, where=WHERE)
    assert found.header_ns == 12_000_000_345
    assert found.shape == shape
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(found.points[:, i], columns[axis])
    assert found.points.dtype == found.intensity.dtype == np.float32
    np.testing.assert_array_equal(found.intensity, columns["intensity"].astype(np.float32))
    np.testing.assert_array_equal(found.ring, columns["ring"])
    np.testing.assert_array_equal(found.time, columns["time"])
    assert np.shares_memory(found.points, message.data) is False


def test_fields_of_several_values_give_their_first():
    columns = _columns(4) | {"intensity": np.arange(4)}
    found = read_cloud(cloud(7, columns, [*XYZ, ("intensity", 12, "f4")], 28, counts={"intensity": 3}), where=WHERE)
    assert found.intensity.tolist() == [0, 1, 2, 3]


def test_the_message_may_have_crossed_the_wire():
    message = drivers.velodyne(SWEEP)
    again = STORE.deserialize_cdr(STORE.serialize_cdr(message, POINT_CLOUD2), POINT_CLOUD2)
    np.testing.assert_array_equal(read_cloud(again, where=WHERE).points, SWEEP.points_lidar)


def _changed(message, **changes):
    for name, value in changes.items():
        setattr(message, name, value)
    return message


@pytest.mark.parametrize(
    ("message", "match"),
    [
        (
            cloud(7, {"x": np.zeros(3), "y": np.zeros(3)}, XYZ[:2], 12),
            r"no field z; expected x y z; the cloud has: x y",
        ),
        (cloud(7, {}, [], 12), "no field x y z"),
        (_changed(drivers.pcl(SWEEP), data=np.zeros(100, np.uint8)), "in 100 bytes"),
        (_changed(drivers.pcl(SWEEP), width=10**6), "1 x 1000000 points"),
        (_changed(drivers.pcl(SWEEP), point_step=11), "field z at byte 8 does not fit a point of 11 bytes"),
        (_changed(drivers.robosense(SWEEP), row_step=5), "with row_step 5"),
        (_changed(drivers.pcl(SWEEP), width=2**31, height=2**31), "expected at most 10000000 points"),
    ],
)
def test_clouds_that_cannot_be_are_refused(message, match):
    with pytest.raises(IngestError, match=match):
        read_cloud(message, where=WHERE)


def test_unknown_datatypes_are_refused_only_where_they_matter():
    message = drivers.pcl(SWEEP)
    message.fields[3].datatype = 77
    with pytest.raises(IngestError, match="field intensity has datatype 77"):
        read_cloud(message, where=WHERE)
    message.fields[3].name = "junk"
    assert read_cloud(message, where=WHERE).intensity is None


@pytest.mark.parametrize("row_step", [0, 12_345_678])
def test_row_step_of_a_single_row_is_not_believed(row_step):
    message = _changed(drivers.pcl(SWEEP), row_step=row_step)
    np.testing.assert_array_equal(read_cloud(message, where=WHERE).points, SWEEP.points_lidar)


def test_returns_counts_each_fault_once():
    columns = _columns(8) | {"time": np.zeros(8)}
    columns["x"][0] = np.nan
    columns["z"][1] = -np.inf
    for axis in "xyz":
        columns[axis][2:4] = 0
    columns["x"][4] = 0
    columns["time"][[0, 2, 5]] = np.nan
    found = read_cloud(cloud(7, columns, [*XYZ, ("time", 12, "f4")], 16), where=WHERE)
    mask, not_finite, at_origin, without_time = returns(found)
    assert mask.tolist() == [False, False, False, False, True, False, True, True]
    assert (not_finite, at_origin, without_time) == (2, 2, 1)
    kept = found.keep(mask)
    assert len(kept) == len(kept.time) == 3
    assert returns(kept) == (None, 0, 0, 0)
