"""Learning the sensing curve: known curves come back, ranges without data say so, captures that cannot carry one are
refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from sidelong.calibration.sensing.exponential import fit_exponential
from sidelong.calibration.sensing.fit import SensingFit, fit_sensing
from sidelong.calibration.sensing.samples import SensingSamples, samples_of
from sidelong.calibration.sensing.scores import scores_of
from sidelong.calibration.sensing.unimodal_curve import REACH_LN
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.mesh import part_from_arrays
from sidelong.geometry.transforms import look_at, transform
from sidelong.physics.reflectance import Phong
from sidelong.physics.response import Response
from sidelong.physics.sensing import PaperSensing, SensingSettings
from sidelong.planning.shading import LightModel
from sidelong.types import Frame, Projector, View

CAMERA = PinholeCamera(160, 128, 150.0, 150.0, 79.5, 63.5)
RIG = StereoRig(CAMERA, CAMERA, 0.1, LightProjector(transform(np.eye(3), (0.05, 0.0, 0.0)), 0.6, 0.6))
TOP = View("top", look_at((0.0, 0.0, 0.7), (0.0, 0.0, 0.0)))
BOX = trimesh.creation.box((0.08, 0.08, 0.01))
PLATE = part_from_arrays("plate", np.asarray(BOX.vertices), np.asarray(BOX.faces))
LIGHT = LightModel((Phong(0.5, 0.0, 1.0),), 50.0, True, "all", 0.012, Response.gamma(), SensingSettings())


def truth(log_x: np.ndarray) -> np.ndarray:
    """Rise from 0.05 to 0.9 around ln x = -1.5, plateau, fall to 0.1 around ln x = 1."""
    return 0.05 + 0.85 / (1 + np.exp(-4 * (log_x + 1.5))) - 0.8 / (1 + np.exp(-4 * (log_x - 1.0)))


def drawn(n: int = 20_000, seed: int = 0, cameras: int = 2, groups: int = 6) -> SensingSamples:
    """Pixels whose second camera often sees a highlight the first does not."""
    rng = np.random.default_rng(seed)
    left = rng.uniform(-4.0, 3.0, n)
    right = np.where(rng.random(n) < 0.5, left + rng.normal(0, 0.2, n), rng.uniform(-4.0, 3.0, n))
    log_x = np.stack([left, right], axis=1)[:, :cameras]
    valid = rng.random(n) < truth(log_x).min(axis=1)
    return SensingSamples.of(
        np.exp(log_x[:, 0]), np.exp(log_x[:, 1]) if cameras == 2 else None, valid, rng.integers(0, groups, n)
    )


@pytest.fixture(scope="module")
def fit() -> SensingFit:
    return fit_sensing(drawn())


@pytest.mark.parametrize("cameras", [1, 2])
def test_the_curve_behind_the_pixels_comes_back(cameras: int) -> None:
    found = fit_sensing(drawn(cameras=cameras)).curve
    log_x = np.linspace(-3.5, 2.5, 61)
    # a bin half an e-fold wide smooths the slopes, which reach 0.85 per e-fold
    assert np.abs(found.at(np.exp(log_x)) - truth(log_x)).max() < 0.12
    assert np.abs(found.at(np.exp(log_x)) - truth(log_x)).mean() < 0.03


def test_taking_each_camera_for_the_only_one_would_not_find_it(fit: SensingFit) -> None:
    samples = drawn()
    left_alone = fit_sensing(SensingSamples(samples.exposure[:, :1], samples.valid, samples.group, samples.weight))
    plateau = np.exp(np.linspace(-0.5, 0.0, 5))
    assert fit.curve.at(plateau).min() > 0.8
    assert left_alone.curve.at(plateau).max() < 0.75


def test_the_curve_rises_then_falls(fit: SensingFit) -> None:
    steps = np.sign(np.diff(fit.curve.probability))
    turns = steps[steps != 0]
    assert (np.diff(turns) <= 0).all()
    assert turns[0] == 1
    assert turns[-1] == -1


def test_held_out_scores_come_near_the_entropy_that_no_forecast_beats(fit: SensingFit) -> None:
    samples = drawn()
    p = truth(np.log(samples.exposure)).min(axis=1)
    entropy = float(-(p * np.log(p) + (1 - p) * np.log(1 - p)).mean())
    assert fit.held_out is not None
    assert entropy - 0.01 < fit.inside.log_loss < fit.held_out.log_loss + 0.002 < entropy + 0.02
    assert fit.held_out.ece < 0.02
    assert fit.exponential_held_out is not None
    assert fit.exponential_held_out.log_loss > fit.held_out.log_loss + 0.2
    assert fit.exponential_inside.brier > fit.inside.brier


def test_counts_and_errors_of_the_bins_are_those_of_the_pixels(fit: SensingFit) -> None:
    assert fit.count.sum() == fit.pixels == 20_000
    assert fit.unlit == 0
    assert (np.diff(fit.log_edges) > 0).all()
    assert np.diff(fit.log_edges).max() <= 0.5 + 1e-9
    full = fit.count > 300
    binomial = np.sqrt(fit.frequency[full] * (1 - fit.frequency[full]) / fit.count[full])
    # six groups of independent pixels: the scatter between them is binomial, known to a factor of 2 or so each
    assert 0.7 < np.median(fit.standard_error[full] / binomial) < 1.3


def test_views_that_differ_widen_the_error() -> None:
    samples = drawn(groups=6)
    rng = np.random.default_rng(1)
    spoiled = replace(samples, valid=samples.valid & ((samples.group % 2 == 0) | (rng.random(len(samples)) < 0.5)))
    alone = fit_sensing(replace(spoiled, group=np.zeros(len(spoiled), np.intp)))
    apart = fit_sensing(spoiled)
    high = apart.frequency > 0.4
    assert (apart.standard_error[high] > 2 * alone.standard_error[high]).all()
    assert alone.held_out is None
    assert any(text.startswith("not cross-validated") for text in alone.warnings)


def test_beyond_the_pixels_the_curve_goes_to_nothing_within_two_stops_and_says_so() -> None:
    samples = drawn()
    bright = samples[(samples.exposure.min(axis=1) > 0.3) & (samples.exposure.max(axis=1) < 3.0)]
    found = fit_sensing(bright)
    low, high = np.exp(found.log_edges[[0, -1]])
    assert found.curve.at(np.array([low * 0.99 * np.exp(-REACH_LN), high * 1.01 * np.exp(REACH_LN)])).tolist() == [0, 0]
    half_way = found.curve.at(np.array([high * np.exp(REACH_LN / 2)]))
    assert half_way == pytest.approx(found.curve.at(np.array([high])) / 2, rel=1e-2)
    assert any("no pixel below 0.3" in text for text in found.warnings)


def test_where_exposure_says_nothing_the_curve_is_flat_and_says_so() -> None:
    samples = drawn()
    coin = replace(samples, valid=np.random.default_rng(3).random(len(samples)) < 0.3)
    found = fit_sensing(coin)
    inside = found.curve.at(np.exp(np.linspace(-3.5, 2.5, 20)))
    np.testing.assert_allclose(inside, 0.3, atol=0.01)
    assert any("flat" in text for text in found.warnings)


def test_a_hole_in_the_middle_takes_the_value_of_its_neighbours() -> None:
    samples = drawn(cameras=1)
    log_x = np.log(samples.exposure[:, 0])
    found = fit_sensing(samples[(log_x < -3.0) | (log_x > -1.0)])
    inside = found.curve.at(np.exp(np.linspace(-3.0, -1.0, 20)))
    assert (np.diff(inside) >= 0).all()
    assert inside[0] < 0.15
    assert inside[-1] > 0.7
    assert np.isnan(found.frequency[found.count == 0]).all()


def test_weights_count_like_copies() -> None:
    samples = drawn(4000)
    twice = np.random.default_rng(5).random(len(samples)) < 0.5
    copied = samples[np.concatenate([np.arange(len(samples)), np.flatnonzero(twice)])]
    weighted = replace(samples, weight=np.where(twice, 2.0, 1.0))
    first, second = fit_sensing(copied).inside, fit_sensing(weighted).inside
    # quantiles that set the bins see the copies
    assert first.log_loss == pytest.approx(second.log_loss, abs=0.01)
    doubled = fit_sensing(replace(samples, weight=np.full(len(samples), 2.0)))
    assert doubled.inside.brier == pytest.approx(fit_sensing(samples).inside.brier, abs=2e-3)


def test_pixels_without_light_are_left_out_and_counted() -> None:
    samples = drawn(4000)
    dark = np.arange(len(samples)) < 100
    exposure = np.where(dark[:, None], 0.0, samples.exposure)
    found = fit_sensing(replace(samples, exposure=exposure))
    assert (found.unlit, found.pixels) == (100, 3900)
    assert found.curve.at(np.array([0.0])) == 0.0


@settings(max_examples=15, deadline=None)
@given(st.integers(600, 1500), st.integers(0, 10_000), st.floats(0.05, 0.95), st.sampled_from([1, 2]))
def test_any_outcome_gives_a_table(n: int, seed: int, rate: float, cameras: int) -> None:
    rng = np.random.default_rng(seed)
    exposure = np.exp(rng.choice([-6.0, -2.0, 0.0, 5.0], (n, cameras)) + rng.normal(0, 0.01, (n, cameras)))
    samples = SensingSamples(exposure, rng.random(n) < rate, rng.integers(0, 3, n), np.ones(n))
    found = fit_sensing(samples)
    assert 0.0 <= found.inside.brier <= 0.26
    assert 0.0 < max(found.curve.probability) < 1.0


# --- what is refused ---


def test_outcomes_that_are_all_alike_are_refused() -> None:
    samples = drawn(2000)
    with pytest.raises(CalibrationError, match="0 of 2000 lit part pixels have depth, at least 20"):
        fit_sensing(replace(samples, valid=np.zeros(2000, np.bool_)))
    with pytest.raises(CalibrationError, match="2000 of 2000 lit part pixels have depth"):
        fit_sensing(replace(samples, valid=np.ones(2000, np.bool_)))


def test_too_few_pixels_are_refused() -> None:
    with pytest.raises(CalibrationError, match="499 lit part pixels, a curve needs 500: capture more views"):
        fit_sensing(drawn(499))
    with pytest.raises(CalibrationError, match="0 lit part pixels"):
        fit_sensing(drawn(0))
    assert fit_sensing(drawn(500)).pixels == 500


def test_exposures_that_hardly_differ_are_refused() -> None:
    samples = drawn(2000)
    rng = np.random.default_rng(0)
    alike = replace(samples, exposure=np.exp(rng.uniform(0.0, 1.5, (2000, 1))))
    with pytest.raises(CalibrationError, match=r"span a factor of 3\.\d+, at least 4 is needed: add views"):
        fit_sensing(alike)
    with pytest.raises(CalibrationError, match="span a factor of 1,"):
        fit_sensing(replace(samples, exposure=np.full((2000, 2), 0.5)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e-300])
@pytest.mark.parametrize("field", ["exposure", "weight"])
def test_numbers_that_are_none_are_refused(value: float, field: str) -> None:
    samples = drawn(1000)
    spoiled = getattr(samples, field).copy()
    spoiled[3] = value
    with pytest.raises(CalibrationError, match=rf"values of {field} are not finite and >= 0"):
        replace(samples, **{field: spoiled})


def test_arrays_of_unlike_length_are_refused() -> None:
    with pytest.raises(CalibrationError, match=r"valid has \(3,\)"):
        SensingSamples.of(np.ones(4), None, np.ones(3, np.bool_))
    with pytest.raises(CalibrationError, match="shapes are"):
        SensingSamples(np.ones((3, 3)), np.ones(3, np.bool_), np.zeros(3, np.intp), np.ones(3))


# --- the exponential beside it ---


def test_the_exponential_that_made_the_pixels_comes_back() -> None:
    made = SensingSettings(z_min=40.0, z_max=250.0, sigma=float(np.geomspace(10.0, 1e4, 25)[8]))
    rng = np.random.default_rng(2)
    exposure = np.exp(rng.uniform(-4.0, 0.5, (40_000, 2)))
    sensing = PaperSensing(made, Response.gamma())
    valid = rng.random(40_000) < sensing.probability(exposure)
    found = fit_exponential(exposure, valid, np.ones(40_000), Response.gamma())
    assert (found.z_min, found.z_max) == (made.z_min, made.z_max)
    assert found.sigma == pytest.approx(made.sigma, rel=0.35)


def test_the_grid_finds_no_worse_an_exponential_than_a_search(fit: SensingFit) -> None:
    samples = drawn(6000)
    response = Response.gamma()
    grid = fit_exponential(samples.exposure, samples.valid, samples.weight, response)

    def loss(parameters: np.ndarray) -> float:
        z_min, z_max, log_sigma = parameters
        if not (0 <= z_min <= z_max <= 255 and -2 < log_sigma < 15):
            return 99.0
        settings = SensingSettings(z_min=z_min, z_max=z_max, sigma=float(np.exp(log_sigma)))
        return scores_of(PaperSensing(settings, response).probability(samples.exposure), samples.valid).log_loss

    on_the_grid = loss(np.array([grid.z_min, grid.z_max, np.log(grid.sigma)]))
    searched = min(
        float(minimize(loss, start, method="Nelder-Mead", options={"maxiter": 150}).fun)
        for start in ([20.0, 250.0, 5.0], [grid.z_min, grid.z_max, np.log(grid.sigma)])
    )
    assert on_the_grid < searched + 0.02


# --- samples from frames ---


def plate_frame(depth_m: np.ndarray | None, exposure_s: float = 0.012) -> Frame:
    image = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    return Frame(TOP, image, None, depth_m, Projector.DOTS, exposure_s)


def test_samples_hold_the_exposure_of_each_part_pixel_and_whether_its_own_depth_was_measured() -> None:
    depth_m = np.full((CAMERA.height, CAMERA.width), np.nan)
    depth_m[:, :80] = 0.695  # the upper face
    depth_m[:, 85:] = 0.70  # something 5 mm behind it
    samples = samples_of([plate_frame(depth_m), plate_frame(depth_m, 0.024)], [np.eye(4)], PLATE, RIG, LIGHT, 1)
    assert len(samples) == 2 * 18 * 18
    first = samples[samples.group == 0]
    # 18 columns from 71 to 88: nine of them left of 80
    assert first.valid.sum() == 9 * 18
    np.testing.assert_allclose(samples[samples.group == 1].exposure, 2 * first.exposure)
    # Lambert: E = k_d I cos / d^2 straight below the projector
    brightest = 0.5 * 50.0 / 0.695**2 * 0.012
    assert first.exposure.max() == pytest.approx(brightest, rel=5e-3)


def test_a_frame_without_depth_is_refused_and_no_frames_give_no_samples() -> None:
    with pytest.raises(CalibrationError, match="view top: the frame has no depth map"):
        samples_of([plate_frame(None)], [np.eye(4)], PLATE, RIG, LIGHT)
    assert len(samples_of([], [np.eye(4)], PLATE, RIG, LIGHT)) == 0
