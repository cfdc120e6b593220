"""Settings of the detection of parts in one grey image."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

DistanceM = Annotated[FiniteFloat, Field(ge=0.01, le=20)]
Listed: Any = Field(strict=False)
"""JSON has lists and no tuples."""
Pixel = Annotated[int, Field(ge=0, le=100_000)]
ElevationDeg = Annotated[FiniteFloat, Field(ge=-90, le=90)]
TurnDeg = Annotated[FiniteFloat, Field(ge=-360, le=360)]
USUAL_DISTANCE_M = (0.55, 0.95)
"""Of a camera over a bin, where nothing tells."""


class DetectionSettings(BaseModel):
    """Which templates are made of a part, how they are matched, and what becomes of the matches.

    Error against run time of templates and matching: ``python tests/benchmarks/bench_detection.py --proposals``, with
    ``--set cell_px=5`` and the like for other points of the plot.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    view_step_deg: Annotated[FiniteFloat, Field(ge=5, le=60)] = 20.0
    """Angle between neighbouring views of the viewsphere, in elevation and (on the circle) in azimuth."""
    roll_step_deg: Annotated[FiniteFloat, Field(ge=2, le=60)] = 15.0
    """Angle between neighbouring turns in the image plane."""
    elevation_deg: Annotated[tuple[ElevationDeg, ElevationDeg], Listed] = (-90.0, 90.0)
    """From where a part can be seen: elevation of the camera over the xy plane of the part's own frame. Parts that
    cannot lie on their heads need no templates from below."""
    azimuth_deg: Annotated[tuple[TurnDeg, TurnDeg], Listed] = (0.0, 360.0)
    """The same about the part's z axis, from x to y."""
    roll_deg: Annotated[tuple[TurnDeg, TurnDeg], Listed] = (0.0, 360.0)
    """Direction in which the part's z axis shows in the image, clockwise from straight up."""
    distance_m: Annotated[tuple[DistanceM, DistanceM], Listed] | None = None
    """Least and largest distance of a part from the camera in the reference view; none: where the cell or the recorded
    depth says, else ``USUAL_DISTANCE_M``."""
    distance_ratio: Annotated[FiniteFloat, Field(ge=1.02, le=2)] = 1.12
    """Largest ratio of neighbouring distances: what an image shows changes with the ratio, not the difference."""
    span_px: Annotated[FiniteFloat, Field(ge=24, le=400)] = 60.0
    """What the part's diameter spans in the matched image at the middle distance; images are resized to reach it."""
    cell_px: Annotated[int, Field(ge=2, le=32)] = 6
    """Spacing of the grid on which templates and image are compared, in pixels of the matched image."""
    weak_gradient: Annotated[FiniteFloat, Field(gt=0)] = 3.0
    """Gradient of the image, grey levels per pixel, at which a lonely edge counts half: a few times the noise."""
    strong_gradient: Annotated[FiniteFloat, Field(gt=0)] = 12.0
    """The same for the pictures of the templates, which use the full range 0..255."""
    dark_cosine: Annotated[FiniteFloat, Field(ge=0, le=1)] = 0.3
    """Facets tilted further from the viewer than this cosine mirror the dark bin instead of the lights above."""
    bright_cosine: Annotated[FiniteFloat, Field(ge=0, le=1)] = 0.9
    """Facets that face the viewer more than this cosine are as bright as any."""
    dark_level: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.1
    """Brightness of the dark facets relative to the bright ones."""
    ground_level: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.2
    """Brightness of what parts lie on, relative to the bright facets."""
    region_px: Annotated[tuple[Pixel, Pixel, Pixel, Pixel], Listed] | None = None
    """(left, top, right, bottom) of the rectangle in which parts are looked for, the last two exclusive; none: all."""
    match_threshold: Annotated[FiniteFloat, Field(gt=0, le=50)] = 3.0
    """Least score of a match, in standard deviations of the edges that the image has anywhere."""
    matches_per_place: Annotated[int, Field(ge=1, le=1000)] = 40
    """Templates kept for each point of the grid, best first."""
    max_matches: Annotated[int, Field(ge=1)] = 100_000
    """Matches kept, best first."""
    deadline_s: Annotated[FiniteFloat, Field(gt=0)] = 60.0
    """Time the matcher's process has to load the templates or to answer before it is ended."""
    cluster_radius: Annotated[FiniteFloat, Field(gt=0, le=1)] = 0.2
    """Matches whose centres lie within this share of the part's diameter may be one object."""
    pose_step_deg: Annotated[FiniteFloat, Field(gt=0, le=90)] = 12.0
    """Hypotheses of one object that differ by less count as one."""
    hypotheses_per_object: Annotated[int, Field(ge=1, le=50)] = 10
    """Hypotheses kept for each object."""
    max_objects: Annotated[int, Field(ge=1, le=500)] = 40
    """Objects reported, best first."""
    contour_points: Annotated[int, Field(ge=32, le=1000)] = 160
    """Points on the contours of a hypothesis that alignment and score look at."""
    overlap: Annotated[FiniteFloat, Field(gt=0, le=1)] = 0.4
    """An object that has more in common with a better one, as a share of the smaller silhouette, is a false alarm."""
    min_score: Annotated[FiniteFloat, Field(ge=0, le=100)] = 20.0
    """Probability, percent, that the best hypothesis of an object needs, as if it were the only one."""
    temperature: Annotated[FiniteFloat, Field(gt=0)] = 0.3
    """Of the softmax over the log-odds of the hypotheses of an object."""
    least_probability: Annotated[FiniteFloat, Field(ge=0, lt=0.5)] = 1e-3
    """Hypotheses of an object that are less probable are dropped; the others' probabilities sum to 1 again."""

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
        for name in ("elevation_deg", "azimuth_deg", "roll_deg"):
            low, high = getattr(self, name)
            if not 0 <= high - low <= 360:
                raise ValueError(f"{name} is {low:g} to {high:g}, must rise by 0 to 360 degrees")
        if self.region_px is not None and not (
            self.region_px[0] < self.region_px[2] and self.region_px[1] < self.region_px[3]
        ):
            raise ValueError(f"region_px is {self.region_px}, needs left < right and top < bottom")
        if not self.dark_cosine < self.bright_cosine:
            raise ValueError(f"dark_cosine is {self.dark_cosine}, must be below bright_cosine, {self.bright_cosine}")
        return self
