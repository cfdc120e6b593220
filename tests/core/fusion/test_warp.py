"""One depth map seen from another place, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from fusion_scene import CAMERA
from hypothesis import given
from hypothesis import strategies as st

from sidelong.fusion.engine import PosedDepth
from sidelong.fusion.settings import FusionSettings
from sidelong.fusion.warping.warp import Holes, warp
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, look_at, rotation_about, transform, transform_points
from sidelong.types import BoolArray, FloatArray

SMALL = PinholeCamera(width=160, height=128, fx=135.0, fy=135.0, cx=79.1, cy=63.8)
EVERYWHERE = np.ones((SMALL.height, SMALL.width), dtype=bool)
SETTINGS = FusionSettings()
EXACT = np.zeros((6, 6))


def layer_of(
    view: PosedDepth, camera: PinholeCamera, wanted: BoolArray, settings: FusionSettings = SETTINGS
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Warp a view and return depth, variance and trust as images (H, W), NaN where nothing was found or wanted."""
    holes = Holes.of(wanted, settings)
    layer = tuple(np.empty(holes.count, dtype=np.float32) for _ in range(3))
    warp(view, camera, holes, settings, (layer[0], layer[1], layer[2]))
    images = [np.full(wanted.shape, np.nan) for _ in range(3)]
    for image, values in zip(images, layer, strict=True):
        image[wanted] = np.where(np.isnan(layer[0]), np.nan, values)
    return images[0], images[1], images[2]


def warped_of(
    depth_m: FloatArray,
    camera: PinholeCamera,
    reference_T_view: FloatArray,
    wanted: BoolArray,
    settings: FusionSettings = SETTINGS,
) -> FloatArray:
    view = PosedDepth(1, depth_m.astype(np.float32), np.full_like(depth_m, 1e-4, np.float32), reference_T_view, EXACT)
    return layer_of(view, camera, wanted, settings)[0]


def plane_depth(base_T_camera: FloatArray, normal: FloatArray, camera: PinholeCamera = SMALL) -> FloatArray:
    """Depth of the plane through the origin with this normal: ``n (o + z r) = 0``."""
    rays = camera.pixel_rays() @ base_T_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        depth_m = -(normal @ base_T_camera[:3, 3]) / (rays @ normal)
    return np.where((depth_m > 0) & (depth_m < 5.0), depth_m, np.nan)


def seen_interior(depth_m: FloatArray, into_view: FloatArray, camera: PinholeCamera, margin_px: float) -> FloatArray:
    """Say which reference pixels fall inside the other view's image, by this margin."""
    points = camera.pixel_rays() * depth_m[..., None]
    uv = camera.project(points @ into_view[:3, :3].T + into_view[:3, 3])
    return (
        (uv[..., 0] > margin_px)
        & (uv[..., 0] < camera.width - 1 - margin_px)
        & (uv[..., 1] > margin_px)
        & (uv[..., 1] < camera.height - 1 - margin_px)
    )


def test_from_the_same_place_nothing_changes() -> None:
    depth_m = 0.5 + 0.05 * np.sin(np.arange(SMALL.width) / 9.0)[None, :] * np.ones((SMALL.height, 1))
    warped = warped_of(depth_m, SMALL, np.eye(4), EVERYWHERE, SETTINGS)
    np.testing.assert_allclose(warped, depth_m, atol=2e-6)


@given(
    st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.4, 0.8), st.floats(-3.1, 3.1), st.floats(-0.5, 0.5),
)  # fmt: skip
def test_a_plane_stays_the_plane_and_has_no_gaps(x: float, y: float, z: float, roll: float, tilt: float) -> None:
    """Any two views of a tilted plane; no gaps wherever the other view sees it at less than 65 degrees."""
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    base_T_reference, base_T_view = look_at((0.05, 0.02, 0.4), (0, 0, 0)), look_at((x, y, z), (0, 0, 0), roll)
    expected_m = plane_depth(base_T_reference, normal)
    reference_T_view = invert(base_T_reference) @ base_T_view
    warped = warped_of(plane_depth(base_T_view, normal), SMALL, reference_T_view, EVERYWHERE, SETTINGS)
    inside = seen_interior(expected_m, invert(reference_T_view), SMALL, margin_px=1.0)
    points_base = transform_points(base_T_reference, SMALL.pixel_rays() * expected_m[..., None])
    to_view = base_T_view[:3, 3] - points_base
    upright = to_view @ normal > np.cos(np.radians(65)) * np.linalg.norm(to_view, axis=-1)
    assert np.isfinite(warped[inside & upright]).all()
    filled = np.isfinite(warped)
    np.testing.assert_allclose(warped[filled], expected_m[filled], atol=10e-6)


def test_magnified_twice_a_noisy_surface_has_no_gaps() -> None:
    base_T_reference, base_T_view = look_at((0, 0, 0.35), (0, 0, 0)), look_at((0.1, 0, 0.7), (0, 0, 0), 0.7)
    up = np.array([0.0, 0.0, 1.0])
    noisy = plane_depth(base_T_view, up) + 1e-4 * np.random.default_rng(0).normal(size=EVERYWHERE.shape)
    reference_T_view = invert(base_T_reference) @ base_T_view
    warped = warped_of(noisy, SMALL, reference_T_view, EVERYWHERE, SETTINGS)
    inside = seen_interior(plane_depth(base_T_reference, up), invert(reference_T_view), SMALL, margin_px=1.0)
    assert inside.sum() > 0.9 * inside.size
    assert np.isfinite(warped[inside]).all()


def test_only_wanted_pixels_are_filled() -> None:
    wanted = np.zeros_like(EVERYWHERE)
    wanted[20:50, 30:90] = True
    depth_m = np.full(EVERYWHERE.shape, 0.5)
    motion = transform(rotation_about((0, 1, 0), 0.05), (0.01, 0.0, 0.02))
    everywhere = warped_of(depth_m, SMALL, motion, EVERYWHERE, SETTINGS)
    np.testing.assert_array_equal(
        warped_of(depth_m, SMALL, motion, wanted, SETTINGS), np.where(wanted, everywhere, np.nan)
    )


def test_a_depth_edge_is_not_bridged() -> None:
    """A plate 10 cm above another, moved sideways: only the two depths come out, and a gap between them."""
    depth_m = np.full(EVERYWHERE.shape, 0.5)
    depth_m[:, :80] = 0.4
    warped = warped_of(depth_m, SMALL, transform(np.eye(3), (-0.05, 0.0, 0.0)), EVERYWHERE, SETTINGS)
    filled = warped[np.isfinite(warped)]
    assert (np.minimum(np.abs(filled - 0.4), np.abs(filled - 0.5)) < 1e-6).all()
    # disparity f b / z: the near plate ends at 79 - 16.9, the far one starts at 80 - 13.5
    row = warped[64]
    assert row[62] == pytest.approx(0.4, abs=1e-6)
    assert np.isnan(row[63:66]).all()
    assert row[67] == pytest.approx(0.5, abs=1e-6)


def test_the_near_surface_hides_the_far_one() -> None:
    depth_m = np.full(EVERYWHERE.shape, 0.5)
    depth_m[:, 80:] = 0.4
    warped = warped_of(depth_m, SMALL, transform(np.eye(3), (-0.05, 0.0, 0.0)), EVERYWHERE, SETTINGS)
    row = warped[64]
    # the near plate starts at 80 - 16.9 = 63.1, where the far one, ending at 79 - 13.5 = 65.5, still lies behind
    np.testing.assert_allclose(row[64:120], 0.4, atol=1e-6)
    np.testing.assert_allclose(row[:62], 0.5, atol=1e-6)


def test_a_surface_seen_from_behind_gives_nothing() -> None:
    """A plate between two cameras that look at each other."""
    below, above = look_at((0, 0, -0.4), (0, 0, 0)), look_at((0, 0.001, 0.4), (0, 0, 0))
    depth_m = plane_depth(below, np.array([0.0, 0.0, 1.0]))
    assert np.isfinite(depth_m).all()
    assert np.isnan(warped_of(depth_m, SMALL, invert(above) @ below, EVERYWHERE, SETTINGS)).all()


def test_points_behind_the_reference_camera_give_nothing() -> None:
    depth_m = np.full(EVERYWHERE.shape, 0.5)
    for forward_m in (0.5, 0.6):
        moved = transform(np.eye(3), (0.0, 0.0, -forward_m))
        assert np.isnan(warped_of(depth_m, SMALL, moved, EVERYWHERE, SETTINGS)).all()


def test_a_lone_pixel_fills_the_pixel_it_falls_on() -> None:
    depth_m = np.full(EVERYWHERE.shape, np.nan)
    depth_m[60, 70] = 0.5
    # 0.5 m * 4 px / fx
    warped = warped_of(depth_m, SMALL, transform(np.eye(3), (0.5 * 4 / SMALL.fx, 0.0, 0.0)), EVERYWHERE, SETTINGS)
    assert np.argwhere(np.isfinite(warped)).tolist() == [[60, 74]]
    assert warped[60, 74] == pytest.approx(0.5, abs=1e-6)


def test_depths_near_the_front_are_averaged_and_those_behind_it_are_not() -> None:
    """Two patches that fall on the same pixel: 1 mm apart they are averaged, 4 mm apart the near one counts."""
    for apart_m, expected_m in ((1e-3, 0.5005), (4e-3, 0.5)):
        depth_m = np.full(EVERYWHERE.shape, np.nan)
        depth_m[60, 70], depth_m[60, 72] = 0.5, 0.5 + apart_m
        # half the size: the tiles are 1.5 px wide, centred on columns 74.55 and 75.55 of row 61.9
        away = transform(np.eye(3), (0.0, 0.0, 0.5))
        settings = FusionSettings(tile_px=3.0, max_incidence_rad=0.01)
        warped = warped_of(depth_m, SMALL, away, EVERYWHERE, settings)
        assert np.argwhere(np.isfinite(warped)).tolist() == [[62, 74], [62, 75], [62, 76]]
        assert warped[62, 74] == pytest.approx(1.0, abs=1e-6)
        assert warped[62, 75] == pytest.approx(0.5 + expected_m, abs=1e-6)


def test_a_tile_stretched_too_far_is_dropped() -> None:
    depth_m = np.full(EVERYWHERE.shape, 0.5)
    closer = transform(np.eye(3), (0.0, 0.0, -0.45))
    assert np.isnan(warped_of(depth_m, SMALL, closer, EVERYWHERE, SETTINGS)).all()
    assert np.isfinite(warped_of(depth_m, SMALL, closer, EVERYWHERE, FusionSettings(max_stretch_px=16))).all()


def test_a_sphere_stays_the_sphere() -> None:
    """30 mm radius, seen 35 degrees apart: off by the sagitta of a tile, 0.01 mm, and at the rim by up to 0.8 mm."""
    radius_m = 0.03

    def sphere_depth(base_T_camera: FloatArray) -> FloatArray:
        rays = CAMERA.pixel_rays()
        centre = invert(base_T_camera)[:3, 3]
        a, b = (rays * rays).sum(axis=-1), rays @ centre
        with np.errstate(invalid="ignore"):
            return (b - np.sqrt(b * b - a * (centre @ centre - radius_m**2))) / a

    base_T_reference, base_T_view = look_at((0, 0, 0.6), (0, 0, 0)), look_at((0.35, 0, 0.5), (0, 0, 0))
    expected_m = sphere_depth(base_T_reference)
    wanted = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
    reference_T_view = invert(base_T_reference) @ base_T_view
    warped = warped_of(sphere_depth(base_T_view), CAMERA, reference_T_view, wanted, SETTINGS)
    both = np.isfinite(warped) & np.isfinite(expected_m)
    assert both.sum() > 0.7 * np.isfinite(expected_m).sum()
    assert (np.isfinite(warped) & np.isnan(expected_m)).sum() < 0.01 * both.sum()
    # from the surface, not along the ray: at the rim a hundredth of a pixel is a millimetre of depth
    points = CAMERA.pixel_rays()[both] * warped[both][:, None]
    error_m = np.abs(np.linalg.norm(points - invert(base_T_reference)[:3, 3], axis=1) - radius_m)
    assert error_m.max() < 0.8e-3
    assert np.median(error_m) < 0.01e-3


POSES = (
    look_at((0.12, 0.05, 0.45), (0, 0, 0), 0.4),
    look_at((-0.2, 0.1, 0.5), (0, 0, 0), -1.0),
    look_at((0.0, -0.25, 0.4), (0, 0, 0)),
)


@pytest.mark.parametrize("base_T_view", POSES)
def test_the_variance_is_how_far_noise_moves_the_surface(base_T_view: FloatArray) -> None:
    """A plane that the view measures a little too far, everywhere: the warped depth moves by the standard deviation."""
    normal = np.array([0.2, -0.1, 1.0])
    reference_T_view = invert(look_at((0.05, 0.02, 0.4), (0, 0, 0))) @ base_T_view
    depth_m = plane_depth(base_T_view, normal)
    moved_m = 1e-4
    farther = warped_of(plane_depth_behind(base_T_view, normal, moved_m), SMALL, reference_T_view, EVERYWHERE)
    sigma_m = np.full(depth_m.shape, np.nan, dtype=np.float32)
    sigma_m[:] = plane_depth_behind(base_T_view, normal, moved_m) - depth_m
    view = PosedDepth(1, depth_m.astype(np.float32), sigma_m, reference_T_view, EXACT)
    warped, variance, _ = layer_of(view, SMALL, EVERYWHERE)
    both = np.isfinite(farther) & np.isfinite(warped)
    assert both.sum() > 0.3 * both.size
    np.testing.assert_allclose(np.sqrt(variance[both]), (farther - warped)[both], rtol=0.06, atol=4e-6)


def plane_depth_behind(base_T_camera: FloatArray, normal: FloatArray, moved_m: float) -> FloatArray:
    """Depth of the plane of ``plane_depth`` shifted by ``moved_m`` along its normal, away from the camera."""
    lifted = base_T_camera.copy()
    lifted[:3, 3] += moved_m * normal / np.linalg.norm(normal)
    return plane_depth(lifted, normal)


@pytest.mark.parametrize("direction", range(6))
def test_the_variance_is_how_far_an_error_of_the_pose_moves_the_surface(direction: int) -> None:
    """A pose that is known but for one direction, a turn or a shift: moved in it, the warped depth moves as much."""
    normal = np.array([0.2, -0.1, 1.0])
    size = 2e-4
    base_T_view = POSES[0]
    reference_T_view = invert(look_at((0.05, 0.02, 0.4), (0, 0, 0))) @ base_T_view
    depth_m = plane_depth(base_T_view, normal)
    covariance = np.zeros((6, 6))
    covariance[direction, direction] = size**2
    view = PosedDepth(1, depth_m.astype(np.float32), np.zeros_like(depth_m, np.float32), reference_T_view, covariance)
    warped, variance, _ = layer_of(view, SMALL, EVERYWHERE)
    moved = reference_T_view.copy()
    if direction < 3:
        moved[:3, :3] = rotation_about(np.eye(3)[direction], size) @ moved[:3, :3]
    else:
        moved[direction - 3, 3] += size
    there = warped_of(depth_m, SMALL, moved, EVERYWHERE)
    both = np.isfinite(there) & np.isfinite(warped)
    np.testing.assert_allclose(np.sqrt(variance[both]), np.abs(there - warped)[both], rtol=0.05, atol=3e-6)


def test_a_depth_at_a_rim_is_trusted_less_and_a_spike_not_at_all() -> None:
    depth_m = np.full(EVERYWHERE.shape, 0.5)
    depth_m[:, :30] = np.nan
    depth_m[60, 70] = 0.45
    view = PosedDepth(1, depth_m.astype(np.float32), np.full_like(depth_m, 1e-4, np.float32), np.eye(4), EXACT)
    warped, _, trust = layer_of(view, SMALL, EVERYWHERE, FusionSettings(tile_px=1.0))
    assert np.isnan(warped[60, 70])
    assert trust[60, 30] == pytest.approx(SETTINGS.noise.rim_trust)
    assert trust[60, 100] == pytest.approx(SETTINGS.noise.trust)
