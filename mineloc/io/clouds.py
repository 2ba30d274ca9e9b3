"""Maps on disk: PLY, PCD, LAZ; DXF and JSON for the roadways. One module a format, all of them from here."""

from __future__ import annotations

from pathlib import Path

from mineloc.data import MapCloud
from mineloc.errors import FormatError
from mineloc.io.dxf_lines import write_dxf
from mineloc.io.laz_clouds import read_laz, write_laz
from mineloc.io.pcd_clouds import read_pcd, write_pcd
from mineloc.io.ply_clouds import read_ply, write_ply
from mineloc.io.roadway_files import read_roadways, write_intersections_csv, write_roadways

__all__ = [
    "read_cloud",
    "read_laz",
    "read_pcd",
    "read_ply",
    "read_roadways",
    "write_dxf",
    "write_intersections_csv",
    "write_laz",
    "write_pcd",
    "write_ply",
    "write_roadways",
]

_READERS = {".ply": read_ply, ".pcd": read_pcd, ".laz": read_laz, ".las": read_laz}


def read_cloud(path: Path) -> MapCloud:
    """A cloud of any format, by its suffix.

    Raises:
        FormatError: another suffix, or not what the suffix says.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise FormatError(path, "not a cloud by its name", expected=", ".join(_READERS), todo="convert it")
    return reader(path)
