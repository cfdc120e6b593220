"""A white image from shifted dot patterns: the maximum over time of each pixel, as the paper makes it of FlexView-16.

It is no white image to the last grey level. Mean error in the simulated camera (1280x1024, dots of 4.5 px with soft
edges, on half the slide, noise of 1 to 2 grey levels), at 10, 50 and 100 grey levels:

- N = 8: -0.1, -2.1, -3.9; N = 16: +0.6, -0.3, -0.9. Too low where no dot lay fully on a pixel.
- The same with dots on 70 % of the slide, N = 16: +1.2, +1.3, +1.3. Too high, as the maximum of noisy values is.
- At 200 grey levels -6.1 and -1.5: light that comes by way of other surfaces stays at the mean of the pattern.

Means of the two or three largest values were tried: they trade the second error for the first, and lose below N = 16.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sidelong.errors import ImageError
from sidelong.types import BoolArray, GrayImage

FEWEST_IMAGES = 3
"""With two images a pixel that both dots covered looks like one that neither did."""
FULL_TENTHS = 9
"""A dot covers a pixel if it brings it to this many tenths of the way from its darkest to its brightest."""
LEAST_MODULATION_GREY = 30
"""A pixel that changes less is not judged: a tenth of its change is no more than noise."""
FEWEST_JUDGED_PX = 500
UNCOVERED_LIMIT = 0.02
"""Estimated share of uncovered pixels above which there is a warning; grey levels are then 2 % too low on average."""


@dataclass(frozen=True, eq=False)
class WhiteImage:
    """What :class:`WhitePattern` made of its images.

    Attributes
    ----------
    image
        (H, W) brightest value of each pixel: what it shows under a white pattern.
    dark
        (H, W) darkest value of each pixel: room light, and what the dark of the pattern lets through.
    images
        How many there were.
    uncovered_share
        Estimated share, 0..1, of the judged pixels that no dot has fully covered: they are at least a tenth too dark.
        None where nothing can be said: fewer than ``FEWEST_IMAGES`` images, or next to no pixel that changes.
    unmodulated_share
        Share, 0..1, of pixels that hardly change with the pattern: in shadow, black, saturated throughout, or never
        near a dot. They are not judged.
    warning
        Why the image should not be taken for white; None where it may.
    """

    image: GrayImage
    dark: GrayImage
    images: int
    uncovered_share: float | None
    unmodulated_share: float
    warning: str | None


class WhitePattern:
    """Takes the images of shifted patterns one by one; keeps four images however many there are."""

    def __init__(self) -> None:
        self._images = 0
        self._largest: list[GrayImage] = []
        """The largest, second and third largest value of each pixel."""
        self._smallest: GrayImage = np.empty((0, 0), dtype=np.uint8)

    def add(self, image: GrayImage) -> None:
        """Take in the image (H, W) of one more pattern: same scene, exposure and camera.

        Raises
        ------
        ImageError
            It is not an 8-bit grey image, is empty, or has not the size of the first.
        """
        self._check(image)
        if not self._images:
            self._largest = [np.zeros_like(image) for _ in range(3)]
            self._smallest = image.copy()
        np.minimum(self._smallest, image, out=self._smallest)
        rest = image
        for largest in self._largest:
            smaller = np.minimum(largest, rest)
            np.maximum(largest, rest, out=largest)
            rest = smaller
        self._images += 1

    def result(self) -> WhiteImage:
        """Return the white image of what was added so far; more may be added afterwards.

        Raises
        ------
        ImageError
            No image was added.
        """
        if not self._images:
            raise ImageError("white pattern: 0 images were added, needs at least 1")
        brightest = self._largest[0]
        judged = (brightest - self._smallest) >= LEAST_MODULATION_GREY
        uncovered = self._uncovered_share(judged)
        return WhiteImage(
            image=brightest.copy(),
            dark=self._smallest.copy(),
            images=self._images,
            uncovered_share=uncovered,
            unmodulated_share=1.0 - float(judged.mean()),
            warning=self._warning(uncovered, int(judged.sum())),
        )

    def _check(self, image: GrayImage) -> None:
        name = f"white pattern: image {self._images}"
        if image.dtype != np.uint8 or image.ndim != 2:
            raise ImageError(f"{name} is {image.dtype} of shape {image.shape}, needs uint8 of shape (H, W)")
        if image.size == 0:
            raise ImageError(f"{name} is empty, its shape is {image.shape}")
        if self._images and image.shape != self._smallest.shape:
            raise ImageError(f"{name} has shape {image.shape}, image 0 has {self._smallest.shape}")

    def _uncovered_share(self, judged: BoolArray) -> float | None:
        """Estimate how many pixels were covered 0 times from how many were 1 and 2 times: Chao's estimator.

        It comes from counting species that were never seen (Chao 1987, for N samples), supposes neither a fill of the
        pattern nor that all pixels are covered equally often, and errs to the low side. Against the simulated camera,
        dots on half the slide: 0.21 for a true 0.26 (N = 6), 0.11 for 0.16 (8), 0.03 for 0.06 (12), 0.01 for 0.03 (16).
        Dots smaller than three pixels of the image never show their full brightness, which it cannot know: at half
        the image size 0.18 for 0.36 (8), 0.03 for 0.12 (16).
        """
        if self._images < FEWEST_IMAGES or judged.sum() < FEWEST_JUDGED_PX:
            return None
        brightest, second, third = (self._above_dark(largest, judged) for largest in self._largest)
        twice = 10 * second >= FULL_TENTHS * brightest
        thrice = 10 * third >= FULL_TENTHS * brightest
        ones, twos = int((~twice).sum()), int((twice & ~thrice).sum())
        never = (self._images - 1) / self._images * ones * (ones - 1) / (2 * (twos + 1))
        return never / (never + len(brightest))

    def _above_dark(self, image: GrayImage, judged: BoolArray) -> NDArray[np.int32]:
        return image[judged].astype(np.int32) - self._smallest[judged]

    def _warning(self, uncovered: float | None, judged_px: int) -> str | None:
        if self._images < FEWEST_IMAGES:
            return (
                f"white pattern: {self._images} images do not tell how much the dots covered, needs {FEWEST_IMAGES}, "
                "better 16"
            )
        if uncovered is None:
            return (
                f"white pattern: {judged_px} px change by {LEAST_MODULATION_GREY} grey levels or more, needs "
                f"{FEWEST_JUDGED_PX}: the pattern is off, did not move, or the exposure is wrong"
            )
        if uncovered > UNCOVERED_LIMIT:
            return (
                f"white pattern: in {self._images} images the dots left about {uncovered:.1%} of the pixels uncovered, "
                f"limit {UNCOVERED_LIMIT:.0%}: use more shifted patterns"
            )
        return None
