"""Pixels of a white capture of a matte plane: where they lie on the plane, and what light they send."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.transforms import invert, transform_points
from sidelong.physics.response import LEVELS, Response
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray

ROUNDS = 8
HUBER = 2.5
"""Residuals beyond this many deviations count linearly."""
FEWEST_TILES = 60
ROUNDING = 1e-9
"""Share of a value below which its residual is not called one: exact planes exist in simulations."""


class ProjectorFitSettings(BaseModel):
    """What counts as a matte plane, and which pixels are used."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    largest_plane_residual_m: FiniteFloat = Field(default=2e-3, gt=0, description="robust rms distance to a plane")
    fewest_pixels: int = Field(default=500, ge=50, description="usable pixels each capture needs")
    most_pixels: int = Field(default=4000, ge=50, description="pixels used of each capture")
    saturated_grey: int = Field(default=250, ge=2, le=LEVELS - 1, description="from here on not used")
    dark_grey: int = Field(default=10, ge=1, le=200, description="up to here not used")
    cone_margin: FiniteFloat = Field(default=0.03, ge=0, lt=1, description="share of the lit cone's edge left out")
    tile_px: int = Field(default=32, ge=1, description="most pixels of a square whose errors go together")


@dataclass(frozen=True, eq=False)
class PlaneCapture:
    """A white capture of a matte plane.

    Attributes
    ----------
    name
        For messages.
    left
        (H, W) left image under the white pattern.
    exposure_s
        Of the image.
    depth_m
        (H, W) depth in the left camera, NaN where missing.
    mask
        (H, W) where the plane is; None: wherever there is depth.
    off, off_exposure_s
        The same with the projector off, at any exposure: the room's light, subtracted. None: the room is dark.
    """

    name: str
    left: GrayImage
    exposure_s: float
    depth_m: FloatArray
    mask: BoolArray | None = None
    off: GrayImage | None = None
    off_exposure_s: float | None = None


@dataclass(frozen=True, eq=False)
class PlaneRows:
    """Pixels of one capture: (N,) ln E - ln cos(theta), ln cos(phi), ln d, cos(alpha), tile; pixels (N, 2)."""

    log_level: FloatArray
    log_axial: FloatArray
    log_distance: FloatArray
    cos_alpha: FloatArray
    tile: IntArray
    pixels: IntArray
    plane_rms_m: float
    saturated: int
    dark: int


def plane_rows(capture: PlaneCapture, rig: StereoRig, response: Response, settings: ProjectorFitSettings) -> PlaneRows:
    """Turn a capture into rows of the regression, on the fitted plane rather than the noisy depth."""
    points, known, plane_rms_m, normal = _on_plane(capture, rig, settings)
    in_projector = transform_points(invert(rig.projector.left_T_projector), points)
    inner = in_projector / np.array([1.0 - settings.cone_margin, 1.0 - settings.cone_margin, 1.0])
    offset = rig.projector.left_T_projector[:3, 3] - points
    distance = np.linalg.norm(offset, axis=-1)
    to_light = offset / distance[..., None]
    to_camera = -points / np.linalg.norm(points, axis=-1, keepdims=True)
    cos_light, cos_camera = to_light @ normal, to_camera @ normal
    lit = known & rig.projector.lights(inner) & (cos_light > 0.1) & (cos_camera > 0.1)
    grey = capture.left
    saturated, dark = lit & (grey >= settings.saturated_grey), lit & (grey <= settings.dark_grey)
    radiance = response.radiance(grey, capture.exposure_s)
    if capture.off is not None and capture.off_exposure_s is not None:
        radiance = radiance - np.nan_to_num(response.radiance(capture.off, capture.off_exposure_s))
    usable = lit & ~saturated & ~dark & (np.nan_to_num(radiance) > 0)
    if usable.sum() < settings.fewest_pixels:
        raise CalibrationError(
            f"{capture.name}: {int(usable.sum())} pixels of the plane are usable, needs {settings.fewest_pixels}: of "
            f"{int(lit.sum())} lit ones {int(saturated.sum())} are at grey level {settings.saturated_grey} or above, "
            f"{int(dark.sum())} at {settings.dark_grey} or below: change the exposure, or fill more of the image"
        )
    # few tiles would tell nothing of their scatter
    tile_px = max(1, min(settings.tile_px, int(np.sqrt(usable.sum() / FEWEST_TILES))))
    pixels = np.argwhere(usable)
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(len(pixels), settings.most_pixels)).astype(np.intp)]
    v, u = pixels.T
    return PlaneRows(
        log_level=np.log(radiance[v, u] / cos_light[v, u]),
        log_axial=np.log(in_projector[v, u, 2] / distance[v, u]),
        log_distance=np.log(distance[v, u]),
        cos_alpha=2.0 * cos_light[v, u] * cos_camera[v, u] - np.einsum("ij,ij->i", to_light[v, u], to_camera[v, u]),
        tile=(v // tile_px) * 10_000 + u // tile_px,
        pixels=pixels,
        plane_rms_m=plane_rms_m,
        saturated=int(saturated.sum()),
        dark=int(dark.sum()),
    )


def _on_plane(
    capture: PlaneCapture, rig: StereoRig, settings: ProjectorFitSettings
) -> tuple[FloatArray, BoolArray, float, FloatArray]:
    """Return points (H, W, 3) on the plane, where there is depth of it, the rms distance, and the normal (3,)."""
    wanted = (rig.left.height, rig.left.width)
    for name, image in (
        ("image", capture.left),
        ("depth", capture.depth_m),
        ("mask", capture.mask),
        ("off image", capture.off),
    ):
        if image is not None and image.shape != wanted:
            raise CalibrationError(
                f"{capture.name}: the {name} has shape {image.shape}, the camera has {wanted} (rows, columns)"
            )
    if not 0 < capture.exposure_s < np.inf:
        raise CalibrationError(f"{capture.name}: its exposure is {capture.exposure_s} s, needs a positive number")
    if capture.off is not None and not 0 < (capture.off_exposure_s or 0.0) < np.inf:
        raise CalibrationError(
            f"{capture.name}: the exposure of its off image is {capture.off_exposure_s} s, needs a positive number"
        )
    rays = rig.left.pixel_rays()
    known = np.isfinite(capture.depth_m) & (np.nan_to_num(capture.depth_m) > 0)
    known &= True if capture.mask is None else capture.mask
    if known.sum() < settings.fewest_pixels:
        raise CalibrationError(
            f"{capture.name}: {int(known.sum())} pixels of the plane have depth, needs {settings.fewest_pixels}"
        )
    inverse, chosen = 1.0 / capture.depth_m[known], rays[known]
    weight = np.ones(len(inverse))
    plane = np.zeros(3)
    for _ in range(ROUNDS):
        # 1/z = plane . ray: linear, and the noise of a stereo pair is even in 1/z
        plane = np.linalg.lstsq(chosen * weight[:, None], inverse * weight, rcond=None)[0]
        error = np.abs(chosen @ plane - inverse)
        limit = max(HUBER * 1.4826 * float(np.median(error)), ROUNDING * float(inverse.max()))
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(error, limit)))
    distance = np.abs(1.0 - capture.depth_m[known] * (chosen @ plane)) / np.linalg.norm(plane)
    # the mean of the inner 95 %: a median would not see a second surface
    rms_m = float(np.sqrt(np.mean(np.sort(np.square(distance))[: int(0.95 * len(distance))])))
    if rms_m > settings.largest_plane_residual_m:
        raise CalibrationError(
            f"{capture.name}: its depth deviates from a plane by {rms_m * 1e3:.2f} mm rms, limit "
            f"{settings.largest_plane_residual_m * 1e3:.2f} mm: show a flat surface, or mask it"
        )
    facing = rays @ plane
    known &= facing > 0
    return rays / np.maximum(facing, 1e-9)[..., None], known, rms_m, -plane / np.linalg.norm(plane)
