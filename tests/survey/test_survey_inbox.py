"""Recordings that land in a folder: taken when they are complete, and not before."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from recording_files import IMU, ROS1, START_NS, STEP_NS, imu, write_bag, write_mcap

from mineloc.errors import OutputError
from mineloc.survey.inbox import Inbox, flight_name

SETTLE_S, BROKEN_S = 10.0, 600.0


def recording(path: Path, *, messages: int = 200) -> Path:
    stamps = [START_NS + k * STEP_NS for k in range(messages)]
    return write_mcap(path, [("/imu", IMU, stamp, imu(stamp)) for stamp in stamps], chunk_size=2000)


def names(inbox: Inbox, now_s: float) -> list[str]:
    return [landed.path.name for landed in inbox.complete(now_s)]


@pytest.fixture
def inbox(tmp_path: Path) -> Inbox:
    (tmp_path / "inbox").mkdir()
    return Inbox(tmp_path / "inbox", settle_s=SETTLE_S, broken_s=BROKEN_S)


def test_a_whole_recording_is_taken_once_it_stood_still(inbox: Inbox, tmp_path: Path) -> None:
    recording(tmp_path / "inbox" / "north.mcap")
    assert names(inbox, 0.0) == []
    assert names(inbox, 9.0) == []
    assert names(inbox, 10.0) == ["north.mcap"]
    assert names(inbox, 1000.0) == []


def test_one_that_is_still_being_copied_is_left_alone(inbox: Inbox, tmp_path: Path) -> None:
    whole = recording(tmp_path / "whole.mcap").read_bytes()
    growing = tmp_path / "inbox" / "north.mcap"
    for k in range(1, 8):
        growing.write_bytes(whole[: k * len(whole) // 8])
        assert names(inbox, 20.0 * k) == []
    # the copy stands still in the middle, for minutes
    assert names(inbox, 500.0) == []
    growing.write_bytes(whole)
    assert names(inbox, 501.0) == []
    assert names(inbox, 511.0) == ["north.mcap"]


def test_one_that_was_broken_off_for_good_is_taken_as_it_is(inbox: Inbox, tmp_path: Path) -> None:
    whole = recording(tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "inbox" / "north.mcap").write_bytes(whole[: len(whole) // 2])
    assert names(inbox, 0.0) == []
    assert names(inbox, 599.0) == []
    assert names(inbox, 600.0) == ["north.mcap"]
    assert not inbox.refused


def test_what_is_no_recording_is_refused_with_its_reason_and_looked_at_again_when_it_changes(
    inbox: Inbox, tmp_path: Path
) -> None:
    note = tmp_path / "inbox" / "readme.txt"
    note.write_text("fly level 4 tomorrow")
    assert names(inbox, 0.0) == names(inbox, 600.0) == []
    assert "not a recording" in inbox.refused[note].line()
    recording(note)
    assert names(inbox, 700.0) == []
    assert names(inbox, 710.0) == ["readme.txt"]
    assert not inbox.refused


def test_a_changed_recording_is_told_again(inbox: Inbox, tmp_path: Path) -> None:
    path = recording(tmp_path / "inbox" / "north.mcap")
    assert names(inbox, 0.0) == []
    assert names(inbox, 10.0) == ["north.mcap"]
    recording(path, messages=300)
    assert names(inbox, 20.0) == []
    assert names(inbox, 30.0) == ["north.mcap"]


def test_unfinished_and_hidden_names_are_not_looked_at(inbox: Inbox, tmp_path: Path) -> None:
    for name in (".north.mcap", "north.mcap.part", "north.mcap.crdownload"):
        recording(tmp_path / "inbox" / name)
    assert names(inbox, 0.0) == names(inbox, 1000.0) == []
    (tmp_path / "inbox" / "north.mcap.part").rename(tmp_path / "inbox" / "north.mcap")
    assert names(inbox, 1001.0) == []
    assert names(inbox, 1011.0) == ["north.mcap"]


def test_folders_and_bags_too(inbox: Inbox, tmp_path: Path) -> None:
    bag = tmp_path / "inbox" / "day_2"
    bag.mkdir()
    recording(bag / "day_2_0.mcap")
    part = recording(tmp_path / "part.mcap").read_bytes()
    (bag / "day_2_1.mcap").write_bytes(part[:-100])
    assert names(inbox, 0.0) == names(inbox, 100.0) == []
    (bag / "day_2_1.mcap").write_bytes(part)
    messages = [(START_NS + k * STEP_NS, k) for k in range(20)]
    entries = [("/imu", IMU, stamp, imu(stamp, types=ROS1.types, seq=k)) for stamp, k in messages]
    write_bag(tmp_path / "inbox" / "day_3.bag", entries)
    assert names(inbox, 101.0) == []
    assert names(inbox, 111.0) == ["day_2", "day_3.bag"]
    shutil.rmtree(bag)
    assert names(inbox, 120.0) == []


def test_flights_are_named_after_files_and_never_alike(tmp_path: Path) -> None:
    assert flight_name(tmp_path / "North-4_b.mcap") == "North-4_b"
    (tmp_path / "day.2").mkdir()
    assert flight_name(tmp_path / "day.2") == "day.2"
    strange = {flight_name(tmp_path / f"{name}.bag") for name in ("шахта 1", "шахта 2", "north level", "north/level")}
    assert len(strange) == 4
    assert all(name.isascii() and " " not in name for name in strange)


def test_no_inbox_no_watch(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no such folder"):
        Inbox(tmp_path / "nowhere")
