"""The photometric response of a sensor: equations (6), (8) and (9)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sidelong.errors import SettingsError
from sidelong.types import BoolArray, FloatArray

LEVELS = 256


@dataclass(frozen=True, eq=False)
class Response:
    """Response Z = f(X) of an 8-bit sensor through its inverse g(Z) = ln f^-1(Z), equation (8).

    Parameters
    ----------
    log_exposure
        (256,) g(Z) for Z = 0..255, strictly rising. Its scale fixes the unit of radiance.

    Raises
    ------
    SettingsError
        Wrong length, a value that is not finite, or a table that does not rise.
    """

    log_exposure: FloatArray

    def __post_init__(self) -> None:
        if self.log_exposure.shape != (LEVELS,):
            raise SettingsError(f"response: the table has shape {self.log_exposure.shape}, needs ({LEVELS},)")
        if not np.isfinite(self.log_exposure).all():
            raise SettingsError("response: the table has entries that are not finite")
        falling = np.flatnonzero(np.diff(self.log_exposure) <= 0)
        if falling.size:
            raise SettingsError(f"response: the table does not rise at Z = {int(falling[0]) + 1}, it must everywhere")

    @classmethod
    def gamma(cls, gamma: float = 1.0) -> Response:
        """Return f(X) = 255 X^(1/gamma) with saturation at X = 1; linear for gamma 1. Z = 0 stands for half a level."""
        if not (np.isfinite(gamma) and gamma > 0):
            raise SettingsError(f"response: gamma is {gamma}, needs a positive finite number")
        levels = np.arange(LEVELS, dtype=np.float64)
        levels[0] = 0.5
        return cls(gamma * np.log(levels / (LEVELS - 1)))

    @cached_property
    def saturation_exposure(self) -> float:
        """Exposure from which on the sensor clips: exp g(255)."""
        return float(np.exp(self.log_exposure[-1]))

    def intensity(self, radiance: FloatArray, exposure_s: float) -> FloatArray:
        """Return Z = f(E dt), equation (6), 0..255, between levels interpolated in ln X; 0 at no light."""
        exposure = np.asarray(radiance, dtype=np.float64) * exposure_s
        dark = ~(exposure > 0)
        log_exposure = np.log(np.where(dark, 1.0, exposure))
        z = np.interp(log_exposure, self.log_exposure, np.arange(LEVELS, dtype=np.float64))
        return np.where(dark, 0.0, z)

    def saturated(self, radiance: FloatArray, exposure_s: float) -> BoolArray:
        """Say where the sensor clips, decided on the exposure: Z itself never exceeds 255."""
        return np.asarray(radiance * exposure_s >= self.saturation_exposure)

    def radiance(self, intensity: ArrayLike, exposure_s: float) -> FloatArray:
        """Return E = exp(g(Z) - ln dt), equation (9); NaN for Z = 0 and Z = 255, which bound it on one side only."""
        z = np.asarray(intensity, dtype=np.float64)
        log_exposure = np.interp(z, np.arange(LEVELS), self.log_exposure)
        return np.where((z > 0) & (z < LEVELS - 1), np.exp(log_exposure - np.log(exposure_s)), np.nan)
