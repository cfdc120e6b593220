"""The response from an exposure bracket: known curves come back, bad brackets are refused with what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sidelong.calibration.response.fit import ResponseFit, fit_response
from sidelong.calibration.response.radiance_map import merge_bracket
from sidelong.calibration.response.samples import choose_samples, draw_pool, read_bracket
from sidelong.calibration.response.solve import (
    SMALLEST_STEP,
    Normal,
    bending,
    eliminate,
    log_levels,
    smooth,
    solve_rising,
)
from sidelong.errors import CalibrationError, ImageError
from sidelong.physics.response import LEVELS, Response

Curve = Callable[[np.ndarray], np.ndarray]
SHAPE = (160, 200)
SEVEN_S = 0.001 * 2.0 ** np.arange(7)


def gamma(exponent: float) -> Curve:
    return lambda x: 255 * x ** (1 / exponent)


def knee(x: np.ndarray) -> np.ndarray:
    """Linear to 70 % of full scale, then a quarter as steep."""
    steep = (0.3 + 0.7 * 0.25) / 0.25
    bend = 0.7 / steep
    return 255 * np.where(x < bend, steep * x, 0.7 + 0.25 * steep * (x - bend))


def s_curve(x: np.ndarray) -> np.ndarray:
    return 255 * 1.25 * x**1.4 / (x**1.4 + 0.25)


CURVES: dict[str, Curve] = {
    "linear": gamma(1.0),
    "gamma 2.2": gamma(2.2),
    "gamma 0.6": gamma(0.6),
    "knee": knee,
    "S": s_curve,
}


def table(curve: Curve) -> np.ndarray:
    """g by inverting the curve on a fine grid: independent of the fit."""
    x = np.linspace(-13.0, 0.0, 200_001)
    return np.interp(np.r_[0.5, np.arange(1.0, LEVELS)], curve(np.exp(x)), x)


@cache
def scene(dark: bool = False) -> np.ndarray:
    """Radiance in saturation exposures per second: shades over three decades, or darkness with a few bright spots."""
    random = np.random.default_rng(2)
    rough = [cv2.GaussianBlur(random.normal(size=SHAPE), (0, 0), s) for s in (15, 3)]
    coarse, fine = (r / r.std() for r in rough)
    if not dark:
        return 20 * np.exp(1.2 * coarse + 0.5 * fine)
    radiance = 0.7 * np.exp(0.3 * coarse + 0.1 * fine)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for _ in range(6):
        at, width = random.uniform(0.1, 0.9, 2) * SHAPE, random.uniform(2, 5)
        spot = np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * width**2))
        radiance += random.uniform(30, 300) * spot
    return radiance


def capture(
    radiance: np.ndarray, times_s: np.ndarray, curve: Curve, noise_grey: float = 1.0, seed: int = 0
) -> np.ndarray:
    """Images by rising index of ``times_s``; noise before the clip, rounded to whole levels."""
    random = np.random.default_rng(seed)
    images: list[np.ndarray] = []
    for time_s in times_s:
        x = radiance * time_s
        z = curve(np.minimum(x, 1)) + 255 * np.clip(x - 1, 0, 1)
        images.append(np.clip(np.rint(z + noise_grey * random.normal(size=z.shape)), 0, 255).astype(np.uint8))
    return np.array(images)


def errors_of(g: np.ndarray, curve: Curve) -> np.ndarray:
    """Error of levels 1 to 254 after the scale is aligned by the median."""
    difference = (g - table(curve))[1:-1]
    return np.abs(difference - np.median(difference))


@cache
def fitted(name: str = "knee", dark: bool = False) -> ResponseFit:
    return fit_response(capture(scene(dark), SEVEN_S, CURVES[name]), SEVEN_S)


# --- known curves come back


@pytest.mark.parametrize("noise_grey", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("name", sorted(CURVES))
def test_a_known_response_comes_back(name: str, noise_grey: float) -> None:
    fit = fit_response(capture(scene(), SEVEN_S, CURVES[name], noise_grey), SEVEN_S)
    errors = errors_of(fit.response.log_exposure, CURVES[name])
    assert np.median(errors) < 0.006
    assert errors[8:245].max() < 0.02 + 0.03 * noise_grey
    assert fit.noise_grey == pytest.approx(np.hypot(noise_grey, 12**-0.5), rel=0.15)
    assert fit.condition < 1e10
    assert fit.warnings == ()


@pytest.mark.parametrize("count", [3, 5, 15])
def test_three_to_fifteen_exposures_do(count: int) -> None:
    times_s = np.geomspace(0.001, 0.064, count)
    fit = fit_response(capture(scene(), times_s, gamma(2.2)), times_s)
    assert errors_of(fit.response.log_exposure, gamma(2.2))[4:].max() < 0.03
    assert fit.names == tuple(f"image {i}" for i in range(count))


@pytest.mark.parametrize("name", sorted(CURVES))
def test_the_scale_is_the_saturation_exposure(name: str) -> None:
    """g(255) is extrapolated; levels in the middle tell how well, and the stated error covers it."""
    fit = fitted(name)
    difference = (fit.response.log_exposure - table(CURVES[name]))[[64, 128, 192]]
    assert fit.response.log_exposure[-1] == 0.0
    assert fit.response.saturation_exposure == 1.0
    assert np.abs(difference).max() < 0.02
    assert (np.abs(difference) < 4 * fit.standard_error[[64, 128, 192]] + 1e-3).all()


def test_black_is_extrapolated_along_the_power_law() -> None:
    fit = fitted("gamma 2.2")
    assert fit.response.log_exposure[0] == pytest.approx(2.2 * np.log(0.5 / 255), abs=0.03)


def test_a_mostly_dark_scene_is_fitted_five_times_better_than_by_opencv() -> None:
    """OpenCV's default: 70 samples on a grid, lambda 10; both aligned by the same rule."""
    ours, theirs = [], []
    for seed in range(3):
        images = capture(scene(dark=True), SEVEN_S, knee, seed=seed)
        ours.append(errors_of(fit_response(images, SEVEN_S).response.log_exposure, knee))
        calibrate = cv2.createCalibrateDebevec(70, 10.0, False)
        opencv = calibrate.process(list(images), SEVEN_S.astype(np.float32)).ravel()
        theirs.append(errors_of(np.log(opencv.astype(np.float64)), knee))
    assert 5 * np.median(ours) < np.median(theirs)
    assert 5 * np.max(ours) < np.max(theirs)


def test_opencv_agrees_where_the_images_are_good() -> None:
    images = capture(scene(), SEVEN_S, gamma(2.2))
    calibrate = cv2.createCalibrateDebevec(500, 10.0, True)
    opencv = np.log(calibrate.process(list(images), SEVEN_S.astype(np.float32)).ravel().astype(np.float64))
    difference = (fitted("gamma 2.2").response.log_exposure - opencv)[30:226]
    assert np.ptp(difference) < 0.08


def test_saturated_pixels_with_noise_after_the_clip_do_not_bend_the_top() -> None:
    """A full well below the converter's range: saturated pixels read 250 to 255."""
    random = np.random.default_rng(5)
    exact = [255 * np.minimum(scene() * t, 1) for t in SEVEN_S]
    images = np.array([np.clip(np.rint(z + random.normal(size=z.shape)), 0, 255) for z in exact]).astype(np.uint8)
    assert errors_of(fit_response(images, SEVEN_S).response.log_exposure, gamma(1.0))[8:].max() < 0.03


def test_hot_pixels_are_outvoted() -> None:
    images = capture(scene(), SEVEN_S, knee)
    random = np.random.default_rng(8)
    hot = random.integers(0, images[0].size, 60)
    images.reshape(7, -1)[:, hot] = random.integers(1, 255, 60)
    fit = fit_response(images, SEVEN_S)
    assert np.median(errors_of(fit.response.log_exposure, knee)) < 0.01
    assert "residuals are" in fit.warnings[0]


# --- the result


def test_the_same_images_and_seed_give_the_same_table_in_any_order() -> None:
    images = capture(scene(), SEVEN_S, knee)
    order = np.random.default_rng(0).permutation(7)
    shuffled = fit_response([images[i] for i in order], SEVEN_S[order], names=[f"{i}.png" for i in order])
    np.testing.assert_array_equal(shuffled.response.log_exposure, fitted("knee").response.log_exposure)
    assert shuffled.names == tuple(f"{i}.png" for i in range(7))


def test_coverage_counts_every_level_the_images_have() -> None:
    fit = fitted("knee")
    assert fit.coverage.share_seen == 1.0
    assert fit.coverage.largest_gap == 0
    assert fit.coverage.per_level.sum() == 7 * fit.samples
    assert fit.coverage.per_level[1:-1].min() >= 7


def test_residuals_per_image_are_the_noise() -> None:
    fit = fitted("knee")
    np.testing.assert_allclose(fit.image_residual_grey, 1.04, rtol=0.2)
    assert 0.003 < fit.residual_ln < 0.3


def test_an_exposure_taken_twice_is_averaged() -> None:
    times_s = np.sort(np.r_[SEVEN_S, SEVEN_S[3]])
    fit = fit_response(capture(scene(), times_s, knee), times_s)
    assert len(fit.names) == 8
    assert np.median(errors_of(fit.response.log_exposure, knee)) < 0.006


def test_an_image_without_usable_pixels_is_left_out_and_said_so() -> None:
    images = capture(scene(), SEVEN_S, knee)
    images[6] = 255
    fit = fit_response(images, SEVEN_S, names=list("abcdefg"))
    assert fit.names == tuple("abcdef")
    assert fit.warnings == ("g (64 ms): left out, clipped almost everywhere",)


@settings(max_examples=12, deadline=20_000)
@given(
    exponent=st.floats(0.6, 2.6),
    noise_grey=st.floats(0.1, 2.5),
    ratio=st.floats(1.5, 2.8),
    seed=st.integers(0, 1000),
)
def test_any_power_law_comes_back_and_rises(exponent: float, noise_grey: float, ratio: float, seed: int) -> None:
    times_s = 0.001 * ratio ** np.arange(6)
    fit = fit_response(capture(scene(), times_s, gamma(exponent), noise_grey, seed), times_s, seed=seed)
    assert (np.diff(fit.response.log_exposure) > 0).all()
    assert np.median(errors_of(fit.response.log_exposure, gamma(exponent))) < 0.02
    assert (np.diff(fit.standard_error[[128, 200, 255]]) < 0).all()


# --- the linear algebra


@pytest.mark.parametrize(("seed", "exponent"), [(0, 1.0), (1, 2.0), (2, 3.0), (3, 4.5), (4, 6.0)])
def test_elimination_equals_the_full_system(seed: int, exponent: float) -> None:
    """Debevec and Malik's system with 255 levels and all log radiances, by numpy's dense least squares."""
    random, smoothness, pixels = np.random.default_rng(seed), 10.0**exponent, 150
    levels = random.integers(1, 255, (pixels, 4))
    weights = random.uniform(0.1, 3.0, levels.shape) * (random.random(levels.shape) < 0.8)
    targets = 1.5 * np.log(levels / 255) + random.normal(size=(pixels, 1)) + 0.01 * random.normal(size=levels.shape)
    full = np.zeros((levels.size + LEVELS - 2, LEVELS + pixels))
    rhs = np.zeros(len(full))
    for row, (pixel, image) in enumerate(np.ndindex(levels.shape)):
        w = weights[pixel, image]
        full[row, levels[pixel, image]], full[row, LEVELS + pixel], rhs[row] = w, -w, w * targets[pixel, image]
    full[levels.size :, :LEVELS] = np.sqrt(smoothness) * bending()
    full = np.delete(full, LEVELS - 1, axis=1)  # g(255) = 0
    full[:, : LEVELS - 1] = full[:, : LEVELS - 1] @ bends_to_g()  # plain g is too badly scaled for eight digits
    norms = np.linalg.norm(full, axis=0)
    norms[norms == 0] = 1.0  # a pixel without equations
    solution = np.linalg.lstsq(full / norms, rhs, rcond=1e-15)[0] / norms
    normal = eliminate(levels, targets, weights)
    rising = solve_rising(normal, smoothness)
    assert rising.correction == 0.0
    np.testing.assert_allclose(rising.g[:-1], bends_to_g() @ solution[: LEVELS - 1], atol=1e-8)
    bent = smoothness * np.sum((bending() @ rising.g) ** 2)
    cost = normal.rest - 2 * normal.rhs @ rising.g + rising.g @ normal.matrix @ rising.g + bent
    assert cost == pytest.approx(np.sum((full @ solution - rhs) ** 2), rel=1e-6)


@cache
def bends_to_g() -> np.ndarray:
    """The inverse of [slope at the top; bending], (255, 255)."""
    return np.linalg.inv(np.vstack([np.eye(LEVELS - 1)[-1], bending()[:, :-1]]))


def solve_free(normal: Normal, smoothness: float) -> np.ndarray:
    """g(0) to g(254) by the normal equations, without the demand to rise."""
    basis = bends_to_g()
    system = basis.T @ normal.matrix[:-1, :-1] @ basis + smoothness * np.diag(np.r_[0.0, np.ones(LEVELS - 2)])
    return basis @ np.linalg.solve(system, basis.T @ normal.rhs[:-1])


def rising_equations(slope: float = 1.0, noise: float = 0.0) -> Normal:
    random = np.random.default_rng(1)
    levels = random.integers(1, 255, (400, 5))
    radiance = random.normal(size=(400, 1))
    targets = slope * np.log(levels / 255) - radiance + noise * random.normal(size=levels.shape)
    return eliminate(levels, targets, np.ones(levels.shape))


def test_a_rising_solution_is_left_alone_and_solves_the_normal_equations() -> None:
    normal = rising_equations(noise=0.01)
    rising = solve_rising(normal, 1e4)
    assert rising.correction == 0.0
    np.testing.assert_allclose(rising.g[:-1], solve_free(normal, 1e4), atol=1e-8)


def test_power_laws_are_not_bent_by_any_smoothing() -> None:
    for smoothness in (1.0, 1e8):
        rising = solve_rising(rising_equations(slope=1.7), smoothness)
        np.testing.assert_allclose(rising.g, 1.7 * (log_levels() - np.log(255)), atol=1e-6)


def test_a_falling_solution_is_mended_as_little_as_least_squares_allows() -> None:
    """The constrained optimum: no feasible step nearby has a lower cost, and the free solution costs less."""
    normal, smoothness = rising_equations(noise=1.5), 1e-3
    free = np.r_[solve_free(normal, smoothness), 0.0]
    assert (np.diff(free) < 0).any()
    rising = solve_rising(normal, smoothness)
    assert (np.diff(rising.g) >= SMALLEST_STEP * (1 - 1e-6)).all()
    assert rising.correction == pytest.approx(np.abs(rising.g - free).max(), rel=1e-4)

    def cost(g: np.ndarray) -> float:
        return float(g @ normal.matrix @ g - 2 * normal.rhs @ g + smoothness * np.sum((bending() @ g) ** 2))

    best, random = cost(rising.g), np.random.default_rng(0)
    assert cost(free) < best
    for size in (1e-3, 1e-2, 0.1):
        for _ in range(50):
            steps = np.maximum(np.diff(rising.g) + size * random.normal(size=LEVELS - 1), SMALLEST_STEP)
            assert cost(-np.r_[np.cumsum(steps[::-1])[::-1], 0.0]) > best - 1e-9


def test_the_smoothing_weight_follows_the_noise() -> None:
    """Noise on a straight line is smoothed away, a sharp bend in clean data is not."""
    straight = smooth(rising_equations(noise=0.3), 30.0)
    assert straight.shapes < 4
    random = np.random.default_rng(1)
    levels = random.integers(1, 255, (1500, 5))
    bent = np.log(levels / 255) + 0.4 * np.sin(levels / 20)
    clean = smooth(eliminate(levels, bent - random.normal(size=(1500, 1)), np.ones(levels.shape)), 48.0)
    assert clean.shapes > 15
    assert clean.sigma < 0.02


def test_samples_hit_every_level_that_any_image_has() -> None:
    """The rarest too: one pixel of a level in one image of many pixels."""
    images = capture(scene(), SEVEN_S, knee, 0.2)
    big = np.concatenate([np.tile(images, (1, 1, 2)), np.full((7, *SHAPE), 3, np.uint8).repeat(2, axis=2)], axis=1)
    big = np.where(big == 77, 78, big)
    big[2, 50, 61] = 77
    big[3, 50, 61] = 140
    bracket = read_bracket(big, SEVEN_S)
    chosen = choose_samples(bracket, draw_pool(bracket, 0), 3000, 0)
    linked = ((big > 0) & (big < 255)).sum(axis=0) >= 2
    present = np.setdiff1d(np.unique(big[:, linked]), [0, 255])
    assert np.isin(present, chosen.grey).all()
    assert 77 in chosen.grey[:, 2]
    assert len(np.unique(chosen.pixels)) == len(chosen.pixels) == 3000


# --- the radiance map


def test_the_map_gives_radiance_back_and_says_where_it_cannot() -> None:
    radiance = scene().copy()
    radiance[:10, :10] = 5000.0
    radiance[-10:, -10:] = 1e-6
    images = capture(radiance, SEVEN_S, knee)
    merged = merge_bracket(images, SEVEN_S, fitted("knee").response)
    seen = np.isfinite(merged.radiance)
    assert np.median(np.abs(np.log(merged.radiance[seen] / radiance[seen]))) < 0.01
    assert merged.saturated[:10, :10].all()
    assert not (merged.saturated & (radiance * SEVEN_S[0] < 0.95)).any()
    assert not seen[:10, :10].any()
    assert merged.dark[-10:, -10:].mean() > 0.0
    assert (merged.dark <= ~seen).all()
    assert np.sqrt(np.nanmean(merged.residual_grey**2)) == pytest.approx(np.hypot(1.0, 12**-0.5), rel=0.1)


def test_residuals_of_the_map_show_what_moved() -> None:
    images = capture(scene(), SEVEN_S, knee)
    images[3, 60:80, 60:80] = images[3, 20:40, 100:120]
    merged = merge_bracket(images, SEVEN_S, fitted("knee").response)
    assert np.nanmedian(merged.residual_grey[60:80, 60:80]) > 5 * np.nanmedian(merged.residual_grey)


def test_one_image_gives_radiance_without_residual() -> None:
    merged = merge_bracket([np.full((2, 2), 128, np.uint8)], [0.5], Response.gamma(1.0))
    np.testing.assert_allclose(merged.radiance, 128 / 255 / 0.5)
    assert np.isnan(merged.residual_grey).all()


# --- bad input: what it names and what to do

TIMES_S = SEVEN_S[1:6]


def good() -> np.ndarray:
    return capture(scene(), TIMES_S, knee)


def changed(index: int, image: np.ndarray) -> list[np.ndarray]:
    images = list(good())
    images[index] = image
    return images


def moved(rows: int) -> list[np.ndarray]:
    return changed(2, capture(np.roll(scene(), rows, axis=0), TIMES_S[2:3], knee, seed=9)[0])


BAD: dict[str, tuple[Callable[[], object], object, str]] = {
    "saturated": (lambda: np.full((5, 64, 64), 255, np.uint8), TIMES_S, r"all images are saturated.*100.0%.*shorter"),
    "dark": (lambda: np.zeros((5, 64, 64), np.uint8), TIMES_S, r"all images are dark.*100.0%.*expose longer"),
    "two images": (lambda: good()[:2], TIMES_S[:2], r"2 distinct exposures, needs 3"),
    "no image": (list, [], r"bracket: no images"),
    "twice the same time": (lambda: good()[:3], [0.001, 0.002, 0.002], r"2 distinct exposures, needs 3"),
    "zero": (good, [0.0, *TIMES_S[1:]], r"image 0: the exposure is 0.0 s, needs a positive"),
    "negative": (good, [*TIMES_S[:4], -1.0], r"image 4: the exposure is -1.0 s"),
    "not a number": (good, [np.nan, *TIMES_S[1:]], r"image 0: the exposure is nan s"),
    "infinite": (good, [*TIMES_S[:4], np.inf], r"image 4: the exposure is inf s"),
    "too many times": (good, SEVEN_S, r"5 images, 7 exposures, 5 names"),
    "narrow": (good, 0.01 + 0.001 * np.arange(5), r"1\.4 times the shortest, needs 2"),
    "reversed": (
        good,
        TIMES_S[::-1],
        r"image 3 .* exposed 2 times as long as image 4 .* -\d+\.\d+ grey levels brighter",
    ),
    "two swapped": (good, TIMES_S[[0, 2, 1, 3, 4]], r"image 1 \(8 ms\): exposed 2 times as long as image 2 \(4 ms\)"),
    "one image for all": (lambda: np.repeat(good()[2:3], 5, axis=0), TIMES_S, r"\+0\.00 grey levels brighter"),
    "one image, fine steps": (lambda: np.repeat(good()[2:3], 9, axis=0), 0.01 * 1.1 ** np.arange(9), r"\+0\.00 grey"),
    "moved": (lambda: moved(3), TIMES_S, r"image 2 \(8 ms\): disagrees with the other images: .* without, limit 75%"),
    "far moved": (lambda: moved(40), TIMES_S, r"image 2 \(8 ms\): disagrees with the other images"),
    "wrong time": (good, [0.002, 0.004, 0.0105, 0.016, 0.032], r"image 2 \(10.5 ms\): disagrees"),
    "all moved": (
        lambda: [capture(np.roll(scene(), 11 * i, 0), TIMES_S[i : i + 1], knee)[0] for i in range(5)],
        TIMES_S,
        r"residuals are \d+.* limit 8|contradict each other",
    ),
    "far apart": (
        lambda: capture(scene(), 1e-4 * 400.0 ** np.arange(3), gamma(1.0)),
        1e-4 * 400.0 ** np.arange(3),
        r"take exposures closer together|gap of|disagree|limit",
    ),
    "two shades": (
        lambda: capture(np.where(scene() > 20, 40.0, 8.0), TIMES_S, gamma(1.0), 0.2),
        TIMES_S,
        r"no pixel has a grey level between \d+ and \d+, a gap of \d+ levels, limit 32",
    ),
    "too few samples": (good, TIMES_S, r"samples: 3, needs at least 50"),
}


@pytest.mark.parametrize("case", sorted(BAD))
def test_a_bracket_that_carries_no_response_is_refused(case: str) -> None:
    images, times_s, message = BAD[case]
    with pytest.raises(CalibrationError, match=message):
        fit_response(images(), times_s, samples=3 if case == "too few samples" else 1000)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros(SHAPE, np.uint16), r"image 1: has uint16 pixels, needs uint8"),
        (np.zeros((*SHAPE, 3), np.uint8), r"image 1: has shape \(160, 200, 3\), needs \(H, W\)"),
        (np.zeros((160, 201), np.uint8), r"image 1: has shape \(160, 201\), needs that of image 0, \(160, 200\)"),
        (np.zeros(SHAPE), r"image 1: has float64 pixels"),
    ],
)
def test_an_image_of_another_kind_is_refused(image: np.ndarray, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        fit_response(changed(1, image), TIMES_S)


def test_names_are_the_callers() -> None:
    with pytest.raises(CalibrationError, match=r"c\.bmp \(8 ms\): disagrees"):
        fit_response(moved(3), TIMES_S, names=[f"{c}.bmp" for c in "abcde"])


def test_levels_that_do_not_change_with_exposure_say_nothing() -> None:
    levels = np.full((100, 3), 50)
    with pytest.raises(CalibrationError, match="no pixel changes its grey level"):
        smooth(eliminate(levels, np.zeros(levels.shape), np.ones(levels.shape)), 30.0)


def test_noise_that_hides_the_curve_is_refused_by_its_standard_error() -> None:
    """Three exposures a factor four apart and a steep camera: the curve is free up to a ripple."""
    times_s = np.array([0.0025, 0.01, 0.04])
    with pytest.raises(CalibrationError, match=r"standard error of g is 0\.\d+ ln units|residuals|contradict"):
        fit_response(capture(scene(), times_s, gamma(0.3), 6.0), times_s)


def test_noise_that_one_image_has_more_of_is_no_sign_that_it_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    images = capture(scene(), SEVEN_S, knee, 0.5)
    loud = images[4] + np.random.default_rng(5).normal(0.0, 1.6, images[4].shape)
    images[4] = np.where((images[4] > 0) & (images[4] < 255), np.clip(np.rint(loud), 0, 255), images[4])
    assert fit_response(images, SEVEN_S).noise_grey < 2.0
    monkeypatch.setattr("sidelong.calibration.response.fit.LEAST_DOUBT_GREY", 0.0)
    with pytest.raises(CalibrationError, match="disagrees with the other images"):
        fit_response(images, SEVEN_S)
