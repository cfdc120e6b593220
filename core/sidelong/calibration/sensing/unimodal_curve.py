"""A curve of the probability of depth that rises to a best exposure and falls beyond it.

Each pixel is seen by one or two cameras and measured with P = min f(x) over them, so only the worse one says anything
of f. Which one that is depends on f: both are found in turn. Between the darkest and the brightest exposure the curve
is what was counted; beyond them nothing is known, and it goes to 0 within ``REACH_LN``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import isotonic_regression

from sidelong.calibration.sensing.samples import SensingSamples
from sidelong.physics.sensing import SensingCurve, all_cameras
from sidelong.types import FloatArray, IntArray

BINS, PIXELS_A_BIN, WIDEST_BIN_LN = 24, 40, 0.5
REACH_LN = float(np.log(4.0))
"""Beyond the exposures that were seen the curve goes to 0 within two stops: the prior for no light, and for nothing but
light."""
PSEUDO_COUNT = 0.5
"""Of both outcomes, added in each bin (Jeffreys): a bin where nothing failed does not promise 1."""
MOST_TURNS = 50


@dataclass(frozen=True, eq=False)
class BinnedCurve:
    """A fitted curve by bins: its knots, its values, and the bin (N,) of the camera that counts for each pixel."""

    log_edges: FloatArray
    log_knots: FloatArray
    p: FloatArray
    limiting: IntArray

    def curve(self) -> SensingCurve:
        """Return the table, with the prior at both ends."""
        ends = (self.log_edges[0], self.log_edges[-1])
        log_x = [ends[0] - REACH_LN, ends[0], *self.log_knots, ends[1], ends[1] + REACH_LN]
        p = [0.0, self.p[0], *self.p, self.p[-1], 0.0]
        rounded = {round(float(x), 4): round(float(value), 4) for x, value in zip(log_x, p, strict=True)}
        return SensingCurve(log_exposure=tuple(rounded), probability=tuple(rounded.values()))


def fit_curve(lit: SensingSamples) -> BinnedCurve:
    """Find the curve and, in turn, the camera that limits each pixel; the best of the turns by likelihood."""
    log_x = np.log(lit.exposure)
    edges = _edges(log_x.ravel())
    inner = edges[1:-1]
    bins = np.searchsorted(inner, log_x, side="right")
    knots = np.array([_median_within(log_x[bins == k], edges[k], edges[k + 1]) for k in range(len(inner) + 1)])
    limiting, best = bins.min(axis=1), (-np.inf, np.zeros(0), np.zeros(0, np.intp))
    for _ in range(MOST_TURNS):
        count, hits = binned_sum(limiting, lit.weight, knots), binned_sum(limiting, lit.weight * lit.valid, knots)
        p = _unimodal(hits, count)
        each = p[bins]
        worse = all_cameras(each)
        likelihood = float(lit.weight @ np.log(np.where(lit.valid, worse, 1.0 - worse)))
        # a plateau gives both cameras the same P: the darker one counts, as it did at first
        limiting = np.where(each == worse[:, None], bins, len(knots)).min(axis=1)
        if likelihood <= best[0]:
            break
        best = likelihood, p, limiting
    return BinnedCurve(edges, knots, *best[1:])


def binned_sum(bins: IntArray, weight: FloatArray, knots: FloatArray) -> FloatArray:
    """Return the sum of weights (N,) in each bin (B,)."""
    return np.bincount(bins, weights=weight, minlength=len(knots)).astype(np.float64)


def _edges(log_x: FloatArray) -> FloatArray:
    """Return borders of bins that hold equal numbers of pixels, none wider than ``WIDEST_BIN_LN``."""
    wanted = int(np.clip(len(log_x) // PIXELS_A_BIN, 2, BINS))
    edges = np.unique(np.quantile(log_x, np.linspace(0.0, 1.0, wanted + 1)))
    cuts: list[FloatArray] = [
        np.linspace(low, high, int(np.ceil((high - low) / WIDEST_BIN_LN)) + 1)[:-1]
        for low, high in pairwise(edges.tolist())
    ]
    return np.unique(np.concatenate([*cuts, edges[-1:]]))


def _median_within(log_x: FloatArray, low: float, high: float) -> float:
    """Return where the pixels of a bin lie; its middle where it is empty."""
    inside = log_x[(log_x >= low) & (log_x <= high)]
    return float(np.median(inside)) if inside.size else (low + high) / 2


def _unimodal(hits: FloatArray, count: FloatArray) -> FloatArray:
    """Return P (B,) that rises to one bin and falls beyond it, or is flat where the data cannot tell (BIC)."""
    rate = (hits + PSEUDO_COUNT) / (count + 2 * PSEUDO_COUNT)
    # an empty bin weighs next to nothing: it takes the value of its neighbours
    weight = count + 1e-6
    fits = [_peaked(rate, weight, peak) for peak in range(len(rate))]
    best = fits[int(np.argmin([weight @ np.square(fit - rate) for fit in fits]))]
    flat = np.full(len(rate), (hits.sum() + PSEUDO_COUNT) / (count.sum() + 2 * PSEUDO_COUNT))
    gained = _log_likelihood(best, hits, count) - _log_likelihood(flat, hits, count)
    levels = len(np.unique(best))
    return best if gained > 0.5 * (levels - 1) * np.log(count.sum()) else flat


def _log_likelihood(p: FloatArray, hits: FloatArray, count: FloatArray) -> float:
    return float(hits @ np.log(p) + (count - hits) @ np.log(1.0 - p))


def _peaked(rate: FloatArray, weight: FloatArray, peak: int) -> FloatArray:
    """Return the least-squares curve that rises before ``peak`` and falls from there on."""
    rising = isotonic_regression(rate[:peak], weights=weight[:peak]).x if peak else rate[:0]
    return np.concatenate([rising, isotonic_regression(rate[peak:], weights=weight[peak:], increasing=False).x])
