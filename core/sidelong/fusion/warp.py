"""A depth map as another view sees it: a z-buffered raster of one tile for each measured pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sidelong.fusion.settings import FusionSettings
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.types import BoolArray, FloatArray

Int32Array = NDArray[np.int32]
Float32Array = NDArray[np.float32]
"""Inside the kernels: at 1 m and 1300 px its rounding is 0.1 um and 1e-4 px."""

EDGE_TOLERANCE_PX = 1e-3
"""Slack at the border of a tile: a pixel centre between two tiles that just touch must not fall through."""

EDGE_ON_PX2 = 1e-6
"""A pixel of the view that covers less of the reference image is seen edge-on, and shows no front."""


def measured(depth_m: FloatArray) -> BoolArray:
    """Say which pixels of a depth map carry a depth: positive and finite."""
    return np.isfinite(depth_m) & (depth_m > 0)


def warp(
    depth_m: FloatArray,
    camera: PinholeCamera,
    reference_T_view: FloatArray,
    wanted: BoolArray,
    settings: FusionSettings,
) -> FloatArray:
    """Return the depth map of another view as depth of the reference view, at the wanted pixels only.

    Each measured pixel is a tile: a planar patch ``tile_px`` wide in its own image that rises as its four neighbours
    say (in 1/z, which is affine on a plane, so planes stay planes). Neighbours whose depths differ by more than a plane
    at ``max_incidence_rad`` to the line of sight would make them differ lie across a depth edge and have no say. Tiles
    overlap on smooth surfaces, never bridge a depth edge, and a lone pixel counts as well (facing its own camera).

    A wanted pixel takes the mean of the depths within ``front_band_m`` of the nearest one. Tiles whose back the
    reference camera sees are dropped.

    Parameters
    ----------
    depth_m
        (H, W), NaN where missing; entries that are not positive and finite count as missing.
    camera
        Of both views.
    reference_T_view
        (4, 4).
    wanted
        (H, W) pixels of the reference view to fill.
    settings
        The lengths and angles named above.

    Returns
    -------
    FloatArray
        (H, W) depth in the reference camera, NaN where nothing was found or wanted.
    """
    inverse = np.full(depth_m.shape, np.nan, dtype=np.float32)
    np.divide(1, depth_m, out=inverse, where=measured(depth_m), casting="same_kind")
    motion = _Motion.of(camera, reference_T_view)
    rows, columns = np.nonzero(_near_wanted(inverse, motion, wanted, settings.max_stretch_px // 2))
    # how much the depth may change with a step of one pixel, relative to the depth
    edge = np.tan(settings.max_incidence_rad) / camera.fx
    tiles = _tiles(inverse, rows.astype(np.int32), columns.astype(np.int32), motion, edge)
    pixel, z_m = _rasterise(tiles, wanted, settings.tile_px / 2, settings.max_stretch_px)
    return _front(pixel, z_m, wanted.size, settings.front_band_m).reshape(wanted.shape)


@dataclass(frozen=True, eq=False)
class _Motion:
    """From the view to the reference: ``q = M (u, v, 1) + m / z``, then u' = q_x / q_z, v' = q_y / q_z, z' = z q_z."""

    M: Float32Array
    m: Float32Array

    @staticmethod
    def of(camera: PinholeCamera, reference_T_view: FloatArray) -> _Motion:
        K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        M = K @ reference_T_view[:3, :3] @ np.linalg.inv(K)
        return _Motion(M.astype(np.float32), (K @ reference_T_view[:3, 3]).astype(np.float32))

    def apply(self, u: NDArray[Any], v: NDArray[Any], inverse: Float32Array) -> tuple[Float32Array, ...]:
        """Return u', v' and q_z; NaN where the depth is missing or the point is behind the reference camera."""
        u, v = u.astype(np.float32), v.astype(np.float32)
        x, y, z = (self.M[i, 0] * u + (self.M[i, 1] * v + self.M[i, 2]) + self.m[i] * inverse for i in range(3))
        z[~(z > 0)] = np.nan
        return x / z, y / z, z


@dataclass(frozen=True, eq=False)
class _Tiles:
    """Planar patches seen in the reference image, one for each pixel of the view; arrays (N,), float32.

    Attributes
    ----------
    u, v, inverse
        Where the centre falls, and its inverse depth in the reference camera.
    u_right, v_right, inverse_right, u_down, v_down, inverse_down
        How these change along the patch for one pixel of the view to the right and one down.
    """

    u: Float32Array
    v: Float32Array
    inverse: Float32Array
    u_right: Float32Array
    v_right: Float32Array
    inverse_right: Float32Array
    u_down: Float32Array
    v_down: Float32Array
    inverse_down: Float32Array


def _near_wanted(inverse: Float32Array, motion: _Motion, wanted: BoolArray, margin_px: int) -> BoolArray:
    """Say which pixels of the view fall within ``margin_px`` of a wanted pixel of the reference."""
    import cv2

    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
    dilated: Any = cv2.dilate(np.pad(wanted, margin_px).astype(np.uint8), kernel)
    height, width = wanted.shape[0] + 2 * margin_px, wanted.shape[1] + 2 * margin_px
    columns = np.arange(inverse.shape[1], dtype=np.float32)
    rows = np.arange(inverse.shape[0], dtype=np.float32)[:, None]
    u, v, _ = motion.apply(columns, rows, inverse)
    u, v = u + np.float32(margin_px + 0.5), v + np.float32(margin_px + 0.5)
    near = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    near[near] = dilated.reshape(-1)[v[near].astype(np.int32) * width + u[near].astype(np.int32)] > 0
    return near


def _tiles(inverse: Float32Array, rows: Int32Array, columns: Int32Array, motion: _Motion, edge: float) -> _Tiles:
    """Return the tiles of these pixels of the view."""
    around = np.pad(inverse, 1, constant_values=np.nan)
    centre = inverse[rows, columns]
    right = _slope(around[rows + 1, columns], centre, around[rows + 1, columns + 2], edge)
    down = _slope(around[rows, columns + 1], centre, around[rows + 2, columns + 1], edge)
    u, v, q_z = motion.apply(columns, rows, centre)
    scale: Float32Array = np.float32(1) / q_z

    def along(axis: int, slope: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Differentiate u', v' and 1 / z' along an axis of the view's image."""
        x, y, z = (motion.M[i, axis] + motion.m[i] * slope for i in range(3))
        return (x - u * z) * scale, (y - v * z) * scale, (slope - centre * scale * z) * scale

    return _Tiles(u, v, centre * scale, *along(0, right), *along(1, down))


def _slope(before: Float32Array, centre: Float32Array, after: Float32Array, edge: float) -> Float32Array:
    """Return the mean step of the inverse depth to the neighbours not across a depth edge; 0 without any."""
    total, count = np.zeros_like(centre), np.zeros_like(centre)
    for low, high in ((before, centre), (centre, after)):
        step = high - low
        joined = np.abs(step) <= np.float32(edge) * np.minimum(low, high)
        total += np.where(joined, step, np.float32(0))
        count += joined
    np.divide(total, count, out=total, where=count > 0)
    return total


def _rasterise(
    tiles: _Tiles, wanted: BoolArray, half_side_px: float, max_stretch_px: int
) -> tuple[Int32Array, FloatArray]:
    """Return flat pixel index and depth of each wanted pixel centre on each tile that shows its front."""
    half = np.float32(half_side_px)
    left, columns = _centres_within(tiles.u, half * (np.abs(tiles.u_right) + np.abs(tiles.u_down)), wanted.shape[1])
    top, rows = _centres_within(tiles.v, half * (np.abs(tiles.v_right) + np.abs(tiles.v_down)), wanted.shape[0])
    area = tiles.u_right * tiles.v_down - tiles.u_down * tiles.v_right
    wide = np.maximum(np.abs(tiles.u_right) + np.abs(tiles.u_down), np.abs(tiles.v_right) + np.abs(tiles.v_down))
    drawn = (area > EDGE_ON_PX2) & (2 * half * wide <= max_stretch_px)
    tile, column, row = _expanded(np.where(drawn, columns, 0), rows)
    column, row = column + left[tile], row + top[tile]
    pixel = row * np.int32(wanted.shape[1]) + column
    asked = wanted.reshape(-1)[pixel]
    tile, pixel, right_px, down_px = tile[asked], pixel[asked], column[asked], row[asked]

    # where on the tile the pixel centre falls, in pixels of the view
    right_px, down_px = right_px.astype(np.float32) - tiles.u[tile], down_px.astype(np.float32) - tiles.v[tile]
    per_area = 1 / area[tile]
    along_right = (tiles.v_down[tile] * right_px - tiles.u_down[tile] * down_px) * per_area
    along_down = (tiles.u_right[tile] * down_px - tiles.v_right[tile] * right_px) * per_area
    inside = np.maximum(np.abs(along_right), np.abs(along_down)) <= half + np.float32(EDGE_TOLERANCE_PX)
    tile, along_right, along_down = tile[inside], along_right[inside], along_down[inside]
    inverse = tiles.inverse[tile] + tiles.inverse_right[tile] * along_right + tiles.inverse_down[tile] * along_down
    in_front = inverse > 0  # the rim of a patch close to the camera may reach behind it
    return pixel[inside][in_front], 1 / inverse[in_front].astype(np.float64)


def _centres_within(centre: Float32Array, reach: Float32Array, size: int) -> tuple[Int32Array, Int32Array]:
    """Return first and number of the pixel centres within reach, cut at the image border."""
    first = np.clip(np.ceil(centre - reach), 0, size).astype(np.int32)
    last = np.clip(np.floor(centre + reach), -1, size - 1).astype(np.int32)
    return first, np.maximum(last - first + 1, 0)


def _expanded(columns: Int32Array, rows: Int32Array) -> tuple[Int32Array, Int32Array, Int32Array]:
    """Return index, column and row of all cells of boxes of these sizes."""
    count = columns * rows
    index = np.repeat(np.arange(len(count), dtype=np.int32), count)
    cell = np.arange(len(index), dtype=np.int32) - np.repeat(np.cumsum(count, dtype=np.int32) - count, count)
    row, column = np.divmod(cell, columns[index])
    return index, column, row


def _front(pixel: Int32Array, z_m: FloatArray, size: int, band_m: float) -> FloatArray:
    """Return the mean depth of the samples within the band behind the nearest (size,), NaN where there is none."""
    nearest = np.full(size, np.inf)
    np.minimum.at(nearest, pixel, z_m)
    used = z_m <= nearest[pixel] + band_m
    count = np.bincount(pixel[used], minlength=size)
    total = np.bincount(pixel[used], weights=z_m[used], minlength=size)
    return np.divide(total, count, out=np.full(size, np.nan), where=count > 0)
