"""Settings of the refinement of hypotheses by depth."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

Share = Annotated[FiniteFloat, Field(gt=0, le=1)]
LengthM = Annotated[FiniteFloat, Field(gt=0, le=0.1)]


class RefinementSettings(BaseModel):
    """How poses are registered to depth, and what the depth says of their probabilities.

    Error against run time: ``python tests/benchmarks/bench_refinement.py``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    wide_kernel: Share = 0.15
    """Robust kernel of the first step, in diameters of the part: how far surfaces may be from their points."""
    fine_kernel_m: LengthM = 0.6e-3
    """Robust kernel of the last steps: several times the noise of the depth."""
    coarse_points: Annotated[int, Field(ge=50, le=20_000)] = 300
    """Points drawn for each hypothesis while the kernel shrinks."""
    coarse_steps: Annotated[int, Field(ge=1, le=100)] = 24
    """Steps while the kernel shrinks, in equal ratios, to one cell of the grid of nearest surface points."""
    grid_cells: Annotated[int, Field(ge=8, le=128)] = 48
    """Cells of that grid along its longest side, which is the part's extent and the wide kernel on either side."""
    exact_steps: Annotated[int, Field(ge=1, le=100)] = 3
    """Steps while the kernel shrinks on to the fine one, with exact nearest points."""
    fine_points: Annotated[int, Field(ge=50, le=20_000)] = 1500
    """Points drawn for each hypothesis in the last steps."""
    fine_steps: Annotated[int, Field(ge=1, le=100)] = 2
    """Last steps, at the fine kernel."""
    slippery: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 1e-3
    """Directions whose eigenvalue is a smaller share of the largest one are left alone: no depth determines them."""
    least_points: Annotated[int, Field(ge=6)] = 20
    """Inliers without which a pose stays as it is, and a view does not support it."""
    object_points: Annotated[int, Field(ge=100, le=1_000_000)] = 4000
    """Points kept around an object, of all views together."""
    correlation_px: Annotated[FiniteFloat, Field(ge=1, le=50)] = 10.0
    """Points of one cell of so many pixels share their noise: the matching window of the stereo camera."""
    prior_turn_deg: Annotated[FiniteFloat, Field(gt=0, le=180)] = 10.0
    """Standard deviation of detection's orientations, for directions that no depth determines."""
    prior_shift_m: LengthM = 5e-3
    """Standard deviation of detection's positions, for directions that no depth determines."""
    same_turn_deg: Annotated[FiniteFloat, Field(gt=0, le=90)] = 3.0
    """Hypotheses that differ by less, modulo the symmetry of the part, and by ``same_shift``, are one."""
    same_shift: Share = 0.02
    """Of the part's centre, in diameters."""
    agreement_m: LengthM = 1e-3
    """Standard deviation of measured from expected depth where a pose is right: noise and what is left of its error."""
    agreement_odds: Share = 0.5
    """Share of a right pose's measured pixels that lie on its surface."""
    occluder_odds: Share = 0.8
    """Likelihood of something nearer than the part, relative to depth that no pose explains: nearly neutral."""
    behind_odds: Share = 0.03
    """Likelihood of something behind the part's surface, relative to the same: nothing is seen through a part."""
    tempering: Share = 0.07
    """Share of the log-likelihood that counts, as neighbouring pixels err together."""
    least_probability: Annotated[FiniteFloat, Field(ge=0, lt=0.5)] = 1e-3
    """Hypotheses below it are dropped."""

    @model_validator(mode="after")
    def _enough_points(self) -> Self:
        if self.least_points > self.coarse_points:
            raise ValueError(f"least_points is {self.least_points}, must not exceed coarse_points {self.coarse_points}")
        return self
