"""How far off the depths of a stereo camera are: noise in disparity, and outliers.

A matcher errs in disparity, so depth errs by ``Z^2 / (f b)`` of that: more the farther away. It errs more where
disparity changes across the window it compares, flattens what bends within it, and errs most at the rim of what it
could match, where half the window shows something else. Away from outliers the error is close to Gaussian, and alike
within a window.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.geometry.camera_model import StereoRig
from sidelong.types import BoolArray, Float32Array, RealArray

SMALLEST_OUTLIER_SHARE = 1e-6
"""No count of outliers shows less; a share of 0 would make one depth outweigh any number of others."""
ROUGHNESS_STEP_PX = 2
ROUGHNESS = 1.5
"""Of ``d(u-2) - 2 d(u) + d(u+2)`` over the noise of d, for matchers that compare windows of 5 to 9 px: 1.37 to 1.75 on
112 maps of two such matchers, 640 and 1280 pixels wide."""
ROUGHNESS_ROW_STEP = 8
FEWEST_DIFFERENCES = 200
FAR_FROM_RIM_PX = 4.0
UNKNOWN_DISPARITY_PX = 0.08
"""Stands in where a map has too few depths to tell."""
LEAST_DISPARITY_PX = 0.01
"""A depth map without noise is none of a camera."""


class DepthNoise(BaseModel):
    """Noise of a stereo camera's depth, in pixels of disparity d.

    ``sigma^2 = disparity^2 + (slope |grad d|)^2 + (bend B)^2 + (rim exp((1 - r) / reach))^2``, where ``grad d`` is the
    change of d from pixel to pixel, ``B^2`` the squares of ``d(-2) - 2 d(0) + d(2)`` along rows and columns beyond what
    noise itself makes, and ``r`` how many steps away the nearest pixel without depth is. A mean over a window of n px
    takes (n^2 - 1) / 96 of such a bend off.

    Where ``disparity_px`` is not given, each depth map tells it by how rough it is: within 20 % for a matcher that
    compares windows of 5 to 9 px, too low for one that smooths its depth. A calibration knows better.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    disparity_px: Annotated[
        FiniteFloat | None,
        Field(gt=0, le=4, description="standard deviation on a flat, faced surface; null: read off each depth map"),
    ] = None
    slope_px: Annotated[
        FiniteFloat,
        Field(ge=0, le=8, description="more of it for each pixel that disparity changes from one to the next"),
    ] = 0.22
    rim_px: Annotated[FiniteFloat, Field(ge=0, le=8, description="more of it where depth ends")] = 0.3
    rim_reach_px: Annotated[FiniteFloat, Field(gt=0, le=32, description="how far from there it falls by 1/e")] = 1.5
    bend: Annotated[FiniteFloat, Field(ge=0, le=4, description="more of it, as a share of how far disparity bends")] = (
        0.4
    )
    outlier_share: Annotated[FiniteFloat, Field(ge=0, le=0.5, description="of depths that mean nothing")] = 1e-3
    rim_outlier_share: Annotated[FiniteFloat, Field(ge=0, le=0.9, description="of those where depth ends")] = 0.02

    def sigma_m(self, depth_m: RealArray, rig: StereoRig) -> Float32Array:
        """Return the standard deviation (H, W) of each depth along the optical axis, metres; NaN where missing."""
        from sidelong.kernels import strips
        from sidelong.physics.depth_noise_kernel import fill_sigma

        fb = np.float32(rig.left.fx * rig.baseline_m)
        disparity_px = np.full(depth_m.shape, np.nan, dtype=np.float32)
        present = _present(depth_m)
        np.divide(fb, depth_m, out=disparity_px, where=present, casting="same_kind")
        rim_px = _steps_to_missing(present)
        flat = self.disparity_px if self.disparity_px is not None else seen_noise_px(disparity_px, rim_px)
        numbers = np.array([fb, flat, self.slope_px, self.rim_px, self.rim_reach_px, self.bend], dtype=np.float32)
        sigma_m = np.empty_like(disparity_px)
        strips(lambda first, last: fill_sigma(disparity_px, rim_px, numbers, sigma_m, first, last), len(sigma_m))
        return sigma_m

    @property
    def trust(self) -> float:
        """Log-odds that a depth is no outlier."""
        return _log_odds(self.outlier_share)

    @property
    def rim_trust(self) -> float:
        """Log-odds that a depth beside missing ones is no outlier."""
        return _log_odds(max(self.outlier_share, self.rim_outlier_share))


def rim_distance_px(depth_m: RealArray) -> Float32Array:
    """Return how many steps along rows and columns (H, W) the nearest pixel without depth is away; 0 where missing.

    The image border is no rim: what lies beyond it is not known to lack depth.
    """
    return _steps_to_missing(_present(depth_m))


def seen_noise_px(disparity_px: Float32Array, rim_px: Float32Array) -> float:
    """Return the noise of a map of disparity (H, W) in pixels, by the median roughness of some of its rows.

    Pixels near rims (``rim_px`` is of :func:`rim_distance_px`) have no say; where others are few it is not known, and
    ``UNKNOWN_DISPARITY_PX``.
    """
    step = ROUGHNESS_STEP_PX
    some = slice(ROUGHNESS_ROW_STEP // 2, None, ROUGHNESS_ROW_STEP)
    far = np.where(rim_px[some] > FAR_FROM_RIM_PX, disparity_px[some], np.float32(np.nan))
    rough = np.abs(far[:, : -2 * step] - 2 * far[:, step:-step] + far[:, 2 * step :])
    rough = rough[np.isfinite(rough)]
    if rough.size < FEWEST_DIFFERENCES:
        return UNKNOWN_DISPARITY_PX
    return max(1.4826 * float(np.median(rough)) / ROUGHNESS, LEAST_DISPARITY_PX)


def _steps_to_missing(present: BoolArray) -> Float32Array:
    import cv2

    distance_px: Any = cv2.distanceTransform(present.view(np.uint8), cv2.DIST_L1, 3)
    return distance_px


def _present(depth_m: RealArray) -> BoolArray:
    return (depth_m > 0) & (depth_m < np.inf)


def _log_odds(outlier_share: float) -> float:
    share = max(outlier_share, SMALLEST_OUTLIER_SHARE)
    return float(np.log((1 - share) / share))
