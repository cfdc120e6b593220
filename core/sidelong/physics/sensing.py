"""The probability of measuring depth at a pixel: equation (7)."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from sidelong.types import BoolArray, FloatArray


class SensingSettings(BaseModel):
    """The paper's sensing probability, and whether one or two cameras must see the pattern."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    z_min: Annotated[FiniteFloat, Field(ge=0, le=255)] = 60.0
    """Grey level below which no depth is measured. The paper gives none. A temporal matcher measures next to nothing
    below 16 and most pixels above 40, but predicted grey levels are not exact: of 20, 30, 45, 60 and 80, 60 chose the
    views that complete most on five scenes with the true poses (recorded tube fittings 48.5, 49.1, 50.4, 52.5, 52.4 %
    after three views; simulated gears, eye bolts, screws and fittings alike). See ``sidelong compare --true-poses``."""
    z_max: Annotated[FiniteFloat, Field(ge=0, le=255)] = 255.0
    """Grey level above which no depth is measured."""
    sigma: Annotated[FiniteFloat, Field(gt=0)] = 100.0
    """Decay of the probability below z_max, in grey levels."""
    stereo: bool = True
    """True: both cameras must see the dots (active stereo). False: the left camera alone (structured light)."""

    @model_validator(mode="after")
    def _ordered(self) -> SensingSettings:
        if self.z_min > self.z_max:
            raise ValueError(f"z_min is {self.z_min}, must not exceed z_max, which is {self.z_max}")
        return self


def sensing_probability(intensity: FloatArray, saturated: BoolArray, settings: SensingSettings) -> FloatArray:
    """Return P = exp((Z - z_max) / sigma) for z_min <= Z <= z_max and 0 elsewhere, equation (7).

    Parameters
    ----------
    intensity
        (...) predicted grey level Z.
    saturated
        (...) where the unclipped exposure exceeds the sensor's range: P is 0 there, although Z reads 255.
    settings
        Limits and decay.
    """
    usable = (intensity >= settings.z_min) & (intensity <= settings.z_max) & ~saturated
    return np.where(usable, np.exp(np.minimum((intensity - settings.z_max) / settings.sigma, 0.0)), 0.0)


def both_cameras(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return min(P_L, P_R): active stereo needs the pattern in both images (text after equation (7))."""
    return np.minimum(left, right)
