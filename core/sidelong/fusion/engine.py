"""What an engine of the fusion does: it takes posed depth maps in and tells the depth of the reference's holes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sidelong.types import Float32Array, FloatArray, IntArray, SceneModel

MEDIAN_STRIDE_PX = 7

MISSING = -1
"""Value of ``source`` where no view gave depth."""


@dataclass(frozen=True, eq=False)
class PosedDepth:
    """The depth map of one view, and where that view is in the reference camera.

    Attributes
    ----------
    step
        Number of the view: 0 the reference, then 1, 2, ...
    depth_m, sigma_m
        (H, W) depth along the optical axis and its standard deviation, NaN where missing.
    reference_T_view
        (4, 4).
    covariance
        (6, 6) of that pose: a small turn (rad) about the view's camera, then a small shift (m), along the axes of the
        reference camera.
    """

    step: int
    depth_m: Float32Array
    sigma_m: Float32Array
    reference_T_view: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Estimate:
    """Depth of the holes of a reference view, (N,) each, in the order of the rows.

    Attributes
    ----------
    depth_m, sigma_m
        Along the optical axis of the reference camera and its standard deviation, NaN where missing.
    source
        Lowest step of the views it comes from, ``MISSING`` where there is none.
    """

    depth_m: FloatArray
    sigma_m: FloatArray
    source: IntArray


class Engine(Protocol):
    """Fuses depth maps; the order in which they come does not matter."""

    @property
    def scene(self) -> SceneModel | None:
        """The whole scene, where the engine models more than the reference view sees."""
        ...

    def add(self, view: PosedDepth) -> None:
        """Take in the depth map of one more view; raises DepthError where there is no room for it, and is as it was."""
        ...

    def estimate(self) -> Estimate:
        """Return the depth of the holes as all views show it."""
        ...


def common_noise(depth_m: Float32Array, sigma_m: Float32Array) -> float:
    """Return the median of standard deviation over squared depth, 1/m: what is usual of a map; 0 where it is empty."""
    some = slice(None, None, MEDIAN_STRIDE_PX)
    by_distance = sigma_m[some, some] / depth_m[some, some] ** 2
    by_distance = by_distance[np.isfinite(by_distance)]
    return float(np.median(by_distance)) if by_distance.size else 0.0
