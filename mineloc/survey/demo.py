"""The demonstration: a survey of two flights through the built-in mine, a mapping flight and an inspection."""

from __future__ import annotations

from pathlib import Path

from mineloc.output import new_file

DEMO = """\
# Written by `mineloc demo`. Change it and run it again with `mineloc run`.
title = "Demo mine"
out = "."
methods = ["odometry"]

[[flight]]
name = "mapping"
mine = "demo"
[flight.config.simulate]
length_m = 180
seed = 1

[[flight]]
name = "inspection"
mine = "demo"
[flight.config.simulate]
length_m = 150
seed = 2
"""


def write_demo(folder: Path) -> Path:
    """Put the survey file of the demonstration into a folder, unless there is one that says the same.

    Raises:
        OutputError: the folder holds another survey file, or cannot be written.
    """
    path = folder / "survey.toml"
    if not path.is_file() or path.read_text() != DEMO:
        with new_file(path) as temp:
            temp.write_text(DEMO)
    return path
