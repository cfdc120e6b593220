"""The adaptive matched filter: how much more a place looks like a template than like the rest of the image.

Robey, Fuhrmann, Kelly and Nitzberg, "A CFAR adaptive matched filter detector" (1992): with the covariance S of the
background, a template t scores ``t' S^-1 (x - m) / sqrt(t' S^-1 t)`` at a place that shows x: standard deviations of
the background. Edges that a textured ground has everywhere count little. The covariance is stationary, so the image's
own autocorrelation gives it (Hariharan, Malik and Ramanan, ECCV 2012).

Templates are rows of a small basis, and all of them are tried at all places: the time does not depend on what is seen.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from sidelong.detection.gradient_cells import DIRECTIONS, Float32Array
from sidelong.types import BoolArray, IntArray

DIAGONAL = 1.0
"""Added to the covariance, in its mean variance: templates differ from what is seen by that much anyhow."""
LEAST_VARIANCE = 1e-6
"""Of a cell: an image with few edges has no statistics."""
BLOCK = 256
"""Places scored at a time."""


@dataclass(frozen=True, eq=False)
class TemplateBank:
    """Templates as combinations of a few pictures.

    Attributes
    ----------
    window
        (n, n) cells a template looks at, n odd; C of them.
    basis
        (B, C * DIRECTIONS) orthonormal.
    weights
        (N, B) of the templates.
    """

    window: BoolArray
    basis: Float32Array
    weights: Float32Array


@dataclass(frozen=True, eq=False)
class Found:
    """Matches, best first: grid points (M, 2) as (row, column), scores (M,), templates (M,), and all there were."""

    place: IntArray
    score: Float32Array
    template: IntArray
    total: int


def search(
    cells: Float32Array, places: BoolArray, bank: TemplateBank, least_score: float, per_place: int, limit: int
) -> Found:
    """Try all templates at all places.

    Parameters
    ----------
    cells
        (R, C, DIRECTIONS) edges of an image, as templates have them.
    places
        (R, C) grid points where a template may be centred.
    bank
        The templates.
    least_score
        Matches score at least that.
    per_place, limit
        Best matches kept for each place, and for the image.
    """
    if not places.any():
        return _nothing()
    coordinates, filters = _whitened(cells, places, bank)
    where = np.argwhere(places)
    # no unit filter scores more than the length: most places of a plain image are done here
    worth = np.flatnonzero(np.einsum("pb,pb->p", coordinates, coordinates) >= least_score**2)
    blocks = [worth[first : first + BLOCK] for first in range(0, max(len(worth), 1), BLOCK)]

    def best(block: IntArray) -> tuple[IntArray, Float32Array, IntArray]:
        return _best(block, coordinates[block] @ filters.T, least_score, per_place)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = pool.map(best, blocks)
    place, score, template = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.argsort(-score, kind="stable")[:limit]
    return Found(where[place[order]], score[order], template[order], len(score))


def _best(
    block: IntArray, scores: Float32Array, least_score: float, per_place: int
) -> tuple[IntArray, Float32Array, IntArray]:
    """Return place, score and template of the matches among the scores (P, N) of some places (P,)."""
    chosen = scores.max(axis=1) >= least_score
    block, scores = block[chosen], scores[chosen]
    kept = min(per_place, scores.shape[1])
    best = np.argpartition(-scores, kept - 1, axis=1)[:, :kept]
    values = np.take_along_axis(scores, best, axis=1)
    high = values >= least_score
    return np.repeat(block, high.sum(axis=1)), values[high], best[high]


def _nothing() -> Found:
    return Found(np.zeros((0, 2), np.intp), np.zeros(0, np.float32), np.zeros(0, np.intp), 0)


def _whitened(cells: Float32Array, places: BoolArray, bank: TemplateBank) -> tuple[Float32Array, Float32Array]:
    """Return places (P, B) and unit filters (N, B) whose products are the scores."""
    centred = cells - cells[places].mean(axis=0)
    decorrelated = linalg.solve(_covariance(centred, bank.window), bank.basis.T, assume_a="pos").T  # (B, D)
    gram = decorrelated @ bank.basis.T.astype(np.float64)
    root = linalg.cholesky((gram + gram.T) / 2, lower=True)
    filters = (bank.weights @ root).astype(np.float32)
    filters /= np.maximum(np.linalg.norm(filters, axis=1, keepdims=True), 1e-12)
    projected = _projected(centred, places, bank.window, decorrelated.astype(np.float32))
    return linalg.solve_triangular(root, projected.T, lower=True).T.astype(np.float32), filters


def _covariance(centred: Float32Array, window: BoolArray) -> NDArray[np.float64]:
    """Return the covariance (D, D) of a window's cells from the autocorrelation of cells of mean zero.

    Divided by the number of all cells and not of the pairs, it is positive semidefinite.
    """
    reach = window.shape[0]
    shape = tuple(fft.next_fast_len(side + reach, real=True) for side in centred.shape[:2])
    spectrum = fft.rfft2(centred.astype(np.float64), shape, axes=(0, 1))
    lags = np.empty((DIRECTIONS, DIRECTIONS, 2 * reach + 1, 2 * reach + 1))
    around = [*range(-reach, reach + 1)]  # negative lags are at the end
    for first in range(DIRECTIONS):
        product = spectrum[..., first, None] * spectrum.conj()
        product_lags = fft.irfft2(product, shape, axes=(0, 1)) / (centred.shape[0] * centred.shape[1])
        lags[first] = np.moveaxis(product_lags[np.ix_(around, around)], -1, 0)
    at = np.argwhere(window)
    apart = at[:, None] - at[None] + reach
    # (C, C, K, K) -> (C K, C K)
    blocks = lags[:, :, apart[..., 0], apart[..., 1]].transpose(2, 0, 3, 1)
    covariance = blocks.reshape(len(at) * DIRECTIONS, -1)
    variance = max(float(np.trace(covariance)) / len(covariance), LEAST_VARIANCE)
    covariance[np.diag_indices_from(covariance)] += DIAGONAL * variance
    return covariance


def _projected(centred: Float32Array, places: BoolArray, window: BoolArray, directions: Float32Array) -> Float32Array:
    """Return the products (P, B) of what the window shows at each place with ``directions`` (B, D)."""
    half = window.shape[0] // 2
    # beyond the image nothing is known: the mean
    padded = np.pad(centred, ((half, half), (half, half), (0, 0)))
    views = np.lib.stride_tricks.sliding_window_view(padded, window.shape, axis=(0, 1))  # (R, C, K, n, n)
    result = [np.zeros((0, len(directions)), np.float32)]
    for row in np.flatnonzero(places.any(axis=1)):
        shown = views[row, places[row]][:, :, window].transpose(0, 2, 1)
        result.append(shown.reshape(len(shown), -1) @ directions.T)
    return np.concatenate(result)
