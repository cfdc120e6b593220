"""What the planner believes about light: materials, projector, sensor."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from sidelong.errors import SettingsError
from sidelong.physics.reflectance import PAPER_MATERIALS, Phong
from sidelong.physics.response import LEVELS, Response

DEFAULT_INTENSITY = 300.0
"""Of a projector nobody has measured, at 1 m, in saturation exposures per second."""

BLACK_PLASTIC = Phong(k_d=0.01, k_s=0.04, n=8.0)
"""Not fitted: a dielectric mirrors 4 % (Fresnel, refractive index 1.5), and one that is black scatters next to nothing.
Beside metal it gives no depth, whatever the exact numbers."""

ABSORBING = Phong(k_d=0.0, k_s=0.0, n=0.0)
"""Of faces that give no depth: whatever light falls on them, none comes back that a camera could use."""

Share = Annotated[FiniteFloat, Field(ge=0)]
ResponseTable = Annotated[tuple[FiniteFloat, ...], Field(min_length=LEVELS, max_length=LEVELS, strict=False)]


class MaterialSettings(BaseModel):
    """Phong reflectance of a material."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    k_d: Share = Field(description="diffuse share")
    k_s: Share = Field(description="specular share")
    n: Annotated[FiniteFloat, Field(ge=0, le=1e6)] = Field(description="glossiness")
    absorbing: bool = Field(default=False, description="known to give no depth: counts as black, whatever the numbers")

    def reflectance(self) -> Phong:
        """Return the reflectance that counts."""
        return ABSORBING if self.absorbing else Phong(self.k_d, self.k_s, self.n)


class LightSettings(BaseModel):
    """Projector, sensor response and reflectance of the materials in the cell."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    intensity: Annotated[FiniteFloat, Field(gt=0)] | None = Field(
        default=None,
        description="projector intensity at 1 m, in saturation exposures per second; none: fitted where there is a "
        f"white capture, else {DEFAULT_INTENSITY:g}",
    )
    gamma: Annotated[FiniteFloat, Field(gt=0, le=10)] = Field(default=1.0, description="response Z = 255 X^(1/gamma)")
    response_table: ResponseTable | None = Field(
        default=None,
        description="g(Z) for Z = 0..255, strictly rising: ln of the exposure that gives grey level Z; its scale does "
        "not matter; goes before gamma",
    )
    fall_off: bool = Field(default=True, description="light falls with the squared distance from the projector")
    vignetting: Annotated[FiniteFloat, Field(ge=0, le=100)] = Field(
        default=0.0, description="projector intensity falls as cos(angle off its axis) to this power; 0: it does not"
    )
    shadows: Literal["none", "self", "all"] = Field(
        default="all", description="what may hide a point from cameras and projector: nothing, its own part, all parts"
    )
    materials: dict[str, MaterialSettings] = Field(
        default_factory=dict[str, MaterialSettings],
        description="by name; the paper's three and black_plastic are known",
    )
    stand_in: str | None = Field(
        default="stainless", description="material taken for one whose reflectance is not known; none: refuse the part"
    )

    @field_validator("response_table")
    @classmethod
    def _rising(cls, table: tuple[float, ...] | None) -> tuple[float, ...] | None:
        falling = np.flatnonzero(np.diff(table) <= 0) if table is not None else np.zeros(0)
        if table is not None and falling.size:
            z = int(falling[0])
            raise ValueError(
                f"does not rise from {table[z]} at Z = {z} to {table[z + 1]} at Z = {z + 1}, it must everywhere"
            )
        return table

    def response(self) -> Response:
        """Return the sensor's response: the table where there is one, else the gamma curve."""
        if self.response_table is None:
            return Response.gamma(self.gamma)
        # light is counted in saturation exposures, whatever the table was fitted in
        table = np.array(self.response_table, dtype=np.float64)
        return Response(table - table[-1])

    def reflectances(self, names: tuple[str, ...]) -> tuple[Phong, ...]:
        """Return the reflectance of each named material.

        Raises
        ------
        SettingsError
            A material is unknown and nothing may stand in, or the stand-in is unknown.
        """
        known = self._known()
        stand_in = known.get(self.stand_in or "")
        found = [known.get(name, stand_in) for name in names]
        for name, reflectance in zip(names, found, strict=True):
            if reflectance is None:
                raise SettingsError(
                    f"light.materials: no reflectance for material {name!r} nor for light.stand_in, "
                    f"{self.stand_in!r}; known are {', '.join(sorted(known))}"
                )
        return tuple(reflectance for reflectance in found if reflectance is not None)

    def unknown(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the materials for which the stand-in is taken."""
        return tuple(name for name in names if name not in self._known())

    def _known(self) -> dict[str, Phong]:
        known = PAPER_MATERIALS | {"black_plastic": BLACK_PLASTIC}
        return known | {name: material.reflectance() for name, material in self.materials.items()}
