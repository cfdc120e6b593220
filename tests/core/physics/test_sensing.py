"""Equation (7): the probability of depth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sidelong.physics.sensing import SensingSettings, both_cameras, sensing_probability

SETTINGS = SensingSettings(z_min=20.0, z_max=250.0, sigma=100.0)


def p(z: float, *, saturated: bool = False, settings: SensingSettings = SETTINGS) -> float:
    return float(sensing_probability(np.array(z), np.array(saturated), settings))


def test_inside_the_limits_it_is_the_papers_exponential() -> None:
    assert p(250.0) == 1.0
    assert p(150.0) == pytest.approx(np.exp(-1.0))
    assert p(20.0) == pytest.approx(np.exp(-2.3))


def test_one_ulp_outside_the_limits_it_is_zero() -> None:
    assert p(np.nextafter(20.0, 0.0)) == 0.0
    assert p(np.nextafter(250.0, 300.0)) == 0.0


def test_a_clipped_pixel_has_no_depth_although_its_grey_level_is_allowed() -> None:
    assert p(255.0, saturated=True, settings=SensingSettings()) == 0.0
    assert p(255.0, saturated=False, settings=SensingSettings()) == 1.0


@given(st.floats(0, 255), st.floats(1e-3, 1e6))
def test_it_is_a_probability(z: float, sigma: float) -> None:
    assert 0.0 <= p(z, settings=SensingSettings(sigma=sigma)) <= 1.0


def test_two_cameras_are_as_good_as_the_worse_one() -> None:
    assert both_cameras(np.array([0.2, 0.9]), np.array([0.5, 0.0])).tolist() == [0.2, 0.0]


@pytest.mark.parametrize(
    ("field", "value"), [("sigma", 0.0), ("sigma", float("nan")), ("z_min", -1.0), ("z_max", 256.0), ("sigma", True)]
)
def test_settings_out_of_range_are_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(ValidationError, match=field):
        SensingSettings(**{field: value})


def test_crossed_limits_are_refused() -> None:
    with pytest.raises(ValidationError, match="z_min is 200"):
        SensingSettings(z_min=200.0, z_max=100.0)
