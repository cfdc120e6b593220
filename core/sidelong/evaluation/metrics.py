"""What a completed depth map is worth against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sidelong.errors import DepthError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.types import BoolArray, CompletedDepth, FloatArray, PixelState

RECOVERED_WITHIN_M = 2e-3
"""Largest depth error of a recovered pixel (paper, section V-B)."""

ON_PART_WITHIN_M = 3e-3
"""How far true depth and posed CAD model may differ for a pixel to show the part: else something stands before it."""


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
        """Return which missing pixels (H, W) now lie within ``RECOVERED_WITHIN_M`` of the truth.

        Doubtful depth counts as well: here the error decides.
        """
        error_m = np.abs(np.where(np.isfinite(depth_m), depth_m, np.inf) - np.nan_to_num(self.depth_m))
        return self.missing & (error_m < RECOVERED_WITHIN_M)

    def completeness(self, depth_m: FloatArray) -> float:
        """Return recovered over missing pixels, 0..1 (depth completion percentage of the paper, as a share)."""
        return float(self.recovered(depth_m).sum() / self.missing.sum())


def truth_of(
    depth_m: FloatArray,
    measured: BoolArray,
    parts: Sequence[tuple[Part, FloatArray]],
    seen_from: tuple[PinholeCamera, FloatArray],
) -> Truth:
    """Return the truth of a view, its part pixels found by rendering the parts at their true poses.

    Parameters
    ----------
    depth_m
        (H, W) true depth, NaN where unknown.
    measured
        (H, W) pixels that had depth in the view.
    parts
        Each part with its ``base_T_object``.
    seen_from
        Camera and ``base_T_camera`` (4, 4) of the view.
    """
    rendered_m = RayScene(parts).render(*seen_from).depth_m
    return Truth(depth_m, np.abs(rendered_m - depth_m) <= ON_PART_WITHIN_M, measured)


def seen_m(depth: CompletedDepth) -> FloatArray:
    """Return the depth (H, W) that some view measured, also where it is doubtful; NaN where a CAD model stands in."""
    return np.where(depth.state == PixelState.MODELLED, np.nan, depth.depth_m)
