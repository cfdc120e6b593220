"""What speaks for and against an aligned pose: a few shares between 0 and 1 that mean the same for any part.

All are relative to what the pose says should be seen, so that neither the size of a part nor the number of its edges
nor the resolution of the camera changes their scale.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.appearance import Look, ReflectanceMaps, facing_brightness, grey_around
from sidelong.detection.contours import ContourPoints, EdgeField, Projected, project
from sidelong.detection.depth_evidence import sampled
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.types import BoolArray, FloatArray, IntArray

FITS, NEAR = 0.01, 0.04
"""How far a measured depth may be from the expected one to be the part's own, and to say nothing against it; diameters.
"""
LEAST_POINTS = 0.1
"""Share of the contour points below which they prove less."""
LEAST_MEASURED = 0.1
"""Share of the covered pixels below which measured ones prove less."""
UNDECIDED = 0.02
"""Share of the silhouette's points that speak evenly for all directions: a round one does not tell how it is turned."""
LEAST_BESIDE = 20
"""Pixels beside a part below which they prove less."""


Features = Mapping[str, FloatArray]
"""Arrays (K,) by name, 0..1 where nothing else is said.

silhouette
    Mean response of edges on the visible silhouette, in that direction of shift, growth and turn for which it is least.
crease
    Mean response of edges on the visible creases, times ``silhouette``: any edge lies on the creases of some pose.
around, inside
    Share of the grey values' variance explained on the disc around the part, by normals and an even ground; and within
    the part by the normals, beyond a constant.
facing
    How much brighter than the ground facets are that face the viewer, -1..0.25.
fits
    Share of what was measured on the covered pixels that lies where the pose says, within ``FITS``.
behind, before
    Share of these pixels measured further away than ``NEAR``: looked through, which an opaque part forbids; nearer:
    hidden.
flush
    Share of the measured pixels beside the part that go on at its depth: its surface should end there.
"""


def contour_features(
    contour: ContourPoints, edges: EdgeField, camera: PinholeCamera, poses: FloatArray, diameter_m: float
) -> Features:
    """Look for edges on the visible contours of poses (K, 4, 4)."""
    seen = project(contour, camera, poses)
    response = np.max(edges.agreement(seen.beside(np.array([[[-1.0, 0.0, 1.0]]])), seen.normals[..., None]), axis=-1)
    radius_px = camera.fx * diameter_m / 2 / poses[:, 2, 3]
    silhouette = _weakest(response, seen, contour.visible & contour.silhouette, radius_px)
    return {"silhouette": silhouette, "crease": silhouette * _mean(response, contour.visible & ~contour.silhouette)}


def grey_features(look: Look, maps: ReflectanceMaps, view: IntArray, smooth: NDArray[np.float32]) -> Features:
    """Compare what poses look like, each like one of the views (K,), with an image from ``smoothed``."""
    grey = grey_around(look, smooth)
    around, inside = maps.explained(view, grey)
    return {"around": around, "inside": inside, "facing": facing_brightness(look, grey)}


def depth_features(look: Look, depth_m: FloatArray, diameter_m: float) -> Features:
    """Compare what poses look like with measured depth (H, W)."""
    measured_m = sampled(depth_m, look.uv)
    residual = (measured_m - look.depth_m) / diameter_m  # NaN where nothing was measured: never counted
    covered, measured = np.maximum(look.covered.sum(axis=1), 1), np.isfinite(residual).sum(axis=1)

    def share(counted: BoolArray) -> FloatArray:
        return counted.sum(axis=1) / covered

    return {
        "fits": (np.abs(residual) < FITS).sum(axis=1) / np.maximum(measured, LEAST_MEASURED * covered),
        "behind": share(residual >= NEAR),
        "before": share(residual <= -NEAR),
        "flush": _flush(look, measured_m, NEAR * diameter_m),
    }


def _flush(look: Look, measured_m: FloatArray, tolerance_m: float) -> FloatArray:
    beside = ~look.covered & np.isfinite(measured_m)
    covered = np.maximum(look.covered.sum(axis=1), 1)
    middle = np.where(look.covered, look.depth_m, 0.0).sum(axis=1) / covered
    flush = beside & (np.abs(measured_m - middle[:, None]) < tolerance_m)
    return flush.sum(axis=1) / np.maximum(beside.sum(axis=1), LEAST_BESIDE)


def _weakest(response: NDArray[np.float32], seen: Projected, counted: BoolArray, radius_px: FloatArray) -> FloatArray:
    """Return the least mean response (K,) over the directions in which a silhouette can move in the image.

    A point speaks for a motion by the square of its shift along the normal n; with j = (n, n . p, n x p) for shift,
    growth and turn, the least of (sum r (j . d)^2) / (sum (j . d)^2) over all d is the least eigenvalue of the
    information that was found relative to the one expected. A step edge along one side of a part, or a stripe as wide
    as it, leaves a direction with nothing.
    """
    weight = counted.astype(np.float32)
    number = np.maximum(weight.sum(axis=1), 1.0)
    middle = (seen.uv * weight).sum(axis=2) / number
    # a pose at the camera projects to anywhere
    place = np.clip(np.nan_to_num((seen.uv - middle[..., None]) / radius_px[:, None]), -2.0, 2.0)
    (u, v), (x, y) = seen.normals, place
    moves: FloatArray = np.stack([u, v, u * x + v * y, v * x - u * y], axis=-1).astype(np.float64)
    mean = _mean(response, counted)
    even = UNDECIDED * number[:, None, None] * np.eye(4)
    expected: FloatArray = np.swapaxes(moves * weight[..., None], 1, 2) @ moves + even
    found: FloatArray = np.swapaxes(moves * (weight * response)[..., None], 1, 2) @ moves + mean[:, None, None] * even
    algebra: Any = np.linalg  # the stub of cholesky leaves the type of its result open
    whitening: FloatArray = algebra.inv(algebra.cholesky(expected))
    relative: FloatArray = whitening @ found @ np.swapaxes(whitening, 1, 2)
    return np.minimum(np.linalg.eigvalsh(relative)[:, 0], mean)


def _mean(values: NDArray[np.float32], counted: BoolArray) -> FloatArray:
    total = np.einsum("kp,kp->k", values, counted.astype(np.float32)).astype(np.float64)
    return total / np.maximum(counted.sum(axis=1), LEAST_POINTS * values.shape[1])
