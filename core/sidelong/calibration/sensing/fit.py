"""The probability of depth against exposure, learned from captures of parts whose poses are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.calibration.sensing.exponential import fit_exponential
from sidelong.calibration.sensing.samples import SensingSamples
from sidelong.calibration.sensing.scores import Scores, scores_of
from sidelong.calibration.sensing.unimodal_curve import PSEUDO_COUNT, BinnedCurve, binned_sum, fit_curve
from sidelong.errors import CalibrationError
from sidelong.physics.response import Response
from sidelong.physics.sensing import PaperSensing, SensingCurve, SensingSettings, all_cameras
from sidelong.types import FloatArray, IntArray

FEWEST_PIXELS, FEWEST_OF_A_KIND = 500, 20
"""Pixels in all, and of those with and of those without depth, that a curve needs."""
LEAST_SPAN_LN = float(np.log(4.0))
"""Least span of the exposures (5th to 95th percentile of the darker camera): two stops."""
FOLDS = 5


@dataclass(frozen=True, eq=False)
class SensingFit:
    """Result of :func:`fit_sensing`.

    Attributes
    ----------
    curve
        The learned probability.
    log_edges
        (B + 1,) borders of the bins, ln of exposure over saturation.
    count, frequency, standard_error
        (B,) pixels that the worse camera sees in the bin, how many of them have depth (share), and the error of that
        share: from the scatter between groups where there are several, else as if pixels were independent. NaN where
        the bin is empty.
    pixels, unlit
        Pixels used, and left out because no light was predicted.
    inside, held_out
        Scores on the pixels fitted, and on those of groups left out; None where there is one group only.
    exponential, exponential_inside, exponential_held_out
        The paper's exponential with the parameters that suit the same pixels best, and its scores.
    warnings
        What does not hold, in words.
    """

    curve: SensingCurve
    log_edges: FloatArray
    count: IntArray
    frequency: FloatArray
    standard_error: FloatArray
    pixels: int
    unlit: int
    inside: Scores
    held_out: Scores | None
    exponential: SensingSettings
    exponential_inside: Scores
    exponential_held_out: Scores | None
    warnings: tuple[str, ...]


def fit_sensing(samples: SensingSamples, response: Response | None = None) -> SensingFit:
    """Learn P(depth | exposure), and the best exponential (7) beside it.

    Parameters
    ----------
    samples
        Pixels. Those without predicted light are left out: the curve is 0 there by definition.
    response
        Sensor, for the grey levels of the exponential; linear where not given.

    Raises
    ------
    CalibrationError
        Too few pixels, all or none of them with depth, or hardly any range of exposures.
    """
    response = response or Response.gamma()
    lit = samples[(samples.exposure > 0).all(axis=1) & (samples.weight > 0)]
    _check(lit)
    binned = fit_curve(lit)
    curve, exponential = binned.curve(), fit_exponential(lit.exposure, lit.valid, lit.weight, response)
    held_out, exponential_held_out = _cross_validated(lit, response)
    count, frequency, standard_error = _bin_counts(lit, binned)
    return SensingFit(
        curve=curve,
        log_edges=binned.log_edges,
        count=count,
        frequency=frequency,
        standard_error=standard_error,
        pixels=len(lit),
        unlit=len(samples) - len(lit),
        inside=scores_of(all_cameras(curve.at(lit.exposure)), lit.valid, lit.weight),
        held_out=held_out,
        exponential=exponential,
        exponential_inside=scores_of(
            PaperSensing(exponential, response).probability(lit.exposure), lit.valid, lit.weight
        ),
        exponential_held_out=exponential_held_out,
        warnings=_warnings(lit, binned, count, held_out),
    )


def _check(lit: SensingSamples) -> None:
    """Refuse pixels that cannot carry a curve."""
    n, with_depth = len(lit), int(lit.valid.sum())
    if n < FEWEST_PIXELS:
        raise CalibrationError(f"sensing: {n} lit part pixels, a curve needs {FEWEST_PIXELS}: capture more views")
    if with_depth < FEWEST_OF_A_KIND or n - with_depth < FEWEST_OF_A_KIND:
        raise CalibrationError(
            f"sensing: {with_depth} of {n} lit part pixels have depth, at least {FEWEST_OF_A_KIND} must have it and "
            f"{FEWEST_OF_A_KIND} lack it: check the poses, or capture at another exposure"
        )
    low, high = np.percentile(np.log(lit.exposure.min(axis=1)), (5, 95))
    if high - low < LEAST_SPAN_LN:
        raise CalibrationError(
            f"sensing: the exposures of 90 % of the pixels span a factor of {np.exp(high - low):.3g}, "
            f"at least {np.exp(LEAST_SPAN_LN):.3g} is needed: add views, or captures at other exposure times"
        )


def _bin_counts(lit: SensingSamples, binned: BinnedCurve) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return how many pixels each bin holds, the share with depth, and its error (B,)."""
    bins, knots = binned.limiting, binned.log_knots
    count = np.bincount(bins, minlength=len(knots))
    weight, hits = binned_sum(bins, lit.weight, knots), binned_sum(bins, lit.weight * lit.valid, knots)
    filled, nowhere = weight > 0, np.full(len(knots), np.nan)
    frequency = np.divide(hits, weight, out=nowhere.copy(), where=filled)
    groups, index = np.unique(lit.group, return_inverse=True)
    if len(groups) == 1:
        smooth = (hits + PSEUDO_COUNT) / (weight + 2 * PSEUDO_COUNT)
        return count, frequency, np.where(filled, np.sqrt(smooth * (1.0 - smooth) / (weight + 1.0)), np.nan)
    # pixels of a view share its errors: how far views differ is what counts
    residual = lit.weight * (lit.valid - frequency[bins])
    of_group = np.bincount(bins * len(groups) + index, weights=residual, minlength=len(knots) * len(groups))
    spread = np.sqrt(np.square(of_group.reshape(len(knots), -1)).sum(axis=1) * len(groups) / (len(groups) - 1))
    return count, frequency, np.divide(spread, weight, out=nowhere, where=filled)


def _cross_validated(lit: SensingSamples, response: Response) -> tuple[Scores | None, Scores | None]:
    """Score curve and exponential on groups they were not fitted to; None where no part can be left out."""
    groups, index = np.unique(lit.group, return_inverse=True)
    fold = index % min(FOLDS, len(groups))
    curve_p, exponential_p = np.full(len(lit), np.nan), np.full(len(lit), np.nan)
    for left_out in np.unique(fold):
        mine = fold == left_out
        rest = lit[~mine]
        if len(rest) < FEWEST_PIXELS // 2 or rest.valid.all() or not rest.valid.any():
            return None, None
        curve_p[mine] = all_cameras(fit_curve(rest).curve().at(lit.exposure[mine]))
        exponential = fit_exponential(rest.exposure, rest.valid, rest.weight, response)
        exponential_p[mine] = PaperSensing(exponential, response).probability(lit.exposure[mine])
    return scores_of(curve_p, lit.valid, lit.weight), scores_of(exponential_p, lit.valid, lit.weight)


def _warnings(lit: SensingSamples, binned: BinnedCurve, count: IntArray, held_out: Scores | None) -> tuple[str, ...]:
    low, high = np.exp(binned.log_edges[[0, -1]])
    thin = int((count < FEWEST_OF_A_KIND).sum())
    found = {
        f"no pixel below {low:.3g} of the saturation exposure: P goes to 0 below it, unmeasured": low > 0.25,
        f"no pixel above {high:.3g} of the saturation exposure: P goes to 0 above it, unmeasured": high < 1.0,
        f"{thin} of {len(count)} bins hold fewer than {FEWEST_OF_A_KIND} pixels": thin > 0,
        "depth does not depend on the exposure here: the curve is flat": bool(np.ptp(binned.p) == 0),
        "not cross-validated: no group can be left out": held_out is None,
    }
    return tuple(text for text, holds in found.items() if holds)
