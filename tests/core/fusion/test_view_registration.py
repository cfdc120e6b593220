"""Small errors of the arm: what the geometry tells is put right, what it does not is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from fusion_scene import CAMERA, OTHERS, REFERENCE, bin_scene

from sidelong.fusion.registration import as_the_arm_says, register, smoothed
from sidelong.fusion.settings import RegistrationSettings
from sidelong.geometry.transforms import invert, rotation_about
from sidelong.types import Float32Array, FloatArray

SHAPE = (CAMERA.height, CAMERA.width)
SETTINGS = RegistrationSettings()
NOISE_M = 5e-5
FLOOR_NORMAL = np.array([0.0, 0.0, 1.0])


def measured(depth_m: FloatArray, seed: int) -> tuple[Float32Array, Float32Array]:
    """Return a depth map with noise, smoothed, and its standard deviation."""
    noisy = depth_m + NOISE_M * np.random.default_rng(seed).normal(size=SHAPE)
    return smoothed(noisy.astype(np.float32)), np.full(SHAPE, NOISE_M, dtype=np.float32)


def plane_m(base_T_camera: FloatArray) -> FloatArray:
    """Depth of the plane z = 0 of the base."""
    rays = CAMERA.pixel_rays() @ base_T_camera[:3, :3].T
    return -base_T_camera[2, 3] / rays[..., 2]


def off_by(reference_T_view: FloatArray, turn_rad: FloatArray, shift_m: FloatArray) -> FloatArray:
    moved = reference_T_view.copy()
    angle = float(np.linalg.norm(turn_rad))
    if angle > 0:
        moved[:3, :3] = rotation_about(turn_rad, angle) @ moved[:3, :3]
    moved[:3, 3] += shift_m
    return moved


def error_at_scene_m(found: FloatArray, true: FloatArray) -> FloatArray:
    """How far (3,) the point the reference looks at is moved."""
    point = np.array([0.0, 0.0, 0.7, 1.0])
    return (found @ invert(true) @ point - point)[:3]


def test_a_scene_with_relief_is_put_right() -> None:
    """Height at once to a few micrometres; what slides along the floor is told by the parts alone."""
    scene = bin_scene()
    before_m: list[FloatArray] = []
    after_m: list[FloatArray] = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        reference = measured(scene.render(CAMERA, REFERENCE).depth_m, 100 + seed)
        true = invert(REFERENCE) @ OTHERS[seed % 3]
        view = measured(scene.render(CAMERA, OTHERS[seed % 3]).depth_m, 200 + seed)
        arm = off_by(true, rng.normal(size=3) * 0.5e-3, rng.normal(size=3) * 0.2e-3)
        found = register(view, reference, arm, CAMERA, SETTINGS)
        before_m.append(error_at_scene_m(arm, true))
        after_m.append(error_at_scene_m(found.reference_T_view, true))
        assert found.shift_m == pytest.approx(np.linalg.norm(found.reference_T_view[:3, 3] - arm[:3, 3]), rel=1e-9)
        assert np.linalg.eigvalsh(found.covariance).min() > 0
    assert np.linalg.norm(after_m) < 0.5 * np.linalg.norm(before_m)
    assert np.abs(after_m)[:, 2].max() < 0.01e-3


@pytest.mark.parametrize("seed", range(6))
def test_the_covariance_is_honest(seed: int) -> None:
    """The squared error in units of the covariance has six degrees of freedom; the prior is what the arm did err."""
    scene, rng = bin_scene(), np.random.default_rng(seed)
    true = invert(REFERENCE) @ OTHERS[seed % 3]
    start = as_the_arm_says(true, SETTINGS)
    drawn = np.linalg.cholesky(start.covariance) @ rng.normal(size=6)
    arm = off_by(true, drawn[:3], drawn[3:])
    reference = measured(scene.render(CAMERA, REFERENCE).depth_m, 300 + seed)
    view = measured(scene.render(CAMERA, OTHERS[seed % 3]).depth_m, 400 + seed)
    found = register(view, reference, arm, CAMERA, SETTINGS)
    turned = found.reference_T_view[:3, :3] @ true[:3, :3].T
    turn = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / 2
    error = np.concatenate([turn, found.reference_T_view[:3, 3] - true[:3, 3]])
    assert error @ np.linalg.solve(found.covariance, error) < 20  # chi squared with 6: 1 in 400 by chance


def test_a_plane_tells_height_and_tilt_and_nothing_of_what_slides() -> None:
    true = invert(REFERENCE) @ OTHERS[0]
    view, reference = measured(plane_m(OTHERS[0]), 1), measured(plane_m(REFERENCE), 2)
    normal = REFERENCE[:3, :3].T @ FLOOR_NORMAL
    along = np.cross(normal, (0.0, 1.0, 0.0))
    lifted = register(view, reference, off_by(true, np.zeros(3), 0.4e-3 * normal), CAMERA, SETTINGS)
    assert abs(error_at_scene_m(lifted.reference_T_view, true) @ normal) < 0.01e-3
    slid = register(view, reference, off_by(true, np.zeros(3), 0.4e-3 * along), CAMERA, SETTINGS)
    assert error_at_scene_m(slid.reference_T_view, true) @ along == pytest.approx(0.4e-3, rel=0.3)
    # sigma knows: along the plane it is nearly that of the arm, across it far less
    point_sigma_m = [_sigma_at_scene_m(slid.covariance, slid.reference_T_view, each) for each in (along, normal)]
    arm = as_the_arm_says(true, SETTINGS)
    assert point_sigma_m[0] > 0.4 * _sigma_at_scene_m(arm.covariance, true, along)
    assert point_sigma_m[1] < 0.05 * _sigma_at_scene_m(arm.covariance, true, normal)


@pytest.mark.parametrize("quantum_m", [1e-12, 3.125e-5, 1e-4])
@pytest.mark.parametrize("sigma_m", [0.0, 5e-5])
def test_planes_without_noise_or_in_steps_are_no_singular_case(quantum_m: float, sigma_m: float) -> None:
    """What is told is told exactly, or to a fraction of a step; what is not, not at all: three directions have no noise
    and no information."""
    true = invert(REFERENCE) @ OTHERS[0]
    sigma = np.full(SHAPE, sigma_m, dtype=np.float32)
    depths = (np.round(plane_m(pose) / quantum_m) * quantum_m for pose in (OTHERS[0], REFERENCE))
    view, reference = ((smoothed(depth_m.astype(np.float32)), sigma) for depth_m in depths)
    arm = off_by(true, np.zeros(3), np.array([0.4e-3, 0.3e-3, 0.2e-3]))
    found = register(view, reference, arm, CAMERA, SETTINGS)
    x, y, z = error_at_scene_m(found.reference_T_view, true)
    assert abs(z) < max(0.05 * quantum_m, 3e-6)
    assert (x, y) == pytest.approx((0.4e-3, 0.3e-3), abs=0.03e-3)
    assert np.linalg.eigvalsh(found.covariance).min() > 0


def test_a_faced_plane_seen_from_beside_itself_is_left_where_it_is() -> None:
    beside = off_by(np.eye(4), np.zeros(3), np.array([0.05, 0.0, 0.0]))
    flat = smoothed(np.full(SHAPE, 0.5, dtype=np.float32)), np.full(SHAPE, NOISE_M, dtype=np.float32)
    found = register(flat, flat, beside, CAMERA, SETTINGS)
    np.testing.assert_allclose(found.reference_T_view, beside, atol=1e-9)
    assert np.isfinite(found.covariance).all()


def _sigma_at_scene_m(covariance: FloatArray, reference_T_view: FloatArray, direction: FloatArray) -> float:
    arm = np.array([0.0, 0.0, 0.7]) - reference_T_view[:3, 3]
    moved = np.concatenate([np.cross(arm, direction), direction])
    return float(np.sqrt(moved @ covariance @ moved))


@pytest.mark.parametrize("shared", ["nothing", "elsewhere", "behind"])
def test_views_that_share_nothing_are_where_the_arm_says(shared: str) -> None:
    scene = bin_scene()
    true = invert(REFERENCE) @ OTHERS[0]
    reference = measured(scene.render(CAMERA, REFERENCE).depth_m, 1)
    view = measured(scene.render(CAMERA, OTHERS[0]).depth_m, 2)
    if shared == "nothing":
        view = np.full(SHAPE, np.nan, dtype=np.float32), view[1]
    elif shared == "elsewhere":
        true = off_by(true, np.zeros(3), np.array([5.0, 0.0, 0.0]))
    else:
        true = off_by(true, np.zeros(3), np.array([0.0, 0.0, -5.0]))
    found = register(view, reference, true, CAMERA, SETTINGS)
    np.testing.assert_array_equal(found.reference_T_view, true)
    np.testing.assert_array_equal(found.covariance, as_the_arm_says(true, SETTINGS).covariance)
    assert found.shared_points == 0


def test_outliers_do_not_pull() -> None:
    """A third of the view's depths are anything within 30 mm."""
    scene, rng = bin_scene(), np.random.default_rng(3)
    true = invert(REFERENCE) @ OTHERS[1]
    reference = measured(scene.render(CAMERA, REFERENCE).depth_m, 1)
    view, sigma_m = measured(scene.render(CAMERA, OTHERS[1]).depth_m, 2)
    wild = rng.random(SHAPE) < 0.33
    view = np.where(wild, view + rng.uniform(-0.03, 0.03, SHAPE), view).astype(np.float32)
    found = register((view, sigma_m), reference, off_by(true, np.zeros(3), np.full(3, 0.2e-3)), CAMERA, SETTINGS)
    assert abs(error_at_scene_m(found.reference_T_view, true)[2]) < 0.05e-3


def test_smoothing_keeps_planes_and_gaps() -> None:
    depth_m = plane_m(OTHERS[0]).astype(np.float32)
    depth_m[100, 100] = np.nan
    smooth = smoothed(depth_m)
    inside = np.isfinite(smooth)
    np.testing.assert_allclose(smooth[inside], depth_m[inside], rtol=1e-5)
    assert np.isnan(smooth[97:104, 97:104]).all()
    assert inside[90, 90]
