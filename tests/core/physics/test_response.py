"""Equations (6), (8), (9): the response and its inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidelong.errors import SettingsError
from sidelong.physics.response import Response


@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.2])
def test_gamma_response_is_its_closed_form(gamma: float) -> None:
    levels = np.arange(1, 256)
    exposure = (levels / 255.0) ** gamma
    np.testing.assert_allclose(Response.gamma(gamma).intensity(exposure / 0.01, 0.01), levels, atol=1e-9)


@given(st.floats(1.0, 254.0), st.floats(1e-6, 10.0))
def test_radiance_inverts_intensity(level: float, exposure_s: float) -> None:
    response = Response.gamma(1.7)
    assert float(response.intensity(response.radiance(level, exposure_s), exposure_s)) == pytest.approx(level, abs=1e-6)


def test_black_and_white_bound_the_radiance_on_one_side_only() -> None:
    assert np.isnan(Response.gamma().radiance([0, 255], 0.01)).all()


def test_saturation_is_decided_on_the_exposure_not_on_the_grey_level() -> None:
    response = Response.gamma()
    e = np.array([0.99, 1.0, 50.0])
    assert response.saturated(e, 1.0).tolist() == [False, True, True]
    assert response.intensity(e, 1.0).max() == 255.0


@given(st.lists(st.floats(0, 1e9), min_size=2, max_size=20))
def test_intensity_never_falls_with_exposure_and_stays_on_the_scale(values: list[float]) -> None:
    z = Response.gamma(2.0).intensity(np.sort(values), 0.012)
    assert (np.diff(z) >= 0).all()
    assert ((z >= 0) & (z <= 255)).all()


def test_no_light_is_black() -> None:
    assert Response.gamma().intensity(np.array([0.0]), 0.01)[0] == 0.0


def test_tables_that_are_no_response_are_refused() -> None:
    rising = np.linspace(-5, 0, 256)
    folded = rising.copy()
    folded[100] = folded[99]
    with pytest.raises(SettingsError, match="does not rise at Z = 100"):
        Response(folded)
    with pytest.raises(SettingsError, match=r"\(255,\), needs \(256,\)"):
        Response(rising[1:])
    with pytest.raises(SettingsError, match="not finite"):
        Response(np.where(np.arange(256) == 3, np.nan, rising))
    with pytest.raises(SettingsError, match="gamma is 0"):
        Response.gamma(0.0)
