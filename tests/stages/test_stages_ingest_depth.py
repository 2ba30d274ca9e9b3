"""Depth images of a recording come into the flight, or are left out with one finding that says why."""

from __future__ import annotations

import driver_clouds as drivers
import numpy as np
import pytest
import recording_files as files
from camera_recordings import CAMERA, TOPIC, base, depths, image, infos, millimetres, placed, run
from recording_files import ROS2, START_NS, STEP_NS

from mineloc import se3
from mineloc.data import Calibration, DepthImage, FlightInfo, GreyImage
from mineloc.errors import IngestError
from mineloc.io.flight import FlightReader, FlightWriter
from mineloc.io.health import Health
from mineloc.io.ros import CAMERA_INFO, IMAGE
from mineloc.io.ros_images import depth_image
from mineloc.stages.ingest import ingest


def _left_out(health: Health) -> list[str]:
    return [finding.detail for finding in health.findings if finding.name == "depth_left_out"]


@pytest.mark.parametrize("options", [{}, {"encoding": "32FC1"}, {"big": True, "pad": 4}], ids=str)
def test_depth_comes_into_the_flight(tmp_path, options) -> None:
    out, health = run(tmp_path, base(), depths(**options), infos(), placed())
    assert not _left_out(health)
    depth = health.topics[-1]
    assert (depth.role, depth.topic, depth.used) == ("depth", TOPIC, 5)
    assert depth.rate_hz == pytest.approx(10.0)
    with FlightReader(out) as reader:
        assert reader.calibration.T_body_camera is not None
        np.testing.assert_allclose(reader.calibration.T_body_camera[:3, 3], [0.2, 0, 0.9])
        images = list(reader.depth_images())
        assert reader.sweep_count == 6
    assert [i.stamp_ns for i in images] == [START_NS + 30_000_000 + i * STEP_NS for i in range(5)]
    for seed, found in enumerate(images):
        assert found.camera == CAMERA
        np.testing.assert_array_equal(np.rint(found.depth_m * 1000), millimetres(seed))


def test_depth_comes_out_of_a_bag_too(tmp_path) -> None:
    """ROS 1 has other names in CameraInfo and a counter in the header."""
    types = files.ROS1.types
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    entries = []
    for topic, kind, log, message in [*infos(), *base(), *depths()]:
        values = [getattr(message, name) for name in message.__dataclass_fields__ if not name.startswith("__")]
        values[0] = files.header(types, log, message.header.frame_id, seq=0)
        if kind == CAMERA_INFO:
            values[-1] = region
        entries.append((topic, kind, log, types[kind](*values)))
    path = files.write_bag(tmp_path / "a.bag", sorted(entries, key=lambda entry: entry[2]))
    told = tmp_path / "sequence.toml"
    told.write_text("[T_body.camera]\ntranslation_m = [1, 2, 3]")
    ingest(path, out=tmp_path / "flight.mcap", sequence=told)
    with FlightReader(tmp_path / "flight.mcap") as reader:
        images = list(reader.depth_images())
    assert [image.camera for image in images] == [CAMERA] * 5
    np.testing.assert_array_equal(np.rint(images[3].depth_m * 1000), millimetres(3))


@pytest.mark.parametrize(
    ("groups", "why"),
    [
        ((infos(),), "nothing places camera_depth_optical_frame"),
        ((infos(), placed("other")), "nothing places"),
        ((placed(),), "no CameraInfo on /camera/depth/camera_info"),
        ((infos(distortion=0.1), placed()), "distortion"),
    ],
)
def test_depth_of_which_too_little_is_known_is_left_out_with_one_finding(tmp_path, groups, why) -> None:
    out, health = run(tmp_path, base(), depths(), *groups)
    (line,) = _left_out(health)
    assert why in line
    with FlightReader(out) as reader:
        assert reader.depth_count == 0
        assert reader.sweep_count == 6


def test_a_sequence_file_places_the_camera_and_names_the_topic(tmp_path) -> None:
    more = depths(topic="/other/depth/image")
    out, health = run(tmp_path, base(), depths(), more, infos(), placed())
    assert any("could be any of" in finding.detail for finding in health.findings)
    told = f'[topics]\ndepth = "{TOPIC}"\n[T_body.camera]\ntranslation_m = [1, 2, 3]'
    out, health = run(tmp_path, base(), depths(), more, infos(), told=told)
    assert not _left_out(health)
    with FlightReader(out) as reader:
        assert reader.depth_count == 5
        assert reader.calibration.T_body_camera is not None
        np.testing.assert_allclose(reader.calibration.T_body_camera[:3, 3], [1, 2, 3])
    out, health = run(tmp_path, base(), depths(), told='[topics]\ndepth = "none"')
    assert not _left_out(health)
    with pytest.raises(IngestError, match="no depth images on /nowhere"):
        run(tmp_path, base(), depths(), told='[topics]\ndepth = "/nowhere"')


def test_colour_images_are_no_depth(tmp_path) -> None:
    colour = [
        (topic, IMAGE, START_NS + i, image(START_NS + i, np.zeros((6, 30), np.uint8), "rgb8"))
        for i, topic in enumerate(["/camera/color/image_raw", "/camera/depth/preview"])
    ]
    out, health = run(tmp_path, base(), colour, placed())
    assert not _left_out(health)
    with FlightReader(out) as reader:
        assert reader.depth_count == 0


def test_images_of_another_size_and_old_ones_are_left_out_and_counted(tmp_path) -> None:
    taken = depths()
    taken[2] = (TOPIC, IMAGE, taken[2][2], image(taken[2][2] - 1000, np.ones((5, 10), np.uint16), "16UC1"))
    topic, kind, log, message = taken[1]
    out, health = run(tmp_path, base(), taken, [(topic, kind, log + 1, message)], infos(), placed())
    found = {finding.name: finding.count for finding in health.findings}
    assert (found["depth_unreadable"], found["depth_duplicates"]) == (1, 1)
    with FlightReader(out) as reader:
        assert reader.depth_count == 4


def test_a_flight_with_images_ingests_to_an_equal_flight(tmp_path) -> None:
    calibration = Calibration(se3.exp(np.arange(6) * 0.1), np.eye(4), se3.exp(np.arange(6) * 0.2))
    depths = [DepthImage(START_NS + i * STEP_NS, (millimetres(i) / 1000).astype(np.float32), CAMERA) for i in range(6)]
    with FlightWriter(tmp_path / "flown.mcap", FlightInfo(flight="7"), calibration) as writer:
        for i, image in enumerate(depths):
            writer.add_depth(image)
            writer.add_grey(GreyImage(image.stamp_ns + 5, (millimetres(i) % 251).astype(np.uint8), CAMERA))
            writer.add_sweep(drivers.vlp16_sweep(START_NS + i * STEP_NS, columns=40, seed=i))
    health = ingest(tmp_path / "flown.mcap", out=tmp_path / "again.mcap").health
    assert not _left_out(health)
    assert [topic.role for topic in health.topics] == ["lidar", "depth", "grey"]
    with FlightReader(tmp_path / "flown.mcap") as flown, FlightReader(tmp_path / "again.mcap") as reader:
        assert reader.grey_count == 6
        for found, made in zip(reader.grey_images(), flown.grey_images(), strict=True):
            # to the grey step: what was JPEG is not made JPEG again
            np.testing.assert_array_equal(found.pixels, made.pixels)
        np.testing.assert_array_equal(reader.calibration.T_body_camera, calibration.T_body_camera)
        for found, made in zip(reader.depth_images(), depths, strict=True):
            assert (found.stamp_ns, found.camera) == (made.stamp_ns, made.camera)
            np.testing.assert_array_equal(found.depth_m, made.depth_m)


def test_what_is_no_depth_image_is_refused() -> None:
    good = image(START_NS, millimetres(0), "16UC1")
    np.testing.assert_array_equal(np.rint(depth_image(good, CAMERA).depth_m * 1000), millimetres(0))
    for change in ({"encoding": "rgb8"}, {"width": 9}, {"step": 19}, {"height": 7}, {"data": np.zeros(5, np.uint8)}):
        values = {
            name: getattr(good, name)
            for name in ("header", "height", "width", "encoding", "is_bigendian", "step", "data")
        }
        with pytest.raises(ValueError, match=r"encoding|pixels|bytes"):
            depth_image(ROS2.types[IMAGE](*{**values, **change}.values()), CAMERA)
