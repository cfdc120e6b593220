"""How well a pose explains the grey values around it, whatever the light.

Under distant light, grey is a function of the normal alone (the reflectance map of shape from shading, Horn 1977).
Each hypothesis gets the best smooth map, a cubic in the normal, fitted to the pixels it covers, and a constant
background; the score is the share of variance explained. The contours alone confuse the ends of a part more often.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.settings import DetectionSettings
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
LEAST_FACING = 0.05
"""Share of a part's pixels that must face the viewer to tell how bright such facets are."""


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

    def __init__(self, part: Part, camera: PinholeCamera) -> None:
        self._camera = camera
        self._centre_m = part.centre_m
        self._radius_m = part.diameter_m / 2
        self._scene = RayScene([(part, np.eye(4))])
        ticks = (np.arange(GRID) + 0.5) / GRID * 2 - 1
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
    """Return the share (K,) 0..1 of the grey values' variance that normals and silhouette explain.

    Parameters
    ----------
    look
        What the poses look like.
    grey
        (K, Q) from ``grey_around``.
    """
    basis = np.concatenate([_cubic(look.normals) * look.covered[..., None], ~look.covered[..., None]], axis=-1)
    moments = np.swapaxes(basis, 1, 2) @ basis + RIDGE * np.eye(basis.shape[-1])
    fitted: Any = np.linalg.solve(moments, np.swapaxes(basis, 1, 2) @ grey[..., None])
    residual: FloatArray = grey - (basis @ fitted)[..., 0]
    total = (grey**2).sum(axis=1)
    return np.clip(1.0 - (residual**2).sum(axis=1) / np.maximum(total, 1e-9), 0.0, 1.0) * (total > 0)


def faces_are_bright(look: Look, grey: FloatArray, settings: DetectionSettings) -> BoolArray:
    """Say for which poses (K,) the facets that face the viewer are brighter than the ground around the part.

    They mirror the lights above the bin. On the dark walls of a bin, which have a part's width and straight edges, they
    are not; where a pose shows hardly any such facet it says nothing, and passes.
    """
    facing = look.covered & (-look.normals[..., 2] >= settings.bright_cosine)
    ground = ~look.covered
    share = facing.sum(axis=1) / np.maximum(look.covered.sum(axis=1), 1)
    bright = (grey * facing).sum(axis=1) / np.maximum(facing.sum(axis=1), 1)
    dark = (grey * ground).sum(axis=1) / np.maximum(ground.sum(axis=1), 1)
    return (bright > dark) | (share < LEAST_FACING)


def _cubic(normals: FloatArray) -> FloatArray:
    """Return x^i y^j z^k (..., 16) with i + j + k <= 3 and k <= 1: all cubics, since z^2 = 1 - x^2 - y^2."""
    x, y, z = np.moveaxis(normals, -1, 0)
    exponents = [(i, j, k) for k in (0, 1) for i in range(4) for j in range(4) if i + j + k <= 3]
    return np.stack([x**i * y**j * z**k for i, j, k in exponents], axis=-1)
