"""What the planner believes about light: materials, projector, sensor."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.errors import SettingsError
from sidelong.physics.reflectance import PAPER_MATERIALS, Phong
from sidelong.physics.response import Response

DEFAULT_INTENSITY = 300.0
"""Of a projector nobody has measured, at 1 m, in saturation exposures per second."""

BLACK_PLASTIC = Phong(k_d=0.01, k_s=0.04, n=8.0)
"""Not fitted: a dielectric mirrors 4 % (Fresnel, refractive index 1.5), and one that is black scatters next to nothing.
Beside metal it gives no depth, whatever the exact numbers."""

Share = Annotated[FiniteFloat, Field(ge=0)]


class MaterialSettings(BaseModel):
    """Phong reflectance of a material."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    k_d: Share = Field(description="diffuse share")
    k_s: Share = Field(description="specular share")
    n: Annotated[FiniteFloat, Field(ge=0, le=1e6)] = Field(description="glossiness")


class LightSettings(BaseModel):
    """Projector, sensor response and reflectance of the materials in the cell."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    intensity: Annotated[FiniteFloat, Field(gt=0)] | None = Field(
        default=None,
        description="projector intensity at 1 m, in saturation exposures per second; none: fitted where there is a "
        f"white capture, else {DEFAULT_INTENSITY:g}",
    )
    gamma: Annotated[FiniteFloat, Field(gt=0, le=10)] = Field(default=1.0, description="response Z = 255 X^(1/gamma)")
    fall_off: bool = Field(default=True, description="light falls with the squared distance from the projector")
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

    def response(self) -> Response:
        """Return the sensor's response."""
        return Response.gamma(self.gamma)

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
        return known | {name: Phong(m.k_d, m.k_s, m.n) for name, m in self.materials.items()}
