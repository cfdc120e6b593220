"""The pixel: its response rises, its noise has the size it should, it clips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sidelong.simulation.exposure import ExposureSettings, exposed, response


@given(knee=st.floats(0.1, 1e6), exposures=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)))
def test_the_response_rises_from_black_to_full(knee, exposures):
    low, high = response(np.sort(np.array(exposures)), knee)
    assert 0.0 <= low <= high <= 255.0
    assert response(np.array([0.0, 1.0, 7.0]), knee) == pytest.approx([0.0, 255.0, 255.0])


def test_a_response_without_knee_is_linear():
    assert response(np.array([0.25, 0.5]), 1e6) == pytest.approx([63.75, 127.5], rel=1e-5)


def test_noise_is_that_of_the_electrons():
    settings = ExposureSettings(blur_px=0.0, full_well_e=1000.0, read_noise_e=20.0, knee=1e6)
    image = exposed(np.full((400, 400), 0.5), 1.0, settings, np.random.default_rng(1)).astype(float)
    expected = np.hypot(np.sqrt(500.0), 20.0) / 1000.0 * 255.0
    assert image.mean() == pytest.approx(127.5, abs=0.1)
    # rounding to whole grey values adds a twelfth
    assert image.std() == pytest.approx(np.hypot(expected, np.sqrt(1 / 12)), rel=0.02)


@given(radiance=st.floats(0.0, 100.0), factor=st.floats(1.0, 10.0))
def test_a_longer_exposure_never_darkens(radiance, factor):
    quiet = ExposureSettings(read_noise_e=0.0, full_well_e=1e6)
    scene = np.full((8, 8), radiance)
    short, long = (exposed(scene, 0.01 * k, quiet, np.random.default_rng(3)) for k in (1.0, factor))
    # the same noise draw at both exposures; shot noise of a million electrons stays within a grey value
    assert (long.astype(int) >= short.astype(int) - 1).all()


def test_too_much_light_is_255_and_none_is_black():
    settings = ExposureSettings()
    rng = np.random.default_rng(0)
    assert (exposed(np.full((16, 16), 200.0), 0.012, settings, rng) == 255).all()
    assert exposed(np.zeros((64, 64)), 0.012, settings, rng).max() <= 3


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValidationError, match="full_well_e"):
        ExposureSettings(full_well_e=0.0)
