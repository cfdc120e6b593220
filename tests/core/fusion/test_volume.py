"""The volumetric engine against closed forms: planes, spheres, plates, and what it must refuse or ignore."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from itertools import permutations

import numpy as np
import pytest
from pydantic import ValidationError

from sidelong.errors import DepthError, ImageError, PoseError, SettingsError
from sidelong.fusion.volume.grid import MOST_COUNTED
from sidelong.fusion.volume.march import VolumeView
from sidelong.fusion.volume.region import region_of
from sidelong.fusion.volume.settings import VolumeSettings
from sidelong.fusion.volume.volume import LAST_STEP, Volume
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, look_at
from sidelong.types import BoolArray, FloatArray

CAMERA = PinholeCamera(width=160, height=128, fx=270.0, fy=270.0, cx=79.1, cy=63.8)
FINE = PinholeCamera(width=320, height=256, fx=540.0, fy=540.0, cx=158.7, cy=128.1)
EVERYWHERE = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
REGION = ((-0.04, -0.04, -0.02), (0.04, 0.04, 0.02))
VOXEL_M = 0.5e-3
TOP = look_at((0.0, 0.0, 0.2), (0.0, 0.0, 0.0))
SIDES = tuple(look_at((0.12 * np.cos(a), 0.12 * np.sin(a), 0.17), (0.0, 0.0, 0.0), roll_rad=a) for a in (0.3, 2.4, 4.5))
UP = np.array([0.0, 0.0, 1.0])


def plane_depth(
    base_T_camera: FloatArray, height_m: float = 0.0, normal: FloatArray = UP, camera: PinholeCamera = CAMERA
) -> FloatArray:
    """Depth of the plane ``normal x = height`` from the side its normal points to."""
    rays = camera.pixel_rays() @ base_T_camera[:3, :3].T
    facing = rays @ normal
    with np.errstate(divide="ignore"):
        depth_m = (height_m - normal @ base_T_camera[:3, 3]) / facing
    return np.where((depth_m > 0) & (depth_m < 2.0) & (facing < 0), depth_m, np.nan)


def sphere_depth(base_T_camera: FloatArray, radius_m: float) -> FloatArray:
    """Depth of a sphere about the origin."""
    rays, centre = CAMERA.pixel_rays(), invert(base_T_camera)[:3, 3]
    a, b = (rays * rays).sum(axis=-1), rays @ centre
    with np.errstate(invalid="ignore"):
        return (b - np.sqrt(b * b - a * (centre @ centre - radius_m**2))) / a


def volume(settings: VolumeSettings | None = None, camera: PinholeCamera = CAMERA) -> Volume:
    return Volume(camera, REGION, settings)


def filled(depth_m: FloatArray, sigma_m: float = 1e-4) -> FloatArray:
    return np.full(depth_m.shape, sigma_m)


def inside(depth_m: FloatArray, base_T_camera: FloatArray, margin_m: float = 0.004) -> BoolArray:
    """Say which pixels show a point well inside the region."""
    points = (CAMERA.pixel_rays() * depth_m[..., None]) @ base_T_camera[:3, :3].T + base_T_camera[:3, 3]
    low, high = np.array(REGION)
    return ((points > low + margin_m) & (points < high - margin_m)).all(axis=-1)


def assert_sigma(sigma_m: FloatArray, of_one_voxel_m: float) -> None:
    """What lies between eight voxels is a little better known than each, for a fifth of their errors is their own."""
    assert (sigma_m > 0.88 * of_one_voxel_m).all()
    assert (sigma_m < 1.02 * of_one_voxel_m).all()


@pytest.mark.parametrize("tilt_rad", [0.0, 0.3, 0.7, 1.0])
def test_a_plane_stays_the_plane_however_it_slopes(tilt_rad: float) -> None:
    """Seen from above, rendered from the side: off by rounding only, for the distance is that to the pixel's plane."""
    normal = np.array([np.sin(tilt_rad), 0.0, np.cos(tilt_rad)])
    fused = volume()
    depth_m = plane_depth(TOP, 0.0, normal)
    fused.add(depth_m, filled(depth_m), TOP, 0)
    expected_m = plane_depth(SIDES[0], 0.0, normal)
    seen = fused.render(SIDES[0], EVERYWHERE)
    asked = inside(expected_m, SIDES[0])
    assert np.isfinite(seen.depth_m[asked]).mean() > 0.999
    error_m = (seen.depth_m - expected_m)[asked]
    assert np.nanmax(np.abs(error_m)) < 0.01 * VOXEL_M


def test_a_sphere_stays_the_sphere_with_normals_that_point_outward() -> None:
    radius_m = 0.015
    fused = volume()
    for step, pose in enumerate((TOP, *SIDES)):
        depth_m = sphere_depth(pose, radius_m)
        fused.add(depth_m, filled(depth_m), pose, step)
    expected_m = sphere_depth(TOP, radius_m)
    points = CAMERA.pixel_rays() * fused.render(TOP, np.isfinite(expected_m)).depth_m[..., None]
    off_m = np.abs(np.linalg.norm(points[np.isfinite(points[..., 0])] - invert(TOP)[:3, 3], axis=1) - radius_m)
    assert len(off_m) > 0.97 * np.isfinite(expected_m).sum()
    assert np.median(off_m) < 0.05 * VOXEL_M
    assert np.quantile(off_m, 0.95) < 0.3 * VOXEL_M

    mesh = fused.mesh()
    assert len(mesh.triangles) > 5000
    outward = mesh.points_m / np.linalg.norm(mesh.points_m, axis=1, keepdims=True)
    assert np.median(np.abs(np.linalg.norm(mesh.points_m, axis=1) - radius_m)) < 0.05 * VOXEL_M
    assert np.median(np.sum(mesh.normals * outward, axis=1)) > np.cos(np.radians(5))
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)
    a, b, c = (mesh.points_m[mesh.triangles[:, corner]] for corner in range(3))
    wound = np.sum(np.cross(b - a, c - a) * outward[mesh.triangles[:, 0]], axis=1)
    assert (wound > 0).mean() > 0.98

    assert len(mesh.points_m) == len(mesh.normals) == len(mesh.sigma_m)
    assert (mesh.sigma_m > 0).all()


def test_an_empty_volume_shows_nothing() -> None:
    fused = volume()
    seen = fused.render(TOP, EVERYWHERE)
    assert np.isnan(seen.depth_m).all()
    assert (seen.source == -1).all()
    assert len(fused.mesh().points_m) == len(fused.mesh().triangles) == 0


def test_views_are_averaged_by_their_information() -> None:
    """0.3 mm apart at 0.1 and 0.2 mm: the mean lies a fifth of the way, its deviation is that of both together."""
    fused = volume()
    for step, (height_m, sigma_m) in enumerate(((0.0, 1e-4), (0.3e-3, 2e-4))):
        depth_m = plane_depth(TOP, height_m)
        fused.add(depth_m, filled(depth_m, sigma_m), TOP, step)
    seen = fused.render(TOP, EVERYWHERE)
    middle = inside(plane_depth(TOP), TOP)
    np.testing.assert_allclose(seen.depth_m[middle], 0.2 - 0.06e-3, atol=0.02 * VOXEL_M)
    assert_sigma(seen.sigma_m[middle], 1e-4 / np.sqrt(1.25))


@pytest.mark.parametrize("camera", [CAMERA, FINE])
def test_one_capture_counts_once_however_many_pixels_it_has(camera: PinholeCamera) -> None:
    depth_m = plane_depth(TOP, camera=camera)
    fused = volume(camera=camera)
    fused.add(depth_m, filled(depth_m), TOP, 0)
    seen = fused.render(TOP, np.ones(depth_m.shape, dtype=bool))
    assert_sigma(seen.sigma_m[np.isfinite(seen.sigma_m)], 1e-4)


def test_sigma_is_that_along_the_optical_axis_of_whoever_looks() -> None:
    """A depth error of a view from the side moves the plane along its normal by the cosine of incidence."""
    depth_m = plane_depth(SIDES[0])
    fused = volume()
    fused.add(depth_m, filled(depth_m), SIDES[0], 0)
    seen = fused.render(TOP, EVERYWHERE)
    axis_cosine = -SIDES[0][2, 2]
    middle = (CAMERA.height // 2, CAMERA.width // 2)
    assert_sigma(seen.sigma_m[middle], axis_cosine * 1e-4)


def test_the_order_of_views_does_not_matter() -> None:
    """With a wrong patch that some views see through: what they say counts whether it came before or after."""
    depths = [plane_depth(pose) for pose in (TOP, *SIDES)]
    depths[0][40:60, 50:80] -= 6e-3
    depths[2][::7] = np.nan
    results = []
    for order in permutations(range(4)):
        fused = volume()
        for index in order:
            fused.add(depths[index], filled(depths[index], 1e-4 * (1 + index)), (TOP, *SIDES)[index], index)
        results.append((fused.render(TOP, EVERYWHERE), fused.nbytes))
    first, nbytes = results[0]
    for seen, bytes_then in results[1:]:
        np.testing.assert_allclose(seen.depth_m, first.depth_m, rtol=1e-5, equal_nan=True)
        np.testing.assert_allclose(seen.sigma_m, first.sigma_m, rtol=1e-4, equal_nan=True)
        np.testing.assert_array_equal(seen.source, first.source)
        assert bytes_then == nbytes


def test_free_space_seen_by_another_view_removes_a_wrong_patch() -> None:
    depth_m = plane_depth(TOP)
    patch = (slice(50, 70), slice(60, 90))
    wrong_m = depth_m.copy()
    wrong_m[patch] -= 6e-3
    fused = volume()
    fused.add(wrong_m, filled(depth_m), TOP, 0)
    alone = fused.render(TOP, EVERYWHERE)
    np.testing.assert_allclose(alone.depth_m[55:65, 65:85], 0.194, atol=1e-5)
    fused.add(plane_depth(SIDES[0]), filled(depth_m), SIDES[0], 1)
    seen = fused.render(TOP, EVERYWHERE)
    np.testing.assert_allclose(seen.depth_m[55:65, 65:85], 0.2, atol=1e-5)
    assert (seen.source[55:65, 65:85] == 1).all()


def test_lone_outliers_leave_no_trace_and_take_nothing_away() -> None:
    """Near ones put no surface into the air, and far ones see through nothing."""
    depth_m = plane_depth(TOP)
    wrong_m = depth_m.copy()
    wrong_m[20:110:9, 20:140:9] -= 8e-3
    wrong_m[24:110:9, 24:140:9] += 15e-3
    fused = volume()
    fused.add(wrong_m, filled(depth_m), TOP, 0)
    before = fused.nbytes
    seen = fused.render(TOP, inside(depth_m, TOP))
    assert np.nanmax(np.abs(seen.depth_m - depth_m)) < 0.02 * VOXEL_M
    fused.add(depth_m, filled(depth_m), TOP, 1)
    assert fused.nbytes == before
    assert np.isfinite(fused.render(TOP, EVERYWHERE).depth_m[inside(depth_m, TOP)]).all()


def test_a_lone_pixel_without_neighbours_counts() -> None:
    """Shiny parts give depth in specks."""
    specks = np.full(EVERYWHERE.shape, np.nan)
    specks[10:120:6, 10:150:6] = plane_depth(TOP)[10:120:6, 10:150:6]
    fused = volume()
    fused.add(specks, filled(specks), TOP, 0)
    measured = np.isfinite(specks) & inside(specks, TOP)
    seen = fused.render(TOP, measured)
    assert np.isfinite(seen.depth_m[measured]).all()
    np.testing.assert_allclose(seen.depth_m[measured], specks[measured], atol=0.05 * VOXEL_M)


def test_a_depth_edge_is_not_bridged() -> None:
    """A plate 15 mm above the ground, looked at from aside: nothing comes out that is neither."""
    depth_m = plane_depth(TOP)
    depth_m[:, :80] = plane_depth(TOP, 0.015)[:, :80]
    fused = volume()
    fused.add(depth_m, filled(depth_m), TOP, 0)
    seen = fused.render(SIDES[0], EVERYWHERE)
    found = np.isfinite(seen.depth_m)
    points = (CAMERA.pixel_rays() * seen.depth_m[..., None]) @ SIDES[0][:3, :3].T + SIDES[0][:3, 3]
    height_m = points[found][:, 2]
    assert (np.minimum(np.abs(height_m), np.abs(height_m - 0.015)) < 0.5 * VOXEL_M).mean() > 0.99
    assert (height_m > 0.01).sum() > 500


def test_a_plate_of_one_millimetre_keeps_both_its_sides() -> None:
    below = look_at((0.0, 0.001, -0.2), (0.0, 0.0, 0.0))
    fused = volume()
    fused.add(plane_depth(TOP, 0.5e-3), filled(EVERYWHERE), TOP, 0)
    fused.add(plane_depth(below, 0.5e-3, -UP), filled(EVERYWHERE), below, 1)
    for pose, normal in ((TOP, UP), (below, -UP)):
        expected_m = plane_depth(pose, 0.5e-3, normal)
        seen = fused.render(pose, inside(expected_m, pose))
        assert np.nanmax(np.abs(seen.depth_m - expected_m)) < 0.2 * VOXEL_M


def test_a_surface_seen_from_behind_gives_nothing_and_hides_what_is_behind_it() -> None:
    below = look_at((0.0, 0.001, -0.2), (0.0, 0.0, 0.0))
    fused = volume()
    fused.add(plane_depth(TOP), filled(EVERYWHERE), TOP, 0)
    fused.add(plane_depth(below, 0.01, -UP), filled(EVERYWHERE), below, 1)
    assert np.isnan(fused.render(below, EVERYWHERE).depth_m).sum() < 0.5 * EVERYWHERE.size
    only_top = volume()
    only_top.add(plane_depth(TOP), filled(EVERYWHERE), TOP, 0)
    assert np.isnan(only_top.render(below, EVERYWHERE).depth_m).all()


def test_ground_seen_past_an_unmeasured_part_lies_behind_space_nobody_saw() -> None:
    """A block 12 mm high that shines too much to be measured; from above, the ground behind it is seen."""
    fused = volume()
    for step, pose in enumerate((SIDES[0], TOP)):
        depth_m = np.where(on_block(pose), np.nan, plane_depth(pose))
        fused.add(depth_m, filled(depth_m), pose, step)
    expected_m = plane_depth(SIDES[0])
    seen = fused.render(SIDES[0], inside(expected_m, SIDES[0]))
    found = np.isfinite(seen.depth_m)
    past, beside = found & on_block(SIDES[0]), found & ~on_block(SIDES[0])
    assert past.sum() > 200
    assert np.median(seen.unseen_m[past]) > 0.008
    assert (seen.unseen_m[beside] < 0.004).mean() > 0.9


def on_block(base_T_camera: FloatArray) -> BoolArray:
    """Say which rays meet the box |x|, |y| < 10 mm, 0 < z < 12 mm."""
    rays, start = CAMERA.pixel_rays() @ base_T_camera[:3, :3].T, base_T_camera[:3, 3]
    with np.errstate(divide="ignore"):
        low, high = (np.array([-0.01, -0.01, 0.0]) - start) / rays, (np.array([0.01, 0.01, 0.012]) - start) / rays
    return np.minimum(low, high).max(axis=-1) < np.maximum(low, high).min(axis=-1)


@pytest.mark.parametrize("bad", [np.nan, 0.0, -0.2, np.inf, -np.inf, 1e30, 1e300, 1e-320])
@pytest.mark.parametrize("which", ["depth", "sigma"])
def test_what_is_no_depth_or_has_no_deviation_changes_nothing(bad: float, which: str) -> None:
    depth_m = plane_depth(TOP)
    fused = volume()
    fused.add(depth_m, filled(depth_m), TOP, 0)
    before, nbytes = fused.render(TOP, EVERYWHERE), fused.nbytes
    values = {"depth": depth_m, "sigma": filled(depth_m), which: np.full(depth_m.shape, bad)}
    fused.add(values["depth"], values["sigma"], TOP, 1)
    for one, other in zip(before, fused.render(TOP, EVERYWHERE), strict=True):
        np.testing.assert_array_equal(one, other)
    assert fused.nbytes == nbytes


@pytest.mark.parametrize("sigma_m", [1e-12, 1e-30, 0.19])
def test_deviations_of_any_size_leave_numbers(sigma_m: float) -> None:
    depth_m = plane_depth(TOP)
    fused = volume()
    for step in range(3):
        fused.add(depth_m, filled(depth_m, sigma_m), TOP, step)
    seen = fused.render(TOP, inside(depth_m, TOP))
    found = np.isfinite(seen.depth_m)
    assert found.sum() > 1000
    np.testing.assert_allclose(seen.depth_m[found], 0.2, atol=0.05 * VOXEL_M)
    assert np.isfinite(seen.sigma_m[found]).all()
    assert (seen.sigma_m[found] > 0).all()


def test_a_camera_that_looks_away_or_stands_in_the_region_breaks_nothing() -> None:
    depth_m = plane_depth(TOP)
    away = look_at((0.0, 0.0, 0.2), (0.0, 0.1, 1.0))
    within = look_at((0.005, 0.0, 0.01), (0.03, 0.0, -0.01))
    fused = volume()
    fused.add(depth_m, filled(depth_m), away, 0)
    assert np.isnan(fused.render(TOP, EVERYWHERE).depth_m).all()
    fused.add(depth_m, filled(depth_m), TOP, 1)
    fused.add(plane_depth(within), filled(depth_m), within, 2)
    assert np.isnan(fused.render(away, EVERYWHERE).depth_m).all()
    expected_m = plane_depth(within)
    seen = fused.render(within, inside(expected_m, within))
    assert np.isfinite(seen.depth_m).sum() > 1000
    assert np.nanmax(np.abs(seen.depth_m - expected_m)) < 0.2 * VOXEL_M


def test_counts_stop_before_they_overflow() -> None:
    depth_m = plane_depth(TOP)
    fused = volume()
    fused.add(depth_m, filled(depth_m), TOP, 0)
    for counts in (fused._grid.counts[..., 0], fused._grid.chunks_through, fused._grid.cells_through):
        counts[counts > 0] = MOST_COUNTED
    before = fused.render(TOP, EVERYWHERE)
    fused.add(depth_m, filled(depth_m), TOP, 0)
    np.testing.assert_allclose(fused.render(TOP, EVERYWHERE).depth_m, before.depth_m, rtol=1e-6, equal_nan=True)


def test_the_same_depth_map_again_breaks_nothing() -> None:
    """Whoever calls refuses it: here it counts as another capture."""
    depth_m = plane_depth(TOP)
    fused = volume()
    fused.add(depth_m, filled(depth_m), TOP, 0)
    once, nbytes = fused.render(TOP, EVERYWHERE), fused.nbytes
    fused.add(depth_m, filled(depth_m), TOP, 0)
    twice = fused.render(TOP, EVERYWHERE)
    np.testing.assert_allclose(twice.depth_m, once.depth_m, rtol=1e-6, equal_nan=True)
    np.testing.assert_allclose(twice.sigma_m, once.sigma_m / np.sqrt(2), rtol=1e-3, equal_nan=True)
    assert fused.nbytes == nbytes


def test_five_hundred_captures_take_bounded_memory_and_grow_no_wrong_surface() -> None:
    noise = np.random.default_rng(4)
    depth_m = plane_depth(TOP)
    fused = volume(VolumeSettings(max_bytes=20_000_000))
    for step in range(500):
        noisy_m = depth_m + 1e-4 * noise.normal(size=depth_m.shape)
        stray = noise.random(depth_m.shape) < 0.01
        noisy_m[stray] += noise.uniform(-0.02, 0.02, stray.sum())
        fused.add(noisy_m, filled(depth_m), TOP, step)
    assert fused.nbytes <= 20_000_000
    seen = fused.render(TOP, EVERYWHERE)
    middle = inside(depth_m, TOP)
    assert np.isfinite(seen.depth_m[middle]).all()
    assert np.abs(seen.depth_m - depth_m)[middle].max() < 0.1e-3
    np.testing.assert_allclose(seen.sigma_m[middle], 1e-4 / np.sqrt(500), rtol=0.2)


def test_the_lowest_step_is_the_source() -> None:
    depth_m = plane_depth(TOP)
    fused = volume()
    for step in (7, 3, LAST_STEP, 5):
        fused.add(depth_m, filled(depth_m), TOP, step)
    seen = fused.render(TOP, inside(depth_m, TOP))
    assert set(np.unique(seen.source)) == {-1, 3}
    for step in (-1, LAST_STEP + 1):
        with pytest.raises(SettingsError, match=f"step: is {step}, limits 0 to {LAST_STEP}"):
            fused.add(depth_m, filled(depth_m), TOP, step)


def test_only_wanted_pixels_are_filled() -> None:
    depth_m = plane_depth(TOP)
    wanted = np.zeros_like(EVERYWHERE)
    wanted[30:60, 40:90] = True
    fused = volume()
    fused.add(depth_m, filled(depth_m), TOP, 0)
    everywhere, some = fused.render(TOP, EVERYWHERE), fused.render(TOP, wanted)
    np.testing.assert_array_equal(some.depth_m, np.where(wanted, everywhere.depth_m, np.nan))
    np.testing.assert_array_equal(some.source, np.where(wanted, everywhere.source, -1))


@pytest.mark.parametrize(
    "region",
    [
        ((0, 0, 0), (0.1, 0.1, 0.0)),
        ((0, 0, 0.1), (0.1, 0.1, 0.0)),
        ((0, 0, np.nan), (0.1, 0.1, 0.1)),
        ((0, 0, 0), (0.1, 0.1, np.inf)),
    ],
)
def test_a_region_that_holds_nothing_is_refused(region: tuple[tuple[float, float, float], ...]) -> None:
    with pytest.raises(SettingsError, match=r"region_m: is .* needs a lowest and a higher corner, all finite"):
        Volume(CAMERA, region)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("side_m", [0.8, 50.0, 1e9, 1.7e308])
def test_a_region_too_large_is_refused_before_anything_is_allocated(side_m: float) -> None:
    tracemalloc.start()
    with pytest.raises(SettingsError, match=r"need \d+ bytes at least, limit max_bytes 600000000: shrink region_m"):
        Volume(CAMERA, ((-side_m, -side_m, -side_m), (side_m, side_m, side_m)))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


def test_a_depth_map_that_does_not_fit_is_refused_and_changes_nothing() -> None:
    """A plate each at five heights: there is room for some."""
    fused = Volume(CAMERA, ((-0.03, -0.03, -0.04), (0.03, 0.03, 0.04)), VolumeSettings(max_bytes=5_500_000))
    fitting: list[tuple[VolumeView, int]] = []

    def fill() -> None:
        for step, height_m in enumerate((-0.03, -0.015, 0.0, 0.015, 0.03)):
            fused.add(plane_depth(TOP, height_m), filled(EVERYWHERE), TOP, step)
            fitting.append((fused.render(TOP, EVERYWHERE), fused.nbytes))

    with pytest.raises(
        DepthError, match=r"need \d+ bytes, limit max_bytes 5500000: shrink region_m or enlarge voxel_m"
    ):
        fill()
    before, nbytes = fitting[-1]
    assert set(np.unique(before.source)) >= {-1, 0}
    assert fused.nbytes == nbytes <= 5_500_000
    for one, other in zip(fused.render(TOP, EVERYWHERE), before, strict=True):
        np.testing.assert_array_equal(one, other)


def test_maps_of_another_size_and_poses_that_are_no_motion_are_refused() -> None:
    depth_m = plane_depth(TOP)
    fused = volume()
    sheared = TOP.copy()
    sheared[0, 0] *= 1.01
    calls: list[tuple[type[Exception], str, Callable[[], object]]] = [
        (
            ImageError,
            "depth map: 80x128 px, the camera has 160x128 px",
            lambda: fused.add(depth_m[:, ::2], depth_m, TOP, 0),
        ),
        (ImageError, "sigma: 160x64 px, the camera has 160x128 px", lambda: fused.add(depth_m, depth_m[::2], TOP, 0)),
        (ImageError, "wanted pixels: 160x64 px", lambda: fused.render(TOP, EVERYWHERE[::2])),
        (PoseError, "step 4: the rotation is not orthonormal", lambda: fused.add(depth_m, depth_m, sheared, 4)),
        (PoseError, "render: the rotation is not orthonormal", lambda: fused.render(sheared, EVERYWHERE)),
    ]
    for error, message, call in calls:
        with pytest.raises(error, match=message):
            call()
    assert np.isnan(fused.render(TOP, EVERYWHERE).depth_m).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("voxel_m", 0.0), ("voxel_m", np.nan), ("front_m", 0.9e-3), ("behind_m", 0.5e-3), ("max_bytes", 0),
        ("least_inlier_probability", 1.0), ("region_m", ((0, 0, 0), (1, 1))), ("typo", 1),
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        VolumeSettings.model_validate({field: value})


def test_settings_survive_json() -> None:
    settings = VolumeSettings(region_m=REGION)
    assert VolumeSettings.model_validate_json(settings.model_dump_json()) == settings
    assert VolumeSettings.model_validate(settings.model_dump(mode="json")) == settings


def test_the_default_region_holds_what_the_reference_shows_but_outliers() -> None:
    tilted = np.array([0.2, 0.0, 1.0]) / np.linalg.norm([0.2, 0.0, 1.0])
    depth_m = plane_depth(TOP, 0.0, tilted)
    low, high = np.array(region_of(depth_m, CAMERA, TOP, 0.01))
    points = (CAMERA.pixel_rays() * depth_m[..., None]) @ TOP[:3, :3].T + TOP[:3, 3]
    assert ((points >= low) & (points <= high)).all()
    depth_m[::31, ::31] = 5.0
    depth_m[0, :] = (np.arange(CAMERA.width) % 3) - 1.0
    np.testing.assert_allclose(region_of(depth_m, CAMERA, TOP, 0.01), (low, high), atol=3e-3)
    with pytest.raises(DepthError, match=f"region: the depth map has 0 of {depth_m.size} px measured"):
        region_of(np.full(depth_m.shape, np.nan), CAMERA, TOP, 0.01)
