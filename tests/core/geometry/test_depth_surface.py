"""Depth maps as surfaces: closed forms on planes and steps, and what holds for any map."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidelong.errors import ImageError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.depth_surface import EDGE_STEP, MAX_INCIDENCE_RAD, Surface, depth_surface
from sidelong.geometry.transforms import look_at
from sidelong.types import FloatArray

CAMERA = PinholeCamera(40, 32, 300.0, 290.0, 18.0, 17.5)
SHAPE = CAMERA.height, CAMERA.width
SQUARES = (CAMERA.height - 1) * (CAMERA.width - 1)
NAN = np.nan


def plane_m(degrees: float, distance_m: float = 0.5, direction: float = 0.7) -> tuple[FloatArray, FloatArray]:
    """Depth of a plane that the optical axis meets at this angle, and its normal towards the camera."""
    angle = np.deg2rad(degrees)
    normal = np.array([np.sin(angle) * np.cos(direction), np.sin(angle) * np.sin(direction), -np.cos(angle)])
    return distance_m * normal[2] / (CAMERA.pixel_rays() @ normal), normal


def crossing(surface: Surface, column: int) -> int:
    """Count the triangles with corners on both sides of the border before a column."""
    beyond = (surface.pixels[surface.triangles, 1] >= column).sum(axis=1)
    return int(((beyond > 0) & (beyond < 3)).sum())


def outward(surface: Surface) -> FloatArray:
    first, second, third = (surface.points_m[surface.triangles[:, corner]] for corner in range(3))
    return np.cross(second - first, third - first)


# --- planes ---


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 68.0])
def test_a_plane_is_wholly_triangulated_with_exact_points_and_normals(degrees: float) -> None:
    depth_m, normal = plane_m(degrees)
    surface = depth_surface(depth_m, CAMERA)
    assert len(surface.points_m) == depth_m.size
    assert len(surface.triangles) == 2 * SQUARES
    np.testing.assert_allclose(surface.points_m[:, 2].reshape(SHAPE), depth_m, rtol=1e-15)
    np.testing.assert_allclose(CAMERA.project(surface.points_m), surface.pixels[:, ::-1], atol=1e-9)
    np.testing.assert_allclose(surface.normals, np.broadcast_to(normal, surface.normals.shape), atol=1e-9)


def test_triangles_of_a_plane_have_its_area_and_turn_to_the_camera() -> None:
    depth_m, normal = plane_m(40.0)
    surface = depth_surface(depth_m, CAMERA)
    areas = outward(surface)
    assert (areas @ normal > 0).all()
    grid = surface.points_m.reshape(*SHAPE, 3)
    corners = grid[0, 0], grid[0, -1], grid[-1, -1], grid[-1, 0]
    fan = sum(np.cross(a - corners[0], b - corners[0]) for a, b in pairwise(corners[1:]))
    np.testing.assert_allclose(np.linalg.norm(areas, axis=1).sum(), np.linalg.norm(fan), rtol=1e-9)


def test_a_plane_that_is_seen_edge_on_has_no_triangles() -> None:
    depth_m, _ = plane_m(80.0, direction=0.0)
    incidence = np.deg2rad(80.0) + np.arctan((CAMERA.width - CAMERA.cx) / CAMERA.fx)
    assert len(depth_surface(depth_m, CAMERA, max_incidence_rad=min(1.55, incidence)).triangles) == 2 * SQUARES
    assert len(depth_surface(depth_m, CAMERA, max_incidence_rad=1.2).triangles) == 0


# --- edges ---


@pytest.mark.parametrize("behind_m", [0.003, 0.01, 0.1, -0.01])
def test_no_triangle_crosses_a_step_between_planes_and_normals_are_exact_on_both_sides(behind_m: float) -> None:
    near_m, normal = plane_m(20.0)
    depth_m = near_m.copy()
    depth_m[:, 15:] += behind_m * depth_m[:, 15:] / 0.5
    surface = depth_surface(depth_m, CAMERA)
    assert crossing(surface, 15) == 0
    assert len(surface.triangles) == 2 * SQUARES - 2 * (CAMERA.height - 1)
    np.testing.assert_allclose(surface.normals, np.broadcast_to(normal, surface.normals.shape), atol=1e-9)


@pytest.mark.parametrize(("pixels", "bridged"), [(0.9, True), (1.1, False)])
def test_a_step_is_an_edge_where_it_is_larger_than_what_a_pixel_spans(pixels: float, bridged: bool) -> None:
    """A step in one pixel of less than that is a slope of up to 45 degrees: it cannot be told from one."""
    assert EDGE_STEP == 1.0
    depth_m = np.full(SHAPE, 0.5)
    depth_m[:, 15:] /= 1.0 - pixels / CAMERA.fx
    assert crossing(depth_surface(depth_m, CAMERA), 15) == (2 * (CAMERA.height - 1) if bridged else 0)


def test_a_ramp_of_mixed_pixels_is_left_out_where_it_is_too_steep() -> None:
    """Equal steps are no jump: the angle of sight decides, 1.3 rad are 3.6 pixels of depth for one of width."""
    limit = np.tan(MAX_INCIDENCE_RAD) / CAMERA.fx
    for steepness, expected in ((0.8, True), (1.5, False)):
        depth_m = np.full(SHAPE, 0.5)
        depth_m[:, 15:] /= 1.0 - steepness * limit
        depth_m[:, 16:] /= 1.0 - steepness * limit
        depth_m[:, 17:] /= 1.0 - steepness * limit
        assert (crossing(depth_surface(depth_m, CAMERA), 16) > 0) == expected


def test_a_wire_before_a_plane_keeps_apart_from_it() -> None:
    depth_m = np.full(SHAPE, 0.5)
    depth_m[:, 20:22] = 0.48
    surface = depth_surface(depth_m, CAMERA)
    depths = surface.points_m[surface.triangles, 2]
    assert (np.ptp(depths, axis=1) < 1e-12).all()
    assert (depths[:, 0] < 0.49).sum() == 2 * (CAMERA.height - 1)


def test_a_square_is_cut_along_the_diagonal_whose_ends_are_nearer() -> None:
    camera = PinholeCamera(2, 2, 300.0, 300.0, 0.5, 0.5)
    for depth_m, diagonal in (
        (np.array([[0.5, 0.501], [0.501, 0.5]]), {0, 3}),
        (np.array([[0.5, 0.5], [0.5, 0.501]]), {1, 2}),
    ):
        triangles = depth_surface(depth_m, camera).triangles
        assert set(triangles[0]) & set(triangles[1]) == diagonal


# --- what is missing ---


def test_a_hole_of_one_pixel_takes_the_corners_off_four_squares() -> None:
    depth_m, _ = plane_m(30.0)
    depth_m[10, 12] = NAN
    surface = depth_surface(depth_m, CAMERA)
    assert len(surface.triangles) == 2 * SQUARES - 4
    assert not (surface.pixels == (10, 12)).all(axis=1).any()


def test_points_without_neighbours_look_at_the_camera_and_belong_to_no_mesh() -> None:
    depth_m = np.full(SHAPE, NAN)
    depth_m[5, 6], depth_m[20, 30] = 0.4, 0.6
    depth_m[10:12, 10:12] = 0.5
    surface = depth_surface(depth_m, CAMERA)
    lone = surface.points_m[[0, -1]]
    np.testing.assert_allclose(
        surface.normals[[0, -1]], -lone / np.linalg.norm(lone, axis=1, keepdims=True), atol=1e-15
    )
    mesh = surface.connected()
    assert (len(surface.points_m), len(mesh.points_m), len(mesh.triangles)) == (6, 4, 2)
    np.testing.assert_array_equal(mesh.pixels, [(10, 10), (10, 11), (11, 10), (11, 11)])
    np.testing.assert_array_equal(mesh.points_m[mesh.triangles], surface.points_m[surface.triangles])


def test_a_map_without_depth_is_an_empty_surface() -> None:
    for depth_m in (np.full(SHAPE, NAN), np.zeros(SHAPE), np.full(SHAPE, -0.5), np.full(SHAPE, np.inf)):
        surface = depth_surface(depth_m, CAMERA).connected()
        assert surface.points_m.shape == surface.normals.shape == surface.triangles.shape == (0, 3)
        assert surface.pixels.shape == (0, 2)


def test_a_map_of_another_size_is_refused() -> None:
    with pytest.raises(ImageError, match=r"the map is \(32, 39\), the camera has \(32, 40\)"):
        depth_surface(np.ones((32, 39)), CAMERA)


# --- curved surfaces, noise, and any map ---


def test_normals_of_a_ball_are_near_to_its_radii() -> None:
    camera = PinholeCamera(160, 128, 600.0, 600.0, 80.0, 64.0)
    rays, centre, radius_m = camera.pixel_rays(), np.array([0.0, 0.0, 0.5]), 0.04
    along, square = rays @ centre, (rays**2).sum(axis=2)
    root = along**2 - square * (centre @ centre - radius_m**2)
    with np.errstate(invalid="ignore"):
        depth_m = (along - np.sqrt(root)) / square
    surface = depth_surface(depth_m, camera)
    radii = (surface.points_m - centre) / radius_m
    facing = -(radii * surface.points_m).sum(axis=1) / np.linalg.norm(surface.points_m, axis=1) > 0.5
    degrees = np.rad2deg(np.arccos(np.clip((surface.normals * radii).sum(axis=1), -1, 1)))[facing]
    assert facing.sum() > 4000
    assert degrees.max() < 4.0
    assert np.median(degrees) < 0.5


def test_smoothing_takes_most_of_the_noise_out_of_normals() -> None:
    """Noise of a tenth of what a pixel spans turns single triangles by 8 degrees and more."""
    depth_m, normal = plane_m(30.0)
    noisy_m = depth_m + 0.1 * 0.5 / CAMERA.fx * np.random.default_rng(3).standard_normal(SHAPE)
    surface = depth_surface(noisy_m, CAMERA)
    areas = outward(surface)
    single = np.arccos(areas @ normal / np.linalg.norm(areas, axis=1))
    assert np.median(np.arccos(np.clip(surface.normals @ normal, -1, 1))) < np.median(single) / 4


@given(st.integers(0, 10_000), st.floats(0.0, 0.7), st.sampled_from([1e-4, 2e-3, 0.05]))
def test_of_any_map_normals_are_unit_vectors_to_the_camera_and_triangles_do_not_overlap(
    seed: int, missing: float, roughness_m: float
) -> None:
    random = np.random.default_rng(seed)
    depth_m = 0.5 + roughness_m * random.standard_normal(SHAPE)
    depth_m[random.random(SHAPE) < missing] = NAN
    surface = depth_surface(depth_m, CAMERA)
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0, rtol=1e-12)
    assert ((surface.normals * surface.points_m).sum(axis=1) < 0).all()
    assert len(surface.points_m) == np.isfinite(depth_m).sum()
    corners = surface.pixels[surface.triangles]
    assert (np.ptp(corners, axis=1) == 1).all()
    squares: dict[tuple[int, int], list[set[tuple[int, int]]]] = {}
    for triangle in corners:
        squares.setdefault(tuple(triangle.min(axis=0)), []).append({tuple(corner) for corner in triangle})
    for pair in squares.values():
        assert len(pair) <= 2
        if len(pair) == 2:
            (one, other) = pair[0] & pair[1]
            assert one[0] != other[0]
            assert one[1] != other[1]


def test_a_surface_that_is_moved_keeps_its_shape() -> None:
    depth_m, normal = plane_m(30.0)
    base_T_camera = look_at((0.4, -0.1, 0.6), (0.5, 0.0, 0.0))
    here = depth_surface(depth_m, CAMERA)
    there = here.moved(base_T_camera)
    np.testing.assert_allclose(there.normals, np.broadcast_to(base_T_camera[:3, :3] @ normal, there.normals.shape))
    back_m = (there.points_m - base_T_camera[:3, 3]) @ base_T_camera[:3, :3]
    np.testing.assert_allclose(back_m, here.points_m, atol=1e-15)
    assert there.triangles is here.triangles
