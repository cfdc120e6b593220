"""Rays against bodies of closed form."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.raycast import SURFACE_OFFSET_M, RayScene
from sidelong.geometry.transforms import invert, look_at, rotation_about, transform

CAMERA = PinholeCamera(width=160, height=128, fx=140.0, fy=140.0, cx=81.0, cy=62.0)
RADIUS_M = 0.05


def part_of(name: str, mesh: trimesh.Trimesh) -> Part:
    return part_from_arrays(name, np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))


BALL = part_of("ball", trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_M))
PLATE = part_of("plate", trimesh.creation.box((1.0, 1.0, 0.01)))


def at(x: float, y: float, z: float) -> np.ndarray:
    return transform(np.eye(3), (x, y, z))


def test_a_ball_has_the_depth_and_normals_of_a_sphere() -> None:
    base_T_camera = look_at((0.2, -0.1, 0.5), (0.01, 0.0, 0.02), roll_rad=0.6)
    rendering = RayScene([(BALL, at(0.01, 0.0, 0.02))]).render(CAMERA, base_T_camera)
    rays = CAMERA.pixel_rays()
    centre = (invert(base_T_camera) @ (0.01, 0.0, 0.02, 1.0))[:3]
    a, b = (rays * rays).sum(axis=-1), rays @ centre
    discriminant = b * b - a * (centre @ centre - RADIUS_M**2)
    # away from the rim, where the facets of the ball end early; their sagitta is 7 um
    inner = discriminant > 0.1 * discriminant.max()
    assert inner.sum() > 400
    expected_m = (b - np.sqrt(np.where(inner, discriminant, np.nan))) / a
    np.testing.assert_allclose(rendering.depth_m[inner], expected_m[inner], atol=60e-6)
    points_camera = rays[inner] * expected_m[inner][:, None]
    normals_base = (points_camera - centre) @ base_T_camera[:3, :3].T / RADIUS_M
    cosines = (rendering.normals_scene[inner] * normals_base).sum(axis=-1)
    assert np.degrees(np.arccos(cosines.min())) < 2.0
    np.testing.assert_array_equal(rendering.instance >= 0, np.isfinite(rendering.depth_m))
    assert np.isnan(rendering.depth_m[discriminant < 0]).all()
    assert np.isnan(rendering.normals_scene[discriminant < 0]).all()


@given(st.floats(-0.5, 0.5), st.floats(-3.0, 3.0))
def test_a_plate_has_the_depth_of_its_plane(tilt_rad: float, turn_rad: float) -> None:
    """z = n p / n r, with p on the plane; float32 inside."""
    rotation = rotation_about((0, 0, 1), turn_rad) @ rotation_about((1, 0, 0), tilt_rad)
    base_T_camera = look_at((0.0, 0.0, 0.5), (0.0, 0.0, 0.0))
    rendering = RayScene([(PLATE, transform(rotation, (0.0, 0.0, 0.0)))]).render(CAMERA, base_T_camera)
    normal = rotation[:, 2]
    rays = CAMERA.pixel_rays() @ base_T_camera[:3, :3].T
    expected_m = (0.005 - normal @ base_T_camera[:3, 3]) / (rays @ normal)
    seen = np.isfinite(rendering.depth_m) & (rendering.normals_scene @ normal > 0.99)
    assert seen.mean() > 0.5
    np.testing.assert_allclose(rendering.depth_m[seen], expected_m[seen], rtol=1e-6)


def test_an_empty_scene_hits_and_blocks_nothing() -> None:
    empty = RayScene([])
    rendering = empty.render(CAMERA, np.eye(4))
    assert rendering.depth_m.shape == (CAMERA.height, CAMERA.width)
    assert np.isnan(rendering.depth_m).all()
    assert np.isnan(rendering.normals_scene).all()
    assert (rendering.instance == -1).all()
    assert (rendering.triangle == -1).all()
    hits = empty.cast(np.zeros(3), np.array([[0.0, 0.0, 1.0]]))
    assert hits.distance.tolist() == [np.inf]
    assert empty.blocked(np.zeros((4, 3)), np.ones(3)).tolist() == [False] * 4


def test_no_rays_give_no_hits() -> None:
    scene = RayScene([(BALL, np.eye(4))])
    hits = scene.cast(np.zeros(3), np.zeros((0, 3)))
    assert hits.distance.shape == (0,)
    assert hits.normals.shape == (0, 3)
    assert scene.blocked(np.zeros((0, 3)), np.ones(3)).shape == (0,)


def test_instance_and_triangle_name_what_was_hit() -> None:
    """Two plates and a ball side by side; the triangle hit is the one that holds the point."""
    parts = [(BALL, at(-0.3, 0, 0)), (PLATE, at(2.0, 0, 0)), (BALL, at(0.3, 0, 0)), (PLATE, at(5.0, 0, 0))]
    hits = RayScene(parts).cast(
        np.array([[-0.31, 0.02, 1], [2.1, 0.2, 1], [0.3, 0.01, 1], [5.0, -0.1, 1], [9, 9, 1]], dtype=float),
        np.array([0.0, 0.0, -1.0]),
    )
    assert hits.instance.tolist() == [0, 1, 2, 3, -1]
    assert hits.triangle[4] == -1
    for index, (part, scene_T_object) in enumerate(parts):
        corners = part.vertices_m[part.triangles[hits.triangle[index]]] + scene_T_object[:3, 3]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        np.testing.assert_allclose(hits.normals[index], normal / np.linalg.norm(normal), atol=1e-12)
        point = np.array([hits.distance[index] * 0.0, 0.0, 1.0 - hits.distance[index]])
        point[:2] = [(-0.31, 0.02), (2.1, 0.2), (0.3, 0.01), (5.0, -0.1)][index]
        assert (point - corners[0]) @ hits.normals[index] == pytest.approx(0.0, abs=1e-6)


def test_distance_counts_lengths_of_the_direction() -> None:
    scene = RayScene([(PLATE, at(0, 0, -0.005))])
    hits = scene.cast(np.array([0.0, 0.0, 1.0]), np.array([[0, 0, -1.0], [0, 0, -0.25], [0.5, 0, -2.0], [0, 0, 1.0]]))
    np.testing.assert_allclose(hits.distance, [1.0, 4.0, 0.5, np.inf], rtol=1e-6)


def test_normals_turn_with_the_part() -> None:
    quarter = transform(rotation_about((0, 1, 0), np.pi / 2), (0, 0, 0))
    hits = RayScene([(PLATE, quarter)]).cast(np.array([1.0, 0.0, 0.0]), np.array([[-1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(hits.normals, [[1.0, 0.0, 0.0]], atol=1e-12)


def test_a_plate_blocks_what_passes_through_it_only() -> None:
    """Plates at heights 0 and 1: segments that stay between them are free, those that cross one are not."""
    scene = RayScene([(PLATE, at(0, 0, 0)), (PLATE, at(0, 0, 1))])
    above_lower = (0.1, 0.1, 0.005 + SURFACE_OFFSET_M)
    segments = [
        ((0, 0, 0.1), (0.2, 0.1, 0.9), False),
        (above_lower, (0.0, 0.0, 0.9), False),
        ((0, 0, 0.5), (0, 0, 1.5), True),
        ((0, 0, 0.5), (0, 0, -0.5), True),
        ((0, 0, 1.5), (0, 0, -0.5), True),
        ((0, 0, 0.5), (3.0, 0, 1.5), False),
    ]
    blocked = scene.blocked(np.array([a for a, _, _ in segments]), np.array([b for _, b, _ in segments]))
    assert blocked.tolist() == [expected for _, _, expected in segments]


def test_one_target_serves_an_image_of_origins() -> None:
    scene = RayScene([(PLATE, at(0, 0, 0))])
    origins = np.zeros((3, 5, 3))
    origins[..., 2] = np.array([-0.5, 0.1, 0.5])[:, None]
    blocked = scene.blocked(origins, np.array([0.0, 0.0, 2.0]))
    assert blocked.shape == (3, 5)
    assert blocked[:, 0].tolist() == [True, False, False]
