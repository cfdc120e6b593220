"""What the planner says of single points in a view, beside what the view then measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.types import BoolArray, FloatArray, IntArray

SAME_SURFACE_M = 3e-3
"""How far measured depth may lie from the predicted surface: more than that is depth of something else."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A view as predicted, one row for each of N points of the belief.

    Attributes
    ----------
    pixels
        (N, 2) row and column in the image the belief was made for.
    weight
        (N,) how many pixels a point stands for, times the probability of its hypothesis.
    exposure
        (N, C) what left (and right) camera should receive if nothing stands between, in units of the exposure at which
        the sensor clips; not clipped.
    reached
        (N,) inside the images and the projector's cone, hidden from no camera, not in shadow.
    probability
        (N,) of depth; 0 where not reached.
    seen_at
        (N, 2) row and column of the pixel of the view's left image that shows the point; -1 outside.
    depth_m
        (N,) of the point in the view's left camera.
    """

    pixels: IntArray
    weight: FloatArray
    exposure: FloatArray
    reached: BoolArray
    probability: FloatArray
    seen_at: IntArray
    depth_m: FloatArray

    def measured(self, depth_m: FloatArray, tolerance_m: float = SAME_SURFACE_M) -> BoolArray:
        """Say which points (N,) a depth map (H, W) of the view shows, NaN where missing, within the tolerance."""
        inside = self.seen_at[:, 0] >= 0
        there_m = np.where(inside, depth_m[self.seen_at[:, 0], self.seen_at[:, 1]], np.nan)
        return np.abs(there_m - self.depth_m) <= tolerance_m
