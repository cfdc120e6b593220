"""What the depth that was measured from the same place says of matches and hypotheses.

Grey values alone cannot tell a part from a smaller image of it further away: on shiny parts, templates 30 % too far
match the inner creases better than the right ones match the contour. But a part cannot lie behind the surface that is
seen around it, nor far before it, and where some of it was measured its distance is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.detection.appearance import Look
from sidelong.errors import SettingsError
from sidelong.types import BoolArray, FloatArray, RealArray

SAMPLES = 7
"""Depths looked at across a part, in both directions."""
FEWEST = 4
"""Measured depths that bound a part; where there are fewer, the whole map does."""
OUTLIERS = 0.1
"""Share of the depths at either end that is not believed."""
LEAST_SHARE = 0.15
"""Of a part's pixels must be measured to decide its distance: a seam of ground beside it must not."""
HEAP = 0.75
"""How far a part may lie before the nearest surface measured around it, in its diameters: it may lie on others."""


@dataclass(frozen=True, eq=False)
class DistanceBounds:
    """Least and largest distance of a part's centre.

    Attributes
    ----------
    depth_m
        (H, W) depth of the view, NaN where missing; None where it was not measured at all.
    limits_m
        What holds in any case.
    diameter_m
        Of the part.
    """

    depth_m: FloatArray | None
    limits_m: tuple[float, float]
    diameter_m: float

    def check(self) -> None:
        """Raise SettingsError where all that was measured lies outside the limits: no part could be found there."""
        if self.depth_m is None:
            return
        low, high = (float(end[0]) for end in _inner_range(self.depth_m.reshape(1, -1)))
        if high < self.limits_m[0] or low - self.diameter_m > self.limits_m[1]:
            raise SettingsError(
                f"detection.distance_m: is {self.limits_m[0]:.3g} to {self.limits_m[1]:.3g} m, but what was measured "
                f"lies between {low:.3g} and {high:.3g} m"
            )

    def at(self, uv: FloatArray, radius_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the bounds (M,), (M,) of parts centred at pixels (M, 2) that reach ``radius_px`` (M,) far."""
        near, far = np.full(len(uv), self.limits_m[0]), np.full(len(uv), self.limits_m[1])
        if self.depth_m is None or not np.isfinite(self.depth_m).any():
            return near, far
        ticks = np.linspace(-1.0, 1.0, SAMPLES)
        grid = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
        low, high = _inner_range(sampled(self.depth_m, uv[:, None] + radius_px[:, None, None] * grid))
        overall = _inner_range(self.depth_m.reshape(1, -1))
        low, high = (np.where(np.isnan(mine), whole, mine) for mine, whole in zip((low, high), overall, strict=True))
        near = np.clip(low - HEAP * self.diameter_m, *self.limits_m)
        return near, np.clip(high, near, self.limits_m[1])


def residuals(look: Look, depth_m: FloatArray) -> FloatArray:
    """Return measured less expected depth (K, Q) of hypotheses; NaN where not covered or not measured."""
    return sampled(depth_m, look.uv) - look.depth_m


def offsets(residual_m: FloatArray, covered: BoolArray, reach_m: float | FloatArray) -> FloatArray:
    """Return how much further away (K,) parts are than expected: the median of residuals (K, Q) within reach.

    The reach is one for all, or (K, 1). 0 where too little of a part was measured to say.
    """
    near = np.abs(residual_m) <= reach_m  # False for NaN
    enough = near.sum(axis=1) >= np.maximum(LEAST_SHARE * covered.sum(axis=1), FEWEST)
    ordered = np.sort(np.where(near, residual_m, np.nan), axis=1)  # NaN comes last
    middle = np.take_along_axis(ordered, near.sum(axis=1)[:, None] // 2, axis=1)[:, 0]
    return np.where(enough, middle, 0.0)


def sampled(depth_m: FloatArray, uv: RealArray) -> FloatArray:
    """Return the depth (...) at the nearest pixel centres to pixels (..., 2); NaN outside the image."""
    height, width = depth_m.shape
    column, row = np.rint(uv[..., 0]), np.rint(uv[..., 1])
    # a part at the camera projects to anywhere, also to where no integer is
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.where(inside, row, 0).astype(np.intp) * width + np.where(inside, column, 0).astype(np.intp)
    return np.where(inside, depth_m.reshape(-1)[at], np.nan)


def _inner_range(depth_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends (M,), (M,) of each row (M, S) without its outliers; NaN where too few are measured."""
    ordered = np.sort(depth_m, axis=1)  # NaN comes last
    count = np.isfinite(depth_m).sum(axis=1)
    rows = np.arange(len(ordered))
    first = (OUTLIERS * count).astype(np.intp)
    enough = count >= FEWEST
    low, high = ordered[rows, first], ordered[rows, np.maximum(count - 1 - first, 0)]
    return np.where(enough, low, np.nan), np.where(enough, high, np.nan)
