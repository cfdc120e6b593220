"""The photometric response of a camera from an exposure bracket of a static scene (Debevec and Malik 1997)."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sidelong.calibration.response.curve import CurveFit, fit_curve
from sidelong.calibration.response.samples import (
    FEWEST_EXPOSURES,
    Bracket,
    Samples,
    check_brightness_order,
    choose_samples,
    draw_pool,
    read_bracket,
    usable_images,
)
from sidelong.calibration.response.solve import DISCOUNT, Rising, solve_rising
from sidelong.errors import CalibrationError
from sidelong.physics.response import LEVELS, Response
from sidelong.types import FloatArray, GrayImage

DEFAULT_SAMPLES = 2000
CONDITION_LIMIT = 1e10
LARGEST_GAP = 32
SMALLEST_SHARE = 0.25
FEWEST_SAMPLES = 50
ERROR_LIMIT = 0.2
"""Largest standard error of g over ``JUDGED`` levels, ln units."""
JUDGED = slice(16, 240)
CORRECTION_LIMIT = 0.2
RESIDUAL_LIMIT_GREY = 6.0
OUTLIER_SPREADS = 4.0
OUTLIER_LIMIT = 0.03
"""Largest share of residuals beyond ``OUTLIER_SPREADS``: hot pixels pass, a part of the scene that moved does not."""
SUSPECT_RATIO = 1.5
"""An image, or the tails of all residuals, this much above the typical spread makes the fit look for a moved image."""
LEAST_DOUBT_GREY = 2.0
"""Residuals below this are noise, however unevenly images share them: dark images have less of it than bright ones."""
SUSPECT_GREY = 4.0
"""Residuals beyond this are warned of."""
CULPRIT_DROP = 0.75
"""An image is the culprit if leaving it out brings the residuals below this share."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """Which grey levels the samples hit.

    Attributes
    ----------
    per_level
        (256,) samples at each level, all images together.
    share_seen
        Of the levels 1..254.
    largest_gap
        Most levels in a row that no sample hit, the ends included.
    """

    per_level: NDArray[np.intp]
    share_seen: float
    largest_gap: int


@dataclass(frozen=True, eq=False)
class ResponseFit:
    """Result of :func:`fit_response`.

    Attributes
    ----------
    response
        The response, g(255) = 0: radiance counts in saturation exposures per second.
    standard_error
        (256,) of g against g(255), ln units, from noise and the chosen smoothness; at 128 it is that of the saturation
        exposure against mid-grey. g(0) and g(255) are extrapolated along ln z, 0 standing for half a level.
    noise_grey
        Standard deviation of the residuals in grey levels, degrees of freedom taken off.
    condition
        Upper bound of the condition number of the 255x255 system, scaled to a unit diagonal, in variables in which the
        penalty is the identity.
    smoothness
        Weight of the penalty on g'' + g'/z, equations weighted by 1/g'.
    shapes
        Effective number of parameters of g at that weight.
    correction
        Largest change of g by the demand that it rises, ln units; 0 if the free solution rises.
    coverage
        Grey levels hit.
    names, image_residual_grey, image_equations
        Of the P images used, by rising exposure: rms residual (NaN where no equation) and number of equations.
    residual_ln
        Rms of g(Z) - ln E - ln dt over the equations.
    samples
        Pixels used.
    warnings
        What the caller should know though the fit stands.
    """

    response: Response
    standard_error: FloatArray
    noise_grey: float
    condition: float
    smoothness: float
    shapes: float
    correction: float
    coverage: Coverage
    names: tuple[str, ...]
    image_residual_grey: FloatArray
    image_equations: NDArray[np.intp]
    residual_ln: float
    samples: int
    warnings: tuple[str, ...]


def fit_response(
    images: Sequence[GrayImage] | GrayImage,
    exposures_s: Sequence[float] | FloatArray,
    names: Sequence[str] | None = None,
    samples: int = DEFAULT_SAMPLES,
    seed: int = 0,
) -> ResponseFit:
    """Fit the response to images of one static scene at several exposures.

    Parameters
    ----------
    images
        P images (H, W) uint8 in any order.
    exposures_s
        (P,) seconds, at least three distinct ones; two images may share one.
    names
        (P,) names of the images for messages.
    samples
        How many pixels to use at most; they are chosen so that all grey levels are hit evenly.
    seed
        Of the choice; same seed and images, same fit.

    Raises
    ------
    ImageError
        Images that are not 8-bit grey or differ in size.
    CalibrationError
        The bracket cannot carry a response (times, clipping, gaps between the grey levels), its images contradict each
        other (swapped times, a scene that moved), or the response stays undetermined. The message has the number.
    """
    if samples < FEWEST_SAMPLES:
        raise CalibrationError(f"samples: {samples}, needs at least {FEWEST_SAMPLES}")
    bracket = read_bracket(images, exposures_s, names)
    pool = draw_pool(bracket, seed)
    grey = bracket.grey(pool)
    usable = usable_images(bracket, grey)
    check_brightness_order(bracket, grey)
    warnings = [f"{bracket.label(int(i))}: left out, clipped almost everywhere" for i in np.flatnonzero(~usable)]
    bracket = bracket.only(usable)
    chosen = choose_samples(bracket, pool, samples, seed)
    coverage = _check_coverage(chosen)
    fit, doubts = _agreeing_fit(chosen, bracket)
    warnings += doubts
    rising = solve_rising(fit.normal, fit.solution.smoothness)
    error = fit.solution.sigma * np.sqrt(DISCOUNT * rising.variance)
    _check_curve(rising, error)
    if rising.correction > 0:
        warnings.append(f"g was moved by up to {rising.correction:.2g} ln units to make it rise")
    return ResponseFit(
        response=Response(rising.g),
        standard_error=error,
        noise_grey=fit.solution.sigma,
        condition=rising.condition,
        smoothness=fit.solution.smoothness,
        shapes=fit.solution.shapes,
        correction=rising.correction,
        coverage=coverage,
        names=bracket.names,
        image_residual_grey=fit.image_rms_grey(),
        image_equations=np.isfinite(fit.residual_grey).sum(axis=0),
        residual_ln=float(np.sqrt(np.nanmean(fit.residual_ln**2))),
        samples=len(chosen.pixels),
        warnings=tuple(warnings),
    )


def _check_coverage(samples: Samples) -> Coverage:
    """Count the levels hit; refuse samples that leave stretches of grey levels without any."""
    per_level = np.bincount(samples.grey.ravel(), minlength=LEVELS)
    seen = np.flatnonzero(per_level[1:-1]) + 1
    share = len(seen) / (LEVELS - 2)
    if len(samples.pixels) < FEWEST_SAMPLES:
        raise CalibrationError(
            f"bracket: {len(samples.pixels)} pixels are off both clips in two images, needs {FEWEST_SAMPLES}: grey "
            "levels are not linked; take exposures closer together"
        )
    ends = np.r_[0, seen, LEVELS - 1]
    gaps = np.diff(ends) - 1
    widest = int(np.argmax(gaps))
    if gaps[widest] > LARGEST_GAP:
        raise CalibrationError(
            f"bracket: no pixel has a grey level between {ends[widest]} and {ends[widest + 1]}, a gap of "
            f"{gaps[widest]} levels, limit {LARGEST_GAP}: use a scene with more shades or exposures in between"
        )
    if share < SMALLEST_SHARE:
        raise CalibrationError(
            f"bracket: {share:.0%} of the grey levels 1 to 254 occur, needs {SMALLEST_SHARE:.0%}: use a scene with "
            "more shades or more exposures"
        )
    return Coverage(per_level, share, int(gaps[widest]))


def _agreeing_fit(samples: Samples, bracket: Bracket) -> tuple[CurveFit, list[str]]:
    """Fit the curve; refuse images that do not show one scene at the exposures given.

    Raises
    ------
    CalibrationError
        Names the image whose absence mends the fit, if there is one and more than three images were given.
    """
    try:
        fit = fit_curve(samples.grey, bracket.exposures_s)
    except CalibrationError:
        _name_culprit(samples, bracket, np.inf)
        raise
    total, typical, per_image = fit.rms_grey, fit.spread_grey, fit.image_rms_grey()
    uneven = max(float(np.nanmax(per_image) / np.nanmedian(per_image)), total / typical)
    outliers = fit.outlier_share(OUTLIER_SPREADS)
    bad = typical > RESIDUAL_LIMIT_GREY or outliers > OUTLIER_LIMIT
    if bad or (uneven > SUSPECT_RATIO and total > LEAST_DOUBT_GREY):
        _name_culprit(samples, bracket, total)
    if bad:
        raise CalibrationError(
            f"bracket: residuals are {typical:.1f} grey levels, limit {RESIDUAL_LIMIT_GREY:g}, {outliers:.1%} of them "
            f"beyond {OUTLIER_SPREADS:g} times that, limit {OUTLIER_LIMIT:.0%}, and no single image is to blame: keep "
            "camera, scene and light still and check the exposure times"
        )
    if typical > SUSPECT_GREY or total > SUSPECT_RATIO * typical:
        worst = int(np.nanargmax(per_image))
        return fit, [
            f"residuals are {total:.1f} grey levels, {typical:.1f} typically, {per_image[worst]:.1f} in "
            f"{bracket.label(worst)}: noisy images, or scene and light were not quite still"
        ]
    return fit, []


def _name_culprit(samples: Samples, bracket: Bracket, total: float) -> None:
    """Raise if leaving one image out brings the residuals well below ``total`` grey levels and under the limit."""
    if len(bracket.names) <= FEWEST_EXPOSURES:
        return  # any two images agree
    culprit, without = _leave_one_out(samples, bracket)
    if without < min(CULPRIT_DROP * total, RESIDUAL_LIMIT_GREY):
        found = f"residuals are {total:.1f} grey levels with it" if np.isfinite(total) else "no curve fits them with it"
        raise CalibrationError(
            f"{bracket.label(culprit)}: disagrees with the other images: {found} and {without:.1f} grey levels "
            f"without, limit {CULPRIT_DROP:.0%}; did camera, scene or light change, or is its exposure wrong? Leave it "
            "out or repeat it"
        )


def _leave_one_out(samples: Samples, bracket: Bracket) -> tuple[int, float]:
    """Return the image without which the residuals are least, and their rms in grey levels."""
    count = len(bracket.names)
    remaining = np.full(count, np.inf)
    for image in range(count):
        others = np.delete(np.arange(count), image)
        with suppress(CalibrationError):  # too little left without it: then it is not the one to blame
            remaining[image] = fit_curve(samples.grey[:, others], bracket.exposures_s[others]).rms_grey
    best = int(np.argmin(remaining))
    return best, float(remaining[best])


def _check_curve(rising: Rising, error: FloatArray) -> None:
    """Refuse a response that the images do not determine."""
    if rising.condition > CONDITION_LIMIT:
        raise CalibrationError(
            f"bracket: the condition number is {rising.condition:.1e}, limit {CONDITION_LIMIT:.0e}: grey levels are "
            "not linked; add exposures in between"
        )
    largest = float(error[JUDGED].max())
    if largest > ERROR_LIMIT:
        raise CalibrationError(
            f"bracket: the standard error of g is {largest:.2f} ln units at grey level "
            f"{JUDGED.start + int(np.argmax(error[JUDGED]))}, limit {ERROR_LIMIT}: add exposures in between, or images "
            "with less noise"
        )
    if rising.correction > CORRECTION_LIMIT:
        raise CalibrationError(
            f"bracket: g had to be moved by {rising.correction:.2f} ln units to rise, limit {CORRECTION_LIMIT}: the "
            "images do not determine it; add exposures in between, or images with less noise"
        )
