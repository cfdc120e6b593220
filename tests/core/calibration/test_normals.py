"""Normals of depth maps: closed forms, direct fits window by window, noise, edges, and what must be refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from sidelong.calibration.normals import NormalMap, NormalSettings, estimate_normals
from sidelong.calibration.window_planes import Method
from sidelong.errors import DepthError, ImageError, SettingsError
from sidelong.geometry.camera_model import PinholeCamera

CAMERA = PinholeCamera(96, 80, 1083.0, 1070.0, 40.0, 45.0)
METHODS: tuple[Method, ...] = ("inverse_depth", "pca")
NO_LIMITS = {"edge_step": 1e3, "max_residual": 1e3}


def plane_depth(camera: PinholeCamera, normal: np.ndarray, distance_m: float) -> np.ndarray:
    """Depth of the plane that the ray through the middle of the image meets at ``distance_m``; NaN behind it."""
    rays = camera.pixel_rays()
    depth = distance_m * (rays[camera.height // 2, camera.width // 2] @ normal) / (rays @ normal)
    return np.where((depth > 0) & (depth < 50 * distance_m), depth, np.nan)


def tilted(angle: float, direction: float) -> np.ndarray:
    return np.array([np.sin(angle) * np.cos(direction), np.sin(angle) * np.sin(direction), -np.cos(angle)])


def angles(found: NormalMap, true: np.ndarray) -> np.ndarray:
    """Angle (H, W) by the sine, which keeps its digits near 0; NaN where there is no normal."""
    return np.linalg.norm(np.cross(found.normals_camera, np.broadcast_to(true, found.normals_camera.shape)), axis=-1)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("degrees", [0.0, 30.0, 70.0, 85.0])
@pytest.mark.parametrize(("distance_m", "focal_px"), [(0.05, 300.0), (0.7, 1083.0), (10.0, 5000.0)])
@pytest.mark.parametrize("window_px", [3, 5, 15])
def test_planes_are_exact_up_to_the_border(
    method: Method, degrees: float, distance_m: float, focal_px: float, window_px: int
) -> None:
    camera = PinholeCamera(96, 80, focal_px, 0.9 * focal_px, 20.0, 60.0)
    normal = tilted(np.deg2rad(degrees), 0.7)
    found = estimate_normals(
        plane_depth(camera, normal, distance_m), camera, NormalSettings(method=method, window_px=window_px)
    )
    error = angles(found, normal)
    middle_row, middle_column = camera.height // 2, camera.width // 2
    assert np.isfinite(error[middle_row, middle_column])
    assert np.isfinite(error[middle_row, [0, -1]]).any()
    assert np.nanmax(error) < 1e-9
    assert np.nanmax(found.residual_m) < 1e-6 * distance_m


def noisy_map(random: np.random.Generator) -> np.ndarray:
    depth = 0.7 + 0.003 * random.standard_normal((CAMERA.height, CAMERA.width))
    depth[random.random(depth.shape) < 0.3] = np.nan
    return depth


@pytest.mark.parametrize("window_px", [3, 7])
def test_inverse_depth_is_the_least_squares_plane_of_each_window(window_px: int) -> None:
    depth = noisy_map(np.random.default_rng(1))
    limits = NormalSettings(window_px=window_px, min_share=0.3, **NO_LIMITS)
    found = estimate_normals(depth, CAMERA, limits)
    rays = CAMERA.pixel_rays()
    r, checked = window_px // 2, 0
    for row, column in np.random.default_rng(2).integers((0, 0), depth.shape, (80, 2)):
        window = slice(max(row - r, 0), row + r + 1), slice(max(column - r, 0), column + r + 1)
        near, near_depth = rays[window].reshape(-1, 3), depth[window].ravel()
        near, near_depth = near[np.isfinite(near_depth)], near_depth[np.isfinite(near_depth)]
        assert found.points[row, column] == len(near)
        if np.isnan(depth[row, column]) or len(near) < limits.fewest_points:
            assert np.isnan(found.normals_camera[row, column]).all()
            continue
        g, square, *_ = np.linalg.lstsq(near, 1 / near_depth, rcond=None)
        np.testing.assert_allclose(found.normals_camera[row, column], -g / np.linalg.norm(g), atol=1e-9)
        rms = np.sqrt(square[0] / (len(near) - 3))
        z = 1 / (g @ rays[row, column])
        from_plane = rms * z**2 * abs(g @ rays[row, column]) / np.linalg.norm(g)
        np.testing.assert_allclose(found.residual_m[row, column], from_plane, rtol=1e-7)
        checked += 1
    assert checked > 30


def test_sigma_is_the_covariance_of_the_fit_carried_to_the_normal() -> None:
    camera = PinholeCamera(96, 80, 90.0, 70.0, -20.0, 10.0)
    random = np.random.default_rng(10)
    depth = plane_depth(camera, tilted(0.6, 0.4), 0.7) * (1 + 1e-3 * random.standard_normal((80, 96)))
    depth[random.random(depth.shape) < 0.3] = np.nan
    found = estimate_normals(depth, camera, NormalSettings(min_share=0.3, **NO_LIMITS))
    rays = camera.pixel_rays()
    ratios: list[float] = []
    for row, column in np.argwhere(np.isfinite(found.sigma_rad))[::60]:
        window = slice(max(row - 2, 0), row + 3), slice(max(column - 2, 0), column + 3)
        near, near_depth = rays[window].reshape(-1, 3), depth[window].ravel()
        near, near_depth = near[np.isfinite(near_depth)], near_depth[np.isfinite(near_depth)]
        g, square, *_ = np.linalg.lstsq(near, 1 / near_depth, rcond=None)
        unit = g / np.linalg.norm(g)
        across = (np.eye(3) - np.outer(unit, unit)) / np.linalg.norm(g)
        covariance = square[0] / (len(near) - 3) * across @ np.linalg.inv(near.T @ near) @ across
        ratios.append(found.sigma_rad[row, column] / np.sqrt(np.trace(covariance)))
    # where the residual is below that of the median window, the latter takes its place
    assert np.min(ratios) == pytest.approx(1.0, rel=5e-3)
    assert np.quantile(ratios, 0.4) == pytest.approx(1.0, rel=5e-3)


@pytest.mark.parametrize("window_px", [3, 7])
def test_pca_is_the_least_variance_of_each_window(window_px: int) -> None:
    depth = noisy_map(np.random.default_rng(3))
    limits = NormalSettings(method="pca", window_px=window_px, min_share=0.3, **NO_LIMITS)
    found = estimate_normals(depth, CAMERA, limits)
    points = CAMERA.pixel_rays() * depth[..., None]
    r, checked = window_px // 2, 0
    for row, column in np.random.default_rng(4).integers((0, 0), depth.shape, (80, 2)):
        near = points[max(row - r, 0) : row + r + 1, max(column - r, 0) : column + r + 1].reshape(-1, 3)
        near = near[np.isfinite(near[:, 2])]
        if np.isnan(depth[row, column]) or len(near) < limits.fewest_points:
            continue
        _, singular, axes = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)
        if singular[2] > 0.9 * singular[1]:  # least of all by chance: digits are lost in both
            continue
        normal = axes[2] * -np.sign(axes[2] @ points[row, column])
        np.testing.assert_allclose(found.normals_camera[row, column], normal, atol=1e-9)
        np.testing.assert_allclose(found.residual_m[row, column], singular[2] / np.sqrt(len(near) - 3), rtol=1e-7)
        checked += 1
    assert checked > 30


@given(
    st.integers(0, 2**32 - 1), st.sampled_from(METHODS), st.sampled_from([3, 5, 9]),
    st.floats(0.05, 10.0), st.floats(0.0, 0.9),
)  # fmt: skip
@settings(max_examples=25)
def test_normals_are_unit_and_face_the_camera(
    seed: int, method: Method, window_px: int, distance_m: float, holes: float
) -> None:
    random = np.random.default_rng(seed)
    camera = PinholeCamera(19, 40, 300.0, 280.0, 5.0, 9.0)
    depth = distance_m * (1 + 0.01 * random.standard_normal((40, 19)).cumsum(axis=0))
    depth[(random.random(depth.shape) < holes) | (depth <= 0)] = np.nan
    if np.isnan(depth).all():
        return
    found = estimate_normals(depth, camera, NormalSettings(method=method, window_px=window_px))
    known = np.isfinite(found.normals_camera).all(axis=-1)
    assert not known[np.isnan(depth)].any()
    np.testing.assert_array_equal(known, np.isfinite(found.residual_m) & np.isfinite(found.sigma_rad))
    np.testing.assert_allclose(np.linalg.norm(found.normals_camera[known], axis=-1), 1.0, atol=1e-12)
    assert (np.sum(found.normals_camera * camera.pixel_rays(), axis=-1)[known] < 0).all()
    assert found.points.max() <= window_px**2


@pytest.mark.parametrize("method", METHODS)
def test_scaling_the_scene_scales_residuals_only(method: Method) -> None:
    depth = plane_depth(CAMERA, tilted(0.6, 0.3), 0.7)
    depth = depth * (1 + 1e-4 * np.random.default_rng(5).standard_normal(depth.shape))
    limits = NormalSettings(method=method)
    near, far = estimate_normals(depth, CAMERA, limits), estimate_normals(4.0 * depth, CAMERA, limits)
    np.testing.assert_allclose(far.normals_camera, near.normals_camera, atol=1e-9)
    np.testing.assert_allclose(far.residual_m, 4.0 * near.residual_m, rtol=1e-6)
    np.testing.assert_allclose(far.sigma_rad, near.sigma_rad, rtol=1e-6)


def sphere_errors(method: Method, radius_m: float) -> np.ndarray:
    """Errors where the sphere, nearest at 0.7 m, is seen at less than 40 degrees."""
    rays, centre = CAMERA.pixel_rays(), np.array([0.0, 0.0, 0.7 + radius_m])
    squared, along = np.sum(rays**2, axis=-1), rays @ centre
    root = along**2 - squared * (centre @ centre - radius_m**2)
    depth = (along - np.sqrt(np.where(root > 0, root, np.nan))) / squared
    true = (rays * depth[..., None] - centre) / radius_m
    found = estimate_normals(depth, CAMERA, NormalSettings(method=method))
    return angles(found, true)[true[..., 2] < -np.cos(np.deg2rad(40))]


@pytest.mark.parametrize("method", METHODS)
def test_a_sphere_shows_its_radii(method: Method) -> None:
    """A window sees the mean bend over itself: what is left falls with the square of its size over the radius."""
    errors = sphere_errors(method, 0.03)
    assert np.isfinite(errors).mean() > 0.95
    assert np.nanmax(errors) < 0.015
    assert np.nanmax(sphere_errors(method, 0.02)) > 1.8 * np.nanmax(errors)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("degrees", [0.0, 45.0, 70.0])
@pytest.mark.parametrize("window_px", [3, 5, 9])
@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_sigma_is_the_error_noise_makes(method: Method, degrees: float, window_px: int, holes: float) -> None:
    random = np.random.default_rng(int(degrees))
    normal = tilted(np.deg2rad(degrees), 0.5)
    depth = plane_depth(CAMERA, normal, 0.7)
    depth += 0.05e-3 * (depth / 0.7) ** 2 * random.standard_normal(depth.shape)
    depth[random.random(depth.shape) < holes] = np.nan
    found = estimate_normals(depth, CAMERA, NormalSettings(method=method, window_px=window_px))
    normalised = angles(found, normal) / found.sigma_rad
    assert np.isfinite(normalised).mean() > 0.9 * np.isfinite(depth).mean() - 0.2 * holes
    assert 0.8 < np.sqrt(np.nanmean(normalised**2)) < 1.25


@pytest.mark.parametrize("window_px", [3, 5, 9])
@pytest.mark.parametrize("smoothing_px", [0.7, 1.5])
def test_sigma_knows_of_noise_that_smoothing_hides(window_px: int, smoothing_px: float) -> None:
    from scipy.ndimage import gaussian_filter

    normal = tilted(0.6, 0.5)
    noise = gaussian_filter(np.random.default_rng(11).standard_normal((CAMERA.height, CAMERA.width)), smoothing_px)
    depth = plane_depth(CAMERA, normal, 0.7) + 0.05e-3 * noise / noise.std()
    found = estimate_normals(depth, CAMERA, NormalSettings(window_px=window_px, smoothing_px=smoothing_px))
    assert 0.8 < np.sqrt(np.nanmean((angles(found, normal) / found.sigma_rad) ** 2)) < 1.25


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("window_px", [3, 5, 7, 9, 15])
@pytest.mark.parametrize("step_m", [2e-3, 0.1])
@pytest.mark.parametrize("edge", ["vertical", "horizontal"])
def test_no_window_reaches_across_a_jump(method: Method, window_px: int, step_m: float, edge: str) -> None:
    normal = tilted(0.5, 0.3)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    beyond = columns > 50 if edge == "vertical" else rows > 41
    depth = np.where(beyond, plane_depth(CAMERA, normal, 0.7 + step_m), plane_depth(CAMERA, normal, 0.7))
    found = estimate_normals(depth, CAMERA, NormalSettings(method=method, window_px=window_px, max_residual=1e3))
    error = angles(found, normal)
    assert np.nanmax(error) < 1e-9
    lost = np.isnan(error[20:60, 20:80]).sum(axis=1 if edge == "vertical" else 0)
    assert (lost == 2 + 2 * ((window_px // 2 - 1) // 2)).all()


@pytest.mark.parametrize("window_px", [3, 5, 7, 15])
@pytest.mark.parametrize("slope", [0.5, 1.0, 3.0])
def test_corners_of_windows_beyond_an_oblique_jump_show_in_the_residual(window_px: int, slope: float) -> None:
    normal = tilted(0.5, 0.3)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    beyond = columns - 48 > slope * (rows - 40)
    depth = np.where(beyond, plane_depth(CAMERA, normal, 0.703), plane_depth(CAMERA, normal, 0.7))
    error = angles(estimate_normals(depth, CAMERA, NormalSettings(window_px=window_px)), normal)
    assert np.nanmax(error) < 1e-9
    assert np.isfinite(error[2:-2, 2:-2]).mean() > 1 - 0.02 * (window_px + 2)


def folds(camera: PinholeCamera, distance_m: float) -> np.ndarray:
    """Depth of a fold that is flat in the first row and sharp in the last."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    slope = 2.0 * rows / camera.height
    return distance_m * (1.0 + slope * np.abs(columns - 48) / camera.fx)


def test_limits_mean_the_same_at_all_distances_and_to_both_methods() -> None:
    dropped = {
        (method, distance_m): np.isnan(estimate_normals(folds(CAMERA, distance_m), CAMERA, each).residual_m)[2:-2, 2:-2]
        for method in METHODS
        for each in [NormalSettings(method=method)]
        for distance_m in (0.07, 0.7, 7.0)
    }
    for method in METHODS:
        one = dropped[method, 0.7]
        assert 20 < one.sum() < 400
        assert (one != dropped[method, 0.07]).sum() <= 2
        assert (one != dropped[method, 7.0]).sum() <= 2
    # least deviation along the ray and across the plane differ a little where the fold is sharp
    assert (dropped["pca", 0.7] != dropped["inverse_depth", 0.7]).mean() < 0.01


def test_noise_hides_no_sharp_fold_and_makes_no_edges() -> None:
    random = np.random.default_rng(6)
    depth = folds(CAMERA, 0.7)
    noisy = depth + 0.06e-3 * random.standard_normal(depth.shape)
    found = estimate_normals(noisy, CAMERA)
    assert np.isnan(found.residual_m[60:78, 47:50]).mean() > 0.95
    assert np.isfinite(found.residual_m[2:-2, :40]).mean() > 0.99
    rough = plane_depth(CAMERA, tilted(0.5, 0.3), 0.7) + 0.5e-3 * random.standard_normal(depth.shape)
    assert np.isfinite(estimate_normals(rough, CAMERA).residual_m[2:-2, 2:-2]).mean() > 0.97


def test_a_jump_hidden_by_a_hole_shows_in_the_residual() -> None:
    columns = np.mgrid[: CAMERA.height, : CAMERA.width][1]
    depth = np.where(columns > 50, 0.71, 0.70)
    depth[:, 50] = np.nan
    found = estimate_normals(depth, CAMERA)
    assert np.nanmax(angles(found, np.array([0.0, 0.0, -1.0]))) < 1e-9
    kept = estimate_normals(depth, CAMERA, NormalSettings(max_residual=1e3))
    assert np.nanmax(angles(kept, np.array([0.0, 0.0, -1.0]))) > 0.5


@pytest.mark.parametrize("method", METHODS)
def test_a_sharp_crease_has_no_normal_and_leaves_its_sides_alone(method: Method) -> None:
    left, right = tilted(0.75, np.pi), tilted(0.75, 0.0)
    sides = [plane_depth(CAMERA, normal, 0.7) for normal in (left, right)]
    depth = np.fmax(*sides)  # a roof of 94 degrees, seen from outside: the nearer plane is the one further outside
    middle = CAMERA.width // 2
    found = estimate_normals(depth, CAMERA, NormalSettings(method=method))
    columns = np.arange(CAMERA.width)
    true = np.where((sides[0] >= sides[1])[..., None], left, right)
    assert np.isnan(found.normals_camera[:, middle - 1 : middle + 1]).all()
    apart = np.abs(columns - middle) > 3
    assert np.nanmax(angles(found, true)[:, apart]) < 1e-9
    assert np.isfinite(found.normals_camera[2:-2, apart]).all()


def test_depth_in_coarse_steps_keeps_a_sigma() -> None:
    """A window of equal counts fits a plane perfectly; that it is perfect is chance."""
    normal = tilted(0.02, 0.4)
    random = np.random.default_rng(9)
    depth = plane_depth(CAMERA, normal, 0.7) + 10e-6 * random.standard_normal((CAMERA.height, CAMERA.width))
    found = estimate_normals(np.rint(depth / 31.25e-6) * 31.25e-6, CAMERA)
    normalised = angles(found, normal) / found.sigma_rad
    assert (found.sigma_rad[np.isfinite(normalised)] > 1e-3).all()
    assert 0.5 < np.sqrt(np.nanmean(normalised**2)) < 1.5


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", ["row", "column", "diagonal", "point"])
def test_points_on_a_line_have_no_normal(method: Method, shape: str) -> None:
    depth = np.full((CAMERA.height, CAMERA.width), np.nan)
    index = np.arange(60)
    where = {"row": (7, index), "column": (index, 7), "diagonal": (index, index), "point": (3, 3)}[shape]
    depth[where] = 0.7 + 1e-4 * np.random.default_rng(0).standard_normal(60 if shape != "point" else ())
    found = estimate_normals(depth, CAMERA, NormalSettings(method=method, min_share=0.01))
    assert np.isnan(found.normals_camera).all()
    assert np.isnan(found.sigma_rad).all()
    assert found.points.max() == (5 if shape != "point" else 1)


def test_pca_agrees_with_open3d_on_the_same_points() -> None:
    import open3d as o3d

    random = np.random.default_rng(7)
    normal = tilted(0.0, 0.0)
    camera = PinholeCamera(96, 80, 1083.0, 1083.0, 40.0, 45.0)
    depth = plane_depth(camera, normal, 0.7) + 0.05e-3 * random.standard_normal((80, 96))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector((camera.pixel_rays() * depth[..., None]).reshape(-1, 3)))
    # on this plane a ball of 1.2 px holds a cross of 5 points, one of 2.95 px 25: a square of 5x5 has its corners at
    # 2.83 px, the next pixels are at 3 px
    spacing_m = 0.7 / camera.fx
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(2.93 * spacing_m))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    theirs = np.asarray(cloud.normals).reshape(80, 96, 3)[10:70, 10:86]
    ours = estimate_normals(depth, camera, NormalSettings(method="pca")).normals_camera[10:70, 10:86]
    apart = np.linalg.norm(np.cross(ours, theirs), axis=-1)
    assert np.nanmedian(apart) < 1e-6


def test_both_methods_agree_where_noise_is_small() -> None:
    depth = plane_depth(CAMERA, tilted(0.8, 1.0), 0.7)
    depth += 0.02e-3 * np.random.default_rng(8).standard_normal(depth.shape)
    one, other = (estimate_normals(depth, CAMERA, NormalSettings(method=method)) for method in METHODS)
    apart = np.linalg.norm(np.cross(one.normals_camera, other.normals_camera), axis=-1)
    assert np.nanmedian(apart) < 0.15 * np.nanmedian(one.sigma_rad)
    np.testing.assert_allclose(np.nanmedian(other.sigma_rad), np.nanmedian(one.sigma_rad), rtol=0.05)


FLAT = np.full((CAMERA.height, CAMERA.width), 0.7)


@pytest.mark.parametrize(
    ("value", "message"),
    [(0.0, r"0\.0 m at row 4, column 6"), (-0.7, r"-0\.7 m"), (np.inf, "inf m"), (-np.inf, "-inf")],
)
def test_depths_that_are_none_are_refused(value: float, message: str) -> None:
    depth = FLAT.copy()
    depth[4, 6] = value
    with pytest.raises(DepthError, match=message):
        estimate_normals(depth, CAMERA)


def test_a_map_without_depth_is_refused() -> None:
    with pytest.raises(DepthError, match="0 of 7680 px are measured"):
        estimate_normals(np.full_like(FLAT, np.nan), CAMERA)


@pytest.mark.parametrize("shape", [(96, 80), (80, 96, 1), (80,), (80, 95)])
def test_a_map_of_another_size_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ImageError, match=r"\(80, 96\) rows and columns"):
        estimate_normals(np.full(shape, 0.7), CAMERA)


@pytest.mark.parametrize(("width", "height"), [(4, 80), (80, 4), (80, 1), (1, 1)])
def test_a_window_larger_than_the_image_is_refused(width: int, height: int) -> None:
    camera = PinholeCamera(width, height, 300.0, 300.0, 2.0, 2.0)
    with pytest.raises(SettingsError, match=rf"window_px is 5 px, limit {min(width, height)} px"):
        estimate_normals(np.full((height, width), 0.7), camera)


def test_the_smallest_image_has_a_normal() -> None:
    camera = PinholeCamera(3, 3, 300.0, 300.0, 1.0, 1.0)
    found = estimate_normals(np.full((3, 3), 0.7), camera, NormalSettings(window_px=3))
    np.testing.assert_allclose(found.normals_camera[1, 1], [0.0, 0.0, -1.0], atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        {"window_px": 4}, {"window_px": 1}, {"window_px": 17}, {"min_share": 0.0}, {"min_share": 1.1},
        {"edge_step": 0.0}, {"max_residual": float("nan")}, {"method": "ransac"}, {"window": 5},
    ],
)  # fmt: skip
def test_settings_outside_their_bounds_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        NormalSettings(**wrong)  # pyright: ignore[reportArgumentType]


def test_the_input_is_left_alone() -> None:
    depth = FLAT.copy()
    depth[3, 3] = np.nan
    before = depth.copy()
    depth.flags.writeable = False
    estimate_normals(depth, CAMERA)
    np.testing.assert_array_equal(depth, before)
