"""What can be calibrated, and what each task has to be told."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter

Name = Annotated[str, Field(min_length=1, max_length=100)]


class _Task(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class ResponseTask(_Task):
    """Response of the sensor, from an exposure bracket."""

    kind: Literal["response"] = "response"


class ProjectorTask(_Task):
    """Intensity, vignetting and fall-off of the projector, from a matte plane."""

    kind: Literal["projector"] = "projector"
    plane_k_d: Annotated[FiniteFloat, Field(gt=0, le=1)] = Field(description="diffuse share of the plane, 0..1")


class MaterialTask(_Task):
    """Reflectance of the materials of a part, from white images and the depth of the same scene, sprayed."""

    kind: Literal["material"] = "material"
    material: Name | None = Field(default=None, description="one of the part's; none: each that is seen")


class SensingTask(_Task):
    """Probability of depth against exposure, from the views of a recorded scene with known poses."""

    kind: Literal["sensing"] = "sensing"
    scene: Annotated[int, Field(ge=0, le=1_000_000)] = 1


class HandEyeTask(_Task):
    """Where the camera sits on the flange, from images of a board."""

    kind: Literal["hand_eye"] = "hand_eye"
    arm: Name | None = Field(default=None, description="model of the arm, for the file")


class NoiseTask(_Task):
    """Noise of depth, from captures of a flat plate, or, as a lower bound, from repeated shots of any scene."""

    kind: Literal["noise"] = "noise"
    method: Literal["plate", "repeats"] = "plate"


Task: TypeAlias = Annotated[
    ResponseTask | ProjectorTask | MaterialTask | SensingTask | HandEyeTask | NoiseTask, Field(discriminator="kind")
]
TASK: TypeAdapter[Task] = TypeAdapter(Task)
