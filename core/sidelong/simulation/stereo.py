"""Depth from shifted dot patterns: a temporal stereo matcher, as in the firmware of active stereo cameras.

Each pixel has a signature: its grey values under the N patterns, less their mean and over their deviation, which takes
out the albedo and whatever does not change with the pattern. Signatures are correlated along the row and averaged over
a small bell-shaped window, bright and dark pixels alike, so that a glint does not outweigh its surroundings. A match is
kept if it correlates, is unique, agrees left to right, is not at a step, and if the pixel has contrast at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from sidelong.errors import ImageError
from sidelong.geometry.camera_model import StereoRig
from sidelong.types import BoolArray, FloatArray, GrayImage

Stack = NDArray[np.float32]

STRIP_ROWS = 64
"""Rows matched at once: the correlations of all disparities of a strip stay small at every image size."""
EDGE_WINDOW_PX = 5
"""Where disparity steps within this window, a match mixes two surfaces."""


class StereoSettings(BaseModel):
    """The matcher's limits."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_depth_m: FiniteFloat = Field(default=0.45, gt=0.0, le=10.0, description="near end of the search")
    max_depth_m: FiniteFloat = Field(default=1.1, gt=0.0, le=20.0, description="far end of the search")
    window_px: int = Field(default=7, ge=1, le=31, description="side of the comparison window, odd")
    min_correlation: FiniteFloat = Field(default=0.78, gt=0.0, lt=1.0, description="least correlation of a match")
    min_lead: FiniteFloat = Field(default=0.05, ge=0.0, lt=1.0, description="least lead over the second best disparity")
    noise_grey: FiniteFloat = Field(default=1.0, gt=0.0, le=255.0, description="noise added to the deviation")
    min_contrast: FiniteFloat = Field(default=5.0, gt=0.0, le=255.0, description="least deviation of a pixel")
    max_disagreement_px: int = Field(default=1, ge=0, le=16, description="left-right check, whole pixels")
    max_step_px: FiniteFloat = Field(default=1.2, gt=0.0, le=100.0, description="an edge: range in 5x5 pixels")
    speckle_px: int = Field(default=12, ge=0, le=100000, description="smaller islands of depth are dropped")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(f"min_depth_m {self.min_depth_m} must be below max_depth_m {self.max_depth_m}")
        if self.window_px % 2 == 0:
            raise ValueError(f"window_px {self.window_px} must be odd")
        return self


@dataclass(frozen=True, eq=False)
class _Best:
    """The best disparity of each pixel as its index in the search, its correlation, the second best, and both sides."""

    index: NDArray[np.int32]
    score: Stack
    second: Stack
    before: Stack
    after: Stack
    right_index: NDArray[np.int32]


def match(
    left: Sequence[GrayImage], right: Sequence[GrayImage], rig: StereoRig, settings: StereoSettings
) -> FloatArray:
    """Return depth (H, W) in metres in the left camera, NaN where nothing was measured.

    Parameters
    ----------
    left, right
        The same N patterns seen by both cameras, rectified, (H, W) each.
    rig
        Camera constants; images must have their size.
    settings
        Limits.

    Raises
    ------
    ImageError
        Fewer than two patterns, or an image that has not the rig's size.
    """
    _check(left, right, rig)
    left_signatures, contrast = _signatures(left, settings.noise_grey)
    right_signatures, _ = _signatures(right, settings.noise_grey)
    low, high = np.sort(rig.disparity_px(np.array([settings.max_depth_m, settings.min_depth_m])))
    search = np.arange(int(np.floor(low)), int(np.ceil(high)) + 1)
    strips = [
        _match_rows(left_signatures, right_signatures, search, slice(top, top + STRIP_ROWS), settings)
        for top in range(0, rig.left.height, STRIP_ROWS)
    ]
    disparity_px = np.where(contrast >= settings.min_contrast, np.concatenate(strips), np.nan)
    disparity_px = _without_steps(disparity_px, settings.max_step_px)
    return rig.depth_m(_without_speckle(disparity_px, settings.speckle_px))


def _check(left: Sequence[GrayImage], right: Sequence[GrayImage], rig: StereoRig) -> None:
    if len(left) < 2 or len(left) != len(right):
        raise ImageError(f"stereo: {len(left)} left and {len(right)} right patterns, needs the same number, at least 2")
    size = (rig.left.height, rig.left.width)
    for image in (*left, *right):
        if image.shape != size:
            raise ImageError(f"stereo: an image is {image.shape}, the rig's images are {size}")


def _signatures(images: Sequence[GrayImage], noise_grey: float) -> tuple[Stack, Stack]:
    """Return signatures (N, H, W), of mean square 1 where the contrast is far above the noise, and contrast (H, W)."""
    stack = np.stack(images).astype(np.float32)
    stack -= stack.mean(axis=0)
    power = np.einsum("nij,nij->ij", stack, stack) / np.float32(len(stack))
    return stack / np.sqrt(power + np.float32(noise_grey**2)), np.sqrt(power)


def _match_rows(
    left: Stack, right: Stack, search: NDArray[np.intp], rows: slice, settings: StereoSettings
) -> FloatArray:
    """Match a strip of rows and return its disparities (h, W), NaN where a test failed."""
    best = _search(_correlations(left, right, search, rows, settings.window_px), search)
    return np.where(_kept(best, search, settings), search[best.index] + _vertex(best), np.nan)


def _correlations(left: Stack, right: Stack, search: NDArray[np.intp], rows: slice, window_px: int) -> Stack:
    """Return correlations (D, h, W) of left pixels, averaged over the window; -1 where the right image ends."""
    import cv2

    _, height, width = left.shape
    stop = min(rows.stop, height)
    wide = slice(max(rows.start - window_px // 2, 0), min(stop + window_px // 2, height))
    inner = slice(rows.start - wide.start, stop - wide.start)
    left, right = np.ascontiguousarray(left[:, wide]), np.ascontiguousarray(right[:, wide])
    scores = np.full((len(search), stop - rows.start, width), -1.0, dtype=np.float32)
    for score, shift in zip(scores, search, strict=True):
        here, there = _overlap(int(shift), width)
        if here.stop - here.start >= window_px:
            product = np.einsum("nij,nij->ij", left[:, :, here], right[:, :, there]) / np.float32(len(left))
            score[:, here] = cv2.GaussianBlur(product, (window_px, window_px), 0)[inner]
    return scores


def _overlap(shift: int, width: int) -> tuple[slice, slice]:
    """Return the columns of the left and the right image that disparity ``shift`` brings together."""
    here = slice(max(shift, 0), max(min(width, width + shift), max(shift, 0)))
    return here, slice(here.start - shift, here.stop - shift)


def _search(scores: Stack, search: NDArray[np.intp]) -> _Best:
    """Find the best match of each left and each right pixel in one volume of correlations (D, h, W)."""
    index = scores.argmax(axis=0).astype(np.int32)
    at = index[None]
    score = np.take_along_axis(scores, at, axis=0)[0]
    before = np.take_along_axis(scores, np.maximum(at - 1, 0), axis=0)[0]
    after = np.take_along_axis(scores, np.minimum(at + 1, len(scores) - 1), axis=0)[0]
    second = _second(scores, index)
    return _Best(index, score, second, before, after, _right_index(scores, search))


def _second(scores: Stack, index: NDArray[np.int32]) -> Stack:
    """Best correlation (h, W) farther than two disparities from the best."""
    second = np.full(index.shape, -1.0, dtype=np.float32)
    for position, score in enumerate(scores):
        np.maximum(second, np.where(np.abs(index - position) > 2, score, -1.0), out=second)
    return second


def _right_index(scores: Stack, search: NDArray[np.intp]) -> NDArray[np.int32]:
    """Best disparity (h, W) of each right pixel, as its index; right pixel x pairs with left pixel x + d."""
    width = scores.shape[2]
    best = np.full(scores.shape[1:], -np.inf, dtype=np.float32)
    index = np.full(scores.shape[1:], -1, dtype=np.int32)
    for position, shift in enumerate(search):
        here, there = _overlap(int(shift), width)
        better = scores[position][:, here] > best[:, there]
        best[:, there][better] = scores[position][:, here][better]
        index[:, there][better] = position
    return index


def _kept(best: _Best, search: NDArray[np.intp], settings: StereoSettings) -> BoolArray:
    """Say which matches correlate, are unique, agree from the right, and lie inside the search."""
    columns: NDArray[np.intp] = np.arange(best.index.shape[1], dtype=np.intp)[None] - search[best.index]
    inside = (columns >= 0) & (columns < best.index.shape[1])
    from_right = np.take_along_axis(best.right_index, np.clip(columns, 0, best.index.shape[1] - 1), axis=1)
    return (
        inside
        & (best.index > 0)
        & (best.index < len(search) - 1)
        & (best.score >= settings.min_correlation)
        & (best.score - best.second >= settings.min_lead)
        & (np.abs(from_right - best.index) <= settings.max_disagreement_px)
    )


def _vertex(best: _Best) -> FloatArray:
    """Return where the parabola through the best correlation and its neighbours peaks, -0.5..0.5 px."""
    bend = best.before - 2.0 * best.score + best.after
    slope = 0.5 * (best.before - best.after)
    offset = np.divide(slope, bend, out=np.zeros_like(slope), where=bend < 0)
    return np.clip(offset, -0.5, 0.5).astype(np.float64)


def _without_steps(disparity_px: FloatArray, max_step_px: float) -> FloatArray:
    """Drop pixels around which the measured disparities spread too far."""
    import cv2

    missing, window = np.isnan(disparity_px), np.ones((EDGE_WINDOW_PX, EDGE_WINDOW_PX), dtype=np.uint8)
    # far outside any disparity, so that missing neighbours do not count
    highest = np.asarray(cv2.dilate(np.where(missing, -1e6, disparity_px), window), dtype=np.float64)
    lowest = np.asarray(cv2.erode(np.where(missing, 1e6, disparity_px), window), dtype=np.float64)
    return np.where(~missing & (highest - lowest > max_step_px), np.nan, disparity_px)


def _without_speckle(disparity_px: FloatArray, speckle_px: int) -> FloatArray:
    """Drop islands of fewer than ``speckle_px`` pixels whose disparities differ from their surroundings by over 1."""
    if speckle_px == 0:
        return disparity_px
    import cv2

    missing = -(2**15)
    sixteenths: Any = np.where(np.isnan(disparity_px), missing, np.rint(disparity_px * 8.0)).astype(np.int16)
    cv2.filterSpeckles(sixteenths, missing, speckle_px, 8)
    return np.where(sixteenths == missing, np.nan, disparity_px)
