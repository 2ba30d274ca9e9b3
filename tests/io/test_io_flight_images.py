from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from driver_clouds import EPOCH_NS, PERIOD_NS, vlp16_sweep
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from mineloc import se3
from mineloc.data import Calibration, CameraModel, DepthImage, FlightInfo, GreyImage, ImuSamples
from mineloc.errors import FlightError, IngestError
from mineloc.io import camera_images, flight_layout
from mineloc.io.flight import FlightReader, FlightWriter
from mineloc.io.ros import CAMERA_INFO, IMAGE, STORE

CAMERA = CameraModel(24, 16, 20.0, 21.0, 11.5, 7.5)
OPTICAL = se3.from_rt(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), [0.1, 0.02, -0.03])
CALIBRATION = Calibration(se3.exp(np.arange(6) * 0.1), se3.exp(np.arange(6) * -0.2), OPTICAL)
STEP_NS = 200_000_000
SWEEPS = [vlp16_sweep(EPOCH_NS + i * PERIOD_NS, columns=40, seed=i) for i in range(12)]


def _depth(stamp_ns: int, *, seed: int = 0, camera: CameraModel = CAMERA) -> DepthImage:
    mm = np.random.default_rng(seed).integers(0, 65536, (camera.height_px, camera.width_px))
    return DepthImage(stamp_ns, (mm / 1000).astype(np.float32), camera)


def _grey(stamp_ns: int, *, seed: int = 0, camera: CameraModel = CAMERA) -> GreyImage:
    tilt = np.random.default_rng(seed).uniform(-4, 4, 2)
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    return GreyImage(stamp_ns, np.clip(128 + tilt[0] * u + tilt[1] * v, 0, 255).astype(np.uint8), camera)


DEPTHS = [_depth(EPOCH_NS + 7 + i * STEP_NS, seed=i) for i in range(6)]
GREYS = [_grey(EPOCH_NS + 50_000_000 + i * STEP_NS, seed=i) for i in range(6)]


def _write(path: Path, *, depths=DEPTHS, greys=GREYS, sweeps=SWEEPS, calibration=CALIBRATION) -> Path:
    """In order of time, as a simulation hands them on."""
    with FlightWriter(path, FlightInfo(flight="f"), calibration) as writer:
        for item in sorted([*depths, *greys, *sweeps], key=lambda item: item.stamp_ns):
            if isinstance(item, DepthImage):
                writer.add_depth(item)
            elif isinstance(item, GreyImage):
                writer.add_grey(item)
            else:
                writer.add_sweep(item)
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    return _write(tmp_path_factory.mktemp("images") / "f.mcap")


def test_images_are_read_as_they_were_written(flight):
    with FlightReader(flight) as reader:
        assert (reader.depth_count, reader.grey_count, reader.sweep_count) == (6, 6, 12)
        np.testing.assert_array_equal(reader.calibration.T_body_camera, OPTICAL)
        assert reader.first_ns == EPOCH_NS
        for found, made in zip(reader.depth_images(), DEPTHS, strict=True):
            assert (found.stamp_ns, found.camera) == (made.stamp_ns, CAMERA)
            np.testing.assert_array_equal(found.depth_m, made.depth_m)
        for found, made in zip(reader.grey_images(), GREYS, strict=True):
            assert (found.stamp_ns, found.camera) == (made.stamp_ns, CAMERA)
            # slopes go through JPEG of quality 95 with hardly a step of grey
            assert np.abs(found.pixels.astype(int) - made.pixels).max() <= 3
        for found, made in zip(reader.sweeps(), SWEEPS, strict=True):
            np.testing.assert_array_equal(found.points_lidar, made.points_lidar)


def test_a_part_of_the_images_is_read(flight):
    with FlightReader(flight) as reader:
        first, last = DEPTHS[2].stamp_ns, DEPTHS[4].stamp_ns
        assert [i.stamp_ns for i in reader.depth_images(first, last)] == [i.stamp_ns for i in DEPTHS[2:4]]
        assert [i.stamp_ns for i in reader.depth_images(end_ns=first + 1)] == [i.stamp_ns for i in DEPTHS[:3]]
        assert [i.stamp_ns for i in reader.grey_images(start_ns=last)] == [i.stamp_ns for i in GREYS[4:]]
        assert list(reader.grey_images(reader.last_ns + 1)) == []


def test_other_programs_read_them(flight):
    with AnyReader([flight], default_typestore=STORE) as bag:
        read = {c.topic: [] for c in bag.connections}
        for connection, log_ns, data in bag.messages():
            read[connection.topic].append((log_ns, bag.deserialize(data, connection.msgtype)))
    log_ns, image = read["/camera/depth/image"][0]
    assert log_ns == DEPTHS[0].stamp_ns
    assert (image.encoding, image.header.frame_id, image.step) == ("16UC1", "camera", 48)
    mm = np.frombuffer(image.data, "<u2").reshape(image.height, image.width)
    np.testing.assert_array_equal(mm, np.rint(DEPTHS[0].depth_m * 1000.0).astype(int))
    (info_ns, info), *more = read["/camera/depth/camera_info"]
    assert not more
    assert info_ns == DEPTHS[0].stamp_ns
    np.testing.assert_array_equal(info.k, [20, 0, 11.5, 0, 21, 7.5, 0, 0, 1])
    picture = read["/camera/grey/image"][0][1]
    assert picture.format == "jpeg"
    assert bytes(picture.data[:2]) == b"\xff\xd8"
    placed = {t.child_frame_id: t for t in read["/tf_static"][0][1].transforms}
    assert placed["camera"].transform.translation.x == pytest.approx(0.1)
    assert placed.keys() == {"lidar", "imu", "camera"}


def test_rerun_shows_depth_through_the_camera(flight):
    """As `rerun flight.mcap` does it: a depth image in the image plane of a pinhole that `/tf_static` places."""
    chunk = pytest.importorskip("rerun.chunk")
    found = {}
    for part in chunk.McapReader(str(flight), include_topic_regex=["/camera/depth/.*"]).stream():
        columns = part.to_record_batch().to_pydict()
        found.setdefault(str(part.entity_path), {}).update(columns)
    shown, pinhole = found["/camera/depth/image"], found["/camera/depth/camera_info"]
    # no DepthImage:meter: whole numbers count as millimetres
    assert "DepthImage:meter" not in shown
    mm = np.frombuffer(bytes(shown["DepthImage:buffer"][-1][0]), "<u2").reshape(CAMERA.height_px, CAMERA.width_px)
    np.testing.assert_array_equal(mm, np.rint(DEPTHS[-1].depth_m * 1000.0).astype(int))
    assert pinhole["Pinhole:parent_frame"] == [["camera"]]
    assert pinhole["Pinhole:child_frame"][0] == shown["CoordinateFrame:frame"][-1]
    np.testing.assert_allclose(np.reshape(pinhole["Pinhole:image_from_camera"], (3, 3)).T[0], [20, 0, 11.5])


def test_chunks_hold_one_kind_in_order_of_time(flight):
    with flight.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = {c.id: c.topic for c in summary.channels.values()}
    kinds = [{topics[c] for c in chunk.message_index_offsets} for chunk in summary.chunk_indexes]
    alone = ({"/camera/depth/image"}, {"/camera/grey/image"}, {"/lidar/points"})
    apart = {topic for kind in alone for topic in kind}
    assert all(kind in alone or not kind & apart for kind in kinds)
    for kind in alone:
        starts = [c.message_start_time for c, found in zip(summary.chunk_indexes, kinds, strict=True) if found == kind]
        assert starts
        assert starts == sorted(starts)


def test_the_same_calls_give_the_same_bytes(flight, tmp_path):
    assert _write(tmp_path / "g.mcap").read_bytes() == flight.read_bytes()


def test_images_may_come_without_sweeps_or_late(tmp_path):
    """More than may wait, before any sweep; and some after the sweeps of their time."""
    many = [_depth(EPOCH_NS + i * 10_000_000, seed=i) for i in range(40)]
    with FlightWriter(tmp_path / "f.mcap", FlightInfo(), CALIBRATION) as writer:
        for image in many[:30]:
            writer.add_depth(image)
        for sweep in SWEEPS[:8]:
            writer.add_sweep(sweep)
        writer.add_imu(ImuSamples(np.array([EPOCH_NS]), np.zeros((1, 3)), np.zeros((1, 3))))
        for image in many[30:]:
            writer.add_depth(image)
    with FlightReader(tmp_path / "f.mcap") as reader:
        for found, made in zip(reader.depth_images(), many, strict=True):
            np.testing.assert_array_equal(found.depth_m, made.depth_m)
        assert len(list(reader.steps())) == 8


def test_memory_does_not_grow_with_the_images(tmp_path):
    """36 MB of images that no sweep follows: 16 wait, a few lie in chunks that are being packed, 4 are read ahead."""
    camera = CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5)
    one = _depth(EPOCH_NS, camera=camera)
    image_bytes = 2 * one.depth_m.size

    def peak() -> int:
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        return most

    tracemalloc.start()
    try:
        with FlightWriter(tmp_path / "f.mcap", FlightInfo(), CALIBRATION, chunk_bytes=1 << 16) as writer:
            for i in range(240):
                writer.add_depth(replace(one, stamp_ns=EPOCH_NS + i * STEP_NS))
        written = peak()
        with FlightReader(tmp_path / "f.mcap") as reader:
            assert sum(1 for _ in reader.depth_images()) == 240
        read = peak()
    finally:
        tracemalloc.stop()
    assert 16 * image_bytes < written < 40 * image_bytes
    # decoded they are twice as large
    assert 4 * 2 * image_bytes < read < 40 * image_bytes


def test_a_camera_may_change(tmp_path):
    other = CameraModel(12, 8, 9.0, 9.5, 5.5, 3.5)
    depths = [*DEPTHS[:3], *(_depth(d.stamp_ns, camera=other) for d in DEPTHS[3:])]
    with FlightReader(_write(tmp_path / "f.mcap", depths=depths)) as reader:
        assert reader.depth_count == 6
        assert [i.camera for i in reader.depth_images()] == [CAMERA] * 3 + [other] * 3


@pytest.mark.parametrize(("late_ns", "what"), [(0, "repeats"), (-1, "goes backwards")])
def test_time_must_go_on(tmp_path, late_ns, what):
    depths = [DEPTHS[0], replace(DEPTHS[1], stamp_ns=DEPTHS[0].stamp_ns + late_ns)]
    with FlightWriter(tmp_path / "f.mcap", FlightInfo(), CALIBRATION) as writer:
        writer.add_depth(depths[0])
        with pytest.raises(FlightError, match=f"time {what} on /camera/depth/image"):
            writer.add_depth(depths[1])


def test_images_need_a_placed_camera(tmp_path):
    with (
        FlightWriter(tmp_path / "f.mcap", FlightInfo(), Calibration()) as writer,
        pytest.raises(ValueError, match="T_body_camera"),
    ):
        writer.add_grey(GREYS[0])


def test_a_flight_without_a_camera_has_no_images(tmp_path):
    path = _write(tmp_path / "f.mcap", depths=[], greys=[], calibration=Calibration())
    assert b"camera" not in path.read_bytes()
    with FlightReader(path) as reader:
        assert (reader.depth_count, reader.grey_count, reader.calibration.T_body_camera) == (0, 0, None)
        assert list(reader.depth_images()) == list(reader.grey_images()) == []


def test_damage_is_told(flight, tmp_path):
    with flight.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    depth = {c.id for c in summary.channels.values() if c.topic == flight_layout.DEPTH}
    chunk = next(c for c in summary.chunk_indexes if depth & c.message_index_offsets.keys())
    raw = bytearray(flight.read_bytes())
    raw[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    (tmp_path / "f.mcap").write_bytes(raw)
    with FlightReader(tmp_path / "f.mcap") as reader:
        assert len(list(reader.grey_images())) == 6
        with pytest.raises(IngestError, match="damaged"):
            list(reader.depth_images())


@given(st.data())
@settings(max_examples=30, deadline=None)
def test_depth_is_kept_to_half_a_millimetre(data):
    camera = CameraModel(data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9)), 5.0, 5.0, 2.0, 2.0)
    n = camera.width_px * camera.height_px
    one = st.floats(-1.0, 80.0, width=32) | st.sampled_from([np.nan, np.inf])
    values = data.draw(st.lists(one, min_size=n, max_size=n))
    depth_m = np.array(values, np.float32).reshape(camera.height_px, camera.width_px)
    image = DepthImage(data.draw(st.integers(0, 2**31 * 10**9 - 1)), depth_m, camera)
    message = camera_images.encode_depth(image)
    found = camera_images.decode_depth(message.data, camera)
    assert found.stamp_ns == image.stamp_ns
    known = (depth_m > 0.001) & (depth_m < 65.5)
    # and what float32 holds of 65 m
    assert np.abs(found.depth_m - depth_m)[known].max(initial=0.0) <= 0.0005 + 1e-5
    assert not found.depth_m[~(depth_m > 0.0) | (depth_m > 65.536)].any()
    # what is read is written again to the same bytes, and is what ROS reads
    np.testing.assert_array_equal(camera_images.encode_depth(found), message)
    ros = STORE.deserialize_cdr(message.tobytes(), IMAGE)
    np.testing.assert_array_equal(STORE.serialize_cdr(ros, IMAGE), message)


def test_foreign_messages_are_refused():
    message = camera_images.encode_depth(DEPTHS[0])
    with pytest.raises(ValueError, match="no multiple"):
        camera_images.decode_depth(message[:-2].data, CAMERA)
    turned = CameraModel(CAMERA.height_px, CAMERA.width_px, 20.0, 21.0, 11.5, 7.5)
    with pytest.raises(ValueError, match="pixels"):
        camera_images.decode_depth(message.data, turned)
    picture = camera_images.encode_grey(GREYS[0])
    with pytest.raises(ValueError, match="canonical"):
        camera_images.decode_grey(picture[:-1].data, CAMERA)
    with pytest.raises(ValueError, match="24 x 16 pixels of a camera of 16 x 24"):
        camera_images.decode_grey(picture.data, turned)
    broken = picture.copy()
    broken[60:] = 0
    with pytest.raises(ValueError, match="cannot be decoded"):
        camera_images.decode_grey(broken.data, CAMERA)


def test_geometry_survives_both_ways():
    assert camera_images.camera_of_json(camera_images.camera_json(CAMERA)) == CAMERA
    info = camera_images.encode_camera_info(CAMERA, EPOCH_NS)
    assert camera_images.decode_camera_info(info.data) == CAMERA
    assert STORE.deserialize_cdr(info.tobytes(), CAMERA_INFO).header.frame_id == "camera"
