"""How well a pose explains the grey values around it, whatever the light.

Under distant light, grey is a function of the normal alone (the reflectance map of shape from shading, Horn 1977).
Each hypothesis gets the best smooth map, a cubic in the normal, fitted to the pixels it covers; what speaks for it is
the share of variance explained. The contours alone confuse the ends of a part more often. What is seen is kept in
float32, whose error is some 1e-4 of a pixel: the time goes into memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray, RealArray

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

    uv: RealArray
    covered: BoolArray
    normals: RealArray
    depth_m: RealArray


@dataclass(frozen=True, eq=False)
class Surface:
    """What views of a part show on a disc around each, in the object's frame: the same wherever the part lies.

    Attributes
    ----------
    points
        (V, Q, 3) on the surface; where it is not covered on a plane through the part's centre.
    normals
        (V, Q, 3) zero where not covered.
    covered
        (V, Q) which points are the part's.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    covered: BoolArray

    def __getitem__(self, view: IntArray) -> Surface:
        return Surface(self.points[view], self.normals[view], self.covered[view])


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
        """Return what poses (K, 4, 4) look like."""
        return self.seen(self.surface(camera_T_object), camera_T_object)

    def surface(self, camera_T_object: FloatArray) -> Surface:
        """Cast rays through a disc around each pose (K, 4, 4)."""
        camera, rotation = self._camera, camera_T_object[:, :3, :3]
        centre = rotation @ self._centre_m + camera_T_object[:, :3, 3]
        radius_px = PADDING * camera.fx * self._radius_m / centre[:, 2]
        uv = camera.project(centre)[:, None] + radius_px[:, None, None] * self._disc
        directions = camera.rays(uv[..., 0], uv[..., 1]) @ rotation
        origins = -(camera_T_object[:, None, :3, 3] @ rotation)
        hits = self._scene.cast(origins, directions)
        covered = hits.instance >= 0
        # directions are scaled to z = 1 in the camera
        distance_m = np.where(covered, hits.distance, centre[:, None, 2])
        points = (origins + distance_m[..., None] * directions).astype(np.float32)
        return Surface(points, np.where(covered[..., None], hits.normals, 0.0).astype(np.float32), covered)

    def seen(self, surface: Surface, camera_T_object: FloatArray) -> Look:
        """Return what the K surfaces of poses (K, 4, 4) look like if nothing else of them is seen than was."""
        camera = self._camera
        turned = np.swapaxes(camera_T_object[:, :3, :3], 1, 2).astype(np.float32)
        points = surface.points @ turned + camera_T_object[:, None, :3, 3].astype(np.float32)
        depth_m = np.where(points[..., 2] > 0, points[..., 2], np.float32(np.nan))
        uv = np.empty((*depth_m.shape, 2), dtype=np.float32)
        uv[..., 0] = camera.fx * (points[..., 0] / depth_m) + camera.cx
        uv[..., 1] = camera.fy * (points[..., 1] / depth_m) + camera.cy
        return Look(
            uv, surface.covered, surface.normals @ turned, np.where(surface.covered, depth_m, np.float32(np.nan))
        )


def smoothed(image: GrayImage, blur_px: float = 1.3) -> NDArray[np.float32]:
    """Return the image (H, W) without the noise that no normal explains."""
    import cv2

    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px), dtype=np.float32)


def grey_around(look: Look, smooth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the grey values (K, Q) of an image from ``smoothed``, less the mean of each row."""
    import cv2

    remap: Any = cv2.remap  # its stub forbids the None that means: coordinates are in one array
    grey = remap(
        smooth, look.uv.astype(np.float32, copy=False), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(grey - grey.mean(axis=1, keepdims=True), dtype=np.float32)


class ReflectanceMaps:
    """The smooth maps from normals to grey values that can be fitted to each of V views, and an even ground.

    Cubics in the normal are the same functions in any frame: the object's serves all poses that show one view.
    """

    def __init__(self, surface: Surface) -> None:
        covered = surface.covered[:, None].astype(np.float32)
        self._basis = np.concatenate([_cubic(surface.normals) * covered, 1.0 - covered], axis=1)
        self._moments = (self._basis @ np.swapaxes(self._basis, 1, 2)).astype(np.float64)
        # of the part alone, and with the ground as the last column
        self._inside = _ridge_inverse(self._moments[:, :-1, :-1])
        self._around = _ridge_inverse(self._moments)

    def explained(self, view: IntArray, grey: NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Return the shares (K,), (K,) 0..1 of the variance of grey values that are explained, on the disc and inside.

        On the whole disc by normals and an even ground; within the part by the normals alone, beyond a constant.

        Parameters
        ----------
        view
            (K,) which view each row is of.
        grey
            (K, Q) from ``grey_around``.
        """
        moments = self._moments[view]
        products = (self._basis[view] @ grey[..., None])[..., 0].astype(np.float64)
        squared = grey.astype(np.float64) ** 2
        around = _share(moments, self._around[view], products, squared.sum(axis=1))
        moments, count, total = moments[:, :-1, :-1], np.maximum(moments[:, 0, 0], 1.0), products[:, 0]
        # the first of the basis is 1 on the part: the other moments follow from those about zero
        within = np.einsum("kq,kq->k", squared, self._basis[view, 0]) - total**2 / count
        products = products[:, :-1] - moments[:, 0] * (total / count)[:, None]
        return around, _share(moments, self._inside[view], products, within)


def _ridge_inverse(moments: FloatArray) -> FloatArray:
    inverse: Any = np.linalg.inv(moments + RIDGE * np.eye(moments.shape[-1]))
    return inverse


def _share(moments: FloatArray, inverse: FloatArray, products: FloatArray, total: FloatArray) -> FloatArray:
    """Return 1 - |g - B w|^2 / |g|^2 (K,) with w = (B' B + ridge)^-1 B' g, of B' B, that inverse, B' g and |g|^2."""
    fitted = (inverse @ products[..., None])[..., 0]
    gained = 2 * (products * fitted).sum(axis=1) - (fitted * (moments @ fitted[..., None])[..., 0]).sum(axis=1)
    return np.clip(gained / np.maximum(total, 1e-9), 0.0, 1.0)


def facing_brightness(look: Look, grey: NDArray[np.float32]) -> FloatArray:
    """Return (K,) -1..``BRIGHT`` how much brighter than the ground those facets are that face the viewer.

    They mirror the lights above the bin. On the dark walls of a bin, which have a part's width and straight edges, they
    do not. More than bright proves nothing: one glint is enough. In twice the standard deviations of the disc; 0 where
    hardly any such facet is seen.
    """
    facing = look.covered & (-look.normals[..., 2] >= FACING)
    covered, facets = look.covered.sum(axis=1), facing.sum(axis=1)
    bright = _sum(grey, facing) / np.maximum(facets, 1)
    dark = _sum(grey, ~look.covered) / np.maximum(look.covered.shape[1] - covered, 1)
    spread = 2 * np.maximum(grey.std(axis=1, dtype=np.float64), LEAST_SPREAD)
    enough = facets >= LEAST_FACING * np.maximum(covered, 1)
    return np.where(enough, np.clip((bright - dark) / spread, -1.0, BRIGHT), 0.0)


def _sum(values: NDArray[np.float32], counted: BoolArray) -> FloatArray:
    return np.einsum("kq,kq->k", values, counted.astype(np.float32)).astype(np.float64)


def _cubic(normals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return x^i y^j z^k (V, 16, Q) with i + j + k <= 3 and k <= 1: all cubics, since z^2 = 1 - x^2 - y^2; 1 first."""
    x, y, z = np.moveaxis(normals, -1, 0)
    one = np.ones_like(x)
    squares = [one, x, y, x * x, x * y, y * y]
    cubes = [squares[3] * x, squares[3] * y, squares[5] * x, squares[5] * y]
    return np.stack([*squares, *cubes, *(each * z for each in squares)], axis=1)
