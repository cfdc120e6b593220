"""Settings of the fusion."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.fusion.volume.settings import VolumeSettings
from sidelong.physics.depth_noise import DepthNoise


class EngineName(StrEnum):
    """How depth maps are fused."""

    WARP = "warp"
    """Each is warped into the reference view, pixel by pixel."""
    VOLUME = "volume"
    """All meet in a grid of voxels, which gives a mesh of the whole bin as well."""


class RegistrationSettings(BaseModel):
    """What the arm may err, and how it is put right by the depth that views share.

    A view that would have to be moved by more than the limits is refused.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    arm_shift_m: Annotated[
        FiniteFloat, Field(ge=1e-6, le=0.02, description="standard deviation of where the arm says the camera is")
    ] = 0.3e-3
    arm_turn_rad: Annotated[
        FiniteFloat, Field(ge=1e-6, le=0.1, description="standard deviation of how it says the camera is turned")
    ] = 0.9e-3
    largest_shift_m: Annotated[FiniteFloat, Field(gt=0, le=0.05, description="no view is moved by more")] = 2e-3
    largest_turn_rad: Annotated[FiniteFloat, Field(gt=0, le=0.2, description="no view is turned by more")] = 6e-3


class ModelSettings(BaseModel):
    """Completion by the CAD model where a pose is certain: what no view measured takes the depth of the mesh."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    least_probability: Annotated[FiniteFloat, Field(gt=0, le=1, description="of the pose")] = 0.9
    least_views: Annotated[int, Field(ge=1, le=100, description="whose depth agrees with the pose")] = 2
    largest_sigma_m: Annotated[
        FiniteFloat, Field(gt=0, le=0.01, description="standard deviation of the depth that the pose gives")
    ] = 0.5e-3


class FusionSettings(BaseModel):
    """How depth maps of other views are laid into the reference view.

    ``tile_px`` trades completeness against extrapolation at the rim of patches. On patchy depth of shiny parts (38 % of
    the part's pixels measured, sensor rms 0.6 mm), missing pixels within 2 mm of the truth after three further views,
    mean of all choices, and rms of those: 1.0 px 37.9 %, 0.72 mm; 1.5 px 42.3 %, 0.73 mm; 2.0 px 44.5 %, 0.75 mm. The
    default carries a depth a quarter of a pixel beyond its own, far less than the window a stereo matcher compares; at
    1.0 px noise opens gaps between neighbours (2 % of the pixels at 0.1 mm).

    ``behind_m`` suits poses refined by depth: it takes hardly a right depth with it. Poses left as detected are off by
    more: give it 8 mm there.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    engine: Annotated[EngineName, Field(strict=False, description="warp or volume")] = EngineName.WARP
    volume: VolumeSettings = Field(default=VolumeSettings(), description="of the volumetric engine")
    noise: DepthNoise = Field(default=DepthNoise(), description="of the camera's depth")
    registration: RegistrationSettings | None = Field(
        default=RegistrationSettings(), description="of the arm's poses; null: they are exact"
    )
    model: ModelSettings | None = Field(default=None, description="completion by the CAD model; null: left out")
    front_band_m: Annotated[
        FiniteFloat, Field(ge=0, le=0.05, description="depths this far behind the nearest one are averaged with it")
    ] = 2e-3
    through_m: Annotated[
        FiniteFloat, Field(gt=0, le=0.05, description="a view that measured so far behind a depth saw through it")
    ] = 3e-3
    least_agreement: Annotated[
        FiniteFloat,
        Field(
            ge=0, le=1, description="a view is refused if less of what it shares with the reference agrees; 0: never"
        ),
    ] = 0.9
    agreement_sigmas: Annotated[
        FiniteFloat, Field(ge=1, le=10, description="depths this many standard deviations apart are one surface")
    ] = 4.0
    behind_m: Annotated[
        FiniteFloat,
        Field(ge=0, le=10, description="depths further behind the believed surface of a part are doubtful"),
    ] = 4e-3
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
    max_views: Annotated[
        int, Field(ge=2, le=100, description="views kept one by one; then they are settled, and kept as one")
    ] = 16
