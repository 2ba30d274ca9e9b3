"""Mesh files written here and read back; everything that is no mine is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from mineloc.errors import FormatError, SimulationError
from mineloc.sim.collada import read_collada
from mineloc.sim.mesh_file import read_mesh
from mineloc.sim.mine import Mine, load_mine
from mineloc.sim.scene import Scene


def _save(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> Path:
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles))
    mesh.compute_triangle_normals()
    assert o3d.io.write_triangle_mesh(str(path), mesh)
    return path


def _collada(
    vertices: np.ndarray, triangles: np.ndarray, *, unit: float = 1.0, up: str = "Z_UP", node: str = ""
) -> str:
    numbers, corners = (" ".join(map(str, values.ravel())) for values in (vertices, triangles))
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{unit}" name="u"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p">
<float_array id="pa" count="{vertices.size}">{numbers}</float_array>
<technique_common><accessor source="#pa" count="{len(vertices)}" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="{len(triangles)}"><input semantic="VERTEX" source="#v" offset="0"/>
<p>{corners}</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">{node}<instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".dae"])
def test_every_kind_of_mesh_gives_the_same_mine(tmp_path: Path, tee: Mine, suffix: str) -> None:
    path = tmp_path / f"tee{suffix}"
    if suffix == ".dae":
        path.write_text(_collada(tee.vertices_m, tee.triangles))
    else:
        _save(path, tee.vertices_m, tee.triangles)
    mine = load_mine(path, threads=1)
    assert mine.name == "tee"
    assert len(mine.graph.intersections) == 1
    node = mine.graph.nodes_m[mine.graph.intersections[0]]
    np.testing.assert_allclose(node, [20, 0, 0], atol=1.5)
    rays = np.array([[5, 0, 1.5], [20, 10, 2.0]])
    expected, got = (one.scene.ranges_m(rays, [0, 0, 1.0]) for one in (tee, mine))
    np.testing.assert_allclose(got, expected, atol=1e-3)


def test_collada_unit_axis_and_nodes_are_applied(tmp_path: Path, tee: Mine) -> None:
    path = tmp_path / "m.dae"
    turned = tee.vertices_m[:, [0, 2, 1]] * [1, 1, -1]  # y up
    path.write_text(_collada(turned * 100, tee.triangles, unit=0.01, up="Y_UP"))
    vertices, triangles = read_collada(path)
    np.testing.assert_allclose(vertices, tee.vertices_m, atol=1e-9)
    np.testing.assert_array_equal(triangles, tee.triangles)
    node = "<translate>0 0 5</translate><rotate>0 0 1 90</rotate><scale>1 1 1</scale>"
    path.write_text(_collada(tee.vertices_m, tee.triangles, node=node))
    np.testing.assert_allclose(read_collada(path)[0], tee.vertices_m[:, [1, 0, 2]] * [-1, 1, 1] + [0, 0, 5], atol=1e-9)
    x_up = tee.vertices_m[:, [2, 0, 1]] * [1, -1, -1]
    path.write_text(_collada(x_up, tee.triangles, up="X_UP"))
    np.testing.assert_allclose(read_collada(path)[0], tee.vertices_m, atol=1e-9)


def test_collada_polygons_become_fans(tmp_path: Path) -> None:
    path = tmp_path / "m.dae"
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]], float)
    text = _collada(corners, np.array([[0, 1, 2]]))
    shape = '<polylist count="2"><input semantic="VERTEX" source="#v" offset="0"/><input semantic="NORMAL" source="#v" '
    shape += 'offset="1"/><vcount>4 3</vcount><p>0 0 1 0 2 0 3 0 3 0 2 0 4 0</p></polylist>'
    start, end = text.index("<triangles"), text.index("</triangles>") + len("</triangles>")
    path.write_text(text[:start] + shape + text[end:])
    np.testing.assert_array_equal(read_collada(path)[1], [[0, 1, 2], [0, 2, 3], [3, 2, 4]])


DANGLING = (
    "<library_visual_scenes><visual_scene><node><instance_geometry url='#x'/></node></visual_scene>"
    "</library_visual_scenes>"
)


@pytest.mark.parametrize("text", ["", "hello", "<a/>", "<COLLADA/>", f"<COLLADA>{DANGLING}</COLLADA>"])
def test_broken_collada_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "m.dae"
    path.write_text(text)
    with pytest.raises((FormatError, SimulationError)):
        read_mesh(path)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_files_that_are_no_meshes_are_refused(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"m{suffix}"
    for content in (b"", b"hello", b"ply\nformat ascii 1.0\nelement vertex 3\n", bytes(range(256))):
        path.write_bytes(content)
        with pytest.raises((FormatError, SimulationError)):
            read_mesh(path)
    with pytest.raises(FormatError, match="no such file"):
        read_mesh(tmp_path / f"none{suffix}")


@pytest.mark.parametrize(
    ("scale", "match"),
    [(1000.0, "millimetres"), (0.1, "kilometres or feet"), (0.0, "no surface")],
)
def test_wrong_units_are_refused(tmp_path: Path, tee: Mine, scale: float, match: str) -> None:
    path = _save(tmp_path / "m.ply", tee.vertices_m * scale, tee.triangles)
    with pytest.raises(SimulationError, match=match):
        load_mine(path, threads=1)


def test_centimetres_are_refused_by_the_height_of_the_roof(tmp_path: Path, tee: Mine) -> None:
    path = _save(tmp_path / "m.ply", tee.vertices_m * 100, tee.triangles)
    with pytest.raises(SimulationError, match="centimetres"):
        load_mine(path, threads=1)


def test_points_flat_plates_and_nan_are_refused(tmp_path: Path, tee: Mine) -> None:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(tee.vertices_m))
    o3d.io.write_point_cloud(str(tmp_path / "m.ply"), cloud)
    with pytest.raises(SimulationError, match="no triangles"):
        read_mesh(tmp_path / "m.ply")
    flat = tee.vertices_m * [1, 1, 0]
    with pytest.raises(SimulationError):
        read_mesh(_save(tmp_path / "m.ply", flat, tee.triangles))
    bad = tee.vertices_m.copy()
    bad[0] = np.nan
    with pytest.raises(SimulationError, match="not finite"):
        read_mesh(_save(tmp_path / "m.ply", bad, tee.triangles))


def test_scene_keeps_its_precision_far_from_the_origin(tee: Mine) -> None:
    far = np.array([500_000.0, 7_100_000.0, 400.0])
    scene = Scene(tee.vertices_m + far, tee.triangles, threads=1)
    points = np.array([[5, 0.3, 1.5], [30, -0.2, 1.2]])
    np.testing.assert_allclose(scene.clearance_m(points + far), tee.scene.clearance_m(points), atol=1e-4)
    np.testing.assert_allclose(
        scene.ranges_m(points + far, [1, 0, 0.0]), tee.scene.ranges_m(points, [1, 0, 0.0]), atol=1e-4
    )
