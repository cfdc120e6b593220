"""What the completed depth of a scan is worth against the truth, pixel by pixel, and whether its sigma is honest."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict

from sidelong.evaluation.metrics import RECOVERED_WITHIN_M, Truth
from sidelong.types import BoolArray, CompletedDepth, PixelState

SIGMAS_OF_95 = 1.959964
"""Half the width of the interval that holds 95 % of a normal distribution, in standard deviations."""


class DepthErrors(BaseModel):
    """Errors of the depth of some pixels whose truth is known; None where there are none.

    ``median_m`` and ``p95_m`` (95th percentile) are of the absolute error of all of them, ``beyond`` is the share of
    those that are not within ``RECOVERED_WITHIN_M``. Of those that are, ``recovered_p95_m`` is the 95th percentile, and
    ``normalised_std`` the standard deviation of error over sigma, 1 where sigma is honest. ``coverage`` is the share of
    all that lie within the 95 % interval of their sigma.
    """

    model_config = ConfigDict(frozen=True)

    pixels: int
    median_m: float | None = None
    p95_m: float | None = None
    beyond: float | None = None
    recovered_p95_m: float | None = None
    normalised_std: float | None = None
    coverage: float | None = None


class DepthScore(BaseModel):
    """Errors of the depth that other views gave, and beside them of what the reference view measured itself.

    Contradicted pixels no longer count as measured, doubtful and modelled ones not as completed.
    """

    model_config = ConfigDict(frozen=True)

    completed_on_parts: DepthErrors
    completed: DepthErrors
    measured_on_parts: DepthErrors
    measured: DepthErrors


def score_depth(depth: CompletedDepth, truth: Truth) -> DepthScore:
    """Judge the depth of a reference view, on the parts and everywhere its truth is known."""
    completed, measured = depth.state == PixelState.COMPLETED, depth.state == PixelState.MEASURED
    return DepthScore(
        completed_on_parts=depth_errors(depth, truth, completed & truth.on_parts),
        completed=depth_errors(depth, truth, completed),
        measured_on_parts=depth_errors(depth, truth, measured & truth.on_parts),
        measured=depth_errors(depth, truth, measured),
    )


def depth_errors(depth: CompletedDepth, truth: Truth, where: BoolArray) -> DepthErrors:
    """Return the errors of the pixels (H, W) that are asked for and have depth and a known truth."""
    known = where & np.isfinite(depth.depth_m) & np.isfinite(truth.depth_m)
    if not known.any():
        return DepthErrors(pixels=0)
    error_m, sigma_m = depth.depth_m[known] - truth.depth_m[known], depth.sigma_m[known]
    size_m = np.abs(error_m)
    within = size_m < RECOVERED_WITHIN_M
    median_m, p95_m = (float(value) for value in np.percentile(size_m, (50, 95)))
    return DepthErrors(
        pixels=int(known.sum()),
        median_m=median_m,
        p95_m=p95_m,
        beyond=float(1.0 - within.mean()),
        recovered_p95_m=float(np.percentile(size_m[within], 95)) if within.any() else None,
        normalised_std=float((error_m[within] / sigma_m[within]).std()) if within.any() else None,
        coverage=float((size_m <= SIGMAS_OF_95 * sigma_m).mean()),
    )
