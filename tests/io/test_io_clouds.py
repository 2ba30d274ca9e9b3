"""Maps on disk: nothing of the mine grid is lost, files are the same when written again, damage is told in a line."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from datetime import date
from pathlib import Path

import ezdxf
import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.data import MapCloud, SurfaceKind
from mineloc.errors import FormatError, OutputError
from mineloc.io.clouds import (
    read_cloud,
    read_roadways,
    write_dxf,
    write_intersections_csv,
    write_laz,
    write_pcd,
    write_ply,
    write_roadways,
)
from mineloc.roadways.graph import read_graph
from mineloc.roadways.mapped import MappedRoadway, MappedRoadways

GRID = np.array([500_000.0, 7_100_000.0, -350.0])
WRITERS: dict[str, Callable[..., None]] = {"ply": write_ply, "pcd": write_pcd, "laz": write_laz, "las": write_laz}


def _cloud(count: int = 200, seed: int = 0) -> MapCloud:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    return MapCloud(
        origin_m=np.array([12.0, -7.0, 3.0]),
        points_m=rng.uniform(-400, 400, (count, 3)).astype(np.float32),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        counts=rng.integers(1, 9000, count).astype(np.int32),
        visits=rng.integers(1, 300, count).astype(np.int32),
        thickness_m=rng.uniform(0, 0.05, count).astype(np.float32),
        near_m=rng.uniform(1, 20, count).astype(np.float32),
        surface=rng.integers(0, 4, count).astype(np.uint8),
        voxel_m=0.1,
    )


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("suffix", WRITERS)
def test_mine_grid_survives_to_less_than_a_millimetre(tmp_path: Path, suffix: str) -> None:
    """float32 alone keeps 3 cm of this easting and half a metre of this northing."""
    cloud, path = _cloud(), tmp_path / f"map.{suffix}"
    WRITERS[suffix](path, cloud, origin_m=GRID, frame="grid")
    back = read_cloud(path)
    # LAZ counts in millimetres
    np.testing.assert_allclose(back.points_map, cloud.points_map + GRID, atol=5.1e-4 if suffix[0] == "l" else 1e-7)
    np.testing.assert_allclose(back.origin_m, cloud.origin_m + GRID, atol=1e-9)
    assert back.frame == "grid"
    assert back.voxel_m == cloud.voxel_m
    for name in ("counts", "visits", "thickness_m", "near_m", "surface"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
    if suffix[0] == "p":
        np.testing.assert_array_equal(back.normals, cloud.normals)


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*(st.floats(-1e7, 1e7, allow_nan=False) for _ in range(3))),
    st.integers(0, 30),
    st.sampled_from(["ply", "pcd", "laz"]),
)
def test_any_origin_and_any_count_come_back(
    tmp_path_factory: pytest.TempPathFactory, origin: tuple[float, float, float], count: int, suffix: str
) -> None:
    cloud, path = _cloud(count), tmp_path_factory.mktemp("c") / f"c.{suffix}"
    WRITERS[suffix](path, cloud, origin_m=np.array(origin))
    back = read_cloud(path)
    assert len(back) == count
    np.testing.assert_allclose(back.points_map, cloud.points_map + origin, atol=6e-4 if suffix == "laz" else 1e-7)


def test_ply_of_floats_tells_what_to_add(tmp_path: Path) -> None:
    cloud, path = _cloud(), tmp_path / "f.ply"
    write_ply(path, cloud, origin_m=GRID, float32=True)
    head = path.read_bytes()[:800].decode("latin-1")
    assert "property float x" in head
    assert "comment unit metre" in head
    assert "comment origin_m 500012.0 7099993.0 -347.0" in head
    np.testing.assert_allclose(read_cloud(path).points_map, cloud.points_map + GRID, atol=1e-7)


@pytest.mark.parametrize("suffix", WRITERS)
def test_files_are_the_same_when_written_again_and_never_half_there(tmp_path: Path, suffix: str) -> None:
    cloud, one, other = _cloud(3000), tmp_path / f"one.{suffix}", tmp_path / f"other.{suffix}"
    for path in (one, other):
        WRITERS[suffix](path, cloud, origin_m=GRID, frame="grid")
    assert _digest(one) == _digest(other)
    with pytest.raises(OutputError, match="exists"):
        WRITERS[suffix](one, cloud)
    with pytest.raises(ValueError, match="one word"):
        WRITERS[suffix](tmp_path / f"third.{suffix}", cloud, frame="mine grid")
    with pytest.raises(ValueError, match="three finite numbers"):
        WRITERS[suffix](tmp_path / f"third.{suffix}", cloud, origin_m=np.array([0.0, np.nan, 0.0]))
    assert sorted(path.name for path in tmp_path.iterdir()) == [one.name, other.name]


def test_laz_is_what_the_trade_expects(tmp_path: Path) -> None:
    cloud, path = _cloud(), tmp_path / "map.laz"
    write_laz(path, cloud, origin_m=GRID, frame="grid", flown=date(2026, 3, 4))
    with laspy.open(path) as reader:
        header, las = reader.header, reader.read()
    assert (header.point_format.id, str(header.version)) == (6, "1.4")
    assert header.creation_date == date(2026, 3, 4)
    np.testing.assert_allclose(header.scales, 0.001)
    np.testing.assert_allclose(header.offsets, GRID + cloud.origin_m)
    np.testing.assert_allclose(header.mins, (cloud.points_map + GRID).min(axis=0), atol=1e-3)
    for kind, number in ((SurfaceKind.FLOOR, 2), (SurfaceKind.WALL, 64), (SurfaceKind.ROOF, 65), (0, 1)):
        np.testing.assert_array_equal(np.asarray(las.classification) == number, cloud.surface == kind)
    words = b"".join(vlr.record_data for vlr in header.vlrs if vlr.user_id == "mineloc").decode()
    assert "unit metre" in words
    assert "frame grid" in words
    # the day of the flight is part of the file, that of writing is not
    write_laz(tmp_path / "unknown.laz", cloud)
    with laspy.open(tmp_path / "unknown.laz") as reader:
        assert reader.header.creation_date == date(1970, 1, 1)
    far = _cloud().keep(np.arange(1))
    with pytest.raises(ValueError, match="2000 km"):
        write_laz(tmp_path / "far.laz", MapCloud(far.origin_m, far.points_m * np.float32(1e6), *_rest(far)))


def _rest(cloud: MapCloud) -> tuple[object, ...]:
    known = (cloud.normals, cloud.counts, cloud.visits, cloud.thickness_m, cloud.near_m)
    return (*known, cloud.surface, cloud.voxel_m)


def test_other_programs_read_pcd_and_ply(tmp_path: Path) -> None:
    import open3d as o3d

    cloud = _cloud()
    write_pcd(tmp_path / "m.pcd", cloud, origin_m=GRID)
    write_ply(tmp_path / "m.ply", cloud, origin_m=GRID)
    theirs = o3d.io.read_point_cloud(str(tmp_path / "m.pcd"))
    np.testing.assert_allclose(np.asarray(theirs.points), cloud.points_m, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(theirs.normals), cloud.normals, rtol=1e-6)
    theirs = o3d.io.read_point_cloud(str(tmp_path / "m.ply"))
    np.testing.assert_allclose(np.asarray(theirs.points), cloud.points_map + GRID, atol=1e-8)
    assert b"\nVIEWPOINT 0 0 0 1 0 0 0\n" in (tmp_path / "m.pcd").read_bytes()


def test_clouds_of_other_programs_are_read(tmp_path: Path) -> None:
    import open3d as o3d

    rng = np.random.default_rng(1)
    points = rng.uniform(-50, 50, (40, 3)) + GRID
    theirs = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.io.write_point_cloud(str(tmp_path / "a.ply"), theirs)
    o3d.io.write_point_cloud(str(tmp_path / "a.pcd"), theirs.translate(-GRID))
    back = read_cloud(tmp_path / "a.ply")
    np.testing.assert_allclose(back.points_map, points, atol=1e-5)
    assert (back.surface == SurfaceKind.OTHER).all()
    assert (back.counts == 1).all()
    assert np.isnan(back.thickness_m).all()
    np.testing.assert_allclose(read_cloud(tmp_path / "a.pcd").points_map, points - GRID, atol=1e-5)
    las = laspy.create(point_format=3, file_version="1.2")
    las.header.offsets, las.header.scales = GRID, np.full(3, 0.01)
    las.x, las.y, las.z = points.T
    las.classification = np.full(40, 2, np.uint8)
    las.write(tmp_path / "a.las")
    back = read_cloud(tmp_path / "a.las")
    np.testing.assert_allclose(back.points_map, points, atol=0.006)
    assert (back.surface == SurfaceKind.FLOOR).all()


# --- damage


@pytest.mark.parametrize("suffix", WRITERS)
def test_cut_files_are_refused_in_one_line(tmp_path: Path, suffix: str) -> None:
    whole, part = tmp_path / f"whole.{suffix}", tmp_path / f"part.{suffix}"
    WRITERS[suffix](whole, _cloud(500), origin_m=GRID)
    data = whole.read_bytes()
    for size in (0, 1, 4, 100, 300, len(data) // 2, len(data) - 1):
        part.write_bytes(data[:size])
        with pytest.raises(FormatError) as caught:
            read_cloud(part)
        assert "\n" not in str(caught.value)
    with pytest.raises(FormatError):
        read_cloud(tmp_path / f"none.{suffix}")


@pytest.mark.parametrize("suffix", ["ply", "pcd", "las"])
def test_mutants_are_read_or_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"m.{suffix}"
    WRITERS[suffix](path, _cloud(20), origin_m=GRID)
    data = path.read_bytes()
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(150):
        mutant = bytearray(data)
        for at in rng.integers(0, min(len(data), 700), 3):
            mutant[at] = rng.integers(0, 256)
        path.write_bytes(mutant)
        try:
            read_cloud(path)
        except FormatError:
            refused += 1
    assert refused > 10


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (b"comment unit metre", b"comment unit inch", "unit inch; expected metre"),
        (b"binary_little_endian", b"binary_big_endian", "export it as binary"),
        (b"origin_m 500012.0", b"origin_m x", "correct the header"),
        (b"element vertex 200", b"element vertex 201", "ends after 200 of 201 points"),
        (b"property double x", b"property list uchar int x", "export the points alone"),
        (b"property double y", b"property double x", "columns of their own"),
        (b"property double z", b"property double w", "this is no cloud"),
        (b"end_header", b"end", "header without an end"),
    ],
)
def test_wrong_ply_is_told(tmp_path: Path, before: bytes, after: bytes, message: str) -> None:
    path = tmp_path / "m.ply"
    write_ply(path, _cloud(), origin_m=GRID)
    data = path.read_bytes()
    assert before in data
    path.write_bytes(data.replace(before, after, 1))
    with pytest.raises(FormatError, match=message):
        read_cloud(path)


def test_wrong_pcd_and_points_that_are_no_numbers_are_told(tmp_path: Path) -> None:
    path = tmp_path / "m.pcd"
    write_pcd(path, _cloud())
    data = path.read_bytes()
    for before, after, message in (
        (b"DATA binary", b"DATA ascii", "export it as binary"),
        (b"SIZE 4 4", b"SIZE 4 9", "do not fit together"),
        (b"POINTS 200", b"POINTS -5", "do not fit together"),
        (b"TYPE F F", b"TYPE F", "do not fit together"),
        (b"FIELDS", b"FELDER", "header without FIELDS"),
    ):
        path.write_bytes(data.replace(before, after, 1))
        with pytest.raises(FormatError, match=message):
            read_cloud(path)
    start = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    path.write_bytes(data[:start] + struct.pack("<f", float("nan")) + data[start + 4 :])
    with pytest.raises(FormatError, match="not finite"):
        read_cloud(path)
    with pytest.raises(FormatError, match="not a cloud by its name"):
        read_cloud(tmp_path / "map.xyz")


# --- roadways


def _mapped() -> MappedRoadways:
    nodes = np.array([[0, 0, 0], [40, 0, 0.5], [80, 0, 1.0], [40, 60, 9.0], [10, 60, 9.2]])
    roads: list[MappedRoadway] = []
    for a, b in ((0, 1), (1, 2), (1, 3), (3, 4)):
        line = np.linspace(nodes[a], nodes[b], 9)
        left = np.full(9, 1.8123)
        left[4] = np.nan
        roads.append(MappedRoadway(a, b, line, left, np.full(9, 2.1), np.full(9, 3.05)))
    return MappedRoadways(nodes, tuple(roads), 1.2)


def test_roadways_come_back_with_widths_and_as_a_plain_graph(tmp_path: Path) -> None:
    mapped, path = _mapped(), tmp_path / "r.json"
    write_roadways(path, mapped, origin_m=GRID, frame="grid")
    back = read_roadways(path)
    np.testing.assert_allclose(back.nodes_m, mapped.nodes_m + GRID, atol=1e-4)
    assert back.width_height_m == 1.2
    assert back.degrees == mapped.degrees
    assert back.levels() == mapped.levels() == [0, 0, None, 1]
    for ours, theirs in zip(mapped.roadways, back.roadways, strict=True):
        np.testing.assert_allclose(theirs.line_m, ours.line_m + GRID, atol=1e-4)
        np.testing.assert_allclose(theirs.left_m, ours.left_m, atol=1e-4)
        np.testing.assert_allclose(theirs.height_m, ours.height_m, atol=1e-4)
    assert read_graph(path).intersections == [1]
    raw = json.loads(path.read_text())
    assert (raw["unit"], raw["frame"]) == ("metre", "grid")
    assert raw["edges"][0]["left_m"][4] is None
    for key, value in (("unit", "inch"), ("width_height_m", None)):
        path.write_text(json.dumps({**raw, key: value}))
        with pytest.raises(FormatError, match="without their widths"):
            read_roadways(path)
    raw["edges"][0].pop("left_m")
    path.write_text(json.dumps(raw))
    with pytest.raises(FormatError, match="left_m"):
        read_roadways(path)


def test_dxf_has_a_layer_a_level_and_full_coordinates(tmp_path: Path) -> None:
    mapped, path = _mapped(), tmp_path / "r.dxf"
    write_dxf(path, mapped, origin_m=GRID, frame="grid")
    drawing = ezdxf.readfile(path)
    assert drawing.header["$INSUNITS"] == ezdxf.units.M
    lines = list(drawing.modelspace().query("POLYLINE"))
    assert [line.dxf.layer for line in lines] == ["LEVEL_1", "LEVEL_1", "RAMPS", "LEVEL_2"]
    for line, road in zip(lines, mapped.roadways, strict=True):
        vertices = np.array([vertex.dxf.location.xyz for vertex in line.vertices])
        np.testing.assert_allclose(vertices, road.line_m + GRID, atol=1e-6)
    points = {point.dxf.layer: point.dxf.location.xyz for point in drawing.modelspace().query("POINT")}
    np.testing.assert_allclose(points["INTERSECTIONS"], mapped.nodes_m[1] + GRID, atol=1e-6)
    words = dict(drawing.header.custom_vars.properties)
    assert (words["unit"], words["frame"]) == ("metre", "grid")
    assert not ezdxf.options.write_fixed_meta_data_for_testing


def test_roadway_files_are_the_same_when_written_again(tmp_path: Path) -> None:
    for name, write in (("r.dxf", write_dxf), ("r.json", write_roadways), ("r.csv", write_intersections_csv)):
        digests = set()
        for folder in ("one", "two"):
            write(tmp_path / folder / name, _mapped(), origin_m=GRID)
            digests.add(_digest(tmp_path / folder / name))
        assert len(digests) == 1
    rows = (tmp_path / "one" / "r.csv").read_text().splitlines()
    assert rows[1:] == ["node,east_m,north_m,up_m,roadways", "1,500040.000,7100000.000,-349.500,3"]


def test_a_mine_without_roadways_still_makes_a_drawing(tmp_path: Path) -> None:
    write_dxf(tmp_path / "r.dxf", MappedRoadways(np.zeros((0, 3)), (), 1.2))
    assert not len(ezdxf.readfile(tmp_path / "r.dxf").modelspace())
