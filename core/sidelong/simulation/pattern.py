"""What the projector shows: pseudo-random dots that a piezo shifts between exposures, as FlexView does."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.geometry.camera_model import LightProjector
from sidelong.geometry.transforms import transform_points
from sidelong.types import FloatArray


class PatternSettings(BaseModel):
    """The slide in the projector."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    columns: int = Field(default=1280, ge=64, le=8192, description="projector pixels over its full width")
    dot_px: FiniteFloat = Field(default=4.5, ge=1.0, le=64.0, description="diameter of a dot in projector pixels")
    fill: FiniteFloat = Field(default=0.5, gt=0.05, lt=0.95, description="share of the slide that is bright")
    dark_level: FiniteFloat = Field(default=0.10, ge=0.0, lt=1.0, description="light that passes the dark of the slide")
    shifts_px: tuple[int, ...] = Field(
        default=(0, 9, 23, 40, 53, 70, 81, 97),
        min_length=1,
        description="shift of each pattern along x",
    )
    seed: int = Field(default=2, ge=0, description="which slide")


@dataclass(frozen=True, eq=False)
class DotPatterns:
    """The patterns of one projector.

    Attributes
    ----------
    settings
        The slide.
    projector
        Where it is shown from.
    """

    settings: PatternSettings
    projector: LightProjector

    @property
    def count(self) -> int:
        """How many patterns there are."""
        return len(self.settings.shifts_px)

    @cached_property
    def slide(self) -> FloatArray:
        """(rows, columns + largest shift) transmission 0..1: blurred noise cut at a level, its edges left soft.

        Soft edges a pixel wide stand for the projector's lens, and let the matcher interpolate between pixels.
        """
        import cv2

        wide = self.settings.columns + max(self.settings.shifts_px)
        noise = np.random.default_rng(self.settings.seed).standard_normal((self._rows, wide)).astype(np.float32)
        grain = np.asarray(cv2.GaussianBlur(noise, (0, 0), self.settings.dot_px / 3.0))
        bright = (grain > np.quantile(grain, 1.0 - self.settings.fill)).astype(np.float32)
        soft = np.asarray(cv2.GaussianBlur(bright, (0, 0), 0.8), dtype=np.float64)
        return self.settings.dark_level + (1.0 - self.settings.dark_level) * soft

    @property
    def mean(self) -> float:
        """Mean transmission of the slide."""
        return self.settings.dark_level + (1.0 - self.settings.dark_level) * self.settings.fill

    def slide_uv(self, points_base: FloatArray, projector_T_base: FloatArray) -> FloatArray:
        """Return slide coordinates (..., 2) of points (..., 3); NaN for those not in front of the projector."""
        points = transform_points(projector_T_base, points_base)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        focal_px = self.settings.columns / 2 / np.tan(self.projector.half_width_rad)
        centre = np.array([self.settings.columns - 1, self._rows - 1]) / 2
        return points[..., :2] / z[..., None] * focal_px + centre

    def sample(self, index: int, uv: FloatArray) -> FloatArray:
        """Return the transmission (H, W) of pattern ``index`` at slide coordinates (H, W, 2); 0 for NaN."""
        import cv2

        at = np.nan_to_num(uv, nan=-1e4).astype(np.float32)
        shifted_x = at[..., 0] + np.float32(self.settings.shifts_px[index])
        return np.asarray(
            cv2.remap(self._slide32, shifted_x, np.ascontiguousarray(at[..., 1]), cv2.INTER_LINEAR), dtype=np.float64
        )

    @cached_property
    def _slide32(self) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return self.slide.astype(np.float32)

    @property
    def _rows(self) -> int:
        ratio = np.tan(self.projector.half_height_rad) / np.tan(self.projector.half_width_rad)
        return round(self.settings.columns * float(ratio))
