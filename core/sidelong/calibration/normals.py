"""Normals of a depth map: by a plane in inverse depth, and by principal components as in the paper.

On a plane 1/z is affine in the image, and the depth noise of a stereo pair, which grows as z^2, is the same everywhere
in 1/z. So the plain least-squares plane of 1/z is the best for such noise, and it takes ten small filters of the image
instead of a search for neighbours and an eigenproblem per pixel.

A window across a depth edge gives a normal of neither side. Edges are taken out before any fit
(:mod:`sidelong.geometry.depth_edges`). What this misses, creases and jumps across holes, leaves a large residual and is
dropped after the fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from sidelong.calibration.depth_noise.blur import noise_blur_px
from sidelong.calibration.window_planes import PLANE_PARAMETERS, Method, Planes, fit_planes
from sidelong.errors import DepthError, ImageError, SettingsError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.depth_edges import depth_jumps, neighbours, typical
from sidelong.types import BoolArray, FloatArray, IntArray

RESIDUAL_NOISE = 2.0
"""As :data:`~sidelong.geometry.depth_edges.EDGE_NOISE` for residuals; with 5x5 points noise scatters them by 15 %."""
SMOOTHED_SIGMA = 3.0
"""Error over sigma per pixel of smoothing, where noise is taken as independent: 2.9 to 3.3 times the blur, measured for
blurs of 0.7 to 2 px and windows of 3 to 9 px."""


WINDOWS_PX = (5, 9, 15)
LEAST_SIGMA_RAD = 2e-3
"""No normal counts for more than one of a tenth of a degree: a flat patch of a quantised map may state 0."""


class NormalSettings(BaseModel):
    """How normals are found. Method and window won on error against run time (``tests/benchmarks/bench_normals.py``).

    Both limits give way where the noise of the map itself is larger than they are. ``max_residual`` weighs how many
    normals there are against how good they are: on noiseless depth of small fittings 0.05, 0.1 and 0.2 keep 33, 47 and
    61 % of the pixels, with 95 % of the errors below 1.5, 6.8 and 11 degrees. A fold of 28 degrees in the middle of a
    window has a residual of 0.1.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    method: Method = Field(default="inverse_depth", description="what is fitted to a window")
    window_px: int = Field(default=5, ge=3, le=15, description="side of the window, odd")
    min_share: FiniteFloat = Field(default=0.5, gt=0.0, le=1.0, description="least share of the window with depth")
    edge_step: FiniteFloat = Field(
        default=1.0, gt=0.0, le=1e3, description="odd step of depth that is an edge, over what a pixel spans (z/f)"
    )
    max_residual: FiniteFloat = Field(
        default=0.1, gt=0.0, le=1e3, description="largest rms deviation of depth from a plane, over half the window"
    )
    smoothing_px: FiniteFloat = Field(
        default=0.0,
        ge=0.0,
        le=8.0,
        description="standard deviation of the blur the matcher laid over depth: noise it hides adds to sigma_rad",
    )

    @model_validator(mode="after")
    def _odd(self) -> Self:
        if self.window_px % 2 == 0:
            raise ValueError(f"window_px is {self.window_px} px, must be odd")
        return self

    @property
    def radius_px(self) -> int:
        """Pixels on either side of the centre."""
        return self.window_px // 2

    @property
    def fewest_points(self) -> int:
        """Points a window must hold, at least one more than a plane has parameters: else no residual."""
        return max(int(np.ceil(self.min_share * self.window_px**2)), PLANE_PARAMETERS + 1)


@dataclass(frozen=True, eq=False)
class NormalMap:
    """Normals of the pixels of a depth map; NaN where there is none.

    Attributes
    ----------
    normals_camera
        (H, W, 3) unit normals in the camera frame, turned to the camera.
    residual_m
        (H, W) rms distance of the window's points from the plane, per degree of freedom.
    sigma_rad
        (H, W) expected rms angle to the true normal, from where the points lie and their residual, or that of the
        median window where it is larger. Of curvature and creases it knows what shows in the residual.
    points
        (H, W) how many points the window holds, edges taken out; also where there is no normal.
    """

    normals_camera: FloatArray
    residual_m: FloatArray
    sigma_rad: FloatArray
    points: IntArray


def estimate_normals(depth_m: FloatArray, camera: PinholeCamera, settings: NormalSettings | None = None) -> NormalMap:
    """Estimate the normal at each pixel of a depth map from the window around it.

    A pixel has a normal if it has depth, is not at an edge, and its window holds enough points that lie on a plane.

    Parameters
    ----------
    depth_m
        (H, W) depth along the optical axis, NaN where missing.
    camera
        Its intrinsics.
    settings
        Method, window and limits.

    Raises
    ------
    ImageError
        The map does not have the camera's size.
    DepthError
        No pixel has depth, or a depth is zero, negative or infinite.
    SettingsError
        The window is larger than the image.
    """
    settings = settings or NormalSettings()
    _check(depth_m, camera, settings)
    inverse = 1.0 / depth_m.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        usable = np.isfinite(inverse) & ~_near_edges(inverse, camera, settings)
        planes = fit_planes(inverse, usable, camera, settings.method, settings.radius_px, settings.fewest_points)
        return _judged(planes, inverse, camera, settings)


def informative_normals(
    depth_m: FloatArray, camera: PinholeCamera, where: BoolArray, windows_px: tuple[int, ...] = WINDOWS_PX
) -> tuple[NormalMap, NormalSettings]:
    """Estimate normals with the window that suits the noise of the depth map, and return them with its settings.

    A small window keeps more pixels of small parts, a large one averages more noise: the window is taken whose normals
    carry most information on the pixels of interest, the sum of 1 / sigma^2. How far the noise reaches from pixel to
    pixel is estimated from the map itself.

    Parameters
    ----------
    depth_m, camera
        As in :func:`estimate_normals`.
    where
        (H, W) pixels of interest.
    windows_px
        Windows to try; those that do not fit into the image are passed over.

    Raises
    ------
    DepthError, SettingsError
        As :func:`estimate_normals`.
    """
    blur_px = noise_blur_px(depth_m)
    best: tuple[float, NormalMap, NormalSettings] | None = None
    for window_px in windows_px:
        if best is not None and window_px > min(depth_m.shape):
            continue
        settings = NormalSettings(window_px=window_px, smoothing_px=blur_px)
        found = estimate_normals(depth_m, camera, settings)
        sigma_rad = np.maximum(found.sigma_rad[where], LEAST_SIGMA_RAD)
        information = float(np.nansum(sigma_rad**-2.0))
        if best is None or information > best[0]:
            best = information, found, settings
    if best is None:
        raise SettingsError("normals: windows_px names no window, needs at least one")
    return best[1], best[2]


def _check(depth_m: FloatArray, camera: PinholeCamera, settings: NormalSettings) -> None:
    size = (camera.height, camera.width)
    if depth_m.shape != size:
        raise ImageError(f"depth: the map is {depth_m.shape}, the camera has {size} rows and columns")
    if settings.window_px > min(size):
        raise SettingsError(f"window_px is {settings.window_px} px, limit {min(size)} px: the image's shorter side")
    wrong = (depth_m <= 0) | np.isinf(depth_m)
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise DepthError(
            f"depth: {int(wrong.sum())} px are not finite and above the limit of 0 m (missing is NaN), the first "
            f"is {depth_m[row, column]} m at row {row}, column {column}"
        )
    if np.isnan(depth_m).all():
        raise DepthError(f"depth: 0 of {depth_m.size} px are measured, a window needs {settings.fewest_points}")


def _near_edges(inverse: FloatArray, camera: PinholeCamera, settings: NormalSettings) -> BoolArray:
    """Say which pixels (H, W) are at a jump of depth or next to it."""
    import cv2

    edges = np.zeros(inverse.shape, dtype=np.bool_)
    inverse32 = inverse.astype(np.float32)  # its digits are 1e-4 of the smallest step that matters
    for axis, focal_px in ((1, camera.fx), (0, camera.fy)):
        jumps = depth_jumps(inverse32, axis, settings.edge_step / focal_px)
        for side in neighbours(edges, axis):
            side |= jumps
    # both pixels of a jump are marked. With radius r, a margin of (r - 1) // 2 keeps centres so far from a straight
    # jump along rows or columns that what their windows hold beyond it is marked, too. Corners beyond an oblique one
    # are left to the residual: a wider margin lost more normals than it mended
    margin_px = (settings.radius_px - 1) // 2
    square = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(edges.view(np.uint8), square)).astype(np.bool_)


def _judged(planes: Planes, inverse: FloatArray, camera: PinholeCamera, settings: NormalSettings) -> NormalMap:
    """Drop the windows that do not lie on a plane."""
    noise = typical(planes.rms)
    largest = settings.max_residual * settings.radius_px / camera.fx * inverse
    keep = np.where(planes.rms <= np.maximum(largest, RESIDUAL_NOISE * noise), 1.0, np.nan)
    # into the same arrays: fresh ones of this size cost as much time as arithmetic on them
    normals = np.multiply(planes.normals, keep[..., None], out=planes.normals)
    residual = np.multiply(planes.distance, planes.rms * keep, out=planes.distance)
    hidden = max(1.0, SMOOTHED_SIGMA * settings.smoothing_px)
    sigma = np.multiply(planes.turn, hidden * np.maximum(planes.rms, noise) * keep, out=planes.turn)
    return NormalMap(normals, residual, sigma, planes.count.astype(np.intp))
