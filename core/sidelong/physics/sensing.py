"""The probability of measuring depth at a pixel: equation (7) of the paper, or a curve learned from captures.

Kinds of sensing models stand behind one protocol, :class:`Sensing`. What they are told of a pixel is the exposure that
each camera receives, in units of the exposure at which the sensor clips, and not clipped itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from sidelong.physics.response import Response
from sidelong.types import BoolArray, FloatArray

Probability = Annotated[FiniteFloat, Field(ge=0, le=1)]
MOST_KNOTS = 256
Knots = Field(min_length=2, max_length=MOST_KNOTS, strict=False)


class SensingCurve(BaseModel):
    """P(depth) over ln(exposure / saturation exposure) of one camera: straight between knots, flat beyond the ends."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    log_exposure: Annotated[tuple[FiniteFloat, ...], Knots]
    """Strictly rising; 0 is where the sensor clips. Beyond it depth may still be had: the bright dots clip before the
    gaps between them do."""
    probability: Annotated[tuple[Probability, ...], Knots]
    """P at each knot."""

    @model_validator(mode="after")
    def _a_table(self) -> SensingCurve:
        if len(self.log_exposure) != len(self.probability):
            raise ValueError(
                f"log_exposure has {len(self.log_exposure)} knots, probability {len(self.probability)}: needs as many"
            )
        falling = np.flatnonzero(np.diff(self.log_exposure) <= 0)
        if falling.size:
            k = int(falling[0])
            raise ValueError(
                f"log_exposure does not rise from {self.log_exposure[k]} (knot {k}) to {self.log_exposure[k + 1]}"
            )
        return self

    def at(self, exposure: FloatArray) -> FloatArray:
        """Return P (...) of one camera at an exposure (...) relative to saturation; 0 without light, and for NaN."""
        lit = exposure > 0
        log_exposure = np.log(np.where(lit, exposure, 1.0))
        return np.where(lit, np.interp(log_exposure, self.log_exposure, self.probability), 0.0)


class SensingSettings(BaseModel):
    """The paper's sensing probability, or a learned curve; and whether one or two cameras must see the pattern."""

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
    curve: SensingCurve | None = None
    """Where given it stands in for equation (7): z_min, z_max and sigma are not used."""
    least_share: Probability = 0.6
    """Of the curve's best probability: where the curve gives less, nothing is promised. Of pixels with little light 2
    to 10 % have depth all the same, whether cameras and projector reach them or not, as poses and light are not
    exact. That says nothing for one view against another, blurs the choice, and would keep a scan going for ever. 0
    leaves the curve as it was learned: truer for single pixels, worse at choosing (see ``bench_sensing.py``)."""

    @model_validator(mode="after")
    def _ordered(self) -> SensingSettings:
        if self.z_min > self.z_max:
            raise ValueError(f"z_min is {self.z_min}, must not exceed z_max, which is {self.z_max}")
        return self

    def kind(self, response: Response) -> Sensing:
        """Return the sensing model that these settings name, for a sensor's response."""
        return PaperSensing(self, response) if self.curve is None else CurveSensing(self.curve, self.least_share)


class Sensing(Protocol):
    """From what the cameras receive to the probability of depth."""

    def probability(self, exposure: FloatArray) -> FloatArray:
        """Return P (N,) for exposures (N, C) of C cameras relative to saturation, not clipped, at least 0."""
        ...


@dataclass(frozen=True)
class PaperSensing:
    """Equation (7) on predicted grey levels; the worse camera counts."""

    settings: SensingSettings
    response: Response

    def probability(self, exposure: FloatArray) -> FloatArray:
        """Return P (N,) for exposures (N, C) relative to saturation."""
        radiance = exposure * self.response.saturation_exposure
        clipped = self.response.saturated(radiance, 1.0)
        return all_cameras(sensing_probability(self.response.intensity(radiance, 1.0), clipped, self.settings))


@dataclass(frozen=True)
class CurveSensing:
    """A learned curve, 0 where it is below a share of its best; the worse camera counts."""

    curve: SensingCurve
    least_share: float

    def probability(self, exposure: FloatArray) -> FloatArray:
        """Return P (N,) for exposures (N, C) relative to saturation."""
        p = all_cameras(self.curve.at(exposure))
        return np.where(p >= self.least_share * max(self.curve.probability), p, 0.0)


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


def all_cameras(probability: FloatArray) -> FloatArray:
    """Return min(P_L, P_R) over the last axis: active stereo needs the pattern in both images (text after (7))."""
    return probability.min(axis=-1)
