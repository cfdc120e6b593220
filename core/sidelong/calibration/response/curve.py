"""The curve of a response from samples: rounds of linear solves with weights and tangents from the round before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.calibration.response.solve import LEAST_RISE, Normal, Solution, eliminate, smooth
from sidelong.errors import CalibrationError
from sidelong.physics.response import LEVELS
from sidelong.types import FloatArray, IntArray

MOST_SHAPES = (8.0, 14.0, 20.0, 30.0)
"""Limit of the effective number of shapes in each round: the fit starts stiff, so that the first tangents hold."""
FIRST_MARGIN = 5
"""Grey levels next to the clips that the first round leaves out: what is clipped is not known before it."""
NOISE_MARGIN = 2.0
"""Later rounds leave out what is predicted within so many standard deviations of a clip: clipped noise is biased."""
LEAST_MARGIN = 0.75
LEAST_LEFT = 0.2
"""Equations that leave less of their variance than this say nothing of the noise: the radiance follows them."""
ROUNDING_GREY = 0.3
"""Standard deviation of rounding to whole levels; noise is never taken for less."""
OUTLIER = 3.0
"""Residuals beyond so many standard deviations count by their size instead of their square."""
FLATTEST = 0.1
"""Least slope of g in units of the overall power law's: keeps weights bounded where an early g is flat."""

CONVERGED = 5e-3
"""A round that changes g by less, ln units above level 15, is the last: each change is a fraction of the one before."""
FEWEST_SPARE = 50
"""Equations that must be left when each radiance has used up one."""
DIVERGED = 1.3
"""A round whose noise exceeds the last one's by this factor is thrown away, and ends the fit."""


@dataclass(frozen=True, eq=False)
class CurveFit:
    """A response curve and how the samples lie on it.

    Attributes
    ----------
    solution, normal
        The curve and the normal equations it solves.
    residual_grey
        (n, P) observed less predicted grey level, over the share each equation leaves of itself (studentised); NaN
        where there is no equation or it leaves too little.
    residual_ln
        (n, P) the same in ln units, not studentised: g(Z) - ln E - ln dt.
    spread_grey
        Standard deviation of ``residual_grey`` by its median, blind to outliers.
    """

    solution: Solution
    normal: Normal
    residual_grey: FloatArray
    residual_ln: FloatArray
    spread_grey: float

    @property
    def rms_grey(self) -> float:
        """Rms of ``residual_grey``, outliers included."""
        return float(np.sqrt(np.nanmean(self.residual_grey**2)))

    def outlier_share(self, spreads: float) -> float:
        """Return the share of residuals beyond so many times ``spread_grey``."""
        known = self.residual_grey[np.isfinite(self.residual_grey)]
        return float((np.abs(known) > spreads * self.spread_grey).mean())

    def image_rms_grey(self) -> FloatArray:
        """Return the rms of ``residual_grey`` of each image (P,), NaN where it has no equation."""
        known = np.isfinite(self.residual_grey)
        count = known.sum(axis=0)
        squares = np.where(known, self.residual_grey, 0.0) ** 2
        return np.where(count > 0, np.sqrt(squares.sum(axis=0) / np.maximum(count, 1)), np.nan)


@dataclass(frozen=True, eq=False)
class _Equations:
    """Equations w [g(level) - ln E - target], (n, P) each; weight 0 means none."""

    levels: IntArray
    targets: FloatArray
    weights: FloatArray


def fit_curve(grey: IntArray, exposures_s: FloatArray) -> CurveFit:
    """Fit g to samples (n, P) of grey levels at P exposures.

    Each round solves for g, predicts every level from its pixel's radiance, and puts there the tangents and weights of
    the next round.

    Raises
    ------
    CalibrationError
        Fewer than ``FEWEST_SPARE`` equations to spare: too few pixels are off both clips in two images.
    """
    equations = _first_equations(grey, np.log(exposures_s))
    best: CurveFit | None = None
    spare = 0
    for most_shapes in MOST_SHAPES:
        normal = eliminate(equations.levels, equations.targets, equations.weights)
        spare = normal.spare
        if spare < FEWEST_SPARE:
            break
        solution = smooth(normal, most_shapes)
        if best is not None and solution.sigma > DIVERGED * max(best.rms_grey, ROUNDING_GREY):
            break
        fit, equations = _next_round(solution, normal, equations, grey, np.log(exposures_s))
        spare = int(np.isfinite(fit.residual_grey).sum())
        if spare < FEWEST_SPARE:
            break
        moved = np.inf if best is None else float(np.abs(solution.g - best.solution.g)[16:].max())
        best = fit
        if moved < CONVERGED:
            break
    if best is None:
        raise CalibrationError(
            f"bracket: {spare} equations can be checked against others, needs {FEWEST_SPARE}: too few pixels are off "
            "both clips in two images, or the images contradict each other; take exposures closer together and keep "
            "the scene still"
        )
    return best


def _first_equations(grey: IntArray, log_time: FloatArray) -> _Equations:
    """Return the equations at the observed levels, with Debevec and Malik's hat as weight."""
    distance = np.minimum(grey, LEVELS - 1 - grey).astype(np.float64)
    weights = _linked(np.where(distance > FIRST_MARGIN, distance, 0.0))
    return _Equations(grey, np.broadcast_to(log_time, grey.shape), weights)


def _next_round(
    solution: Solution, normal: Normal, equations: _Equations, grey: IntArray, log_time: FloatArray
) -> tuple[CurveFit, _Equations]:
    """Return how the samples lie on the curve, and the equations that follow from it."""
    g = (np.maximum.accumulate(solution.g) + LEAST_RISE * np.arange(LEVELS)).astype(np.float64)
    square = equations.weights**2
    total = square.sum(axis=1, keepdims=True)
    pulled = ((g[equations.levels] - equations.targets) * square).sum(axis=1, keepdims=True)
    log_radiance: FloatArray = np.divide(pulled, total, out=np.full_like(total, np.nan), where=total > 0)
    predicted = np.interp(log_radiance + log_time, g, np.arange(LEVELS)).astype(np.float64)
    possible = np.isfinite(predicted) & (grey > 0) & (grey < LEVELS - 1)
    levels = np.rint(np.where(possible, predicted, 1.0)).astype(np.intp)
    slope = slopes(g)[levels]
    residual = np.where(possible, grey - predicted, 0.0)
    # an equation pulls its own radiance along: this share of its variance is left in its residual
    left = 1 - np.divide(square, total, out=np.zeros_like(square), where=total > 0)
    telling = (equations.weights > 0) & (left > LEAST_LEFT)
    student = residual / np.sqrt(np.maximum(left, LEAST_LEFT))
    spread = max(1.483 * float(np.median(np.abs(student[telling]))), ROUNDING_GREY) if telling.any() else ROUNDING_GREY
    margin = max(NOISE_MARGIN * spread, LEAST_MARGIN)
    used = possible & (predicted > margin) & (predicted < LEVELS - 1 - margin)
    robust = np.sqrt(np.minimum(1.0, OUTLIER * spread / np.maximum(np.abs(student), 1e-9)))
    weights = _linked(np.where(used, robust / slope, 0.0))
    fit = CurveFit(
        solution,
        normal,
        np.where((weights > 0) & (left > LEAST_LEFT), student, np.nan),
        np.where(weights > 0, residual * slope, np.nan),
        spread,
    )
    return fit, _Equations(levels, log_time - slope * (grey - levels), weights)


def slopes(g: FloatArray) -> FloatArray:
    """Return dg/dz (256,) over four levels, never flatter than ``FLATTEST`` of the overall power law's."""
    slopes = np.empty(LEVELS)
    slopes[2:-2] = (g[4:] - g[:-4]) / 4
    slopes[:2], slopes[-2:] = slopes[2], slopes[-3]
    exponent = (g[240] - g[10]) / np.log(24.0)
    return np.maximum(slopes, FLATTEST * exponent / np.maximum(np.arange(LEVELS), 1))


def _linked(weights: FloatArray) -> FloatArray:
    """Drop the equations of pixels that have only one: they fix their radiance and nothing else."""
    return np.where((weights > 0).sum(axis=1, keepdims=True) >= 2, weights, 0.0)
