"""Settings of the detection of parts in one grey image."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator


class DetectionSettings(BaseModel):
    """Which templates are made of a part, how they are matched, and what becomes of the matches."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    view_step_deg: Annotated[FiniteFloat, Field(ge=5, le=60)] = 15.0
    """Angle between neighbouring views of the viewsphere, in elevation and (on the circle) in azimuth."""
    roll_step_deg: Annotated[FiniteFloat, Field(ge=2, le=60)] = 10.0
    """Angle between neighbouring turns in the image plane."""
    distance_m: tuple[Annotated[FiniteFloat, Field(gt=0)], Annotated[FiniteFloat, Field(gt=0)]] = (0.55, 0.95)
    """Least and largest distance of a part from the camera."""
    distance_ratio: Annotated[FiniteFloat, Field(ge=1.02, le=2)] = 1.12
    """Largest ratio of neighbouring distances: what an image shows changes with the ratio, not the difference."""
    span_px: Annotated[FiniteFloat, Field(ge=24, le=400)] = 80.0
    """Size the part's diameter has in the matched image at the middle distance; images are resized to reach it."""
    num_features: Annotated[int, Field(ge=16, le=63)] = 63
    """Features of a template; fewer are used where the part does not offer as many. OpenCV raises above 63."""
    weak_threshold: Annotated[FiniteFloat, Field(gt=0)] = 10.0
    """Gradient magnitude below which a pixel of the image has no direction (grey levels, Sobel of the blurred image)."""
    strong_threshold: Annotated[FiniteFloat, Field(gt=0)] = 55.0
    """Gradient magnitude a feature of a template needs."""
    match_threshold: Annotated[FiniteFloat, Field(ge=50, le=99)] = 80.0
    """Least similarity of a match, 0..100. Chance alone reaches 84 on noise, and 100 finds nothing at all."""
