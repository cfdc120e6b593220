"""Settings of the fusion."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat


class FusionSettings(BaseModel):
    """How depth maps of other views are laid into the reference view.

    ``tile_px`` trades completeness against extrapolation at the rim of patches. On patchy depth of shiny parts (38 % of
    the part's pixels measured, sensor rms 0.6 mm), missing pixels within 2 mm of the truth after three further views,
    mean of all choices, and rms of those: 1.0 px 37.9 %, 0.72 mm; 1.5 px 42.3 %, 0.73 mm; 2.0 px 44.5 %, 0.75 mm. The
    default carries a depth a quarter of a pixel beyond its own, far less than the window a stereo matcher compares; at
    1.0 px noise opens gaps between neighbours (2 % of the pixels at 0.1 mm).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    front_band_m: Annotated[
        FiniteFloat, Field(ge=0, le=0.05, description="depths this far behind the nearest one are averaged with it")
    ] = 2e-3
    behind_m: Annotated[
        FiniteFloat,
        Field(ge=0, le=10, description="depths further behind the believed surface of a part are doubtful"),
    ] = 8e-3
    max_incidence_rad: Annotated[
        FiniteFloat, Field(gt=0, lt=1.57, description="neighbours that rise more steeply are taken for a depth edge")
    ] = 1.3
    tile_px: Annotated[
        FiniteFloat, Field(ge=1, le=3, description="side of the square of its own image a measured pixel stands for")
    ] = 1.5
    max_stretch_px: Annotated[
        int,
        Field(ge=2, le=32, description="largest extent of such a square in the reference image; larger are dropped"),
    ] = 8
