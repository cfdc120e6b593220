"""Settings of the volumetric engine."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

Corner = Annotated[tuple[FiniteFloat, FiniteFloat, FiniteFloat], Field(strict=False)]
Corners = Annotated[tuple[Corner, Corner], Field(strict=False)]


class VolumeSettings(BaseModel):
    """How depth maps are laid into a volume of voxels, and what counts as a surface there.

    ``front_m`` and ``behind_m`` bound how far from a measured depth voxels learn of it. Both must be several standard
    deviations of the depth, or the views' errors do not average out; the less of it lies behind, the less do the two
    sides of a thin part disturb each other.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    voxel_m: Annotated[FiniteFloat, Field(ge=0.05e-3, le=0.02, description="side of a voxel")] = 0.5e-3
    front_m: Annotated[FiniteFloat, Field(gt=0, le=0.1, description="voxels this far before a surface know of it")] = (
        1.5e-3
    )
    behind_m: Annotated[FiniteFloat, Field(gt=0, le=0.1, description="voxels this far behind it know of it")] = 1e-3
    region_m: Annotated[
        Corners | None,
        Field(strict=False, description="lowest and highest corner of what is modelled, in the base frame"),
    ] = None
    least_inlier_probability: Annotated[
        FiniteFloat, Field(gt=0, lt=1, description="voxels below it are taken for free space or outliers")
    ] = 0.5
    max_incidence_rad: Annotated[
        FiniteFloat, Field(gt=0, lt=1.57, description="neighbours that rise more steeply are taken for a depth edge")
    ] = 1.3
    max_bytes: Annotated[
        int, Field(ge=1_000_000, le=64_000_000_000, description="memory of the volume and of its work on one frame")
    ] = 600_000_000

    @model_validator(mode="after")
    def _band_spans_voxels(self) -> VolumeSettings:
        """A crossing needs a voxel on either side of the surface along any direction, so at least two of them."""
        for name in ("front_m", "behind_m"):
            band_m: float = getattr(self, name)
            if band_m < 2 * self.voxel_m:
                raise ValueError(f"{name} is {band_m:g} m, needs at least 2 voxel_m = {2 * self.voxel_m:g} m")
        return self
