"""How likely the measured depth of a view is if a pose is right, relative to depth that no pose explains.

Each pixel that the part covers was measured on its surface (a Gaussian), on something before it (an occluder, nearly
neutral), or behind it, which an opaque part forbids; the latter two are uniform. This is the beam model of a range
sensor (Thrun, Burgard and Fox, Probabilistic Robotics, 2005, section 6.3). Where nothing was measured nothing is said:
shiny parts lose depth wherever they are.
"""

from __future__ import annotations

import numpy as np

from sidelong.detection.appearance import Look
from sidelong.detection.depth_evidence import residuals
from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.types import FloatArray


def log_likelihood_ratio(look: Look, depth_m: FloatArray, span_m: float, settings: RefinementSettings) -> FloatArray:
    """Return the log-likelihood (K,) of a depth map, less that of depth spread evenly over ``span_m``.

    Pixels count as if their errors were independent; 0 where nothing was measured.

    Parameters
    ----------
    look
        What K poses look like from the view.
    depth_m
        (H, W) measured depth, NaN where missing.
    span_m
        Range of depths that the uniform distributions cover, metres: the diameter of the part.
    settings
        Width and odds of the mixture.
    """
    residual_m = residuals(look, depth_m)
    deviation_m = settings.agreement_m
    peak = settings.agreement_odds * span_m / (deviation_m * np.sqrt(2 * np.pi))
    elsewhere = np.where(residual_m > 0, settings.behind_odds, settings.occluder_odds)
    ratio = np.log(peak * np.exp(-0.5 * (residual_m / deviation_m) ** 2) + elsewhere)
    return np.where(np.isfinite(residual_m), ratio, 0.0).sum(axis=1)
