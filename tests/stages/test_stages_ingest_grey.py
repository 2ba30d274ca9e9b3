"""Grey and colour images of a recording come into the flight where their camera is known, and are seen from there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import recording_files as files
from camera_recordings import CAMERA, FRAME, base, colours, depths, image, infos, jpeg, placed, run
from PIL import Image
from recording_files import ROS2, START_NS, STEP_NS

from mineloc.data import CameraModel
from mineloc.errors import IngestError
from mineloc.io.flight import FlightReader
from mineloc.io.health import Health
from mineloc.io.ros import COMPRESSED_IMAGE, IMAGE
from mineloc.io.ros_images import grey_image

COLOUR, INFO = "/camera/color/image_raw", "/camera/color/camera_info"
OPTICAL = "camera_color_optical_frame"
ALIGNED = "/camera/aligned_depth_to_color/image_raw"
# what image_proc makes of a distorted camera
RECTIFIED = (7.5, 0, 4.0, 0, 0, 7.75, 2.25, 0, 0, 0, 1, 0)


def _greys(seed: int) -> np.ndarray:
    """By the textbook: ITU-R BT.601."""
    return colours(seed) @ np.array([0.299, 0.587, 0.114])


def _colours(count: int = 4, *, topic: str = COLOUR, encoding: str = "rgb8", frame: str = OPTICAL) -> list[files.Entry]:
    out: list[files.Entry] = []
    for i in range(count):
        stamp = START_NS + 10_000_000 + i * STEP_NS
        if encoding == "jpeg":
            out.append((topic, COMPRESSED_IMAGE, stamp, jpeg(stamp, colours(i), frame=frame)))
        else:
            out.append((topic, IMAGE, stamp, image(stamp, _stored(colours(i), encoding), encoding, pad=3, frame=frame)))
    return out


def _stored(rgb: np.ndarray, encoding: str) -> np.ndarray:
    if encoding == "mono8":
        return np.asarray(Image.fromarray(rgb).convert("L"))
    rgb = rgb[..., ::-1] if encoding.startswith("bgr") else rgb
    return np.dstack([rgb, np.full(rgb.shape[:2], 17, np.uint8)]) if encoding.endswith("a8") else rgb


def _lines(health: Health, name: str = "grey_left_out") -> list[tuple[str, str]]:
    return [(finding.severity, finding.detail) for finding in health.findings if finding.name == name]


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "bgr8", "rgba8", "bgra8", "jpeg"])
def test_pictures_become_grey(encoding) -> None:
    """Red, green and blue in their places: a picture that swaps them is up to 40 steps off."""
    message = (
        jpeg(START_NS, colours(3)) if encoding == "jpeg" else image(START_NS, _stored(colours(3), encoding), encoding)
    )
    found = grey_image(message, CAMERA)
    assert (found.stamp_ns, found.camera) == (START_NS, CAMERA)
    assert np.abs(found.pixels - _greys(3)).max() < (4.0 if encoding == "jpeg" else 1.0)


@pytest.mark.parametrize("encoding", ["bgr8", "jpeg"])
def test_colour_comes_into_the_flight_beside_depth_aligned_to_it(tmp_path, encoding) -> None:
    topic = COLOUR + "/compressed" if encoding == "jpeg" else COLOUR
    depth = depths(topic=ALIGNED, frame=OPTICAL)
    about = infos(ALIGNED.replace("image_raw", "camera_info"), frame=OPTICAL) + infos(INFO, frame=OPTICAL)
    out, health = run(tmp_path, base(), depth, _colours(topic=topic, encoding=encoding), about, placed(OPTICAL))
    assert not _lines(health)
    assert not _lines(health, "depth_left_out")
    assert [(t.role, t.topic, t.used) for t in health.topics[1:]] == [("depth", ALIGNED, 5), ("grey", topic, 4)]
    with FlightReader(out) as reader:
        assert (reader.depth_count, reader.sweep_count) == (5, 6)
        np.testing.assert_allclose(reader.calibration.T_body_camera[:3, 3], [0.2, 0, 0.9])
        greys = list(reader.grey_images())
    assert [grey.stamp_ns for grey in greys] == [START_NS + 10_000_000 + i * STEP_NS for i in range(4)]
    for seed, grey in enumerate(greys):
        assert grey.camera == CAMERA
        # once or twice through JPEG of quality 95
        assert np.abs(grey.pixels - _greys(seed)).max() < 8.0


def test_a_frame_that_lies_in_that_of_depth_is_as_good(tmp_path) -> None:
    """The left infrared imager of a RealSense, whose frame has another name."""
    topic, frame = "/camera/infra1/image_rect_raw", "camera_infra1_optical_frame"
    pictures = _colours(topic=topic, encoding="mono8", frame=frame)
    about = infos() + infos("/camera/infra1/camera_info", frame=frame)
    for off_m, count in ((0.0, 4), (0.05, 0)):
        _, health = run(tmp_path, base(), depths(), pictures, about, placed(FRAME, (FRAME, frame, (off_m, 0, 0))))
        assert len(_lines(health)) == (count == 0)
        with FlightReader(tmp_path / "flight.mcap") as reader:
            assert (reader.depth_count, reader.grey_count) == (5, count)


@pytest.mark.parametrize(
    ("groups", "told", "severity", "why"),
    [
        ((infos(INFO),), "", "info", "nothing places camera_color_optical_frame on the drone; record /tf_static"),
        ((placed(OPTICAL),), "", "info", "no CameraInfo on /camera/color/camera_info; record it"),
        ((infos(INFO, distortion=0.1), placed(OPTICAL)), "", "info", "distortion; record rectified images"),
        ((infos(INFO),), f'[topics]\ngrey = "{COLOUR}"', "warning", "put [T_body.camera] into a sequence file"),
        ((depths(), infos(), infos(INFO), placed()), "", "info", "depth is seen from camera_depth_optical_frame"),
    ],
)
def test_colour_of_which_too_little_is_known_is_left_out_with_one_finding(
    tmp_path, groups, told, severity, why
) -> None:
    out, health = run(tmp_path, base(), _colours(), *groups, told=told)
    (line,) = _lines(health)
    assert line[0] == severity
    assert why in line[1]
    with FlightReader(out) as reader:
        assert (reader.grey_count, reader.sweep_count) == (0, 6)


def test_rectified_images_have_the_geometry_of_the_projection(tmp_path) -> None:
    pictures = _colours(topic="/camera/color/image_rect_color")
    out, health = run(tmp_path, base(), pictures, infos(INFO, distortion=0.1, p=RECTIFIED), placed(OPTICAL))
    assert not _lines(health)
    with FlightReader(out) as reader:
        assert [grey.camera for grey in reader.grey_images()] == [CameraModel(10, 6, 7.5, 7.75, 4.0, 2.25)] * 4


def test_one_camera_that_sends_both_ways_is_one_camera(tmp_path) -> None:
    both = _colours() + _colours(topic=COLOUR + "/compressed", encoding="jpeg")
    out, health = run(tmp_path, base(), both, infos(INFO), placed(OPTICAL))
    assert not _lines(health, "topic_assumed")
    assert [topic.topic for topic in health.topics[1:]] == [COLOUR]
    with FlightReader(out) as reader:
        assert reader.grey_count == 4


def test_a_sequence_file_tells_cameras_apart(tmp_path) -> None:
    two = _colours() + _colours(topic="/left/image_raw", frame="left")
    about = infos(INFO) + infos("/left/camera_info")
    _, health = run(tmp_path, base(), two, about, placed(OPTICAL))
    assert any(
        "it could be any of /camera/color/image_raw, /left/image_raw" in d for _, d in _lines(health, "topic_assumed")
    )
    told = '[topics]\ngrey = "/left/image_raw"\n[T_body.camera]\ntranslation_m = [1, 2, 3]'
    out, health = run(tmp_path, base(), two, about, told=told)
    assert [topic.topic for topic in health.topics[1:]] == ["/left/image_raw"]
    with FlightReader(out) as reader:
        np.testing.assert_allclose(reader.calibration.T_body_camera[:3, 3], [1, 2, 3])
    _, health = run(tmp_path, base(), two, about, told='[topics]\ngrey = "none"')
    assert not _lines(health)
    with pytest.raises(IngestError, match="no grey images on /points, which the sequence file names as grey"):
        run(tmp_path, base(), two, told='[topics]\ngrey = "/points"')


def test_broken_pictures_are_left_out_and_counted(tmp_path) -> None:
    pictures = _colours(topic=COLOUR + "/compressed", encoding="jpeg")
    topic, kind, log, message = pictures[2]
    cut = ROS2.types[kind](message.header, message.format, message.data[:100])
    pictures[2] = (topic, kind, log, cut)
    wide = jpeg(pictures[3][2], np.zeros((6, 11, 3), np.uint8), frame=OPTICAL)
    pictures[3] = (topic, kind, pictures[3][2], wide)
    out, health = run(tmp_path, base(), pictures, infos(INFO), placed(OPTICAL))
    assert {finding.name: finding.count for finding in health.findings}["grey_unreadable"] == 2
    with FlightReader(out) as reader:
        assert reader.grey_count == 2


def test_what_is_no_picture_is_refused() -> None:
    good = image(START_NS, colours(0), "rgb8")
    names = ("header", "height", "width", "encoding", "is_bigendian", "step", "data")
    changes: list[dict[str, Any]] = [{"encoding": "16UC1"}, {"width": 9}, {"step": 29}, {"data": np.zeros(5, np.uint8)}]
    for change in changes:
        values = {name: getattr(good, name) for name in names}
        with pytest.raises(ValueError, match=r"encoding|pixels|bytes"):
            grey_image(ROS2.types[IMAGE](*{**values, **change}.values()), CAMERA)
