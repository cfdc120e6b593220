"""Which part of the base frame a volume has to cover."""

from __future__ import annotations

import numpy as np

from sidelong.errors import DepthError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import transform_points
from sidelong.types import FloatArray, RealArray

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]

STRAY = 0.005
"""Share of the points that may lie outside on each side before the margin is added: outliers."""


def region_of(depth_m: RealArray, camera: PinholeCamera, base_T_camera: FloatArray, margin_m: float) -> Corners:
    """Return lowest and highest corner, in the base frame, of the box around what a depth map shows.

    Parameters
    ----------
    depth_m
        (H, W), NaN where missing; what is not a positive, finite length counts as missing.
    camera, base_T_camera
        That took it.
    margin_m
        Added on all sides of the box that holds 99 % of the points along each axis.

    Raises
    ------
    DepthError
        The depth map has no measured pixel.
    """
    present = np.isfinite(depth_m) & (depth_m > 0)
    if not present.any():
        raise DepthError(f"region: the depth map has 0 of {depth_m.size} px measured")
    rows, columns = np.nonzero(present)
    points_camera = camera.rays(columns.astype(np.float64), rows.astype(np.float64)) * depth_m[present][:, None]
    points_base = transform_points(base_T_camera, points_camera.astype(np.float64))
    low, high = np.quantile(points_base, (STRAY, 1 - STRAY), axis=0)
    low, high = (low - margin_m).tolist(), (high + margin_m).tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
