"""The matcher measures what can be matched, with the accuracy of sub-pixel matching, and keeps silent elsewhere."""

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from sidelong.errors import ImageError, SettingsError
from sidelong.simulation.rig import rig_for
from sidelong.simulation.stereo import StereoSettings, match

RIG = rig_for(320, 256)
SETTINGS = StereoSettings(min_depth_m=0.5, max_depth_m=1.0)


def textures(count=8, seed=0):
    """Band-limited noise, wider than an image."""
    noise = np.random.default_rng(seed).standard_normal((count, 256, 640)).astype(np.float32)
    return [np.clip(128 + 90 * cv2.GaussianBlur(each, (0, 0), 1.2) / 0.24 * 0.5, 0, 255) for each in noise]


def seen(texture, disparity_px):
    """What the right camera sees of a left image's texture at a disparity map over right pixels."""
    v, u = np.mgrid[0:256, 0:320].astype(np.float32)
    return cv2.remap(texture, (u + 160.0 + disparity_px).astype(np.float32), v, cv2.INTER_CUBIC)


def rounded(image):
    return np.rint(np.clip(image, 0, 255)).astype(np.uint8)


def pair(disparity_px, count=8):
    images = textures(count)
    left = [rounded(image[:, 160:480]) for image in images]
    return left, [rounded(seen(image, disparity_px)) for image in images]


@pytest.mark.parametrize("depth_m", [0.6, 0.7213, 0.85])
def test_a_plane_is_measured_to_a_twentieth_of_a_pixel(depth_m):
    disparity_px = float(RIG.disparity_px(np.array(depth_m)))
    measured = match(*pair(disparity_px), RIG, SETTINGS)
    inside = measured[10:-10, 10 : 320 - int(abs(disparity_px)) - 15]
    pixel_m = depth_m**2 / (RIG.left.fx * RIG.baseline_m)
    assert np.isfinite(inside).mean() > 0.99
    assert abs(np.nanmedian(inside) - depth_m) < 0.05 * pixel_m
    assert np.nanmedian(np.abs(inside - depth_m)) < 0.05 * pixel_m


def test_pixels_the_right_camera_does_not_see_have_no_depth():
    # a near square in front of a far plane hides a strip of the plane from the right camera
    near_m, far_m = 0.55, 0.9
    near, far = (float(RIG.disparity_px(np.array(z))) for z in (near_m, far_m))
    images, front = textures(seed=0), textures(seed=1)
    square_left = np.zeros((256, 320), dtype=bool)
    square_left[80:180, 60:130] = True
    square_right = np.zeros_like(square_left)
    square_right[80:180, round(60 - near) : round(130 - near)] = True
    left = [rounded(np.where(square_left, f[:, 160:480], b[:, 160:480])) for b, f in zip(images, front, strict=True)]
    right = [rounded(np.where(square_right, seen(f, near), seen(b, far))) for b, f in zip(images, front, strict=True)]
    measured = match(left, right, RIG, SETTINGS)
    hidden = np.zeros_like(square_left)
    hidden[85:175, 60 - round(near - far) + 1 : 60] = True
    assert round(near - far) >= 15
    assert np.isfinite(measured[hidden]).mean() < 0.05
    assert np.nanmedian(measured[90:170, 70:120]) == pytest.approx(near_m, abs=1e-3)
    assert np.nanmedian(measured[200:250, 20:130]) == pytest.approx(far_m, abs=3e-3)


def test_unrelated_noise_gives_next_to_no_depth():
    rng = np.random.default_rng(5)
    left, right = ([rng.integers(0, 256, (256, 320), dtype=np.uint8) for _ in range(8)] for _ in range(2))
    assert np.isfinite(match(left, right, RIG, SETTINGS)).mean() < 1e-3


def test_a_scene_that_does_not_change_with_the_pattern_gives_none():
    left, right = pair(-40.0)
    assert np.isnan(match([left[0]] * 8, [right[0]] * 8, RIG, SETTINGS)).all()


def test_clipped_images_give_none():
    white = [np.full((256, 320), 255, dtype=np.uint8)] * 8
    assert np.isnan(match(white, white, RIG, SETTINGS)).all()


def test_a_surface_out_of_the_interval_gives_no_depth():
    left, right = pair(float(RIG.disparity_px(np.array(0.7))))
    assert np.isfinite(match(left, right, RIG, StereoSettings(min_depth_m=0.9, max_depth_m=1.2))).mean() < 2e-3


def test_images_of_another_size_are_refused():
    left, right = pair(-40.0)
    with pytest.raises(ImageError, match=r"an image is \(128, 320\), the rig's images are \(256, 320\)"):
        match(left, [*right[:-1], right[-1][:128]], RIG, SETTINGS)


@pytest.mark.parametrize(("left", "right"), [(1, 1), (8, 7)])
def test_too_few_patterns_are_refused(left, right):
    image = np.zeros((256, 320), dtype=np.uint8)
    with pytest.raises(ImageError, match=f"{left} left and {right} right patterns"):
        match([image] * left, [image] * right, RIG, SETTINGS)


def test_settings_that_contradict_each_other_are_refused():
    with pytest.raises(ValidationError, match=r"min_depth_m 2.0 must be below max_depth_m 1.1"):
        StereoSettings(min_depth_m=2.0)
    with pytest.raises(ValidationError, match="window_px 4 must be odd"):
        StereoSettings(window_px=4)


def test_the_rig_is_that_of_the_data_set_and_scales():
    full, half = rig_for(1280, 1024), rig_for(640, 512)
    assert (full.left.fx, full.left.cx, full.right.cx, full.left.cy) == (1083.097, 379.327, 735.997, 509.437)
    assert half.disparity_px(np.array(0.7)) == pytest.approx(full.disparity_px(np.array(0.7)) / 2)
    axis = full.projector.left_T_projector[:3, 2]
    assert np.rad2deg(np.arctan2(axis[0], axis[2])) == pytest.approx(4.4, abs=0.01)


@pytest.mark.parametrize("size", [(640, 480), (40, 32), (0, 0)])
def test_a_size_the_sensor_has_not_is_refused(size):
    with pytest.raises(SettingsError, match=f"is {size[0]}x{size[1]} px, needs sides 5:4"):
        rig_for(*size)
