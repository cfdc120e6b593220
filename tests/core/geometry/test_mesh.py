"""CAD models: closed forms of what is derived from them, and every way a file can be wrong."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sidelong.errors import MeshError, UnknownNameError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, load_part, part_from_arrays, simplified
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import look_at
from sidelong.simulation.parts import simulated_part
from sidelong.types import FloatArray, IntArray


def box(size_m: tuple[float, float, float] = (0.03, 0.04, 0.12)) -> tuple[FloatArray, IntArray]:
    mesh = trimesh.creation.box(size_m)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp)


def box_part() -> Part:
    return part_from_arrays("box", *box())


def written(path: Path, vertices: FloatArray, triangles: IntArray) -> Path:
    trimesh.Trimesh(vertices, triangles, process=False).export(path)
    return path


def test_diameter_is_the_space_diagonal_of_a_box() -> None:
    assert box_part().diameter_m == pytest.approx(0.13)  # 3-4-12-13


def test_diameter_counts_the_hull_and_not_the_centre() -> None:
    """A regular tetrahedron: its bounding sphere is wider than its edge, its diameter is the edge."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 0.01
    part = part_from_arrays("tetrahedron", corners, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))
    assert part.diameter_m == pytest.approx(0.02 * np.sqrt(2))


def test_centre_is_that_of_the_bounding_box() -> None:
    vertices, triangles = box()
    np.testing.assert_allclose(part_from_arrays("box", vertices + np.array([1, 2, 3]), triangles).centre_m, (1, 2, 3))


def test_normals_point_outwards() -> None:
    part = box_part()
    middles = part.vertices_m[part.triangles].mean(axis=1)
    np.testing.assert_allclose(np.abs(part.triangle_normals).max(axis=1), 1.0)
    assert ((middles * part.triangle_normals).sum(axis=1) > 0).all()


def test_a_mesh_inside_out_is_turned() -> None:
    vertices, triangles = box()
    turned = part_from_arrays("box", vertices, triangles[:, ::-1])
    np.testing.assert_allclose(turned.triangle_normals, box_part().triangle_normals)


def test_a_triangle_without_area_has_a_zero_normal() -> None:
    """CAD exports hold slivers: here the edge 0-1 of a tetrahedron is split at its middle by one."""
    vertices = np.array([[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0, 0, 0.02], [0.01, 0, 0]])
    triangles = np.array([[0, 2, 4], [4, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [0, 4, 1]])
    part = part_from_arrays("sliver", vertices, triangles)
    lengths = np.linalg.norm(part.triangle_normals, axis=1)
    np.testing.assert_allclose(lengths, [1, 1, 1, 1, 1, 0])


def test_materials_stay_with_their_triangles() -> None:
    vertices, triangles = box()
    material = np.arange(12, dtype=np.intp) % 2
    part = part_from_arrays("box", vertices, triangles, material, ("stainless", "rubber"))
    np.testing.assert_array_equal(part.triangle_material, material)


def with_nan() -> FloatArray:
    vertices = box()[0].copy()
    vertices[2, 1] = np.nan
    vertices[5, 0] = np.inf
    return vertices


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp), r"box: the mesh is empty \(0 vertices, 0 triangles\)"),
        (box()[0], np.zeros((0, 3), dtype=np.intp), r"box: the mesh is empty \(8 vertices, 0 triangles\)"),
        (with_nan(), box()[1], "box: 2 vertex coordinates are not finite"),
        (
            box()[0],
            box()[1][:-1],
            "box: the mesh is not watertight, 3 edges have a triangle on one side alone; .* 14.3 %",
        ),
        (box()[0][:-1], box()[1], "box: triangles refer to vertices 0 to 7, the mesh has 7"),
        (box()[0], box()[1] - 1, "box: triangles refer to vertices -1 to 6, the mesh has 8"),
        (box()[0] * 1e-3, box()[1], r"box: the largest extent is 0\.12 mm, limits 0\.5 to 5000 mm; .* in metres"),
        (box()[0] * 1e3, box()[1], r"box: the largest extent is 1\.2e\+05 mm, .* a smaller unit than declared"),
        (box()[0] * (1, 1, 0), box()[1], "box: the mesh is flat, it encloses 0 mm3"),
    ],
)
def test_meshes_that_are_no_body_are_refused(vertices: FloatArray, triangles: IntArray, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        part_from_arrays("box", vertices, triangles)


def test_a_single_turned_triangle_is_refused() -> None:
    """Which side is out cannot be told from the sign of the volume any more."""
    vertices, triangles = box()
    triangles = triangles.copy()
    triangles[4] = triangles[4, ::-1]
    with pytest.raises(MeshError, match="box: neighbouring triangles are wound against each other"):
        part_from_arrays("box", vertices, triangles)


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (np.zeros(11, dtype=np.intp), "box: 11 material indices for 12 triangles"),
        (np.full(12, 1), "box: material indices run from 1 to 1, there are 1 materials"),
        (np.full(12, -1), "box: material indices run from -1 to -1"),
    ],
)
def test_materials_that_do_not_fit_are_refused(material: IntArray, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        part_from_arrays("box", *box(), material)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".off"])
def test_files_are_millimetres_and_welded(tmp_path: Path, suffix: str) -> None:
    part = load_part(written(tmp_path / f"block{suffix}", box()[0] * 1e3, box()[1]))
    assert part.name == "block"
    assert part.vertices_m.shape == (8, 3)
    assert part.diameter_m == pytest.approx(0.13)
    assert part.materials == ("stainless",)
    assert not part.triangle_material.any()


@pytest.mark.parametrize(("unit", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), ("in", 25.4e-3)])
def test_the_file_beside_it_declares_the_unit(tmp_path: Path, unit: str, metres: float) -> None:
    path = written(tmp_path / "block.stl", box()[0] / metres, box()[1])
    path.with_suffix(".json").write_text(json.dumps({"unit": unit}))
    assert load_part(path).diameter_m == pytest.approx(0.13, rel=1e-6)


def test_metres_instead_of_millimetres_are_named(tmp_path: Path) -> None:
    path = written(tmp_path / "block.stl", *box())
    with pytest.raises(MeshError, match=r"block\.stl: block: .* 0\.12 mm.* seems to be in metres: declare its unit"):
        load_part(path)


def test_face_ranges_count_the_faces_of_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "block.stl", box()[0] * 1e3, box()[1])
    ranges = [[0, 4, "stainless"], [4, 10, "rubber"], [10, 12, "stainless"]]
    path.with_suffix(".json").write_text(json.dumps({"unit": "mm", "face_ranges": ranges}))
    part = load_part(path)
    assert part.materials == ("stainless", "rubber")
    assert part.triangle_material.tolist() == [0] * 4 + [1] * 6 + [0] * 2
    np.testing.assert_allclose(part.vertices_m[part.triangles], box()[0][box()[1]], atol=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"unit": "parsec"}', r"block\.json: unit is 'parsec', known units are mm, cm, m, in"),
        ('{"unit": "mm"', r"block\.json: cannot be read as a material file"),
        ("[1, 2]", r"block\.json: cannot be read as a material file"),
        ('{"face_ranges": [[0, 4]]}', r"block\.json: cannot be read as a material file"),
        ('{"face_ranges": [["a", 4, "steel"]]}', r"block\.json: cannot be read as a material file"),
        ('{"face_ranges": [[0, 13, "steel"]]}', r"block\.json: face range 0\.\.13 lies outside 0\.\.12"),
        ('{"face_ranges": [[-1, 12, "steel"]]}', r"block\.json: face range -1\.\.12 lies outside 0\.\.12"),
        ('{"face_ranges": [[4, 4, "steel"]]}', r"block\.json: face range 4\.\.4 lies outside 0\.\.12"),
        ('{"face_ranges": [[0, 11, "steel"]]}', r"block\.json: 1 of 12 faces have no material"),
        ('{"face_ranges": [[0, 8, "a"], [6, 12, "b"]]}', r"block\.json: face range 6\.\.12 overlaps another"),
    ],
)
def test_material_files_that_do_not_fit_are_refused(tmp_path: Path, content: str, message: str) -> None:
    path = written(tmp_path / "block.stl", box()[0] * 1e3, box()[1])
    path.with_suffix(".json").write_text(content)
    with pytest.raises(MeshError, match=message):
        load_part(path)


def test_a_material_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "block.stl", box()[0] * 1e3, box()[1])
    path.with_suffix(".json").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(MeshError, match=r"block\.json: cannot be read as a material file"):
        load_part(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"nowhere\.stl: no such CAD file"):
        load_part(tmp_path / "nowhere.stl")
    with pytest.raises(UnknownNameError, match="no such CAD file"):
        load_part(tmp_path)


def binary_stl(triangle_count: int) -> bytes:
    return bytes(80) + struct.pack("<I", triangle_count)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.stl", b""),
        ("header_only.stl", bytes(40)),
        ("no_triangles.stl", binary_stl(0)),
        ("truncated.stl", binary_stl(12) + bytes(70)),
        ("garbage.stl", b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 2),
        ("prose.stl", b"the drawing is in the other folder"),
        ("empty.obj", b""),
        ("points_only.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        ("truncated.ply", b"ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\n"),
        ("far_index.off", b"OFF\n3 1 0\n0 0 0\n10 0 0\n0 10 0\n3 0 1 7\n"),
        ("part.step", b"ISO-10303-21;"),
    ],
)
def test_files_that_hold_no_mesh_are_refused_by_name(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(MeshError, match=rf"{name}: (cannot be read as a mesh|the mesh is empty|triangles refer)"):
        load_part(path)


def test_a_file_cut_off_in_the_middle_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "block.stl", box()[0] * 1e3, box()[1])
    path.write_bytes(path.read_bytes()[:-120])
    with pytest.raises(MeshError, match=r"block\.stl: "):
        load_part(path)


def test_not_finite_vertices_of_a_file_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "block.stl", box()[0] * 1e3, box()[1])
    content = bytearray(path.read_bytes())
    # header, count, normal of the first triangle, then its first corner
    struct.pack_into("<f", content, 80 + 4 + 12, float("nan"))
    path.write_bytes(content)
    with pytest.raises(MeshError, match=r"block\.stl: block: 1 vertex coordinates are not finite"):
        load_part(path)


def test_a_simplified_part_keeps_its_shape() -> None:
    """An icosphere of 5,120 triangles brought to 500: corners within 1 % of the radius, volume within 5 %."""
    radius_m = 0.03
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius_m)
    part = part_from_arrays("ball", np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.intp))
    coarse = simplified(part, max_triangles=500)
    assert len(coarse.triangles) <= 500
    assert np.abs(np.linalg.norm(coarse.vertices_m, axis=1) - radius_m).max() < 0.01 * radius_m
    mesh = trimesh.Trimesh(coarse.vertices_m, coarse.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(ball.volume, rel=0.05)
    assert coarse.diameter_m == pytest.approx(part.diameter_m, rel=0.01)
    assert coarse.materials == ("stainless",)
    assert len(coarse.triangle_material) == len(coarse.triangles)


def test_the_depth_of_a_simplified_part_is_that_of_the_part() -> None:
    """3,000 triangles, what visibility rays are traced against."""
    camera = PinholeCamera(width=320, height=256, fx=600.0, fy=600.0, cx=160.0, cy=128.0)
    base_T_camera = look_at((0.1, 0.05, 0.2), (0.0, 0.0, 0.0))
    part = simulated_part("tube_fitting")
    coarse = simplified(part, max_triangles=3000)
    assert len(coarse.triangles) < len(part.triangles)
    fine_m, coarse_m = (RayScene([(p, np.eye(4))]).render(camera, base_T_camera).depth_m for p in (part, coarse))
    assert (np.isfinite(fine_m) != np.isfinite(coarse_m)).sum() < 0.002 * np.isfinite(fine_m).sum()
    assert np.nanpercentile(np.abs(fine_m - coarse_m), 99) < 0.05e-3


def test_a_part_with_few_triangles_is_returned_as_it_is() -> None:
    part = box_part()
    assert simplified(part, max_triangles=12) is part
