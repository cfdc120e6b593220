"""Open meshes: what is closed and told, what is refused, and that closed ones stay as they are."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np
import pytest
import trimesh

from sidelong.errors import MeshError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import MOST_TRIANGLES, Part, part_from_arrays, simplified
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import look_at
from sidelong.simulation.lofting import loft
from sidelong.types import FloatArray, IntArray

BALL = trimesh.creation.icosphere(4, 0.02)
VERTICES, TRIANGLES = np.asarray(BALL.vertices), np.asarray(BALL.faces, dtype=np.intp)


def part_of(mesh: trimesh.Trimesh) -> Part:
    return part_from_arrays("part", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))


def closed_edges(part: Part) -> bool:
    """Whether every edge is run through as often one way as the other; where holes touch, four triangles share one."""
    edges = Counter(
        (int(a), int(b)) for triangle in part.triangles for a, b in zip(triangle, np.roll(triangle, -1), strict=True)
    )
    return all(edges[end, start] == count for (start, end), count in edges.items())


def test_a_closed_mesh_stays_as_it_is() -> None:
    part = part_of(BALL)
    assert part.repairs == ()
    np.testing.assert_array_equal(part.vertices_m, VERTICES)
    np.testing.assert_array_equal(part.triangles, TRIANGLES)


@pytest.mark.parametrize("missing", [1, 5, 20])
def test_small_holes_are_closed_and_told(missing: int) -> None:
    """The fan is as large as the hole, and takes the material around it."""
    material = np.arange(len(TRIANGLES)) // (len(TRIANGLES) // 2)
    kept = slice(missing, None)
    part = part_from_arrays("ball", VERTICES, TRIANGLES[kept], material[kept], ("steel", "rubber"))
    assert closed_edges(part)
    (told,) = part.repairs
    assert told.startswith("1 holes with ") or missing > 1
    assert "% of the surface" in told
    np.testing.assert_array_equal(part.triangles[: len(TRIANGLES) - missing], TRIANGLES[kept])
    assert len(part.triangle_material) == len(part.triangles)
    assert part.triangle_material[-1] == 0
    mesh = trimesh.Trimesh(part.vertices_m, part.triangles, process=False)
    assert mesh.volume == pytest.approx(BALL.volume, rel=2e-3)


def test_a_hole_that_is_too_large_is_refused_with_its_size() -> None:
    with pytest.raises(
        MeshError, match=r"ball: the mesh is not watertight, \d+ edges .* the 1 holes takes .* limit 1 %"
    ):
        part_from_arrays("ball", VERTICES, TRIANGLES[np.asarray(BALL.triangles_center)[:, 2] < 0.017])


def test_a_tube_without_its_caps_is_refused() -> None:
    """Both caps are missing: what lacks of one side makes up for the other in a sum of vectors, not here."""
    tube = trimesh.creation.cylinder(0.01, 0.04, sections=48)
    sides = np.abs(np.asarray(tube.face_normals)[:, 2]) < 0.5
    with pytest.raises(MeshError, match=r"96 edges have a triangle on one side .* the 2 holes takes 24\.9 %"):
        part_from_arrays("tube", np.asarray(tube.vertices), np.asarray(tube.faces, dtype=np.intp)[sides])


def cracked(gap_m: float) -> tuple[FloatArray, IntArray]:
    """Return a cylinder whose caps have vertices of their own, shifted outwards."""
    tube = trimesh.creation.cylinder(0.01, 0.04, sections=48)
    vertices, triangles = np.asarray(tube.vertices), np.asarray(tube.faces, dtype=np.intp)
    caps = np.abs(np.asarray(tube.face_normals)[:, 2]) > 0.5
    shifted = vertices + gap_m * np.sign(vertices[:, 2:]) * np.array([0, 0, 1])
    return np.concatenate([vertices, shifted]), np.where(caps[:, None], triangles + len(vertices), triangles)


def test_cracks_of_micrometres_are_welded_and_told() -> None:
    part = part_from_arrays("tube", *cracked(2e-6))
    assert closed_edges(part)
    assert part.repairs == ("96 vertices on open edges are welded, moved by at most 2 um",)


def test_wider_cracks_are_not() -> None:
    with pytest.raises(MeshError, match="the mesh is not watertight, 192 edges"):
        part_from_arrays("tube", *cracked(0.1e-3))


def test_the_open_ends_of_a_thin_wire_are_closed_not_welded_to_a_point() -> None:
    """1 m by 0.2 mm: the rim is as narrow as the tolerance of welding, and its caps are a tiny share of the surface."""
    wire = trimesh.creation.cylinder(1e-4, 1.0, sections=32)
    sides = np.abs(np.asarray(wire.face_normals)[:, 2]) < 0.5
    part = part_from_arrays("wire", np.asarray(wire.vertices), np.asarray(wire.faces, dtype=np.intp)[sides])
    (told,) = part.repairs
    assert told.startswith("2 holes with 64 edges are closed")
    np.testing.assert_allclose(np.ptp(part.vertices_m, axis=0), (2e-4, 2e-4, 1.0), rtol=1e-9)


def test_triangles_that_are_there_twice_are_dropped_with_their_material() -> None:
    twice = np.concatenate([TRIANGLES, np.roll(TRIANGLES[7:9], 1, axis=1)])
    material = np.concatenate([np.zeros(len(TRIANGLES), dtype=np.intp), [1, 1]])
    part = part_from_arrays("ball", VERTICES, twice, material, ("steel", "rubber"))
    np.testing.assert_array_equal(part.triangles, TRIANGLES)
    assert not part.triangle_material.any()
    assert part.repairs == ("2 triangles that were there twice are dropped",)


def test_two_bodies_are_used_also_where_they_share_an_edge() -> None:
    first = trimesh.creation.box((0.02, 0.02, 0.02))
    apart = trimesh.util.concatenate([first, first.copy().apply_translation((0.05, 0, 0))])
    assert part_of(apart).repairs == ()
    touching = trimesh.util.concatenate([first, first.copy().apply_translation((0.02, 0.02, 0))])
    touching.merge_vertices()
    part = part_of(touching)
    assert part.repairs == ()
    assert len(part.triangles) == 24


def test_surfaces_that_run_through_each_other_are_seen_from_outside() -> None:
    """Two bars that cross: a camera above sees the top of both, 10 mm above the middle, and nothing inside."""
    bars = [trimesh.creation.box(size) for size in ((0.06, 0.02, 0.02), (0.02, 0.06, 0.02))]
    part = part_of(trimesh.util.concatenate(bars))
    camera = PinholeCamera(81, 81, 200.0, 200.0, 40.0, 40.0)
    seen = RayScene([(part, np.eye(4))]).render(camera, look_at((0, 0, 0.2), (0, 0, 0)))
    assert seen.depth_m[40, 40] == pytest.approx(0.19, abs=1e-6)
    np.testing.assert_allclose(seen.normals_scene[40, 40], (0, 0, 1), atol=1e-6)


def test_zero_area_triangles_stay_in_step_with_their_materials() -> None:
    """After welding a sliver may use one vertex twice: it closes nothing and opens nothing."""
    slivers = np.array([[0, 0, 5], [3, 3, 3]])
    material = np.concatenate([np.zeros(len(TRIANGLES), dtype=np.intp), [1, 1]])
    part = part_from_arrays("ball", VERTICES, np.concatenate([TRIANGLES, slivers]), material, ("steel", "rubber"))
    assert part.repairs == ()
    assert part.triangle_material[-2:].tolist() == [1, 1]
    np.testing.assert_array_equal(part.triangle_normals[-2:], np.zeros((2, 3)))


def test_a_mesh_of_nothing_but_slivers_is_refused() -> None:
    with pytest.raises(MeshError, match="the mesh is flat, it encloses 0 mm3"):
        part_from_arrays("line", np.array([[0, 0, 0], [0.01, 0, 0], [0.02, 0, 0]]), np.array([[0, 1, 2], [0, 2, 1]]))


def test_a_sheet_is_refused_in_words() -> None:
    grid = trimesh.creation.box((0.05, 0.05, 0.01))
    top = np.asarray(grid.face_normals)[:, 2] > 0.5
    with pytest.raises(MeshError, match="not watertight, 4 edges have a triangle on one side alone"):
        part_from_arrays("sheet", np.asarray(grid.vertices), np.asarray(grid.faces, dtype=np.intp)[top])


def test_triangles_wound_against_each_other_are_counted() -> None:
    turned = TRIANGLES.copy()
    turned[4] = turned[4, ::-1]
    with pytest.raises(MeshError, match="wound against each other along 3 edges, limit 0"):
        part_from_arrays("ball", VERTICES, turned)


def test_too_many_triangles_are_refused_before_anything_is_computed() -> None:
    many = np.broadcast_to(np.array([[0, 1, 2]]), (MOST_TRIANGLES + 1, 3))
    with pytest.raises(MeshError, match="5000001 triangles, limit 5000000: export it coarser"):
        part_from_arrays("scan", VERTICES, many)


def test_two_million_triangles_are_checked_and_simplified_in_seconds() -> None:
    """A ring of 2,000,000 triangles; the deadlines are generous, the coarse one lies where the fine one does."""
    count = 1000
    u, v = np.meshgrid(*[np.arange(count) * 2 * np.pi / count] * 2, indexing="ij")
    radius = 0.02 + 0.008 * np.cos(v)
    rings = np.stack([radius * np.cos(u), radius * np.sin(u), 0.008 * np.sin(v)], axis=-1)
    vertices, triangles = loft(list(rings), cyclic=True)
    started_s = time.perf_counter()
    part = part_from_arrays("ring", vertices, triangles)
    assert part.diameter_m == pytest.approx(0.056, rel=1e-5)
    coarse = simplified(part, 3000)
    assert time.perf_counter() - started_s < 90
    assert len(coarse.triangles) <= 3000
    middles = coarse.vertices_m[coarse.triangles].mean(axis=1)
    around = np.hypot(np.hypot(middles[:, 0], middles[:, 1]) - 0.02, middles[:, 2])
    assert np.abs(around - 0.008).max() < 0.2e-3
