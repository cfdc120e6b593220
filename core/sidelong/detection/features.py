"""What speaks for and against an aligned pose: a few shares between 0 and 1 that mean the same for any part.

All are relative to what the pose says should be seen, so that neither the size of a part nor the number of its edges nor
the resolution of the camera changes their scale.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.appearance import Look, explained_around, explained_variance, facing_brightness, grey_around
from sidelong.detection.contours import ContourModel, EdgeField, project
from sidelong.detection.depth_evidence import residuals, sampled
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.types import BoolArray, FloatArray

BESIDE = (-0.12, -0.06, 0.06, 0.12)
"""Where texture is looked for that has edges everywhere, in diameters along a contour's normals."""
FITS, NEAR = 0.01, 0.04
"""How far a measured depth may be from the expected one to be the part's own, and to say nothing against it, diameters."""
LEAST_POINTS = 0.1
"""Share of the contour points below which they prove less."""
LEAST_BESIDE = 20
"""Pixels beside a part below which they prove less."""


Features = Mapping[str, FloatArray]
"""Arrays (K,) by name, 0..1 where nothing else is said.

silhouette, silhouette_beside, crease
    Mean response of edges on the visible silhouette and beside it, and on the visible creases.
around, inside
    Share of the grey values' variance explained on the disc around the part, by normals and an even ground; and within the part that the normals explain, beyond a constant.
facing
    How much brighter than the ground facets are that face the viewer, -1..0.25.
fits
    Share of the covered pixels that was measured where the pose says, within ``FITS``.
behind, before
    Share of them measured further away than ``NEAR``: looked through, which an opaque part forbids; nearer: hidden.
flush
    Share of the measured pixels beside the part that go on at its depth: its surface should end there.
"""


def contour_features(
    contours: ContourModel, edges: EdgeField, camera: PinholeCamera, poses: FloatArray, diameter_m: float
) -> Features:
    """Look for edges on and beside the visible contours of poses (K, 4, 4)."""
    contour = contours.select(poses, np.random.default_rng(1))
    seen = project(contour, camera, poses)
    across_px = (camera.fx * diameter_m / poses[:, 2, 3])[:, None, None]
    at_px = np.concatenate([np.broadcast_to([-1.0, 0.0, 1.0], (len(poses), 1, 3)), across_px * BESIDE], axis=-1)
    where = seen.uv[:, :, None] + at_px[..., None] * seen.normals[:, :, None]
    response = edges.agreement(where, seen.normals[:, :, None])
    here, beside = response[..., :3].max(axis=-1), response[..., 3:].mean(axis=-1)
    outer, inner = contour.visible & contour.silhouette, contour.visible & ~contour.silhouette
    return {
        "silhouette": _mean(here, outer),
        "silhouette_beside": _mean(beside, outer),
        "crease": _mean(here, inner),
    }


def grey_features(look: Look, smooth: NDArray[np.float32]) -> Features:
    """Compare what poses look like with an image from ``smoothed``."""
    grey = grey_around(look, smooth)
    return {
        "around": explained_around(look, grey),
        "inside": explained_variance(look, grey),
        "facing": facing_brightness(look, grey),
    }


def depth_features(look: Look, depth_m: FloatArray, diameter_m: float) -> Features:
    """Compare what poses look like with measured depth (H, W)."""
    residual = residuals(look, depth_m) / diameter_m
    size = np.abs(residual)  # NaN where nothing was measured: never counted
    covered = np.maximum(look.covered.sum(axis=1), 1)

    def share(counted: BoolArray) -> FloatArray:
        return counted.sum(axis=1) / covered

    return {
        "fits": share(size < FITS),
        "behind": share(residual >= NEAR),
        "before": share(residual <= -NEAR),
        "flush": _flush(look, depth_m, NEAR * diameter_m),
    }


def _flush(look: Look, depth_m: FloatArray, tolerance_m: float) -> FloatArray:
    beside = np.where(look.covered, np.nan, sampled(depth_m, look.uv))
    covered = np.maximum(look.covered.sum(axis=1), 1)
    middle = np.where(look.covered, look.depth_m, 0.0).sum(axis=1) / covered
    flush = np.abs(beside - middle[:, None]) < tolerance_m
    return flush.sum(axis=1) / np.maximum(np.isfinite(beside).sum(axis=1), LEAST_BESIDE)


def _mean(values: FloatArray, counted: BoolArray) -> FloatArray:
    return (values * counted).sum(axis=1) / np.maximum(counted.sum(axis=1), LEAST_POINTS * values.shape[1])
