"""The noise of depth: closed forms where surfaces have one, and honesty before sensors whose truth is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sidelong.devices import CaptureRequest
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.physics.depth_noise import (
    LEAST_DISPARITY_PX,
    SMALLEST_OUTLIER_SHARE,
    UNKNOWN_DISPARITY_PX,
    DepthNoise,
    rim_distance_px,
)
from sidelong.recorded.dataset import Dataset
from sidelong.simulation.rig import rig_for
from sidelong.types import FloatArray, Projector
from sidelong_drivers.simulated import SimulatedCamera, SimulatedCameraSettings

ROBI = Path(__file__).parents[2] / "data" / "robi"
RIG = rig_for(160, 128)
FB = RIG.left.fx * RIG.baseline_m
SIZE = (RIG.left.height, RIG.left.width)
NOISE = DepthNoise(disparity_px=0.1, slope_px=0.5, rim_px=0.4, rim_reach_px=2.0, bend=0.3)


def depth_of(disparity_px: FloatArray) -> FloatArray:
    return FB / disparity_px


def sigma_px(noise: DepthNoise, depth_m: FloatArray, rig: StereoRig = RIG) -> FloatArray:
    """Return the deviation in disparity."""
    fb = rig.left.fx * rig.baseline_m
    return noise.sigma_m(depth_m, rig).astype(np.float64) * fb / depth_m**2


@given(depth_m=st.floats(0.1, 20.0), disparity_px=st.floats(0.01, 2.0))
def test_on_a_faced_surface_it_is_z_squared_over_f_b(depth_m: float, disparity_px: float) -> None:
    sigma_m = DepthNoise(disparity_px=disparity_px).sigma_m(np.full((12, 16), depth_m), RIG)
    assert sigma_m.dtype == np.float32
    np.testing.assert_allclose(sigma_m, disparity_px * depth_m**2 / FB, rtol=1e-4)


@given(across=st.floats(-0.5, 0.5), down=st.floats(-0.5, 0.5))
def test_a_slope_adds_its_share(across: float, down: float) -> None:
    v, u = np.indices(SIZE)
    found = sigma_px(NOISE, depth_of(150 + across * u + down * v))
    expected = np.sqrt(0.1**2 + 0.25 * (across**2 + down**2))
    np.testing.assert_allclose(found[1:-1, 1:-1], expected, rtol=2e-3)


def test_a_bend_adds_its_share_beyond_what_noise_bends() -> None:
    u = np.indices(SIZE)[1] - 80.0
    found = sigma_px(NOISE.model_copy(update={"slope_px": 0.0}), depth_of(100 + 0.5 * 0.2 * u**2))
    # d(-2) - 2 d(0) + d(2) of curvature 0.2 is 0.8; noise bends by 4 * 0.1
    expected = np.sqrt(0.1**2 + 0.3**2 * (0.8**2 - 0.4**2))
    np.testing.assert_allclose(found[:, 2:-2], expected, rtol=1e-2)
    np.testing.assert_allclose(found[:, 0], 0.1, rtol=1e-4)


def test_noise_rises_towards_missing_depth_but_not_towards_the_border() -> None:
    depth_m = np.full(SIZE, 0.7)
    depth_m[:, 60] = np.nan
    found = sigma_px(NOISE, depth_m)
    distance = np.abs(np.arange(SIZE[1]) - 60.0)
    expected = np.sqrt(0.1**2 + (0.4 * np.exp((1 - distance) / 2.0)) ** 2)
    np.testing.assert_allclose(found[64, distance > 0], expected[distance > 0], rtol=1e-3)
    np.testing.assert_array_equal(rim_distance_px(depth_m)[0, 60:63], [0, 1, 2])


@given(value=st.sampled_from([np.nan, 0.0, -0.7, np.inf, -np.inf]), row=st.integers(0, 11), column=st.integers(0, 15))
def test_depths_that_are_none_have_no_noise_and_are_rims(value: float, row: int, column: int) -> None:
    depth_m = np.full((12, 16), 0.7)
    depth_m[row, column] = value
    sigma_m = NOISE.sigma_m(depth_m, RIG)
    depth_m[row, column] = np.nan
    np.testing.assert_array_equal(sigma_m, NOISE.sigma_m(depth_m, RIG))
    assert np.isnan(sigma_m).sum() == 1
    beside = column + 1 if column < 15 else column - 1
    assert sigma_m[row, beside] > sigma_m[(row + 6) % 12, (column + 8) % 16]


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3), (4, 4), (5, 7)])
@pytest.mark.parametrize("noise", [NOISE, DepthNoise()])
def test_maps_of_any_size_have_noise_where_they_have_depth(size: tuple[int, int], noise: DepthNoise) -> None:
    assert np.isfinite(noise.sigma_m(np.full(size, 0.7), RIG)).all()
    assert np.isnan(noise.sigma_m(np.full(size, np.nan), RIG)).all()


def test_both_precisions_give_the_same() -> None:
    depth_m = 0.7 + 1e-3 * np.random.default_rng(0).normal(size=SIZE).astype(np.float32)
    np.testing.assert_allclose(NOISE.sigma_m(depth_m, RIG), NOISE.sigma_m(depth_m.astype(np.float64), RIG), rtol=1e-3)


# --- noise that is read off the map ---


@pytest.mark.parametrize("blur_px", [1.0, 1.2, 1.4])
@pytest.mark.parametrize("noise_px", [0.03, 0.1, 0.3])
def test_without_a_number_the_roughness_of_the_map_tells(blur_px: float, noise_px: float) -> None:
    u = np.indices(SIZE)[1]
    noise = cv2.GaussianBlur(np.random.default_rng(1).normal(size=SIZE), (0, 0), blur_px)
    disparity_px = 100 + 0.01 * u + noise_px * noise / noise.std()
    found = float(np.median(sigma_px(DepthNoise(slope_px=0.0, bend=0.0), depth_of(disparity_px))))
    assert found == pytest.approx(noise_px, rel=0.3)


def test_where_too_few_depths_tell_it_is_a_usual_number() -> None:
    depth_m = np.full(SIZE, np.nan)
    depth_m[::3, ::3] = 0.7
    kind = DepthNoise(rim_px=0.0)
    np.testing.assert_allclose(sigma_px(kind, depth_m)[::3, ::3], UNKNOWN_DISPARITY_PX, rtol=1e-4)


def test_a_map_without_noise_is_still_not_exact() -> None:
    assert np.median(sigma_px(DepthNoise(), np.full(SIZE, 0.7))) == pytest.approx(LEAST_DISPARITY_PX, rel=1e-3)


def honest(depth_m: FloatArray, truth_m: FloatArray, rig: StereoRig, noise: DepthNoise) -> tuple[float, float]:
    """Return the deviation of the errors over sigma, and the share within 1.96 of it."""
    ratio = (depth_m - truth_m) / noise.sigma_m(depth_m, rig)
    ratio = ratio[np.isfinite(ratio)]
    return float(ratio.std()), float((np.abs(ratio) < 1.96).mean())


@pytest.mark.parametrize(("part", "sprayed", "width"), [
    ("tube_fitting", False, 640), ("gear", True, 640), ("hex_screw", False, 800)])  # fmt: skip
def test_the_default_is_honest_before_the_simulated_camera(part: str, sprayed: bool, width: int) -> None:
    settings = SimulatedCameraSettings(
        part=part, count=12, heap=True, seed=3, sprayed=sprayed, width=width, height=width * 4 // 5
    )
    camera = SimulatedCamera(settings)
    camera.open()
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation_about((1, 0, 0), 0.25)
    view = transform(turn, np.array([0.5, 0.0, 0.02]) - turn @ np.array([0.1, 0.0, 0.66]))
    frame = camera.capture(CaptureRequest(Projector.DOTS, 0.012, depth=True), view)
    assert frame.depth_m is not None
    deviation, covered = honest(frame.depth_m, camera.true_depth_m(view), camera.rig, DepthNoise())
    assert 0.8 < deviation < 1.25
    assert 0.92 < covered < 0.985


def test_the_default_is_not_bold_on_the_recorded_scene() -> None:
    # every other pixel of a map is rougher than the map: what is read off is too much, never too little
    dataset = Dataset(ROBI)
    scene = dataset.scene("Tube_fitting", 1)
    for name in scene.names:
        truth_m = scene.true_depth_m(name)
        if truth_m is not None:
            deviation, covered = honest(scene.depth_m(name), truth_m, dataset.rig, DepthNoise())
            assert 0.35 < deviation < 1.25, name
            assert covered > 0.92, name


# --- outliers and settings ---


@given(share=st.floats(1e-6, 0.5), rim_share=st.floats(0.0, 0.9))
def test_trust_is_log_odds_and_never_less_at_rims_than_away_from_them(share: float, rim_share: float) -> None:
    noise = DepthNoise(outlier_share=share, rim_outlier_share=rim_share)
    assert 1 / (1 + np.exp(noise.trust)) == pytest.approx(share)
    assert noise.rim_trust <= noise.trust


def test_no_outliers_is_no_certainty() -> None:
    assert DepthNoise(outlier_share=0.0).trust == pytest.approx(-np.log(SMALLEST_OUTLIER_SHARE), rel=1e-4)


@pytest.mark.parametrize("name", list(DepthNoise.model_fields))
@pytest.mark.parametrize("value", [-1.0, 1e9, float("nan"), float("inf"), True, "0.1"])
def test_numbers_out_of_range_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValidationError, match=name):
        DepthNoise.model_validate({name: value})


def test_settings_come_back_from_json() -> None:
    for noise in (DepthNoise(), NOISE):
        assert DepthNoise.model_validate_json(noise.model_dump_json()) == noise
