"""Pinhole cameras, the stereo pair and the projector's cone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidelong.errors import SettingsError
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig

CAMERA = PinholeCamera(width=1280, height=1024, fx=1083.1, fy=1079.3, cx=379.3, cy=509.4)
LAMP = LightProjector(np.eye(4), half_width_rad=0.5, half_height_rad=0.3)


def rig(cx_right: float = 379.3) -> StereoRig:
    right = PinholeCamera(width=1280, height=1024, fx=1083.1, fy=1079.3, cx=cx_right, cy=509.4)
    return StereoRig(CAMERA, right, baseline_m=0.1, projector=LAMP)


@given(st.floats(-100, 1400), st.floats(-100, 1200), st.floats(0.01, 100))
def test_rays_lead_back_to_their_pixel_at_any_depth(u: float, v: float, z: float) -> None:
    ray = CAMERA.rays(np.array(u), np.array(v))
    assert ray[2] == 1.0
    np.testing.assert_allclose(CAMERA.project(ray * z), (u, v), atol=1e-9)


def test_pixel_rays_hold_the_ray_of_each_pixel() -> None:
    rays = CAMERA.pixel_rays()
    assert rays.shape == (1024, 1280, 3)
    np.testing.assert_array_equal(rays[17, 900], CAMERA.rays(np.array(900.0), np.array(17.0)))
    np.testing.assert_allclose(CAMERA.project(rays)[17, 900], (900, 17), atol=1e-12)


def test_projection_agrees_with_opencv() -> None:
    import cv2

    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.2 + (0, 0, 1)
    K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.zeros(5))
    np.testing.assert_allclose(CAMERA.project(points), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("z", [0.0, -0.5, np.nan])
def test_points_not_in_front_project_to_nan(z: float) -> None:
    uv = CAMERA.project(np.array([[0.0, 0.0, 0.7], [0.01, 0.02, z]]))
    np.testing.assert_allclose(uv[0], (CAMERA.cx, CAMERA.cy))
    assert np.isnan(uv[1]).all()
    assert CAMERA.contains(uv).tolist() == [True, False]


def test_an_image_ends_half_a_pixel_beyond_its_outer_centres() -> None:
    inside = [(-0.5, -0.5), (1279.49, 1023.49), (0.0, 0.0)]
    outside = [(-0.51, 0.0), (0.0, -0.51), (1279.5, 0.0), (0.0, 1023.5), (np.nan, 5.0)]
    assert CAMERA.contains(np.array(inside)).all()
    assert not CAMERA.contains(np.array(outside)).any()


@given(st.sampled_from([0.25, 0.5, 2.0]), st.floats(0, 1), st.floats(0, 1))
def test_a_resized_image_shows_the_same_ray_at_the_same_share_of_its_area(factor: float, s: float, t: float) -> None:
    small = CAMERA.scaled(factor)
    assert (small.width, small.height) == (1280 * factor, 1024 * factor)
    large_ray = CAMERA.rays(np.array(s * 1280 - 0.5), np.array(t * 1024 - 0.5))
    small_ray = small.rays(np.array(s * small.width - 0.5), np.array(t * small.height - 0.5))
    np.testing.assert_allclose(small_ray, large_ray, atol=1e-12)


def test_scaling_there_and_back_is_the_camera_again() -> None:
    again = CAMERA.scaled(0.5).scaled(2.0)
    assert (again.width, again.height) == (CAMERA.width, CAMERA.height)
    assert [again.fx, again.fy, again.cx, again.cy] == pytest.approx([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])


@given(st.floats(0.2, 5.0), st.floats(300, 460))
def test_disparity_and_depth_are_inverse_also_where_the_centres_differ(depth_m: float, cx_right: float) -> None:
    pair = rig(cx_right)
    assert pair.depth_m(pair.disparity_px(np.array(depth_m))) == pytest.approx(depth_m, rel=1e-12)


@given(st.floats(-0.2, 0.2), st.floats(0.3, 2.0), st.floats(300, 460))
def test_disparity_is_the_difference_of_the_two_projections(x: float, z: float, cx_right: float) -> None:
    pair = rig(cx_right)
    point_left = np.array([x, 0.03, z])
    point_right = point_left - pair.left_T_right[:3, 3]
    difference = pair.left.project(point_left)[0] - pair.right.project(point_right)[0]
    assert pair.disparity_px(np.array(z)) == pytest.approx(difference, abs=1e-9)


def test_disparity_follows_the_size_of_the_images() -> None:
    full, half = rig(400.0), rig(400.0).scaled(0.5)
    assert half.disparity_px(np.array(0.7)) == pytest.approx(full.disparity_px(np.array(0.7)) / 2)


def test_rays_that_do_not_meet_in_front_have_no_depth() -> None:
    assert np.isnan(rig().depth_m(np.array([0.0, -3.0, np.nan]))).all()
    # centres 20 px apart: infinity lies at -20 px
    assert np.isnan(rig(cx_right=399.3).depth_m(np.array([-20.0, -25.0]))).all()
    assert rig(cx_right=399.3).depth_m(np.array(-19.0)) == pytest.approx(108.31)


def test_the_projector_lights_a_cone_in_front_of_it() -> None:
    edge_x, edge_y = np.tan(0.5), np.tan(0.3)
    points = np.array([
        (0.0, 0.0, 1.0), (0.99 * edge_x, 0.99 * edge_y, 1.0), (-0.99 * edge_x, -0.99 * edge_y, 1.0),
        (1.01 * edge_x, 0.0, 1.0), (0.0, -1.01 * edge_y, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), (np.nan, 0.0, 1.0),
    ])  # fmt: skip
    assert LAMP.lights(points).tolist() == [True, True, True, False, False, False, False, False]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "camera: size is 0x1024 px, needs at least 1x1"),
        ({"height": -3}, "camera: size is 1280x-3 px"),
        ({"fx": 0.0}, r"camera: focal lengths are 0\.0, 1079\.3 px, need positive finite numbers"),
        ({"fy": -5.0}, r"camera: focal lengths are 1083\.1, -5\.0 px"),
        ({"fx": np.nan}, "camera: focal lengths are nan"),
        ({"fx": np.inf}, "camera: focal lengths are inf"),
    ],
)
def test_cameras_that_cannot_be_are_refused(change: dict[str, float], message: str) -> None:
    settings = {"width": 1280, "height": 1024, "fx": 1083.1, "fy": 1079.3, "cx": 379.3, "cy": 509.4}
    with pytest.raises(SettingsError, match=message):
        PinholeCamera(**(settings | change))  # type: ignore[arg-type]


def test_a_principal_point_that_is_not_finite_is_refused_by_name() -> None:
    with pytest.raises(SettingsError, match=r"camera: principal point is nan, 509\.4 px, needs finite numbers"):
        PinholeCamera(width=1280, height=1024, fx=1083.1, fy=1079.3, cx=np.nan, cy=509.4)


def test_an_image_scaled_to_nothing_is_refused() -> None:
    with pytest.raises(SettingsError, match="camera: size is 0x0 px"):
        CAMERA.scaled(1e-4)


@pytest.mark.parametrize("baseline_m", [0.0, -0.1, np.nan, np.inf])
def test_a_rig_needs_a_baseline(baseline_m: float) -> None:
    with pytest.raises(SettingsError, match=rf"rig: baseline is {baseline_m} m, needs a positive number"):
        StereoRig(CAMERA, CAMERA, baseline_m, LAMP)


def test_a_rig_needs_images_of_one_size() -> None:
    with pytest.raises(SettingsError, match="rig: left and right images differ in size"):
        StereoRig(CAMERA, CAMERA.scaled(0.5), 0.1, LAMP)


@pytest.mark.parametrize("angle_rad", [0.0, -0.2, 1.6, np.nan])
def test_a_projector_needs_an_angle_below_a_right_one(angle_rad: float) -> None:
    with pytest.raises(SettingsError, match=rf"projector: half_height_rad is {angle_rad} rad, limits 0 to pi/2"):
        LightProjector(np.eye(4), 0.5, angle_rad)
