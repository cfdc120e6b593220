"""How good probabilities are against what happened: log-loss, Brier score, expected calibration error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.types import BoolArray, FloatArray, IntArray

SUREST = 1e-3
"""Probabilities count as at least this far from 0 and 1 in the log-loss: one "never" that happens would decide it."""
BINS = 10


@dataclass(frozen=True)
class Scores:
    """Lower is better, 0 is perfect.

    Attributes
    ----------
    log_loss
        Mean of -ln of the probability given to what happened, nats.
    brier
        Mean squared difference of probability and outcome.
    ece
        Expected calibration error: mean difference of forecast and frequency over ten equally wide bins.
    ece_adaptive
        The same over ten bins of equal weight.
    """

    log_loss: float
    brier: float
    ece: float
    ece_adaptive: float


def scores_of(probability: FloatArray, happened: BoolArray, weight: FloatArray | None = None) -> Scores:
    """Score forecasts (N,) against outcomes (N,), weighted (N,); all 0 where there is nothing to score."""
    weight = np.ones(len(probability)) if weight is None else weight
    total = float(weight.sum())
    if total <= 0:
        return Scores(0.0, 0.0, 0.0, 0.0)
    p = np.clip(probability, SUREST, 1.0 - SUREST)
    surprise = -np.log(np.where(happened, p, 1.0 - p))
    return Scores(
        log_loss=float(weight @ surprise) / total,
        brier=float(weight @ np.square(probability - happened)) / total,
        ece=calibration_error(equal_width(probability), probability, happened, weight),
        ece_adaptive=calibration_error(equal_weight(probability, weight), probability, happened, weight),
    )


def equal_width(probability: FloatArray) -> IntArray:
    """Return the bin (N,) of each probability among ``BINS`` equally wide ones; 1 falls into the last."""
    return np.minimum((probability * BINS).astype(np.intp), BINS - 1)


def equal_weight(probability: FloatArray, weight: FloatArray) -> IntArray:
    """Return the bin (N,) of each probability among ``BINS`` of equal weight; equal probabilities stay together."""
    order = np.argsort(probability, kind="stable")
    levels, inverse = np.unique(probability[order], return_inverse=True)
    of_level = np.bincount(inverse, weights=weight[order], minlength=len(levels))
    middle = (np.cumsum(of_level) - of_level / 2) / of_level.sum()
    bins = np.empty(len(probability), dtype=np.intp)
    bins[order] = np.minimum((middle * BINS).astype(np.intp), BINS - 1)[inverse]
    return bins


def calibration_error(bins: IntArray, probability: FloatArray, happened: BoolArray, weight: FloatArray) -> float:
    """Return the mean of |forecast - frequency| over bins (N,), by weight."""
    excess = np.bincount(bins, weights=weight * (probability - happened))
    return float(np.abs(excess).sum() / weight.sum())
