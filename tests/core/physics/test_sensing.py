"""The probability of depth: equation (7), and the learned curve."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sidelong.physics.response import Response
from sidelong.physics.sensing import (
    CurveSensing,
    PaperSensing,
    SensingCurve,
    SensingSettings,
    all_cameras,
    sensing_probability,
)

SETTINGS = SensingSettings(z_min=20.0, z_max=250.0, sigma=100.0)
CURVE = SensingCurve(log_exposure=(-3.0, -1.0, 0.0, 2.0), probability=(0.0, 0.6, 0.8, 0.2))
EXPOSURES = st.floats(min_value=0.0) | st.just(float("nan"))


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
    assert all_cameras(np.array([[0.2, 0.5], [0.9, 0.0]])).tolist() == [0.2, 0.0]


@pytest.mark.parametrize(
    ("field", "value"),
    [("sigma", 0.0), ("sigma", float("nan")), ("z_min", -1.0), ("z_max", 256.0), ("sigma", True), ("least_share", 1.1)],
)
def test_settings_out_of_range_are_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(ValidationError, match=field):
        SensingSettings(**{field: value})


def test_crossed_limits_are_refused() -> None:
    with pytest.raises(ValidationError, match="z_min is 200"):
        SensingSettings(z_min=200.0, z_max=100.0)


def test_settings_stored_before_there_was_a_curve_are_the_papers() -> None:
    stored = SensingSettings.model_validate_json('{"z_min": 30.0, "z_max": 255.0, "sigma": 100.0, "stereo": true}')
    assert isinstance(stored.kind(Response.gamma()), PaperSensing)


def test_a_curve_survives_json_to_the_bit() -> None:
    settings = SensingSettings(curve=CURVE)
    assert SensingSettings.model_validate_json(settings.model_dump_json()) == settings
    assert SensingSettings.model_validate(settings.model_dump(mode="json")) == settings


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_the_papers_kind_reads_grey_levels_off_the_response(gamma: float) -> None:
    sensing = SETTINGS.kind(Response.gamma(gamma))
    z = np.array([19.0, 21.0, 100.0, 249.0, 251.0])
    exposure = (z / 255.0) ** gamma
    expected = np.where((z >= 20) & (z <= 250), np.exp((z - 250) / 100), 0.0)
    np.testing.assert_allclose(sensing.probability(np.stack([exposure, exposure], axis=1)), expected, rtol=1e-9)


def test_the_papers_kind_promises_everything_up_to_the_exposure_that_clips_and_nothing_from_there_on() -> None:
    below, at, above = np.nextafter(1.0, 0.0), 1.0, np.nextafter(1.0, 2.0)
    sensing = SensingSettings().kind(Response.gamma())
    promised = sensing.probability(np.array([[below], [at], [above]]))
    assert promised.tolist() == [pytest.approx(1.0), 0.0, 0.0]


def test_the_curve_is_straight_between_knots_and_flat_beyond_them() -> None:
    log_x = np.array([-9.0, -3.0, -2.0, -1.0, -0.5, 0.0, 1.0, 2.0, 9.0])
    np.testing.assert_allclose(CURVE.at(np.exp(log_x)), [0, 0, 0.3, 0.6, 0.7, 0.8, 0.5, 0.2, 0.2], atol=1e-12)


def test_beyond_saturation_the_curve_may_promise_depth() -> None:
    assert CurveSensing(CURVE, 0.5).probability(np.array([[np.e, np.e]])) == pytest.approx(0.5)


def test_where_the_curve_promises_less_than_a_share_of_its_best_nothing_is_promised() -> None:
    log_x = np.array([[-2.0], [-1.9], [-1.0], [1.9]])
    half = CurveSensing(CURVE, 0.5).probability(np.exp(log_x))  # of 0.8: 0.4, reached at ln x = -5/3
    np.testing.assert_allclose(half, [0.0, 0.0, 0.6, 0.0], atol=1e-12)
    all_of_it = CurveSensing(CURVE, 0.0).probability(np.exp(log_x))
    np.testing.assert_allclose(all_of_it, [0.3, 0.33, 0.6, 0.23], atol=1e-12)


@given(EXPOSURES, EXPOSURES)
def test_no_exposure_gives_anything_but_a_probability_and_no_light_gives_none(left: float, right: float) -> None:
    for sensing in (SensingSettings().kind(Response.gamma()), CurveSensing(CURVE, 0.0)):
        promised = float(sensing.probability(np.array([[left, right]]))[0])
        assert 0.0 <= promised <= 1.0
        assert promised == 0.0 or (left > 0 and right > 0)


def test_no_pixels_give_no_probabilities() -> None:
    for sensing in (SensingSettings().kind(Response.gamma()), CurveSensing(CURVE, 0.0)):
        assert sensing.probability(np.zeros((0, 2))).shape == (0,)


@pytest.mark.parametrize(
    ("log_exposure", "probability", "words"),
    [
        ((0.0, 1.0, 1.0), (0.1, 0.2, 0.3), r"does not rise from 1\.0 \(knot 1\) to 1\.0"),
        ((0.0, -1.0), (0.1, 0.2), r"does not rise from 0\.0 \(knot 0\) to -1\.0"),
        ((0.0, 1.0, 2.0), (0.1, 0.2), "3 knots, probability 2"),
        ((0.0, 1.0), (0.1, 1.2), "less than or equal to 1"),
        ((0.0, 1.0), (0.1, float("nan")), "finite"),
        ((float("-inf"), 1.0), (0.1, 0.2), "finite"),
        ((0.0,), (0.1,), "at least 2"),
    ],
)
def test_a_table_that_is_none_is_refused(
    log_exposure: tuple[float, ...], probability: tuple[float, ...], words: str
) -> None:
    with pytest.raises(ValidationError, match=words):
        SensingCurve(log_exposure=log_exposure, probability=probability)
