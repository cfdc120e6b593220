"""Whether a white image and the depth of the sprayed scene were taken from the same place.

Where a metal part shines follows from its normals, whatever the exact reflectance. The picture that a typical lobe
would give is shifted over the image: it must fit best where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.errors import CalibrationError
from sidelong.types import FloatArray, GrayImage, IntArray

REACH_PX = 12
"""Largest shift looked at."""
TYPICAL_N, TYPICAL_DIFFUSE = 20.0, 0.05
"""Of the lobe: the paper's metals have n of 20 and 39, and their diffuse light is a twentieth of the specular."""
FEWEST_PIXELS = 400
LEAST_CONTRAST = 0.15
"""Standard deviation of ln radiance expected below which the image has no marks to compare."""
LEAST_CORRELATION = 0.25
"""Best correlation below which image and depth show different things."""
ALIKE_PX, DEVIATIONS = 10.0, 3.0
"""Pixels that say the same (lens, normals of a window), and how sure a better correlation must be to be believed."""
BLIND_PX = 3.0
"""Shift that must be told from none."""
QUARTER_MARGIN_PX = 0.5
MOST_PIXELS = 8_000


@dataclass(frozen=True)
class Registration:
    """How image and depth fit.

    Attributes
    ----------
    shift_px
        (u, v) by which the image must be moved back to fit best.
    correlation
        Of expected and measured ln grey level there.
    correlation_unshifted
        Of the images as they are.
    correlation_beside
        Largest at ``BLIND_PX`` and more from the best shift.
    pixels
        That were compared.
    """

    shift_px: tuple[int, int]
    correlation: float
    correlation_unshifted: float
    correlation_beside: float
    pixels: int

    @property
    def distance_px(self) -> float:
        """Length of the shift, where it is believed; else 0."""
        return float(np.hypot(*self.shift_px)) if self._exceeds(self.correlation_unshifted) else 0.0

    @property
    def conclusive(self) -> bool:
        """Whether a shift of ``BLIND_PX`` would have been noticed."""
        return self._exceeds(self.correlation_beside)

    def _exceeds(self, other: float) -> bool:
        """Say whether the best correlation is surely larger (Fisher's transform)."""
        best, other = np.arctanh(np.clip([self.correlation, other], -0.999, 0.999))
        return bool(best - other > DEVIATIONS / np.sqrt(self.pixels / ALIKE_PX))


def register(image: GrayImage, cosines: tuple[FloatArray, FloatArray], labels: IntArray) -> tuple[Registration, ...]:
    """Find the shift at which the image fits the expected shading best: of all pixels, then of each quarter.

    Quarters tell a rotation, which moves the whole nowhere. Those without marks to compare are left out; where there is
    nothing at all to compare, the answer is empty.

    Parameters
    ----------
    image
        (H, W) under the white pattern.
    cosines
        cos theta and cos alpha (H, W) from the sprayed depth, NaN where unknown.
    labels
        (H, W) materials to compare, each for itself; -1 for none.
    """
    import cv2

    cos_theta, cos_alpha = cosines
    inside = np.zeros(labels.shape, dtype=np.bool_)
    inside[REACH_PX:-REACH_PX, REACH_PX:-REACH_PX] = True
    chosen = np.argwhere(inside & (labels >= 0) & np.isfinite(cos_alpha) & (np.nan_to_num(cos_theta) > 0.1))
    chosen = chosen[:: max(1, len(chosen) // MOST_PIXELS)]
    if not len(chosen):
        return ()
    log_grey = np.log(np.maximum(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0), 1.0))
    below = chosen > np.median(chosen, axis=0)
    quarter = 2 * below[:, 0] + below[:, 1]
    groups = (chosen, *(chosen[quarter == number] for number in range(4)))
    found = [_shift(log_grey, cosines, labels, group) for group in groups]
    return tuple(each for each in found if each is not None)


def check_registration(
    image: GrayImage, cosines: tuple[FloatArray, FloatArray], labels: IntArray, largest_shift_px: float
) -> tuple[Registration, ...]:
    """Return :func:`register`, and refuse a pair that does not belong together.

    Raises
    ------
    CalibrationError
        The image, or a quarter of it, fits best elsewhere, or nowhere.
    """
    found = register(image, cosines, labels)
    if found and found[0].correlation < LEAST_CORRELATION:
        raise CalibrationError(
            f"white image: its brightness follows the sprayed depth with a correlation of {found[0].correlation:.2f}, "
            f"needs {LEAST_CORRELATION}: image and depth show different things, or the camera moved by more than "
            f"{REACH_PX} px between the scans: take both from one place"
        )
    for number, each in enumerate(found):
        # a quarter has fewer marks, and errs by a pixel more often
        limit_px = largest_shift_px + (QUARTER_MARGIN_PX if number else 0.0)
        if each.correlation >= LEAST_CORRELATION and each.distance_px > limit_px:
            raise CalibrationError(
                f"white image: it fits the sprayed depth best when moved by {each.distance_px:.1f} px (u "
                f"{each.shift_px[0]}, v {each.shift_px[1]}), limit {limit_px:g} px: camera or parts moved "
                "between the scans: take both from one place"
            )
    return found


def _shift(
    log_grey: FloatArray, cosines: tuple[FloatArray, FloatArray], labels: IntArray, pixels: IntArray
) -> Registration | None:
    """Return the best shift of some pixels (N, 2), None where they have too few marks."""
    if len(pixels) < FEWEST_PIXELS:
        return None
    rows, columns = pixels.T
    cos_theta, cos_alpha = (each[rows, columns] for each in cosines)
    material = labels[rows, columns]
    expected = _centred(np.log(TYPICAL_DIFFUSE * cos_theta + np.maximum(cos_alpha, 0.0) ** TYPICAL_N), material)
    if min(expected.std(), _centred(log_grey[rows, columns], material).std()) < LEAST_CONTRAST:
        return None
    reach = range(-REACH_PX, REACH_PX + 1)
    table = np.array(
        [[_alike(expected, _centred(log_grey[rows + v, columns + u], material)) for u in reach] for v in reach]
    )
    v, u = (int(each) - REACH_PX for each in np.unravel_index(int(table.argmax()), table.shape))
    away = np.hypot(*np.mgrid[-REACH_PX - v : REACH_PX - v + 1, -REACH_PX - u : REACH_PX - u + 1]) >= BLIND_PX
    unshifted = float(table[REACH_PX, REACH_PX])
    return Registration((u, v), float(table.max()), unshifted, float(table[away].max()), len(pixels))


def _centred(values: FloatArray, material: IntArray) -> FloatArray:
    """Subtract the mean of each material."""
    number = material - material.min()
    count = np.maximum(np.bincount(number), 1)
    return values - (np.bincount(number, values) / count)[number]


def _alike(expected: FloatArray, measured: FloatArray) -> float:
    """Return the correlation of centred values; 0 where one of them does not vary."""
    scale = np.sqrt((expected @ expected) * (measured @ measured))
    return float(expected @ measured / scale) if scale > 0 else 0.0
