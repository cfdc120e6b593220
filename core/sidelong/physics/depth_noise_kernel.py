"""The loops over the pixels of a depth map that give each its standard deviation."""

from __future__ import annotations

import math

import numpy as np

from sidelong.kernels import compiled
from sidelong.types import Float32Array

HIDDEN = np.float32(4)
"""Bend, in units of the noise, that noise makes by itself and that does not count."""
FAINT = np.float32(6)
"""Reaches from a rim at which nothing is left of its noise."""


@compiled
def fill_sigma(
    disparity_px: Float32Array,
    rim_px: Float32Array,
    numbers: Float32Array,
    sigma_m: Float32Array,
    first: int,
    last: int,
) -> None:
    """Fill rows ``first`` to ``last`` of ``sigma_m``; ``numbers`` are f b, then of the noise disparity to bend.

    ``disparity_px`` is f b / Z, NaN where missing.
    """
    height, width = disparity_px.shape
    rise2, bend2 = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    for row in range(first, last):
        # beyond the image nothing rises or bends
        one = 1 if 1 <= row < height - 1 else 0
        two = 2 if 2 <= row < height - 2 else 0
        here = disparity_px[row]
        _down(disparity_px[row - one], disparity_px[row + one], rise2)
        _bent(disparity_px[row - two], here, disparity_px[row + two], bend2)
        _across(here, rise2)
        _bent_across(here, bend2)
        _variance(rise2, bend2, numbers)
        _add_rim(rim_px[row], numbers, rise2)
        _to_depth(here, numbers[0], rise2, sigma_m[row])


# one loop each: with many arrays in one the compiler does not use vector instructions


@compiled
def _down(above: Float32Array, below: Float32Array, rise2: Float32Array) -> None:
    for column in range(len(rise2)):
        rise2[column] = _square(below[column] - above[column])


@compiled
def _across(here: Float32Array, rise2: Float32Array) -> None:
    for column in range(len(here) - 2):
        rise2[column + 1] += _square(here[column + 2] - here[column])


@compiled
def _bent(above: Float32Array, here: Float32Array, below: Float32Array, bend2: Float32Array) -> None:
    for column in range(len(here)):
        bend2[column] = _square(above[column] - here[column] - here[column] + below[column])


@compiled
def _bent_across(here: Float32Array, bend2: Float32Array) -> None:
    for column in range(len(here) - 4):
        bend2[column + 2] += _square(here[column] - here[column + 2] - here[column + 2] + here[column + 4])


@compiled
def _variance(rise2: Float32Array, bend2: Float32Array, numbers: Float32Array) -> None:
    """Turn the squared rise over two pixels into the variance away from rims."""
    flat2 = numbers[1] * numbers[1]
    hidden2 = HIDDEN * HIDDEN * flat2
    slope2, share2 = numbers[2] * numbers[2] / np.float32(4), numbers[5] * numbers[5]
    zero, one, four = np.float32(0), np.float32(1), np.float32(4)
    for column in range(len(rise2)):
        # across a depth edge it is neither a rise nor a bend
        rise = rise2[column] if rise2[column] < four else four
        bend = (bend2[column] if bend2[column] < one else one) - hidden2
        rise2[column] = flat2 + slope2 * rise + share2 * (bend if bend > zero else zero)


@compiled
def _add_rim(rim_px: Float32Array, numbers: Float32Array, variance: Float32Array) -> None:
    rim2, reach = numbers[3] * numbers[3], numbers[4] / np.float32(2)
    one, zero, faint_px = np.float32(1), np.float32(0), FAINT * numbers[4]
    for column in range(len(variance)):
        if zero < rim_px[column] < faint_px:
            variance[column] += rim2 * math.exp((one - rim_px[column]) / reach)


@compiled
def _to_depth(disparity_px: Float32Array, fb: np.float32, variance: Float32Array, sigma_m: Float32Array) -> None:
    for column in range(len(variance)):
        sigma_m[column] = math.sqrt(variance[column]) * fb / (disparity_px[column] * disparity_px[column])


@compiled
def _square(step: np.float32) -> np.float32:
    """Return the square of a step, 0 where a depth is missing."""
    return step * step if step == step else np.float32(0)
