"""A depth map as another view sees it: a z-buffered raster of one planar tile for each measured pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sidelong.fusion.engine import PosedDepth
from sidelong.fusion.settings import FusionSettings
from sidelong.fusion.warping.kernels import average_fronts, draw_tiles, fill_trust
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.kernels import strips
from sidelong.types import BoolArray, Float32Array, FloatArray

SMALLEST_VARIANCE = 1e-18
"""Added to the diagonal of the pose's covariance, rad^2 and m^2, so that an exact pose has a root as well."""


@dataclass(frozen=True, eq=False)
class Holes:
    """The pixels of a reference view that are to be filled, numbered row by row.

    Attributes
    ----------
    index
        (H, W) number of each hole, -1 elsewhere.
    near
        (H + 2 margin, W + 2 margin) whether a hole is so near that a tile centred there may reach it.
    pixels
        (N, 2) column and row of each hole.
    """

    index: NDArray[np.int32]
    near: BoolArray
    pixels: NDArray[np.int32]

    @property
    def count(self) -> int:
        """How many holes there are."""
        return len(self.pixels)

    @staticmethod
    def of(wanted: BoolArray, settings: FusionSettings) -> Holes:
        """Number the holes of a mask (H, W)."""
        import cv2

        pixels = np.argwhere(wanted)[:, ::-1].astype(np.int32)
        index = np.full(wanted.shape, -1, dtype=np.int32)
        index[wanted] = np.arange(len(pixels), dtype=np.int32)
        margin_px = settings.max_stretch_px // 2 + 1
        kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
        near: Any = cv2.dilate(np.pad(wanted, margin_px).astype(np.uint8), kernel)
        return Holes(index, near > 0, np.ascontiguousarray(pixels))


Layer = tuple[Float32Array, Float32Array, Float32Array]
"""What one view says of the holes, (N,) each: depth along the optical axis of the reference camera, NaN where it says
nothing, the variance of that depth, and the log-odds that it is no outlier."""


def warp(view: PosedDepth, camera: PinholeCamera, holes: Holes, settings: FusionSettings, layer: Layer) -> None:
    """Fill a layer with the depth map of another view as depth of the reference view, at the holes only.

    Each measured pixel is a tile: a planar patch ``tile_px`` wide in its own image that rises as its four neighbours
    say (in 1/z, which is affine on a plane, so planes stay planes). Neighbours whose depths differ by more than a plane
    at ``max_incidence_rad`` to the line of sight would make them differ lie across a depth edge and have no say. Tiles
    overlap on smooth surfaces, never bridge a depth edge, and a lone pixel counts as well (facing its own camera).

    A hole takes the mean of the depths within ``front_band_m`` of the nearest one. Tiles whose back the reference
    camera sees are dropped. The variance is little less than that of one depth, for the errors of neighbours are much
    alike: noise and the error of the pose move the tile, and the line of sight of the hole meets it elsewhere.
    """
    inverse = np.float32(1) / view.depth_m
    motion = motion_of(camera, view.reference_T_view)
    root = np.linalg.cholesky(view.covariance + SMALLEST_VARIANCE * np.eye(6)).astype(np.float32)
    noise = settings.noise
    limits = np.array(
        [_edge(camera, settings), settings.tile_px / 2, settings.max_stretch_px, noise.trust, noise.rim_trust,
         camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float32,
    )  # fmt: skip
    target = holes.index, holes.near
    lists = tuple(
        strips(
            lambda first, last: draw_tiles(inverse, view.sigma_m, target, motion, root, limits, first, last),
            len(inverse),
        )
    )
    band_m = np.float32(settings.front_band_m)
    strips(lambda first, last: average_fronts(lists, band_m, layer, first, last), holes.count)


def trust_of(depth_m: Float32Array, camera: PinholeCamera, settings: FusionSettings) -> Float32Array:
    """Return the log-odds (H, W) that a depth is no outlier: less where depth ends, none for a spike."""
    trust = np.empty_like(depth_m)
    limits = _edge(camera, settings), np.float32(settings.noise.trust), np.float32(settings.noise.rim_trust)
    inverse = np.float32(1) / depth_m
    strips(lambda first, last: fill_trust(inverse, limits, trust, first, last), len(inverse))
    return trust


def _edge(camera: PinholeCamera, settings: FusionSettings) -> np.float32:
    """Return how much the depth may change with a step of one pixel, relative to the depth."""
    return np.float32(np.tan(settings.max_incidence_rad) / camera.fx)


def motion_of(camera: PinholeCamera, reference_T_view: FloatArray) -> Float32Array:
    """Return M, m, tau, c and R of :func:`sidelong.fusion.warping.kernels.draw_tiles`, (9, 3)."""
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    R, t = reference_T_view[:3, :3], reference_T_view[:3, 3]
    return np.vstack([K @ R @ np.linalg.inv(K), K @ t, R.T @ t, t, R]).astype(np.float32)
