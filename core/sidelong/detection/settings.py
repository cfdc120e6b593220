"""Settings of the detection of parts in one grey image."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

DistanceM = Annotated[FiniteFloat, Field(ge=0.01, le=20)]
USUAL_DISTANCE_M = (0.55, 0.95)
"""Of a camera over a bin, where nothing tells."""


class DetectionSettings(BaseModel):
    """Which templates are made of a part, how they are matched, and what becomes of the matches.

    The defaults won error against run time on a bin of hexagonal steel fittings, 84 px long at 1280x1024: 12,720
    templates (view 20, turn 15 degrees, span 60 px) train in 8-11 s, match in 0.2-0.3 s, and propose a pose within 15
    degrees of 98-100 % of the parts; 33,120 (15, 10, span 80) take 43 s and 0.5-0.9 s for the same share.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    view_step_deg: Annotated[FiniteFloat, Field(ge=5, le=60)] = 20.0
    """Angle between neighbouring views of the viewsphere, in elevation and (on the circle) in azimuth."""
    roll_step_deg: Annotated[FiniteFloat, Field(ge=2, le=60)] = 15.0
    """Angle between neighbouring turns in the image plane."""
    distance_m: tuple[DistanceM, DistanceM] | None = None
    """Least and largest distance of a part from the camera in the reference view; none: where the cell or the recorded
    depth says, else ``USUAL_DISTANCE_M``."""
    distance_ratio: Annotated[FiniteFloat, Field(ge=1.02, le=2)] = 1.12
    """Largest ratio of neighbouring distances: what an image shows changes with the ratio, not the difference."""
    span_px: Annotated[FiniteFloat, Field(ge=24, le=400)] = 60.0
    """What the part's diameter spans in the matched image at the middle distance; images are resized to reach it."""
    num_features: Annotated[int, Field(ge=16, le=63)] = 63
    """Features of a template; fewer are used where the part does not offer as many. OpenCV raises above 63."""
    weak_threshold: Annotated[FiniteFloat, Field(gt=0)] = 10.0
    """Gradient below which a pixel of the image has no direction (Sobel of the blurred 8-bit image)."""
    strong_threshold: Annotated[FiniteFloat, Field(gt=0)] = 150.0
    """Gradient a feature of a template needs, same unit; templates use the full range 0..255."""
    dark_cosine: Annotated[FiniteFloat, Field(ge=0, le=1)] = 0.3
    """Facets tilted further from the viewer than this cosine mirror the dark bin instead of the lights above."""
    bright_cosine: Annotated[FiniteFloat, Field(ge=0, le=1)] = 0.9
    """Facets that face the viewer more than this cosine are as bright as any."""
    dark_level: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.1
    """Brightness of the dark facets relative to the bright ones."""
    ground_level: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.2
    """Brightness of what parts lie on, relative to the bright facets. With 0, 0.2 and 0.35 the best hypothesis lay
    within 10 % of the diameter for 163, 171 and 84 of 200 recorded fittings, 91, 103 and 56 of 128 simulated eye bolts
    (min_score 40)."""
    match_threshold: Annotated[FiniteFloat, Field(ge=50, le=99)] = 72.0
    """Least similarity of a match, 0..100. Chance alone reaches 84 on noise, and 100 finds nothing at all."""
    max_matches: Annotated[int, Field(ge=1)] = 100_000
    """Matches kept, best first; textured images have millions."""
    deadline_s: Annotated[FiniteFloat, Field(gt=0)] = 60.0
    """Time the matcher's process has to load the templates or to answer before it is ended."""
    cluster_radius: Annotated[FiniteFloat, Field(gt=0, le=1)] = 0.2
    """Matches whose centres lie within this share of the part's diameter may be one object."""
    pose_step_deg: Annotated[FiniteFloat, Field(gt=0, le=90)] = 12.0
    """Hypotheses of one object that differ by less before alignment count as one; a third of it after."""
    hypotheses_per_object: Annotated[int, Field(ge=1, le=50)] = 10
    """Hypotheses kept for each object."""
    max_objects: Annotated[int, Field(ge=1, le=500)] = 40
    """Objects reported, best first."""
    contour_points: Annotated[int, Field(ge=32, le=1000)] = 160
    """Points on the contours of a hypothesis that alignment and score look at."""
    overlap: Annotated[FiniteFloat, Field(gt=0, le=1)] = 0.3
    """An object whose silhouette is covered further than this by a better object's is a false alarm."""
    min_score: Annotated[FiniteFloat, Field(ge=0, le=100)] = 45.0
    """Score the best hypothesis of an object needs: the mean of contour agreement and explained variance, percent."""
    bright_faces: bool = True
    """Whether facets that face the viewer mirror light and are brighter than the ground; off for black parts."""
    depth_tolerance: Annotated[FiniteFloat, Field(gt=0, le=10)] = 0.15
    """How far a measured depth may differ from a hypothesis before it speaks against it, in diameters of the part."""
    temperature: Annotated[FiniteFloat, Field(gt=0)] = 4.0
    """Of the softmax over the hypotheses of an object, on the 0..100 scale of the scores."""

    @property
    def reach_m(self) -> tuple[float, float]:
        """Least and largest distance for which there are templates."""
        return self.distance_m or USUAL_DISTANCE_M

    def reaching(self, near_m: float, far_m: float) -> DetectionSettings:
        """Return these settings with ``distance_m`` set, unless it is set already.

        The range is rounded outwards to powers of ``distance_ratio``, so that like scenes share trained templates.
        """
        if self.distance_m is not None:
            return self
        step = math.log(self.distance_ratio)
        ends = math.floor(math.log(near_m) / step), math.ceil(math.log(far_m) / step)
        return self.model_copy(update={"distance_m": (math.exp(step * ends[0]), math.exp(step * ends[1]))})

    @model_validator(mode="after")
    def _ordered(self) -> DetectionSettings:
        if not self.reach_m[0] <= self.reach_m[1]:
            raise ValueError(f"distance_m is {self.distance_m}, the first must not exceed the second")
        if not self.dark_cosine < self.bright_cosine:
            raise ValueError(f"dark_cosine is {self.dark_cosine}, must be below bright_cosine, {self.bright_cosine}")
        return self
