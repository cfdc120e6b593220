"""Templates of a part: views of the viewsphere x turns in the image plane x distances.

A template shows the part on the optical axis of a camera with square pixels and focal length ``focal_px``. Each
(view, distance) is rendered once; turns in the plane rotate that picture, which is exact on the axis.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from sidelong.detection.gradient_cells import DIRECTIONS, Float32Array, gradient_cells
from sidelong.detection.matched_filter import TemplateBank
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.shading import brightness
from sidelong.detection.viewsphere import Ranges, views
from sidelong.errors import DetectionError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import look_at, rotate, rotation_about
from sidelong.types import BoolArray, FloatArray, GrayImage

Progress: TypeAlias = Callable[[int, int], None]

FILE = "templates.npz"
LARGEST_UPSCALING = 2.0
LEAST_CELLS = 4
"""Cells across a part that still tell its poses apart."""
BASIS_SIZE = 192
"""Pictures that templates are combined of."""


@dataclass(frozen=True, eq=False)
class TemplateSet:
    """Trained templates and their poses.

    Attributes
    ----------
    folder
        Holds ``FILE``: the templates themselves, for :func:`read_bank`.
    focal_px
        Focal length of the matched image.
    axis_R_object
        (N, 3, 3) rotation from the object to a camera that looks straight at the part's centre.
    distance_m
        (N,) of the part's centre.
    """

    folder: Path
    focal_px: float
    axis_R_object: FloatArray
    distance_m: FloatArray


def distances(settings: DetectionSettings) -> FloatArray:
    """Return the distances (D,) in metres: the middles of equal ratios that cover the range."""
    near, far = settings.reach_m
    count = max(1, int(np.ceil(np.log(far / near) / np.log(settings.distance_ratio) - 1e-9)))
    return near * (far / near) ** ((np.arange(count) + 0.5) / count)


def matched_focal_px(part: Part, camera: PinholeCamera, settings: DetectionSettings) -> float:
    """Return the focal length at which the part spans ``span_px`` at the middle (geometric mean) distance."""
    middle_m = float(np.sqrt(settings.reach_m[0] * settings.reach_m[1]))
    return min(settings.span_px * middle_m / part.diameter_m, LARGEST_UPSCALING * camera.fx)


def train(
    part: Part, camera: PinholeCamera, settings: DetectionSettings, folder: Path, progress: Progress | None = None
) -> TemplateSet:
    """Render the templates of ``part`` and write them to ``folder``, which must exist.

    Parameters
    ----------
    part
        The CAD model.
    camera
        Of the images that will be searched.
    settings
        Grid of views, turns and distances.
    folder
        Receives the file.
    progress
        Called with (pictures done, pictures in all), a picture for each view and distance. What it raises ends the
        training within a few pictures.

    Raises
    ------
    DetectionError
        The part is too small in the image for templates, or larger than the image; or no view lies in the ranges of
        elevation, azimuth and roll.
    """
    _check_size(part, camera, settings)
    studio = _Studio(part, matched_focal_px(part, camera, settings), settings)
    directions = _declared(part, settings)
    jobs = [(direction, rolls, float(d)) for d in distances(settings) for direction, rolls in directions]
    taken: list[tuple[Float32Array, FloatArray]] = [studio.turned(*jobs[0])]
    pool = ThreadPoolExecutor(max_workers=os.cpu_count() or 1)
    try:
        waiting = [pool.submit(studio.turned, *job) for job in jobs[1:]]
        for done, _ in enumerate(as_completed(waiting), start=2):
            if progress is not None:
                progress(done, len(jobs))
        taken += [each.result() for each in waiting]
    finally:
        pool.shutdown(cancel_futures=True)
    pictures = np.concatenate([cells for cells, _ in taken])
    basis = _basis(pictures, BASIS_SIZE)
    templates = TemplateSet(
        folder=folder,
        focal_px=studio.focal_px,
        axis_R_object=np.concatenate([rotations for _, rotations in taken]),
        distance_m=np.concatenate([np.full(len(cells), job[2]) for job, (cells, _) in zip(jobs, taken, strict=True)]),
    )
    np.savez(
        folder / FILE, window=studio.window, basis=basis, weights=pictures @ basis.T,
        axis_R_object=templates.axis_R_object, distance_m=templates.distance_m,
    )  # fmt: skip
    return templates


def read_bank(folder: Path) -> TemplateBank:
    """Return what ``train`` wrote."""
    with np.load(folder / FILE) as arrays:
        return TemplateBank(arrays["window"], arrays["basis"], arrays["weights"])


class _Studio:
    """Takes the pictures of one part; rays are moved into the object frame, so that one scene serves all views."""

    def __init__(self, part: Part, focal_px: float, settings: DetectionSettings) -> None:
        self.focal_px = focal_px
        self.window = _window(part, focal_px, settings)
        self._part = part
        self._settings = settings
        self._scene = RayScene([(part, np.eye(4))])

    def turned(
        self, direction: FloatArray, rolls_rad: FloatArray, distance_m: float
    ) -> tuple[Float32Array, FloatArray]:
        """Return what this view shows at each turn, (R, C * DIRECTIONS), with ``axis_R_object`` (R, 3, 3)."""
        import cv2

        picture, camera_R_object = self._picture(direction, distance_m)
        half, cell, level = picture.shape[0] // 2, self._settings.cell_px, self._settings.strong_gradient
        grid = half + cell * (np.arange(len(self.window)) - len(self.window) // 2).astype(np.float64)
        ground = round(255 * self._settings.ground_level)
        turns = [rotation_about((0, 0, 1), float(roll)) for roll in rolls_rad]
        shown = np.empty((len(turns), int(self.window.sum()) * DIRECTIONS), np.float32)
        for row, turn in enumerate(turns):
            about_centre = np.hstack([turn[:2, :2], (half - turn[:2, :2] @ (half, half))[:, None]])
            turned = cv2.warpAffine(picture, about_centre, picture.shape[::-1], borderValue=ground)
            cells = gradient_cells(turned.astype(np.uint8, copy=False), grid, grid, cell, level)
            shown[row] = cells[self.window].ravel()
        return shown, np.array(turns) @ camera_R_object

    def _picture(self, direction: FloatArray, distance_m: float) -> tuple[GrayImage, FloatArray]:
        """Return the shaded picture (2 H, 2 H), the part's centre at pixel H, and ``camera_R_object`` (3, 3)."""
        half = (len(self.window) // 2 + 2) * self._settings.cell_px
        camera = PinholeCamera(2 * half, 2 * half, self.focal_px, self.focal_px, half, half)
        centre_m = self._part.centre_m
        object_T_camera = look_at(centre_m + distance_m * direction, centre_m)
        rays = rotate(object_T_camera, camera.pixel_rays())
        hits = self._scene.cast(object_T_camera[:3, 3], rays)
        cosine = -(hits.normals * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
        level = brightness(np.where(hits.instance >= 0, cosine, -1.0), self._settings)
        return (255 * level).astype(np.uint8), object_T_camera[:3, :3].T


def _declared(part: Part, settings: DetectionSettings) -> list[tuple[FloatArray, FloatArray]]:
    """Return the views and turns of the viewsphere that the settings' ranges allow."""
    ranges = Ranges(settings.elevation_deg, settings.azimuth_deg, settings.roll_deg)
    step_deg = max(settings.view_step_deg, settings.roll_step_deg)
    allowed: list[tuple[FloatArray, FloatArray]] = []
    for direction, rolls in views(settings.view_step_deg, settings.roll_step_deg, part.symmetry):
        camera_R_object = look_at(direction, np.zeros(3))[:3, :3].T
        turned = np.array([rotation_about((0, 0, 1), float(roll)) @ camera_R_object for roll in rolls])
        kept = rolls[ranges.allow(turned, part.symmetry, step_deg)]
        if len(kept):
            allowed.append((direction, kept))
    if not allowed:
        raise DetectionError(
            f"{part.name}: no view lies in elevation_deg {settings.elevation_deg}, azimuth_deg {settings.azimuth_deg} "
            f"and roll_deg {settings.roll_deg}"
        )
    return allowed


def _window(part: Part, focal_px: float, settings: DetectionSettings) -> BoolArray:
    """Return the disc of cells (n, n) that holds the part at its nearest, however turned, and a cell around it."""
    radius_m = part.diameter_m / 2
    nearest_m = max(float(distances(settings)[0]) - radius_m, radius_m)
    radius = focal_px * radius_m / nearest_m / settings.cell_px
    half = int(np.ceil(radius)) + 1
    across = np.arange(-half, half + 1)
    return across[:, None] ** 2 + across**2 <= (radius + 1) ** 2


def _check_size(part: Part, camera: PinholeCamera, settings: DetectionSettings) -> None:
    far_m = float(distances(settings)[-1])
    span_px = matched_focal_px(part, camera, settings) * part.diameter_m / far_m
    if span_px < LEAST_CELLS * settings.cell_px:
        raise DetectionError(
            f"{part.name}: spans {span_px:.3g} px at {far_m:.3g} m in the searched image, templates need "
            f"{LEAST_CELLS * settings.cell_px} px; raise span_px ({settings.span_px:g}) or come nearer"
        )
    seen_px = camera.fx * part.diameter_m / far_m
    if seen_px > max(camera.width, camera.height):
        raise DetectionError(
            f"{part.name}: spans {seen_px:.4g} px at {far_m:.3g} m, the image has {camera.width}x{camera.height} px"
        )


def _basis(pictures: Float32Array, size: int) -> Float32Array:
    """Return an orthonormal basis (B, D) of the most of pictures (N, D): subspace iteration from some of them."""
    chosen = np.random.default_rng(0).permutation(len(pictures))[: min(size + size // 4, pictures.shape[1])]
    span = np.linalg.qr(pictures[chosen].T)[0]
    for _ in range(2):
        span = np.linalg.qr(pictures.T @ (pictures @ span))[0]
    inside = pictures @ span
    vectors = np.linalg.eigh(inside.T @ inside)[1][:, ::-1]
    return np.ascontiguousarray((span @ vectors[:, :size]).T.astype(np.float32))
