"""One radiance map from an exposure bracket whose response is known, with what speaks against it at each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sidelong.calibration.response.curve import slopes
from sidelong.calibration.response.samples import read_bracket
from sidelong.physics.response import LEVELS, Response
from sidelong.types import BoolArray, FloatArray, GrayImage


@dataclass(frozen=True, eq=False)
class RadianceMap:
    """Result of :func:`merge_bracket`, all (H, W).

    Attributes
    ----------
    radiance
        In saturation exposures per second if g(255) = 0; NaN where no image is off both clips.
    residual_grey
        Root mean square of what the images differ from ``radiance`` by, in grey levels, one degree of freedom taken
        off; NaN where fewer than two images are off both clips.
    saturated, dark
        Where radiance is NaN: every image is 255; every image is 0. A pixel that is neither jumps from 0 to 255 between
        two exposures.
    """

    radiance: FloatArray
    residual_grey: FloatArray
    saturated: BoolArray
    dark: BoolArray


def merge_bracket(
    images: Sequence[GrayImage] | GrayImage,
    exposures_s: Sequence[float] | FloatArray,
    response: Response,
    names: Sequence[str] | None = None,
) -> RadianceMap:
    """Merge images of one scene into radiance, weighted by the inverse variance that even noise in Z gives ln E.

    Parameters
    ----------
    images
        P images (H, W) uint8 in any order; one is enough, but leaves no residual.
    exposures_s
        (P,) seconds.
    response
        Of the camera.
    names
        (P,) for messages.

    Raises
    ------
    ImageError, CalibrationError
        See ``read_bracket``.
    """
    bracket = read_bracket(images, exposures_s, names)
    g = response.log_exposure
    weight = slopes(g) ** -2.0
    weight[[0, -1]] = 0.0  # clipped: a bound on one side only
    shape = bracket.images[0].shape
    total, first, second = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    used = np.zeros(shape, dtype=np.uint8)
    for image, time_s in zip(bracket.images, bracket.exposures_s, strict=True):
        log_radiance = g - np.log(time_s)
        total += weight[image]
        first += (weight * log_radiance)[image]
        second += (weight * log_radiance**2)[image]
        used += (image > 0) & (image < LEVELS - 1)
    known = used > 0
    mean = np.divide(first, total, out=np.full(shape, np.nan), where=known)
    squares = np.maximum(second - first * np.where(known, mean, 0.0), 0.0)
    residual = np.where(used > 1, np.sqrt(squares / np.maximum(used.astype(np.float64) - 1, 1)), np.nan)
    # by rising exposure: whoever saturates in the shortest does so in all, and the dark likewise
    saturated = ~known & (bracket.images[0] == LEVELS - 1)
    return RadianceMap(np.exp(mean), residual, saturated, ~known & (bracket.images[-1] == 0))
