"""Pinhole cameras, the stereo pair they form, and its projector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.errors import SettingsError
from sidelong.geometry.transforms import transform
from sidelong.types import BoolArray, FloatArray


@dataclass(frozen=True)
class PinholeCamera:
    """A rectified camera. Pixel centres lie at integer coordinates (OpenCV); all intrinsics in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise SettingsError(f"camera: size is {self.width}x{self.height} px, needs at least 1x1")
        if not (0 < self.fx < np.inf and 0 < self.fy < np.inf):
            raise SettingsError(f"camera: focal lengths are {self.fx}, {self.fy} px, need positive finite numbers")
        if not np.isfinite([self.cx, self.cy]).all():
            raise SettingsError(f"camera: principal point is {self.cx}, {self.cy} px, needs finite numbers")

    def scaled(self, factor: float) -> PinholeCamera:
        """Return the camera of the image resized by ``factor`` (area resampling: pixel areas, not centres, scale)."""
        return PinholeCamera(
            width=round(self.width * factor),
            height=round(self.height * factor),
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
        )

    def project(self, points_camera: FloatArray) -> FloatArray:
        """Project points (..., 3) to pixel coordinates (..., 2) as (u, v); NaN for points not in front (z <= 0)."""
        z = np.where(points_camera[..., 2] > 0, points_camera[..., 2], np.nan)
        return np.stack(
            [self.fx * points_camera[..., 0] / z + self.cx, self.fy * points_camera[..., 1] / z + self.cy],
            axis=-1,
        )

    def contains(self, uv: FloatArray) -> BoolArray:
        """Say which pixel coordinates (..., 2) fall on a pixel of the image; False for NaN."""
        return (
            (uv[..., 0] >= -0.5) & (uv[..., 0] < self.width - 0.5) & (uv[..., 1] >= -0.5)
            & (uv[..., 1] < self.height - 0.5)
        )  # fmt: skip

    def rays(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Return directions (..., 3) through pixel coordinates, scaled to z = 1."""
        u, v = np.broadcast_arrays(u, v)
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)

    def pixel_rays(self) -> FloatArray:
        """Return directions (H, W, 3) through all pixel centres, scaled to z = 1."""
        return self.rays(
            np.arange(self.width, dtype=np.float64)[None, :],
            np.arange(self.height, dtype=np.float64)[:, None],
        )


@dataclass(frozen=True, eq=False)
class LightProjector:
    """The projector as an inverse camera: its pose in the left camera (4, 4) and the half-angles it lights, radians."""

    left_T_projector: FloatArray
    half_width_rad: float
    half_height_rad: float

    def __post_init__(self) -> None:
        for name, angle in (("half_width_rad", self.half_width_rad), ("half_height_rad", self.half_height_rad)):
            if not 0 < angle < np.pi / 2:
                raise SettingsError(f"projector: {name} is {angle} rad, limits 0 to pi/2")

    def lights(self, points_projector: FloatArray) -> BoolArray:
        """Say which points (..., 3) in the projector's frame lie in its cone."""
        x, y, z = points_projector[..., 0], points_projector[..., 1], points_projector[..., 2]
        return (
            (z > 0) & (np.abs(x) <= z * np.tan(self.half_width_rad)) & (np.abs(y) <= z * np.tan(self.half_height_rad))
        )


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Left and right rectified cameras and the projector. The right camera sits at x = +baseline_m in the left."""

    left: PinholeCamera
    right: PinholeCamera
    baseline_m: float
    projector: LightProjector

    def __post_init__(self) -> None:
        if not (np.isfinite(self.baseline_m) and self.baseline_m > 0):
            raise SettingsError(f"rig: baseline is {self.baseline_m} m, needs a positive number")
        if (self.left.width, self.left.height) != (self.right.width, self.right.height):
            raise SettingsError("rig: left and right images differ in size")

    @property
    def left_T_right(self) -> FloatArray:
        """Pose of the right camera in the left (4, 4)."""
        return transform(np.eye(3), (self.baseline_m, 0.0, 0.0))

    def scaled(self, factor: float) -> StereoRig:
        """Return the rig of images resized by ``factor``."""
        return StereoRig(self.left.scaled(factor), self.right.scaled(factor), self.baseline_m, self.projector)

    def disparity_px(self, depth_m: FloatArray) -> FloatArray:
        """Return u_left - u_right of points at this depth: f b / Z - (cx_right - cx_left)."""
        return self.left.fx * self.baseline_m / depth_m - (self.right.cx - self.left.cx)

    def depth_m(self, disparity_px: FloatArray) -> FloatArray:
        """Return depth from u_left - u_right; NaN where the rays do not meet in front of the camera."""
        shifted = np.asarray(disparity_px + (self.right.cx - self.left.cx), dtype=np.float64)
        return self.left.fx * self.baseline_m / np.where(shifted > 0, shifted, np.nan)
