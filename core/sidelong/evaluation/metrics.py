"""What a completed depth map is worth against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sidelong.errors import DepthError
from sidelong.types import BoolArray, FloatArray

RECOVERED_WITHIN_M = 2e-3
"""Largest depth error of a recovered pixel (paper, section V-B)."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth of one reference view.

    Attributes
    ----------
    depth_m
        (H, W) true depth, NaN where unknown.
    on_parts
        (H, W) pixels that show a part.
    measured
        (H, W) pixels that had depth in the reference view.
    """

    depth_m: FloatArray
    on_parts: BoolArray
    measured: BoolArray

    @cached_property
    def missing(self) -> BoolArray:
        """(H, W) pixels on the parts that had no depth and whose true depth is known: the denominator.

        Raises
        ------
        DepthError
            There is none, so completeness has no meaning.
        """
        missing = self.on_parts & ~self.measured & np.isfinite(self.depth_m)
        if not missing.any():
            on_parts_px = int(self.on_parts.sum())
            raise DepthError(f"truth: 0 of {on_parts_px} part pixels lack depth and have a known truth, limit 1")
        return missing

    def recovered(self, depth_m: FloatArray) -> BoolArray:
        """Return which missing pixels (H, W) now lie within ``RECOVERED_WITHIN_M`` of the truth."""
        error_m = np.abs(np.where(np.isfinite(depth_m), depth_m, np.inf) - np.nan_to_num(self.depth_m))
        return self.missing & (error_m < RECOVERED_WITHIN_M)

    def completeness(self, depth_m: FloatArray) -> float:
        """Return recovered over missing pixels, 0..1 (depth completion percentage of the paper, as a share)."""
        return float(self.recovered(depth_m).sum() / self.missing.sum())
