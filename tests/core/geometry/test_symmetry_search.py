"""The symmetry found from a mesh: the groups of known shapes in any orientation, and what breaks them."""

from __future__ import annotations

import time

import numpy as np
import pytest
import trimesh

from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.symmetry import Symmetry
from sidelong.geometry.symmetry_search import TOLERANCE, find_symmetry
from sidelong.geometry.transforms import rotation_about
from sidelong.simulation.lofting import loft, polar_ring
from sidelong.simulation.parts import simulated_part
from sidelong.types import FloatArray, IntArray

TURN = rotation_about((3, -1, 2), 1.1)
SHIFT_M = np.array([0.02, -0.01, 0.03])
AXIS = TURN[:, 2]
make = trimesh.creation


def turned(mesh: trimesh.Trimesh, material: IntArray | None = None) -> Part:
    """Return a mesh as a part in an orientation and at a place that no axis knows of."""
    vertices = np.asarray(mesh.vertices) @ TURN.T + SHIFT_M
    materials = ("stainless",) if material is None else ("stainless", "plastic")
    return part_from_arrays("shape", vertices, np.asarray(mesh.faces, dtype=np.intp), material, materials)


def lofted(rings: list[FloatArray]) -> Part:
    vertices, triangles = loft(rings)
    return turned(trimesh.Trimesh(vertices, triangles, process=False))


def tetrahedron() -> trimesh.Trimesh:
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 0.01
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], process=False)


def bracket() -> trimesh.Trimesh:
    outline = np.array([[0, 0], [50, 0], [50, 8], [8, 8], [8, 30], [0, 30]]) * 1e-3
    rings = [np.column_stack([outline, np.full(6, z)]) for z in (0.0, 0.02)]
    triangles = [[a, (a + 1) % 6, (a + 1) % 6 + 6] for a in range(6)]
    triangles += [[a, (a + 1) % 6 + 6, a + 6] for a in range(6)]
    cap = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    triangles += [face[::-1] for face in cap] + [[corner + 6 for corner in face] for face in cap]
    return trimesh.Trimesh(np.concatenate(rings), triangles, process=False)


@pytest.mark.parametrize(
    ("mesh", "rotations", "planes"),
    [
        (make.box((0.03, 0.03, 0.03)), 24, 9),
        (tetrahedron(), 12, 6),
        (make.icosahedron().apply_scale(0.02), 60, 15),
        (make.box((0.03, 0.04, 0.05)), 4, 3),
        (make.box((0.03, 0.03, 0.09)), 8, 5),
        (make.cylinder(0.01, 0.03, sections=6), 12, 7),
        (make.cylinder(0.0046, 0.1, sections=6), 12, 7),
        (make.cylinder(0.015, 0.015 * np.sqrt(3), sections=5), 10, 6),
        (make.cone(0.02, 0.05, sections=7), 7, 7),
        (bracket(), 1, 1),
    ],
    ids=["cube", "tetrahedron", "icosahedron", "brick", "square bar", "hexagon prism", "hexagon wire",
         "pentagon prism of three nearly equal moments", "pyramid", "L bracket"],
)  # fmt: skip
def test_finite_groups(mesh: trimesh.Trimesh, rotations: int, planes: int) -> None:
    symmetry = find_symmetry(turned(mesh))
    assert symmetry.axis is None
    assert (len(symmetry.rotations), len(symmetry.planes)) == (rotations, planes)
    assert_maps_vertices_onto_themselves(symmetry, np.asarray(mesh.vertices) @ TURN.T + SHIFT_M)


def assert_maps_vertices_onto_themselves(symmetry: Symmetry, vertices_m: FloatArray) -> None:
    """The vertices of these shapes form orbits: each comes to lie on another, to single precision."""
    operations = [operation[:3, :3] for operation in symmetry.equivalent(1.0)]
    operations += [np.eye(3) - 2 * np.outer(normal, normal) for normal in symmetry.planes]
    points = vertices_m - symmetry.centre_m
    for operation in operations:
        apart_m = np.linalg.norm((points @ operation.T)[:, None] - points, axis=2).min(axis=1)
        assert apart_m.max() < 2e-7


@pytest.mark.parametrize("sections", [16, 32, 48, 96])
@pytest.mark.parametrize("height_m", [0.004, 0.036, 0.06], ids=["disc", "equal moments", "rod"])
def test_finely_cut_cylinders_are_round_and_may_be_flipped(sections: int, height_m: float) -> None:
    symmetry = find_symmetry(turned(make.cylinder(0.015, height_m, sections=sections)))
    assert symmetry.axis is not None
    assert abs(symmetry.axis @ AXIS) == pytest.approx(1.0, abs=1e-9)
    assert len(symmetry.rotations) == 2
    assert symmetry.rotations[1] @ symmetry.axis == pytest.approx(-symmetry.axis)
    np.testing.assert_allclose(np.abs(symmetry.planes @ AXIS), [1.0])


def test_a_cone_cannot_be_flipped() -> None:
    symmetry = find_symmetry(turned(make.cone(0.02, 0.05, sections=64)))
    assert symmetry.axis is not None
    assert len(symmetry.rotations) == 1
    assert len(symmetry.planes) == 0


@pytest.mark.parametrize("mesh", [make.icosphere(4, 0.02), make.uv_sphere(0.02, count=(40, 40))], ids=["ico", "uv"])
def test_a_ball_is_the_same_however_it_is_turned(mesh: trimesh.Trimesh) -> None:
    symmetry = find_symmetry(turned(mesh))
    assert symmetry.ball
    np.testing.assert_allclose(symmetry.centre_m, SHIFT_M, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "rotations", "planes"), [("tube_fitting", 6, 6), ("hex_screw", 6, 6), ("eye_bolt", 2, 2), ("gear", 24, 24)]
)
def test_parts_of_the_simulated_cell(name: str, rotations: int, planes: int) -> None:
    """The ends of the tube fitting differ in length by 2 mm, 3.6 % of it: it cannot be flipped."""
    symmetry = simulated_part(name).symmetry
    assert symmetry.axis is None
    assert len(symmetry.rotations) == rotations
    assert len(symmetry.planes) == planes


@pytest.mark.parametrize("teeth", [5, 7, 24, 36])
def test_as_many_turns_as_teeth(teeth: int) -> None:
    points = 8 * teeth
    tooth = np.where(np.arange(points) % 8 < 4, 0.02, 0.0175)
    wheel = lofted([polar_ring(tooth, 0.0, points), polar_ring(tooth, 0.006, points)])
    symmetry = find_symmetry(wheel)
    assert symmetry.axis is None
    assert (len(symmetry.rotations), len(symmetry.planes)) == (2 * teeth, teeth + 1)


def test_without_its_lead_a_thread_is_round() -> None:
    radius = [0.0076 if index % 2 else 0.008 for index in range(30)]
    symmetry = find_symmetry(lofted([polar_ring(r, index * 1e-3, 64) for index, r in enumerate(radius)]))
    assert symmetry.axis is not None


@pytest.mark.parametrize(("depth", "same"), [(TOLERANCE * 0.8, True), (TOLERANCE * 1.3, False)])
def test_what_is_larger_than_the_tolerance_breaks_the_symmetry(depth: float, same: bool) -> None:
    """A bar is not quite square: turned by 90 degrees its faces stand out by a share of its width, the diagonal."""
    side_m = 0.03
    out_m = depth * side_m * np.sqrt(2)
    symmetry = find_symmetry(turned(make.box((side_m - out_m, side_m + out_m, 0.09))))
    assert (len(symmetry.rotations) == 8) is same


def test_another_material_breaks_a_symmetry_as_a_hole_would() -> None:
    mesh = make.box((0.03, 0.03, 0.03))
    top = np.asarray(mesh.face_normals)[:, 2] > 0.5
    symmetry = find_symmetry(turned(mesh, top.astype(np.intp)))
    assert len(symmetry.rotations) == 4  # about the normal of that face
    for rotation in symmetry.rotations:
        np.testing.assert_allclose(rotation @ AXIS, AXIS, atol=1e-6)


def test_the_result_is_the_same_every_time_and_in_every_place() -> None:
    part = simulated_part("gear")
    first, again = find_symmetry(part), find_symmetry(part)
    np.testing.assert_array_equal(first.rotations, again.rotations)
    np.testing.assert_array_equal(first.planes, again.planes)
    vertices_m = part.vertices_m @ TURN.T + SHIFT_M
    elsewhere = find_symmetry(part_from_arrays("gear", vertices_m, part.triangles))
    np.testing.assert_allclose(elsewhere.centre_m, TURN @ first.centre_m + SHIFT_M, atol=1e-6)
    for rotation in elsewhere.rotations:
        assert first.angle_rad(TURN.T @ rotation @ TURN, np.eye(3)) < 1e-4


def test_thirty_five_thousand_triangles_take_seconds() -> None:
    """A ring of five bumps with 34,848 triangles, none of them flat: a generous deadline."""
    count = 132
    u, v = np.meshgrid(*[np.arange(count) * 2 * np.pi / count] * 2, indexing="ij")
    radius = 0.02 + 0.008 * np.cos(v) * (1 + 0.25 * np.cos(6 * u))
    rings = np.stack([radius * np.cos(u), radius * np.sin(u), 0.008 * np.sin(v)], axis=-1)
    vertices, triangles = loft(list(rings), cyclic=True)
    part = part_from_arrays("ring", vertices, triangles)
    started_s = time.perf_counter()
    symmetry = find_symmetry(part)
    assert time.perf_counter() - started_s < 30
    assert len(symmetry.rotations) == 12
