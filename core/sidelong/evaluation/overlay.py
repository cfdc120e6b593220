"""The picture by which a person judges poses: the mesh drawn over the image it was found in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene, Rendering
from sidelong.types import BoolArray, DetectedObject, FloatArray, GrayImage

CREASE_COSINE = 0.88
"""Neighbouring pixels whose normals enclose a smaller cosine (28 degrees) lie on both sides of an edge."""
COLOURS_BGR = (
    (178, 114, 0),
    (0, 159, 230),
    (115, 158, 0),
    (167, 121, 204),
    (233, 180, 86),
    (0, 94, 213),
    (66, 228, 240),
)
"""Okabe and Ito's palette: told apart with any kind of colour vision."""
BRIGHT_PERCENTILE = 99.5
WIDTH_PX = 1200
"""Of the picture, about: what lies around the objects is magnified to it."""
MARGIN = 0.75
"""Around the centres of the objects, in diameters of the part."""


def draw_overlay(
    image: GrayImage, part: Part, camera: PinholeCamera, objects: Sequence[DetectedObject], names: Sequence[str]
) -> bytes:
    """Draw the silhouettes and creases of the most probable poses over an image; return a PNG.

    Parameters
    ----------
    image
        (H, W) of the reference view; the picture shows what lies around the objects, the whole where there are none,
        magnified, and brightened where it is dark.
    part, camera
        What was found, and the intrinsics of the image.
    objects
        As detected or refined.
    names
        A label for each object, written beside its upper end.
    """
    import cv2

    poses = [item.hypotheses[0].camera_T_object for item in objects]
    window = _window(camera, part, poses)
    left, top, right, bottom = window
    scale = max(1, round(WIDTH_PX / (right - left)))
    close = _cropped(camera, window).scaled(scale)
    size = (close.width, close.height)
    part_of_it = _brightened(image)[top:bottom, left:right]
    canvas = np.asarray(cv2.resize(part_of_it, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    seen = RayScene([(part, pose) for pose in poses]).render(close, np.eye(4))
    lines = edges(seen)
    for index, name in enumerate(names):
        mine = seen.instance == index
        canvas[lines & mine] = COLOURS_BGR[index % len(COLOURS_BGR)]
        if mine.any():
            row, column = np.argwhere(mine)[0].tolist()
            for colour, thickness in (((0, 0, 0), 4), ((255, 255, 255), 1)):  # a dark rim reads on any ground
                cv2.putText(canvas, name, (column, max(row, 14)), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, thickness,
                            cv2.LINE_AA)  # fmt: skip
    return cv2.imencode(".png", canvas)[1].tobytes()


def _window(camera: PinholeCamera, part: Part, poses: Sequence[FloatArray]) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom (exclusive) of what lies around the parts; of the whole image without any."""
    centres = np.array([pose[:3, :3] @ part.centre_m + pose[:3, 3] for pose in poses]).reshape(-1, 3)
    centres = centres[centres[:, 2] > 0]
    uv = camera.project(centres)
    reach_px = MARGIN * camera.fx * part.diameter_m / centres[:, 2:]
    size = np.array([camera.width, camera.height])
    if len(uv) == 0:
        return 0, 0, camera.width, camera.height
    low = np.clip(np.floor((uv - reach_px).min(axis=0)), 0, size - 1).astype(np.intp).tolist()
    high = np.clip(np.ceil((uv + reach_px).max(axis=0)), np.add(low, 1), size).astype(np.intp).tolist()
    return low[0], low[1], high[0], high[1]


def _cropped(camera: PinholeCamera, window: tuple[int, int, int, int]) -> PinholeCamera:
    left, top, right, bottom = window
    return PinholeCamera(right - left, bottom - top, camera.fx, camera.fy, camera.cx - left, camera.cy - top)


def edges(seen: Rendering) -> BoolArray:
    """Return the pixels (H, W) beside which another part, the void, or a face of another direction shows."""
    lines = np.zeros(seen.instance.shape, dtype=np.bool_)
    normals = np.nan_to_num(seen.normals_scene)
    for along in (0, 1):
        here, there = _neighbours(seen.instance, along)
        cosine = (_neighbours(normals, along)[0] * _neighbours(normals, along)[1]).sum(axis=-1)
        step = (here != there) | ((here >= 0) & (cosine < CREASE_COSINE))
        for side in _neighbours(lines, along):
            side |= step
    return lines & (seen.instance >= 0)


def _neighbours(values: Any, along: int) -> tuple[Any, Any]:
    """Return an array without its last, and without its first row (or column)."""
    return (values[:-1], values[1:]) if along == 0 else (values[:, :-1], values[:, 1:])


def _brightened(image: GrayImage) -> Any:
    """Return the image (H, W, 3) with its brightest parts at full scale: long exposures of dark bins are dim."""
    import cv2

    bright = max(1.0, float(np.percentile(image, BRIGHT_PERCENTILE)))
    grey = np.clip(image * (230.0 / bright), 0, 255).astype(np.uint8)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
