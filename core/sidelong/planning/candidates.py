"""Candidate views on a dome above the bin."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.geometry.transforms import look_at
from sidelong.types import View


class DomeSettings(BaseModel):
    """A dome of camera poses that look at the middle of the bin."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    distances_m: tuple[Annotated[FiniteFloat, Field(gt=0.05, le=10)], ...] = Field(
        default=(0.66, 0.78), min_length=1, description="distances from the target"
    )
    elevations_deg: tuple[Annotated[FiniteFloat, Field(gt=0, le=90)], ...] = Field(
        default=(75.0, 60.0),
        min_length=1,
        description="elevations above the floor; the top view is the reference",
    )
    azimuths: Annotated[int, Field(ge=1, le=360)] = Field(default=6, description="views around, at each elevation")


def dome_views(target_m: tuple[float, float, float], settings: DomeSettings) -> tuple[View, ...]:
    """Return the dome's views: first the one from straight above at the first distance, then ring by ring.

    Parameters
    ----------
    target_m
        The point all views look at, base frame.
    settings
        Distances, elevations, number around.
    """
    target = np.asarray(target_m, dtype=np.float64)
    views = [View("top", look_at(target + np.array([0.0, 0.0, settings.distances_m[0]]), target))]
    for ring, elevation_deg in enumerate(settings.elevations_deg):
        distance_m = settings.distances_m[ring % len(settings.distances_m)]
        elevation = np.deg2rad(elevation_deg)
        for k in range(settings.azimuths):
            # neighbouring rings are turned by half a step, so that no two views line up
            azimuth = 2 * np.pi * (k + 0.5 * (ring % 2)) / settings.azimuths
            direction = np.array(
                [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
            )
            name = f"e{elevation_deg:g}_a{np.rad2deg(azimuth):g}"
            views.append(View(name, look_at(target + distance_m * direction, target)))
    return tuple(views)
