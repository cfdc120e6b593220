"""Pixels of a sprayed scene whose geometry can be trusted, and who sees them: cameras and projector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.geometry.camera_model import PinholeCamera, StereoRig
from sidelong.types import BoolArray, FloatArray, IntArray

GAP = np.ones((3, 3), dtype=np.uint8)
"""Neighbours whose nearest a pixel of the depth buffer takes."""


@dataclass(frozen=True, eq=False)
class SprayedScene:
    """The same scene from the same place after spraying, in the left camera.

    Attributes
    ----------
    depth_m
        (H, W), NaN where missing.
    normals_camera
        (H, W, 3) unit normals that face the camera, NaN where there are none.
    normal_sigma_rad
        (H, W) expected rms angle to the true normal.
    labels
        (H, W) whole numbers: the material of each pixel, -1 for none.
    """

    depth_m: FloatArray
    normals_camera: FloatArray
    normal_sigma_rad: FloatArray
    labels: IntArray


def sound_pixels(scene: SprayedScene, edge_px: int, step_share: float) -> tuple[BoolArray, dict[str, BoolArray]]:
    """Return the pixels (H, W) whose geometry is sound, and those dropped, by reason."""
    labelled = scene.labels >= 0
    depth = np.isfinite(scene.depth_m)
    border = _near_border(scene.labels, edge_px) | _near_jump(scene.depth_m, edge_px, step_share)
    sound = np.isfinite(scene.normals_camera).all(axis=-1) & np.isfinite(scene.normal_sigma_rad)
    dropped = {
        "no depth": labelled & ~depth,
        "edge": labelled & depth & border,
        "no normal": labelled & depth & ~border & ~sound,
    }
    return labelled & depth & ~border & sound, dropped


def _near_jump(depth_m: FloatArray, edge_px: int, step_share: float) -> BoolArray:
    """Say which pixels (H, W) lie within ``edge_px`` of a jump of the depth, or of a hole."""
    import cv2

    log_depth = np.log(np.nan_to_num(depth_m, nan=1e6))
    jump = np.zeros(depth_m.shape, dtype=np.bool_)
    down, across = (np.abs(np.diff(log_depth, axis=axis)) > step_share for axis in (0, 1))
    jump[:-1] |= down
    jump[1:] |= down
    jump[:, :-1] |= across
    jump[:, 1:] |= across
    kernel = np.ones((2 * edge_px + 1, 2 * edge_px + 1), dtype=np.uint8)
    return cv2.dilate(jump.astype(np.uint8), kernel) > 0


def projector_camera(rig: StereoRig) -> PinholeCamera:
    """Return the projector as a camera whose pixels are as wide as the left camera's."""
    focal = rig.left.fx
    width, height = (
        2 * int(np.ceil(focal * np.tan(half))) + 1
        for half in (rig.projector.half_width_rad, rig.projector.half_height_rad)
    )
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def unhidden(points_eye: FloatArray, known: BoolArray, eye: PinholeCamera, tolerance_m: float) -> BoolArray:
    """Say which points (H, W, 3) no other of them hides from an eye: a depth buffer of the points themselves.

    Only what the left camera saw can hide. A buffer pixel takes the nearest of its 3x3 neighbours, which closes the
    gaps that stretching leaves.
    """
    import cv2

    uv = eye.project(points_eye)
    inside = known & eye.contains(uv)
    columns, rows = (np.rint(np.where(inside, uv[..., axis], 0.0)).astype(np.intp) for axis in (0, 1))
    nearest = np.full((eye.height, eye.width), np.float64(1e6))
    np.minimum.at(nearest, (rows[inside], columns[inside]), points_eye[..., 2][inside])
    nearest = cv2.erode(nearest, GAP)
    return inside & (points_eye[..., 2] <= nearest[rows, columns] + tolerance_m)


def _near_border(labels: IntArray, distance_px: int) -> BoolArray:
    """Say which pixels (H, W) lie within this distance of a pixel of another label or of the image's border."""
    import cv2

    size = 2 * distance_px + 1
    kernel = np.ones((size, size), dtype=np.uint8)
    padded = np.pad(labels.astype(np.float64), distance_px, constant_values=-2.0)
    differs = cv2.dilate(padded, kernel) != cv2.erode(padded, kernel)
    return differs[distance_px : distance_px + labels.shape[0], distance_px : distance_px + labels.shape[1]]
