"""Forecasts beside outcomes: closed forms of the scores, bins that hold every pixel, intervals, a picture."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.stats import binomtest

from sidelong.calibration.sensing.scores import SUREST, equal_weight, scores_of
from sidelong.devices import Cell
from sidelong.evaluation.reliability import Reliability, draw, wilson
from sidelong.geometry.transforms import invert
from sidelong.planning.candidates import DomeSettings, dome_views
from sidelong.recipe import PlanningSettings, Recipe, build_stages
from sidelong.scan import scan
from sidelong.stopwatch import Stopwatch
from sidelong.types import DetectedObject, Forecast, Hypothesis
from sidelong_drivers.mock import MockArm, MockArmSettings
from sidelong_drivers.simulated import SimulatedCamera, SimulatedCameraSettings

PROBABILITY = st.floats(0.0, 1.0)


def forecast(probability: list[float], measured: list[int], weight: list[float] | None = None) -> Forecast:
    ones = [1.0] * len(probability)
    return Forecast(np.array(probability, float), np.array(weight or ones, float), np.array(measured, np.bool_))


def honest(n: int = 50_000, seed: int = 0) -> Forecast:
    rng = np.random.default_rng(seed)
    p = rng.beta(0.7, 1.5, n)
    return Forecast(p, np.ones(n), rng.random(n) < p)


def test_scores_of_two_pixels_are_those_worked_out_by_hand() -> None:
    scores = scores_of(np.array([0.8, 0.3]), np.array([True, True]))
    assert scores.log_loss == pytest.approx(-(np.log(0.8) + np.log(0.3)) / 2)
    assert scores.brier == pytest.approx((0.04 + 0.49) / 2)
    assert scores.ece == pytest.approx((0.2 + 0.7) / 2)


def test_in_one_bin_errors_of_opposite_sign_cancel() -> None:
    scores = scores_of(np.array([0.55, 0.55]), np.array([True, False]))
    assert scores.ece == pytest.approx(0.05)
    assert scores.ece_adaptive == pytest.approx(0.05)


def test_a_sure_forecast_that_fails_costs_much_and_not_everything() -> None:
    scores = scores_of(np.array([0.0, 1.0]), np.array([True, False]))
    assert scores.log_loss == pytest.approx(-np.log(SUREST))
    assert (scores.brier, scores.ece) == (1.0, 1.0)


def test_a_perfect_forecast_scores_zero() -> None:
    scores = scores_of(np.array([0.0, 1.0, 1.0]), np.array([False, True, True]))
    assert (scores.brier, scores.ece, scores.ece_adaptive) == (0.0, 0.0, 0.0)
    assert scores.log_loss == pytest.approx(-np.log(1 - SUREST))


def test_weights_count_like_copies() -> None:
    p, happened = np.array([0.1, 0.45, 0.9]), np.array([True, False, True])
    copies = np.array([1, 3, 2])
    weighted = scores_of(p, happened, copies.astype(float))
    copied = scores_of(np.repeat(p, copies), np.repeat(happened, copies))
    assert weighted.log_loss == pytest.approx(copied.log_loss)
    assert weighted.brier == pytest.approx(copied.brier)
    assert weighted.ece == pytest.approx(copied.ece)


def test_nothing_to_score_scores_zero() -> None:
    nothing, weightless = np.zeros(0), np.zeros(2)
    assert scores_of(nothing, nothing.astype(bool)).brier == 0.0
    assert scores_of(np.array([0.5, 0.5]), np.array([True, True]), weightless).log_loss == 0.0


def test_adaptive_bins_hold_the_same_weight_and_keep_equal_forecasts_together() -> None:
    rng = np.random.default_rng(1)
    p, weight = rng.random(10_000) ** 4, rng.random(10_000)
    held = np.bincount(equal_weight(p, weight), weights=weight)
    np.testing.assert_allclose(held, weight.sum() / 10, rtol=0.01)
    tied = equal_weight(np.array([0.0] * 90 + [0.5] * 10), np.ones(100))
    assert len(set(tied[:90])) == len(set(tied[90:])) == 1
    assert tied[0] < tied[-1]


def test_an_honest_forecast_has_no_calibration_error_but_noise_and_one_that_promises_half_has() -> None:
    true = honest()
    halved = Forecast(true.probability / 2, true.weight, true.measured)
    report, low = Reliability().add(true).report(), Reliability().add(halved).report()
    assert report.ece < 0.01
    assert report.ece_adaptive < 0.01
    assert report.predicted_px == pytest.approx(report.measured_px, rel=0.02)
    assert low.ece == pytest.approx(true.probability.mean() / 2, abs=0.01)
    assert low.log_loss > report.log_loss
    assert low.brier > report.brier


def test_the_diagonal_lies_in_nearly_all_intervals_of_an_honest_forecast() -> None:
    inside = [
        each.measured_low <= each.forecast <= each.measured_high
        for seed in range(20)
        for each in Reliability().add(honest(3000, seed)).report().bins
    ]
    assert 0.9 < np.mean(inside) < 0.99


def test_views_add_up_and_the_reference_view_has_no_forecast() -> None:
    first, second = forecast([0.2, 0.9], [0, 1]), forecast([0.95], [0], [9.0])
    report = Reliability().add(None).add(first).add(second).report()
    assert (report.views, report.points) == (2, 3)
    assert report.predicted_px == pytest.approx(0.2 + 0.9 + 9 * 0.95)
    assert report.measured_px == 1.0
    assert [(each.low, each.pixels, each.points) for each in report.bins] == [(0.2, 1.0, 1), (0.9, 10.0, 2)]
    assert report.bins[1].measured == pytest.approx(0.1)


def test_unequal_weights_widen_the_interval() -> None:
    alike = Reliability().add(forecast([0.5] * 100, [1, 0] * 50)).report().bins[0]
    unlike = Reliability().add(forecast([0.5] * 100, [1, 0] * 50, [50.0, 50.0] + [1.0] * 98)).report().bins[0]
    assert unlike.measured_high - unlike.measured_low > 2 * (alike.measured_high - alike.measured_low)


@pytest.mark.parametrize(("hits", "count"), [(0, 5), (5, 5), (1, 10), (37, 100), (9999, 10_000)])
def test_wilsons_interval_is_scipys(hits: int, count: int) -> None:
    expected = binomtest(hits, count).proportion_ci(0.95, "wilson")
    assert wilson(hits / count, count) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_without_trials_the_interval_is_everything() -> None:
    assert wilson(0.0, 0.0) == (0.0, 1.0)


@given(st.lists(st.tuples(PROBABILITY, st.booleans(), st.floats(1e-6, 1e6)), max_size=30))
def test_bins_hold_every_pixel_and_all_numbers_are_in_range(rows: list[tuple[float, bool, float]]) -> None:
    p, measured, weight = ([row[k] for row in rows] for k in range(3))
    report = Reliability().add(forecast(p, measured, weight)).report()
    assert sum(each.points for each in report.bins) == len(rows)
    assert sum(each.pixels for each in report.bins) == pytest.approx(sum(weight))
    assert 0 <= report.ece <= 1
    assert 0 <= report.brier <= 1
    for each in report.bins:
        assert each.low - 1e-9 <= each.forecast <= each.high + 1e-9
        assert 0 <= each.measured_low <= each.measured + 1e-9
        assert each.measured <= each.measured_high + 1e-9 <= 1 + 1e-8
    assert "NaN" not in report.model_dump_json()


@pytest.mark.parametrize("forecasts", [(), (forecast([], []),), (honest(500),), (forecast([1.0], [1]),)])
def test_a_picture_is_drawn_of_any_scan(forecasts: tuple[Forecast, ...]) -> None:
    picture = Image.open(io.BytesIO(draw(Reliability(forecasts).report(), "tube fitting")))
    assert picture.format == "PNG"
    assert np.asarray(picture.convert("L")).std() > 10


def test_each_step_of_a_scan_brings_the_forecast_of_its_view() -> None:
    camera = SimulatedCamera(SimulatedCameraSettings(width=160, height=128, count=2))
    arm = MockArm(MockArmSettings(speed_factor=1e3))
    camera.open()
    arm.open()
    views = dome_views((0.5, 0.0, 0.03), DomeSettings(azimuths=4, elevations_deg=(70.0,)))
    camera_T_base = invert(views[0].base_T_camera)
    objects = tuple(DetectedObject((Hypothesis(camera_T_base @ pose, 100.0, 1.0),)) for pose in camera.base_T_objects)
    recipe = Recipe(planning=PlanningSettings(max_views=2, stride_px=1, gain_threshold_share=0.0))
    cell = Cell(camera, arm, camera.flange_T_camera, views[0], views)
    reliability = Reliability()
    with build_stages(recipe, camera.part, camera.rig, Path(), objects=objects) as stages:
        steps = list(scan(cell, stages, recipe, Stopwatch()))
    arm.close()
    camera.close()
    assert steps[0].forecast is None
    for step in steps[1:]:
        assert step.forecast is not None
        assert step.forecast.weight @ step.forecast.probability == pytest.approx(step.predicted_gain_px)
        # with one sure hypothesis and every pixel scored, what the belief holds is what is counted
        assert step.forecast.weight @ step.forecast.measured == pytest.approx(step.measured_gain_px, abs=3)
    for step in steps:
        reliability = reliability.add(step.forecast)
    report = reliability.report()
    assert report.views == len(steps) - 1 == 2
    assert report.predicted_px == pytest.approx(sum(step.predicted_gain_px for step in steps))
