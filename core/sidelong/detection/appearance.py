"""How well a pose explains the grey values around it, whatever the light.

Under distant light, grey is a function of the normal alone (the reflectance map of shape from shading, Horn 1977).
Each hypothesis gets the best smooth map, a cubic in the normal, fitted to the pixels it covers; what speaks for it is the
share of variance explained. The contours alone confuse the ends of a part more often.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import transform_points
from sidelong.types import BoolArray, FloatArray, GrayImage

GRID = 28
"""Pixels looked at across the part's diameter."""
PADDING = 1.1
"""Radius of the disc looked at, in radii of the part: some background belongs to the evidence."""
RIDGE = 1e-2
FACING = 0.9
"""Cosine from which on a facet faces the viewer."""
LEAST_FACING = 0.05
"""Share of a part's pixels that must face the viewer to tell how bright such facets are."""
BRIGHT = 0.25
LEAST_SPREAD = 1.0
"""Grey levels below which differences are noise."""


@dataclass(frozen=True, eq=False)
class Look:
    """What poses look like on a disc of pixels around each.

    Attributes
    ----------
    uv
        (K, Q, 2) pixels.
    covered
        (K, Q) which of them the part covers.
    normals
        (K, Q, 3) in the camera's frame; zero where not covered.
    depth_m
        (K, Q) of the part's surface; NaN where not covered.
    """

    uv: FloatArray
    covered: BoolArray
    normals: FloatArray
    depth_m: FloatArray


class AppearanceModel:
    """Renders poses of one part on a coarse disc of pixels."""

    def __init__(self, part: Part, camera: PinholeCamera, grid: int = GRID) -> None:
        self._camera = camera
        self._centre_m = part.centre_m
        self._radius_m = part.diameter_m / 2
        self._scene = RayScene([(part, np.eye(4))])
        ticks = (np.arange(grid) + 0.5) / grid * 2 - 1
        disc = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
        self._disc = disc[np.linalg.norm(disc, axis=1) < 1.0]

    def look(self, camera_T_object: FloatArray) -> Look:
        """Cast rays through a disc around each pose (K, 4, 4)."""
        camera = self._camera
        centre = np.stack([transform_points(pose, self._centre_m) for pose in camera_T_object])
        radius_px = PADDING * camera.fx * self._radius_m / centre[:, 2]
        uv = camera.project(centre)[:, None] + radius_px[:, None, None] * self._disc
        rotation = camera_T_object[:, :3, :3]
        directions = camera.rays(uv[..., 0], uv[..., 1]) @ rotation
        origins = -(camera_T_object[:, None, :3, 3] @ rotation)
        hits = self._scene.cast(origins, directions)
        covered = hits.instance >= 0
        normals = np.where(covered[..., None], hits.normals, 0.0) @ np.swapaxes(rotation, 1, 2)
        # directions are scaled to z = 1 in the camera
        return Look(uv, covered, normals, np.where(covered, hits.distance, np.nan))


def smoothed(image: GrayImage, blur_px: float = 1.3) -> NDArray[np.float32]:
    """Return the image (H, W) without the noise that no normal explains."""
    import cv2

    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px), dtype=np.float32)


def grey_around(look: Look, smooth: NDArray[np.float32]) -> FloatArray:
    """Return the grey values (K, Q) of an image from ``smoothed``, less the mean of each row."""
    import cv2

    remap: Any = cv2.remap  # its stub forbids the None that means: coordinates are in one array
    where = look.uv.astype(np.float32)
    grey = remap(smooth, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    return grey - grey.mean(axis=1, keepdims=True)


def explained_variance(look: Look, grey: FloatArray) -> FloatArray:
    """Return the share (K,) 0..1 of the grey values' variance within the part that normals explain.

    Parameters
    ----------
    look
        What the poses look like.
    grey
        (K, Q) from ``grey_around``.
    """
    count = np.maximum(look.covered.sum(axis=1), 1)
    mean = (grey * look.covered).sum(axis=1) / count
    inside = (grey - mean[:, None]) * look.covered
    return _explained(_cubic(look.normals) * look.covered[..., None], inside)


def explained_around(look: Look, grey: FloatArray) -> FloatArray:
    """Return the share (K,) 0..1 of the variance on the whole disc that normals and an even ground explain."""
    return _explained(
        np.concatenate([_cubic(look.normals) * look.covered[..., None], ~look.covered[..., None]], -1), grey
    )


def _explained(basis: FloatArray, grey: FloatArray) -> FloatArray:
    transposed = np.swapaxes(basis, 1, 2)
    moments = transposed @ basis + RIDGE * np.eye(basis.shape[-1])
    fitted: Any = np.linalg.solve(moments, transposed @ grey[..., None])
    residual: FloatArray = grey - (basis @ fitted)[..., 0]
    total = (grey**2).sum(axis=1)
    return np.clip(1.0 - (residual**2).sum(axis=1) / np.maximum(total, 1e-9), 0.0, 1.0) * (total > 0)


def facing_brightness(look: Look, grey: FloatArray) -> FloatArray:
    """Return (K,) -1..``BRIGHT`` how much brighter than the ground those facets are that face the viewer.

    They mirror the lights above the bin. On the dark walls of a bin, which have a part's width and straight edges, they
    do not. More than bright proves nothing: one glint is enough. In twice the standard deviations of the disc; 0 where
    hardly any such facet is seen.
    """
    facing = look.covered & (-look.normals[..., 2] >= FACING)
    ground = ~look.covered
    enough = facing.sum(axis=1) >= LEAST_FACING * np.maximum(look.covered.sum(axis=1), 1)
    bright = (grey * facing).sum(axis=1) / np.maximum(facing.sum(axis=1), 1)
    dark = (grey * ground).sum(axis=1) / np.maximum(ground.sum(axis=1), 1)
    spread = 2 * np.maximum(grey.std(axis=1), LEAST_SPREAD)
    return np.where(enough, np.clip((bright - dark) / spread, -1.0, BRIGHT), 0.0)


def _cubic(normals: FloatArray) -> FloatArray:
    """Return x^i y^j z^k (..., 16) with i + j + k <= 3 and k <= 1: all cubics, since z^2 = 1 - x^2 - y^2."""
    x, y, z = np.moveaxis(normals, -1, 0)
    exponents = [(i, j, k) for k in (0, 1) for i in range(4) for j in range(4) if i + j + k <= 3]
    return np.stack([x**i * y**j * z**k for i, j, k in exponents], axis=-1)
