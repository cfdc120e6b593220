"""Equations (1) to (5) against closed forms and 50-digit arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpmath import mp, mpf

from sidelong.errors import SettingsError
from sidelong.physics.reflectance import Phong, fall_off, incident_light, lambert, mirrored, radiance, specular

UP = np.array([0.0, 0.0, 1.0])


def direction(angle_rad: float) -> np.ndarray:
    return np.array([np.sin(angle_rad), 0.0, np.cos(angle_rad)])


def test_incident_light_is_projector_plus_ambient() -> None:
    assert incident_light(np.array([3.0]), 0.5).tolist() == [3.5]
    assert incident_light(np.array([3.0])).tolist() == [3.0]


@pytest.mark.parametrize("angle_deg", [0, 30, 60, 89.999, 90, 120, 180])
def test_lambert_is_the_cosine_up_to_a_right_angle_and_nothing_beyond(angle_deg: float) -> None:
    angle = np.deg2rad(angle_deg)
    expected = 2.0 * max(np.cos(angle), 0.0)
    assert lambert(np.array(2.0), direction(angle), UP) == pytest.approx(expected, abs=1e-15)


@given(st.floats(-1.5, 1.5), st.floats(0, 2 * np.pi))
def test_mirror_ray_lies_in_the_plane_of_incidence_at_the_same_angle(angle: float, azimuth: float) -> None:
    to_light = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
    reflected = mirrored(to_light, UP)
    assert reflected @ UP == pytest.approx(to_light @ UP, abs=1e-14)
    assert np.linalg.det(np.stack([reflected, to_light, UP])) == pytest.approx(0.0, abs=1e-14)
    np.testing.assert_allclose(mirrored(reflected, UP), to_light, atol=1e-14)


@pytest.mark.parametrize("n", [0.1, 1.0, 19.9, 1e3, 1e6])
@pytest.mark.parametrize("alpha", [1e-9, 1e-5, 1e-3, 0.1, 1.0, 1.5])
def test_specular_power_keeps_its_digits_for_every_glossiness(n: float, alpha: float) -> None:
    mp.dps = 50
    reflected, to_camera = direction(0.3), direction(0.3 + alpha)
    dot = sum(mpf(float(a)) * mpf(float(b)) for a, b in zip(reflected, to_camera, strict=True))
    dot /= mp.sqrt(sum(mpf(float(a)) ** 2 for a in reflected)) * mp.sqrt(sum(mpf(float(b)) ** 2 for b in to_camera))
    expected = float(dot ** mpf(n))
    got = float(specular(np.array(1.0), reflected, to_camera, n))
    # the unit vectors themselves carry 1e-16, which n amplifies
    assert got == pytest.approx(expected, rel=max(1e-12, 4e-16 * n), abs=1e-300)


@pytest.mark.parametrize(("alpha", "value"), [(0.0, 5.0), (np.pi, 0.0), (np.pi / 2 + 1e-9, 0.0)])
def test_specular_is_the_full_light_in_the_mirror_direction_and_nothing_behind(alpha: float, value: float) -> None:
    assert specular(np.array(5.0), UP, direction(alpha), 40.0) == value


def test_fall_off_is_the_inverse_square_and_no_light_at_the_source() -> None:
    np.testing.assert_allclose(fall_off(9.0, np.array([3.0, 1.0, 0.5])), [1.0, 9.0, 36.0])
    assert fall_off(9.0, np.array([0.0])).tolist() == [0.0]
    assert fall_off(1.0, np.array([0.6]))[0] / fall_off(1.0, np.array([0.9]))[0] == pytest.approx(2.25)


def test_radiance_is_the_weighted_sum_of_both_terms() -> None:
    to_light, to_camera = direction(0.4), direction(-0.3)
    material = Phong(k_d=0.2, k_s=0.7, n=20.0)
    expected = 3.0 * (0.2 * np.cos(0.4) + 0.7 * np.cos(0.1) ** 20)
    got = radiance(np.array([3.0]), (to_light[None], to_camera[None]), UP[None], material)
    assert got[0] == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize(("light", "camera"), [(2.0, 0.1), (0.1, 2.0)])
def test_surface_turned_away_from_light_or_camera_returns_nothing(light: float, camera: float) -> None:
    directions = direction(light)[None], direction(camera)[None]
    assert radiance(np.ones(1), directions, UP[None], Phong(0.5, 0.5, 0.1))[0] == 0.0


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1e6), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_radiance_is_finite_and_never_exceeds_all_light(k_d: float, k_s: float, n: float, a: float, b: float) -> None:
    e = radiance(np.ones(1), (direction(a)[None], direction(b)[None]), UP[None], Phong(k_d, k_s, n))
    assert 0.0 <= e[0] <= k_d + k_s + 1e-12


@pytest.mark.parametrize("parameter", ["k_d", "k_s", "n"])
@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_impossible_materials_are_refused_by_name(parameter: str, value: float) -> None:
    with pytest.raises(SettingsError, match=parameter):
        Phong(**{"k_d": 0.1, "k_s": 0.1, "n": 1.0} | {parameter: value})
