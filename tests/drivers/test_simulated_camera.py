"""The simulated camera as a device: opening, refusing, repeating, and knowing the truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from sidelong.devices import Camera, CaptureRequest
from sidelong.errors import DeviceUnavailableError, PoseError, SettingsError, UnknownNameError
from sidelong.geometry.transforms import look_at
from sidelong.types import Projector
from sidelong_drivers.simulated import SimulatedCamera, SimulatedCameraSettings

POSE = look_at((0.5, 0.05, 0.7), (0.5, 0.0, 0.0))
OFF = CaptureRequest(Projector.OFF, 0.2)
DOTS = CaptureRequest(Projector.DOTS, 0.012, depth=True)


def small(**changes):
    return SimulatedCamera(SimulatedCamera.Settings(**{"width": 320, "height": 256, "count": 6, **changes}))


@pytest.fixture(scope="module")
def camera():
    device = small()
    device.open()
    yield device
    device.close()


def test_it_is_a_camera_and_its_defaults_open_without_any_file():
    device: Camera = SimulatedCamera(SimulatedCameraSettings())
    device.open()
    assert (device.rig.left.width, device.rig.left.height) == (640, 512)
    device.close()


def test_a_frame_carries_what_was_asked_for(camera):
    frame = camera.capture(DOTS, POSE)
    assert frame.left.shape == frame.right.shape == frame.depth_m.shape == (256, 320)
    assert frame.left.dtype == np.uint8
    assert (frame.projector, frame.exposure_s) == (Projector.DOTS, 0.012)
    assert np.allclose(frame.view.base_T_camera, POSE)
    assert frame.started_s < frame.ended_s
    assert camera.capture(OFF, POSE).depth_m is None


def test_dots_show_texture_white_does_not_and_off_is_darker(camera):
    images = {kind: camera.capture(CaptureRequest(kind, 0.012), POSE).left[20:50, 60:200] for kind in Projector}
    assert images[Projector.DOTS].std() > 3 * images[Projector.WHITE].std()
    assert images[Projector.OFF].mean() < 0.2 * images[Projector.WHITE].mean()


def test_it_repeats_itself_and_so_does_another_with_the_same_settings(camera):
    twin = small()
    twin.open()
    frames = [device.capture(DOTS, POSE) for device in (camera, camera, twin)]
    for frame in frames[1:]:
        assert np.array_equal(frame.left, frames[0].left)
        assert np.array_equal(frame.depth_m, frames[0].depth_m, equal_nan=True)


def test_another_seed_is_another_bin(camera):
    other = small(seed=1)
    other.open()
    assert not np.allclose(other.base_T_objects[0], camera.base_T_objects[0])


def test_truth_and_measurement_agree_on_the_bin(camera):
    depth_m, truth_m = camera.capture(DOTS, POSE).depth_m, camera.true_depth_m(POSE)
    assert np.nanmedian(np.abs(depth_m - truth_m)) < 2e-3  # a tenth of a pixel at this image size
    assert np.isfinite(truth_m).mean() > np.isfinite(depth_m).mean()


def test_the_bin_stands_where_the_settings_say():
    device = small(bin_origin_m=(0.1, -0.2, 0.3))
    device.open()
    positions = np.array([pose[:3, 3] for pose in device.base_T_objects])
    assert np.abs(positions[:, 0] - 0.1).max() < device.settings.bin.length_m / 2
    assert np.abs(positions[:, 1] + 0.2).max() < device.settings.bin.width_m / 2
    assert (positions[:, 2] > 0.3).all()


def test_the_camera_looks_along_the_flange(camera):
    assert np.array_equal(camera.flange_T_camera[:3, :3], np.eye(3))
    assert camera.flange_T_camera[:3, 3].tolist() == list(camera.settings.mount_m)


def test_an_empty_bin_is_a_bin():
    device = small(count=0)
    device.open()
    assert device.base_T_objects == ()
    assert np.isfinite(device.capture(DOTS, POSE).depth_m).any()


def test_before_open_and_after_close_everything_is_refused():
    device = small()
    device.close()
    for use in (
        lambda: device.rig,
        lambda: device.part,
        lambda: device.base_T_objects,
        lambda: device.capture(OFF, POSE),
        lambda: device.true_depth_m(POSE),
    ):
        with pytest.raises(DeviceUnavailableError, match="simulated camera: is not open"):
            use()
    device.open()
    device.close()
    device.close()
    with pytest.raises(DeviceUnavailableError, match="simulated camera: is not open"):
        device.capture(OFF, POSE)


@settings(max_examples=25, deadline=None)
@given(exposure_s=st.one_of(st.floats(max_value=9.9e-7), st.floats(min_value=10.001), st.just(float("nan"))))
def test_exposures_it_has_not_are_refused(camera, exposure_s):
    with pytest.raises(SettingsError, match=r"simulated camera: exposure is .* s, limits 1e-06 to 10 s"):
        camera.capture(CaptureRequest(Projector.WHITE, exposure_s), POSE)


def test_a_pose_that_is_none_is_refused(camera):
    with pytest.raises(PoseError, match="simulated camera: base_T_camera"):
        camera.capture(OFF, 2.0 * np.eye(4))


def test_an_unknown_part_is_refused_at_open():
    with pytest.raises(UnknownNameError, match="'teapot' is unknown"):
        small(part="teapot").open()


def test_too_many_parts_are_refused_at_open_and_it_stays_closed():
    device = small(count=200)
    with pytest.raises(SettingsError, match="bin count: 200 x tube_fitting do not fit"):
        device.open()
    with pytest.raises(DeviceUnavailableError, match="is not open"):
        device.capture(OFF, POSE)


def test_an_image_that_is_not_the_sensors_is_refused_at_open():
    with pytest.raises(SettingsError, match="image size: is 640x480 px, needs sides 5:4"):
        small(width=640, height=480).open()


@pytest.mark.parametrize("wrong", [{"count": -1}, {"width": 10}, {"bin_origin_m": (0, 0, float("nan"))}, {"colour": 1}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        small(**wrong)


def test_spray_leaves_parts_where_they_are_and_makes_their_depth_complete() -> None:
    empty, shiny, sprayed = small(count=0), small(), small(sprayed=True)
    for device in (empty, shiny, sprayed):
        device.open()
    truth = shiny.true_depth_m(POSE)
    np.testing.assert_array_equal(truth, sprayed.true_depth_m(POSE))
    on_parts = truth < empty.true_depth_m(POSE) - 1e-6
    shares = [np.isfinite(device.capture(DOTS, POSE).depth_m)[on_parts].mean() for device in (shiny, sprayed)]
    assert shares[0] < 0.6
    # what stays missing at this size are edges
    assert shares[1] > 0.7


def test_an_arm_that_errs_puts_the_camera_elsewhere_the_same_way_each_time(camera):
    """0.3 mm and 0.9 mrad: the frame says where the arm said it is, and shows what is seen from beside it."""
    erring = small(arm_shift_m=0.3e-3, arm_turn_rad=0.9e-3)
    erring.open()
    frames = [erring.capture(DOTS, POSE) for _ in range(2)]
    assert np.array_equal(frames[0].depth_m, frames[1].depth_m, equal_nan=True)
    assert np.allclose(frames[0].view.base_T_camera, POSE)
    moved_m = np.abs(erring.true_depth_m(POSE) - camera.true_depth_m(POSE))
    assert 1e-5 < np.nanmedian(moved_m) < 2e-3
    elsewhere = look_at((0.5, 0.06, 0.7), (0.5, 0.0, 0.0))
    offset = np.nanmedian(erring.true_depth_m(POSE) - camera.true_depth_m(POSE))
    assert abs(np.nanmedian(erring.true_depth_m(elsewhere) - camera.true_depth_m(elsewhere)) - offset) > 1e-6
