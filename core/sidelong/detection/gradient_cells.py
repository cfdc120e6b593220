"""What templates and images are compared by: how much edge of which direction lies around each point of a grid.

Histograms of oriented gradients (Dalal and Triggs, CVPR 2005) without their sign: a shiny facet may be brighter or
darker than the ground. An edge counts relative to the contrast around it, so dark and bright parts of an image weigh
the same.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sidelong.types import BoolArray, FloatArray, GrayImage

Float32Array: TypeAlias = NDArray[np.float32]

DIRECTIONS = 8
PERIOD_RAD = np.pi
BLUR_PX = 1.0
SOBEL_SCALE = 1 / 8
"""Makes a 3x3 Sobel the gradient in grey levels per pixel."""
CONTRAST_CELLS = 4
"""Size of the window in which the contrast around a pixel is measured, in cells."""
AROUND = 0.5
"""Weight of the contrast around an edge against its own."""


def gradient_cells(
    image: GrayImage, rows_px: FloatArray, columns_px: FloatArray, cell_px: int, half_level: float,
    usable: BoolArray | None = None,
) -> Float32Array:  # fmt: skip
    """Return the edges around grid points, (R, C, DIRECTIONS).

    Parameters
    ----------
    image
        (H, W) 8-bit grey.
    rows_px, columns_px
        (R,), (C,) of the grid points; pixels count linearly less up to ``cell_px`` away.
    cell_px
        Spacing of the grid.
    half_level
        Gradient, grey levels per pixel, at which a lonely edge counts half: a few times the noise.
    usable
        (H, W) pixels whose edges count; all by default.
    """
    import cv2

    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX)
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=SOBEL_SCALE)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=SOBEL_SCALE)
    size, angle_rad = cv2.cartToPolar(across, down)
    window = CONTRAST_CELLS * cell_px + 1
    # a running sum of squares can end a little below zero
    around = np.sqrt(np.maximum(cv2.blur(size * size, (window, window)), 0))
    edge = size / (size + AROUND * around + half_level)
    if usable is not None:
        edge = edge * usable
    bins = angle_rad * (DIRECTIONS / PERIOD_RAD)
    down_weights = _triangles(rows_px, image.shape[0], cell_px)
    across_weights = _triangles(columns_px, image.shape[1], cell_px).T.copy()
    cells = [down_weights @ (edge * _share(bins, k)) @ across_weights for k in range(DIRECTIONS)]
    return np.stack(cells, axis=-1, dtype=np.float32)


def _share(bins: NDArray[np.floating], direction: int) -> Float32Array:
    """Return how much (...) of an edge of direction ``bins`` (modulo DIRECTIONS) falls into one bin, linearly."""
    apart = np.abs((bins - direction + DIRECTIONS / 2) % DIRECTIONS - DIRECTIONS / 2)
    return np.maximum(1 - apart, 0).astype(np.float32)


def _triangles(at_px: FloatArray, length_px: int, cell_px: int) -> Float32Array:
    """Return the weights (N, length_px) of pixels in the cells at ``at_px`` (N,); of unit sum away from the border."""
    apart = np.abs(np.arange(length_px) - at_px[:, None]) / cell_px
    return (np.maximum(1 - apart, 0) / cell_px).astype(np.float32)
