"""From radiance to an 8-bit image: lens blur, exposure, shot and read noise, a nonlinear response, saturation."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.types import FloatArray, GrayImage


class ExposureSettings(BaseModel):
    """Lens and pixel."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    blur_px: FiniteFloat = Field(default=0.6, ge=0.0, le=5.0, description="standard deviation of the lens blur")
    full_well_e: FiniteFloat = Field(default=9000.0, ge=100.0, le=1e6, description="electrons at saturation")
    read_noise_e: FiniteFloat = Field(default=12.0, ge=0.0, le=1e3, description="read noise in electrons")
    knee: FiniteFloat = Field(default=1.5, ge=0.1, le=1e6, description="response (1 + k) x / (x + k)")


def response(exposure: FloatArray, knee: float) -> FloatArray:
    """Return the grey value 0..255 of an exposure in full wells: rises everywhere up to saturation at 1."""
    clipped = np.clip(exposure, 0.0, 1.0)
    # the clip takes off what rounding adds at x = 1
    return np.minimum(255.0 * (1.0 + knee) * clipped / (clipped + knee), 255.0)


def exposed(radiance: FloatArray, exposure_s: float, settings: ExposureSettings, rng: np.random.Generator) -> GrayImage:
    """Return the image (H, W) of a radiance map (H, W) in full wells per second. Same generator state, same image."""
    import cv2

    exposure = (radiance * exposure_s).astype(np.float32)
    if settings.blur_px > 0:
        exposure = np.asarray(cv2.GaussianBlur(exposure, (0, 0), settings.blur_px))
    # shot noise of many electrons is Gaussian; the sum of both variances in units of the full well
    electrons = exposure * settings.full_well_e
    noise = np.sqrt(electrons + settings.read_noise_e**2) / settings.full_well_e
    noisy = exposure + noise * rng.standard_normal(exposure.shape, dtype=np.float32)
    return np.rint(response(noisy.astype(np.float64), settings.knee)).astype(np.uint8)
