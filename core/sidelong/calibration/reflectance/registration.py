"""Whether a white image and the depth of the sprayed scene were taken from the same place.

Where a metal part shines follows from its normals, whatever the exact reflectance. The picture that a typical lobe
would give is shifted over the image: it must fit best where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.errors import CalibrationError
from sidelong.types import FloatArray, GrayImage, IntArray

REACH_PX, REACH_RAD, STEPS = 12, 0.052, 24
"""Largest shift and turn looked at, and how many turns to either side."""
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
MOST_PIXELS = 8_000


@dataclass(frozen=True)
class Registration:
    """How image and depth fit.

    Attributes
    ----------
    shift_px
        (u, v) by which the image lies beside the depth.
    turn_rad
        By which it is turned about the middle of the marks.
    correlation, correlation_turned
        Of expected and measured ln grey level at the best shift, and at the best turn.
    correlation_still
        Of the images as they are.
    correlation_beside
        Largest at ``BLIND_PX`` and more from the best shift.
    radius_px
        Within which nine of ten marks lie.
    pixels
        That were compared.
    """

    shift_px: tuple[int, int]
    turn_rad: float
    correlation: float
    correlation_turned: float
    correlation_still: float
    correlation_beside: float
    radius_px: float
    pixels: int

    @property
    def moved_px(self) -> float:
        """How far marks moved, as far as that is believed."""
        shifted = float(np.hypot(*self.shift_px)) if self._surely(self.correlation, self.correlation_still) else 0.0
        turned = abs(self.turn_rad) * self.radius_px
        return max(shifted, turned if self._surely(self.correlation_turned, self.correlation_still) else 0.0)

    @property
    def conclusive(self) -> bool:
        """Whether a shift of ``BLIND_PX`` would have been noticed."""
        return self._surely(self.correlation, self.correlation_beside)

    def _surely(self, best: float, other: float) -> bool:
        """Say whether a correlation is larger beyond chance (Fisher's transform)."""
        best, other = np.arctanh(np.clip([best, other], -0.999, 0.999))
        return bool(best - other > DEVIATIONS / np.sqrt(self.pixels / ALIKE_PX))


def register(image: GrayImage, cosines: tuple[FloatArray, FloatArray], labels: IntArray) -> Registration | None:
    """Find the shift and the turn at which the image fits the expected shading best; None where it has no marks.

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
    pixels = np.argwhere(inside & (labels >= 0) & np.isfinite(cos_alpha) & (np.nan_to_num(cos_theta) > 0.1))
    pixels = pixels[:: max(1, len(pixels) // MOST_PIXELS)]
    if len(pixels) < FEWEST_PIXELS:
        return None
    at = tuple(pixels.T)
    lobe = np.maximum(cos_alpha[at], 0.0) ** TYPICAL_N
    expected = _centred(np.log(TYPICAL_DIFFUSE * cos_theta[at] + lobe), labels[at])
    log_grey = np.log(np.maximum(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0), 1.0))
    if min(expected.std(), _centred(log_grey[at], labels[at]).std()) < LEAST_CONTRAST:
        return None

    def fit(rows: IntArray, columns: IntArray) -> float:
        return _alike(expected, _centred(log_grey[rows, columns], labels[at]))

    reach = range(-REACH_PX, REACH_PX + 1)
    shifts = np.array([[fit(at[0] + v, at[1] + u) for u in reach] for v in reach])
    v, u = (int(each) - REACH_PX for each in np.unravel_index(int(shifts.argmax()), shifts.shape))
    away = np.hypot(*np.mgrid[-REACH_PX - v : REACH_PX - v + 1, -REACH_PX - u : REACH_PX - u + 1]) >= BLIND_PX
    turns = [REACH_RAD * step / STEPS for step in sorted(range(-STEPS, STEPS + 1), key=abs)]
    turned = np.array([fit(*_turned(pixels, turn, labels.shape)) for turn in turns])
    return Registration(
        shift_px=(u, v),
        turn_rad=turns[int(turned.argmax())],
        correlation=float(shifts.max()),
        correlation_turned=float(turned.max()),
        correlation_still=float(shifts[REACH_PX, REACH_PX]),
        correlation_beside=float(shifts[away].max()),
        radius_px=float(np.percentile(np.linalg.norm(pixels - pixels.mean(axis=0), axis=1), 90)),
        pixels=len(pixels),
    )


def check_registration(
    image: GrayImage, cosines: tuple[FloatArray, FloatArray], labels: IntArray, largest_shift_px: float
) -> Registration | None:
    """Return :func:`register`, and refuse a pair that does not belong together.

    Raises
    ------
    CalibrationError
        The image fits best elsewhere, or nowhere.
    """
    found = register(image, cosines, labels)
    if found is None:
        return None
    if max(found.correlation, found.correlation_turned) < LEAST_CORRELATION:
        raise CalibrationError(
            f"white image: its brightness follows the sprayed depth with a correlation of {found.correlation:.2f}, "
            f"needs {LEAST_CORRELATION}: image and depth show different things, or the camera moved by more than "
            f"{REACH_PX} px between the scans: take both from one place"
        )
    if found.moved_px > largest_shift_px:
        raise CalibrationError(
            f"white image: beside the sprayed depth it is moved by {found.moved_px:.1f} px (best fit: u "
            f"{found.shift_px[0]} px, v {found.shift_px[1]} px, turn {np.rad2deg(found.turn_rad):.2f} deg), limit "
            f"{largest_shift_px:g} px: camera or parts moved between the scans: take both from one place"
        )
    return found


def _turned(pixels: IntArray, angle_rad: float, shape: tuple[int, ...]) -> tuple[IntArray, IntArray]:
    """Return rows and columns (N,) of pixels (N, 2) turned about their middle, within the image."""
    middle = pixels.mean(axis=0)
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    moved = np.rint((pixels - middle) @ np.array([[cosine, sine], [-sine, cosine]]) + middle).astype(np.intp)
    return np.clip(moved[:, 0], 0, shape[0] - 1), np.clip(moved[:, 1], 0, shape[1] - 1)


def _centred(values: FloatArray, material: IntArray) -> FloatArray:
    """Subtract the mean of each material."""
    number = material - material.min()
    count = np.maximum(np.bincount(number), 1)
    return values - (np.bincount(number, values) / count)[number]


def _alike(expected: FloatArray, measured: FloatArray) -> float:
    """Return the correlation of centred values; 0 where one of them does not vary."""
    scale = np.sqrt((expected @ expected) * (measured @ measured))
    return float(expected @ measured / scale) if scale > 0 else 0.0
