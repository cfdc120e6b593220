"""Whether anything lies in a scene: an empty bin is another answer than a bin of parts that were not recognised."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from sidelong.detection.contours import EdgeField
from sidelong.detection.depth_evidence import sampled
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.types import BoolArray, FloatArray, GrayImage

STEPS_PER_PART = 16
"""Depths looked at across a part's diameter."""
FLAT = 0.03
"""How far from a plane a depth may lie, in diameters of the part."""
LONG = 1.5
"""Length from which on a piece of a plane is none of a part, in diameters."""
PLANE_TRIALS = 60
MOST_PLANES = 8
"""Floor, table, the walls of a bin inside and outside, and their rim."""
BLOB = 3
"""Depths in a row, in both directions, that a lying part shows off all planes; seams along edges are narrower."""
EDGE = 0.8
"""Response of :class:`EdgeField` from which on a pixel lies on an edge."""
LEAST_EDGES = 1e-3
"""Share of the pixels that lie on an edge where something is seen."""


def is_empty(
    image: GrayImage, depth_m: FloatArray | None, camera: PinholeCamera, diameter_m: float, distance_m: float
) -> bool:
    """Say whether nothing of a part's size lies in the scene.

    With depth: all that was measured lies on pieces of planes longer than the part (floor, table, walls of a bin), but
    for seams narrower than ``BLOB`` samples. A part of which nothing was measured, or thinner than ``FLAT`` of its
    diameter, is not noticed: an empty bin has holes as wide, with as many edges, in the shadows of its walls. Without
    depth only an image without edges is an empty scene: grey values do not tell an empty bin from a full one.

    Parameters
    ----------
    image, depth_m
        (H, W) of the view; depth NaN where missing, or None.
    camera
        Of both.
    diameter_m, distance_m
        Of the part, and about how far away it lies.
    """
    if depth_m is None or not np.isfinite(depth_m).any():
        return not _has_edges(image)
    step_px = max(1.0, camera.fx * diameter_m / distance_m / STEPS_PER_PART)
    u, v = np.meshgrid(np.arange(0, camera.width, step_px), np.arange(0, camera.height, step_px))
    uv = np.stack([u, v], axis=-1)
    points = camera.rays(u, v) * sampled(depth_m, uv)[..., None]
    left = _off_planes(points, diameter_m)
    return not ndimage.binary_opening(left, np.ones((BLOB, BLOB), dtype=np.bool_)).any()


def _has_edges(image: GrayImage) -> bool:
    return float(np.mean(EdgeField(image).strength > EDGE)) > LEAST_EDGES


def _off_planes(points: FloatArray, diameter_m: float) -> BoolArray:
    """Return which points (H, W, 3) lie on no connected piece of a plane that is longer than a part; NaN lie on one."""
    rng = np.random.default_rng(0)
    left: BoolArray = np.isfinite(points[..., 2])
    for _ in range(MOST_PLANES):
        on_plane = np.zeros_like(left)
        on_plane[left] = _plane(points[left], FLAT * diameter_m, rng)
        # a plane at the height of the parts' upper sides meets the walls too: only what hangs together counts
        pieces, count = ndimage.label(on_plane, np.ones((3, 3), dtype=np.bool_))
        long = [k for k in range(1, count + 1) if _length(points[pieces == k]) > LONG * diameter_m]
        if not long:
            break
        left &= ~np.isin(pieces, long)
    return left


def _plane(points: FloatArray, tolerance_m: float, rng: np.random.Generator) -> BoolArray:
    """Return the points (N,) of the plane that holds most of them (RANSAC)."""
    best = np.zeros(len(points), dtype=np.bool_)
    for _ in range(PLANE_TRIALS if len(points) >= 3 else 0):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length > 0:
            inliers = np.abs((points - a) @ (normal / length)) < tolerance_m
            best = inliers if inliers.sum() > best.sum() else best
    return best


def _length(points: FloatArray) -> float:
    """Return the diagonal of the box around points (N, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))
