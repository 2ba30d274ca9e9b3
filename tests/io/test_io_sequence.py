from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mineloc.errors import ConfigError
from mineloc.io.sequence import Sequence, load_sequence

DATASETS = Path(__file__).resolve().parents[2] / "datasets"


@pytest.mark.parametrize("path", sorted(DATASETS.glob("*.toml")), ids=lambda p: p.stem)
def test_the_sequence_files_that_come_along_are_valid(path):
    sequence = load_sequence(path)
    assert sequence.name == path.stem
    assert sequence.topics.lidar.startswith("/")
    assert path.name in (DATASETS / "README.md").read_text()


def test_m2dgr_says_what_its_recording_does_not():
    sequence = load_sequence(DATASETS / "m2dgr_hall_02.toml")
    assert (sequence.lidar.header, sequence.lidar.time_unit, sequence.lidar.rings) == ("end", "s", "field")
    np.testing.assert_allclose(sequence.calibration.T_lidar_imu[:3, 3], [-0.27255, 0.00053, -0.17954])
    # `body` is what the reference places: the prism
    np.testing.assert_allclose(sequence.calibration.T_body_lidar[:3, 3], [0.21374, -0.00146, -0.68356])
    assert sequence.flight_info(source="hall_02.bag").lidar == "Velodyne VLP-32C"


def test_readme_names_every_key():
    readme = (DATASETS / "README.md").read_text()
    for section in ("topics", "lidar", "imu", "reference", "flight"):
        for key in type(getattr(Sequence(), section)).model_fields:
            assert f"`{key}`" in readme, f"{section}.{key}"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[lidar]\nunit = 's'", r"unknown key lidar\.unit.*time_unit"),
        ("lidar_topic = '/x'", "unknown key lidar_topic"),
        ("[lidar]\ntime_unit = 'sec'", r"lidar\.time_unit = 'sec'"),
        ("[lidar]\nrate_hz = -1", r"lidar\.rate_hz = -1"),
        ("[T_body.imu]\ntranslation_m = [1, 2]", r"T_body\.imu\.translation_m"),
        ("[T_body.imu]\nquaternion_xyzw = [0, 0, 0, 2]", "quaternion of length 1"),
        ("[T_body.radar]\n", r"unknown key T_body\.radar.*camera, imu, lidar"),
        ("[T_body.imu]\ntranslation_m = [1, 2, nan]", r"T_body\.imu\.translation_m"),
        ("[lidar", "not TOML"),
    ],
)
def test_mistakes_are_one_line(tmp_path, text, match):
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=match) as info:
        load_sequence(path)
    assert str(info.value).startswith(str(path))
    assert "\n" not in str(info.value)


def test_no_such_file(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        load_sequence(tmp_path / "missing.toml")


def test_an_empty_file_says_nothing(tmp_path):
    (tmp_path / "s.toml").touch()
    assert load_sequence(tmp_path / "s.toml") == Sequence()
    np.testing.assert_array_equal(Sequence().calibration.T_lidar_imu, np.eye(4))
    np.testing.assert_array_equal(Sequence().T_places_body, np.eye(4))
