"""What measured depth says of matches and hypotheses, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from detection_scene import CAMERA, bracket, photograph, true_poses

from sidelong.detection.appearance import AppearanceModel
from sidelong.detection.depth_evidence import HEAP, DistanceBounds, offsets, residuals, sampled
from sidelong.detection.detector import TemplateDetector
from sidelong.detection.settings import DetectionSettings
from sidelong.errors import SettingsError
from sidelong.geometry.raycast import RayScene
from sidelong.types import FloatArray

LIMITS_M = (0.4, 1.2)
DIAMETER_M = 0.05
HERE = np.array([[40.0, 30.0]])
RADIUS_PX = np.array([10.0])


def bounds(depth_m: FloatArray | None) -> tuple[float, float]:
    near, far = DistanceBounds(depth_m, LIMITS_M, DIAMETER_M).at(HERE, RADIUS_PX)
    return float(near[0]), float(far[0])


def test_a_part_lies_on_what_is_measured_around_it_or_on_another_part():
    assert bounds(np.full((60, 80), 0.8)) == pytest.approx((0.8 - HEAP * DIAMETER_M, 0.8))


def test_the_depth_here_counts_and_not_the_one_elsewhere():
    depth_m = np.full((60, 80), 1.0)
    depth_m[15:45, 25:55] = 0.7
    assert bounds(depth_m) == pytest.approx((0.7 - HEAP * DIAMETER_M, 0.7))


def test_a_few_wild_depths_are_not_believed():
    depth_m = np.full((60, 80), 0.8)
    depth_m[30, 40] = 0.1
    depth_m[20, 30] = 5.0
    assert bounds(depth_m) == pytest.approx((0.8 - HEAP * DIAMETER_M, 0.8))


def test_where_nothing_is_measured_the_rest_of_the_map_decides():
    depth_m = np.full((60, 80), 0.9)
    depth_m[15:46, 25:56] = np.nan
    assert bounds(depth_m) == pytest.approx((0.9 - HEAP * DIAMETER_M, 0.9))


@pytest.mark.parametrize("depth_m", [None, np.full((60, 80), np.nan)])
def test_without_any_depth_the_limits_hold(depth_m: FloatArray | None):
    assert bounds(depth_m) == LIMITS_M


@pytest.mark.parametrize(("measured_m", "expected_m"), [(0.2, (0.4, 0.4)), (3.0, (1.2, 1.2))])
def test_depth_beyond_the_limits_leaves_the_nearest_limit(measured_m: float, expected_m: tuple[float, float]):
    assert bounds(np.full((60, 80), measured_m)) == pytest.approx(expected_m)


def test_a_part_at_the_border_of_the_image_is_bounded_too():
    near, far = DistanceBounds(np.full((60, 80), 0.8), LIMITS_M, DIAMETER_M).at(np.array([[-3.0, 59.0]]), RADIUS_PX)
    assert (near[0], far[0]) == pytest.approx((0.8 - HEAP * DIAMETER_M, 0.8))


def test_depth_is_sampled_at_pixel_centres_and_is_missing_outside():
    depth_m = np.arange(12, dtype=np.float64).reshape(3, 4)
    uv = np.array([[0.4, 0.4], [2.6, 1.2], [-0.6, 0.0], [4.0, 1.0], [1.0, 2.6]])
    np.testing.assert_array_equal(sampled(depth_m, uv), [0.0, 7.0, np.nan, np.nan, np.nan])


def test_the_offset_is_the_median_of_the_residuals_within_reach():
    residual_m = np.array([[0.001, 0.002, 0.003, 0.004, 0.005, 0.5, np.nan, -0.4]])
    assert offsets(residual_m, np.ones_like(residual_m, dtype=np.bool_), 0.02) == pytest.approx([0.003])


def test_too_few_measured_pixels_leave_the_distance_alone():
    residual_m = np.full((1, 100), np.nan)
    residual_m[0, :10] = 0.004
    assert offsets(residual_m, np.ones((1, 100), dtype=np.bool_), 0.02) == pytest.approx([0.0])
    assert offsets(np.full((1, 100), np.nan), np.ones((1, 100), dtype=np.bool_), 0.02) == pytest.approx([0.0])


def test_a_part_at_its_place_leaves_no_residual_and_one_that_is_further_leaves_its_distance():
    truth = true_poses()[0]
    depth_m = RayScene([(bracket(), truth)]).render(CAMERA, np.eye(4)).depth_m
    further = truth.copy()
    further[:3, 3] *= 1.01  # along the line of sight: the same pixels, nearly
    look = AppearanceModel(bracket(), CAMERA).look(np.stack([truth, further]))
    residual_m = residuals(look, depth_m)
    off_m = offsets(residual_m, look.covered, 0.03)
    assert off_m[0] == pytest.approx(0.0, abs=5e-4)
    assert off_m[1] == pytest.approx(-0.01 * truth[2, 3], abs=1e-3)


def test_measured_depth_corrects_the_distance_of_a_detection(tmp_path_factory: pytest.TempPathFactory):
    settings = DetectionSettings(view_step_deg=30, roll_step_deg=20, distance_m=(0.6, 0.8), span_px=48)
    truths = true_poses()
    seen = RayScene([(bracket(), pose) for pose in truths]).render(CAMERA, np.eye(4))
    # pixels drop out at random: a comb of measured columns can miss every pixel that a coarse grid looks at
    measured = np.random.default_rng(0).random(seen.depth_m.shape) < 1 / 3
    third = np.where(measured, np.nan_to_num(seen.depth_m, nan=0.75), np.nan)
    with TemplateDetector(bracket(), CAMERA, settings, tmp_path_factory.mktemp("templates")) as detector:
        image = photograph(bracket(), truths, CAMERA)
        blind, seeing = detector.detect(image), detector.detect(image, third)
    assert len(seeing) == 2
    errors_m = [
        [min(abs(found.hypotheses[0].camera_T_object[2, 3] - truth[2, 3]) for found in objects) for truth in truths]
        for objects in (blind, seeing)
    ]
    assert max(errors_m[1]) < 4e-3
    assert max(errors_m[1]) < max(errors_m[0])


@pytest.mark.parametrize("measured_m", [0.2, 1.4])
def test_distances_without_templates_are_refused_with_both_ranges(measured_m: float):
    with pytest.raises(SettingsError, match=rf"detection\.distance_m: is 0\.4 to 1\.2 m, .* between {measured_m}"):
        DistanceBounds(np.full((60, 80), measured_m), LIMITS_M, DIAMETER_M).check()


@pytest.mark.parametrize("measured_m", [0.41, 1.22, np.nan])
def test_distances_within_reach_and_unknown_ones_are_accepted(measured_m: float):
    DistanceBounds(np.full((60, 80), measured_m), LIMITS_M, DIAMETER_M).check()


def test_settings_reach_what_a_scene_needs_in_steps_that_scenes_share():
    settings = DetectionSettings(distance_ratio=1.1)
    near_m, far_m = settings.reaching(0.60, 0.88).reach_m
    assert 0.60 / 1.1 < near_m <= 0.60
    assert 0.88 <= far_m < 0.88 * 1.1
    assert settings.reaching(0.58, 0.90).reach_m == (near_m, far_m)
    declared = DetectionSettings(distance_m=(0.5, 0.6))
    assert declared.reaching(0.62, 0.88).reach_m == (0.5, 0.6)
