"""The projector's intensity from one white image."""

from __future__ import annotations

import numpy as np
import pytest

from sidelong.calibration.projector.white_image import fit_intensity
from sidelong.devices import CaptureRequest
from sidelong.errors import InputError
from sidelong.geometry.transforms import look_at
from sidelong.recipe import Recipe, light_model
from sidelong.types import Frame, Projector
from sidelong_drivers.simulated import SimulatedCamera, SimulatedCameraSettings

POSE = look_at((0.5, 0.001, 0.7), (0.5, 0.0, 0.0))


@pytest.fixture(scope="module")
def camera() -> SimulatedCamera:
    """A bin of gears whose faces saturate from above: of all intensities the absurd ones miss its grey levels least."""
    opened = SimulatedCamera(SimulatedCameraSettings(part="gear", seed=12))
    opened.open()
    return opened


@pytest.fixture(scope="module")
def white(camera: SimulatedCamera) -> Frame:
    return camera.capture(CaptureRequest(Projector.WHITE, 0.012), POSE)


def test_an_image_that_mostly_saturates_gives_no_absurd_intensity(camera: SimulatedCamera, white: Frame) -> None:
    fit = fit_intensity(white, camera.base_T_objects, camera.part, camera.rig, light_model(Recipe(), camera.part))
    assert 200 < fit.intensity < 1500


def test_twice_the_exposure_is_half_the_intensity_for_the_same_image(camera: SimulatedCamera, white: Frame) -> None:
    light = light_model(Recipe(), camera.part)
    twice = Frame(white.view, white.left, None, None, Projector.WHITE, 2 * white.exposure_s)
    first, second = (fit_intensity(f, camera.base_T_objects, camera.part, camera.rig, light) for f in (white, twice))
    assert second.intensity == pytest.approx(first.intensity / 2, rel=1e-3)
    assert second.mean_error_grey == pytest.approx(first.mean_error_grey, rel=1e-3)


@pytest.mark.parametrize("grey", [0, 255])
def test_an_image_without_shades_says_nothing_of_the_light(camera: SimulatedCamera, white: Frame, grey: int) -> None:
    flat = Frame(white.view, np.full_like(white.left, grey), None, None, Projector.WHITE, white.exposure_s)
    with pytest.raises(InputError, match="0 part pixels lie between grey levels 8 and 247"):
        fit_intensity(flat, camera.base_T_objects, camera.part, camera.rig, light_model(Recipe(), camera.part))
