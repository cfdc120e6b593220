"""The paper's exponential (7) with the parameters that suit given captures best: the fair rival of a learned curve."""

from __future__ import annotations

import numpy as np

from sidelong.calibration.sensing.scores import SUREST
from sidelong.physics.response import LEVELS, Response
from sidelong.physics.sensing import SensingSettings
from sidelong.types import BoolArray, FloatArray, IntArray

Z_MIN = np.arange(0, 161, 4)
Z_MAX = np.array([200.0, 220.0, 235.0, 245.0, 250.0, 255.0])
SIGMA = np.geomspace(10.0, 1e4, 25)


def fit_exponential(exposure: FloatArray, valid: BoolArray, weight: FloatArray, response: Response) -> SensingSettings:
    """Return z_min, z_max and sigma of least log-loss on a grid.

    Parameters
    ----------
    exposure
        (N, C) of C cameras, relative to saturation.
    valid, weight
        (N,) whether depth was measured, and how much the pixel counts.
    response
        Sensor.
    """
    radiance = exposure * response.saturation_exposure
    z = response.intensity(radiance, 1.0)
    # where a camera clips P is 0, as it is above z_max
    brightest = np.where(response.saturated(radiance, 1.0), np.inf, z).max(axis=1)
    # P rises with Z up to z_max, so the darker camera decides; each z_min of the grid is a border between levels
    level = np.floor(z.min(axis=1)).astype(np.intp)
    candidates = [_best_z_min(float(z_max), brightest <= z_max, level, valid, weight) for z_max in Z_MAX]
    _, z_min, z_max, sigma = min(candidates)
    return SensingSettings(z_min=z_min, z_max=z_max, sigma=sigma, stereo=exposure.shape[1] == 2)


def _best_z_min(
    z_max: float, usable: BoolArray, level: IntArray, valid: BoolArray, weight: FloatArray
) -> tuple[float, float, float, float]:
    """Return the least loss for a ``z_max``, and its z_min, z_max and sigma."""
    hits = np.bincount(level, weights=weight * (usable & valid), minlength=LEVELS).astype(np.float64)
    misses = np.bincount(level, weights=weight * (usable & ~valid), minlength=LEVELS).astype(np.float64)
    beyond = _losses(np.zeros(1), weight @ (~usable & valid), weight @ (~usable & ~valid)).sum()
    z = np.minimum(np.arange(LEVELS) + 0.5, LEVELS - 1)
    # the loss of every z_min at once: P is 0 below it and the exponential from there on
    below = np.concatenate([[0.0], np.cumsum(_losses(np.zeros(LEVELS), hits, misses))])
    best = (np.inf, 0.0, z_max, 1.0)
    for sigma in SIGMA:
        inside = _losses(np.exp(np.minimum((z - z_max) / sigma, 0.0)), hits, misses)
        above = np.concatenate([np.cumsum(inside[::-1])[::-1], [0.0]])
        losses = (below + above)[Z_MIN]
        k = int(np.argmin(losses))
        best = min(best, (float(losses[k] + beyond), float(Z_MIN[k]), z_max, float(sigma)))
    return best


def _losses(p: FloatArray, hits: FloatArray, misses: FloatArray) -> FloatArray:
    p = np.clip(p, SUREST, 1.0 - SUREST)
    return -(hits * np.log(p) + misses * np.log(1.0 - p))
