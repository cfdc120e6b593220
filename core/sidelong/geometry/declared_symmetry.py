"""The symmetry of a part as the file beside its CAD file declares it."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from sidelong.geometry.symmetry import LARGEST_ORDER, Symmetry, group_from
from sidelong.geometry.transforms import rotation_about
from sidelong.types import FloatArray

Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
SQUARE_SINE = np.sin(np.deg2rad(1.0))
"""How far from square a flip may be declared to the axis; it is squared."""


class DeclaredSymmetry(BaseModel):
    """One of ``none``, ``cyclic`` with ``axis``, ``continuous`` and ``ball``, or ``planes`` alone.

    ``{"cyclic": 6, "axis": [0, 0, 1], "flip": [1, 0, 0]}``: a hexagon nut. ``{"continuous": [0, 0, 1]}``: a cone.
    ``{"none": true}``: what the mesh shows is not to be believed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    none: Literal[True] | None = None
    ball: Literal[True] | None = None
    cyclic: Annotated[int, Field(ge=2, le=LARGEST_ORDER)] | None = None
    """Turns about ``axis`` in a full circle."""
    axis: Vector | None = None
    continuous: Vector | None = None
    """Axis about which the part may be turned by any angle."""
    flip: Vector | None = None
    """Second axis, square to the first, about which half a turn changes nothing."""
    planes: tuple[Vector, ...] = ()
    """Normals of mirror planes."""
    centre: Vector | None = None
    """Where axes and planes meet, in the unit of the CAD file; left out: the centroid of the surface."""

    @model_validator(mode="after")
    def _is_one_kind(self) -> DeclaredSymmetry:
        kinds = [name for name in ("none", "ball", "cyclic", "continuous") if getattr(self, name) is not None]
        if len(kinds) > 1 or not (kinds or self.planes):
            raise ValueError(f"one of none, ball, cyclic, continuous or planes is needed, got {kinds}")
        if (self.cyclic is None) != (self.axis is None):
            raise ValueError("cyclic and axis belong together")
        main = self.axis or self.continuous
        if self.flip is not None and main is None:
            raise ValueError("flip needs cyclic or continuous")
        for vector in (main, self.flip, *self.planes):
            if vector is not None and not np.linalg.norm(vector) > 0:
                raise ValueError(f"{list(vector)} has no direction")
        if main is not None and self.flip is not None and not abs(_unit(main) @ _unit(self.flip)) < SQUARE_SINE:
            raise ValueError(f"flip {list(self.flip)} is not square to the axis {list(main)}")
        return self

    def symmetry(self, centre_m: FloatArray) -> Symmetry:
        """Return it as a symmetry about ``centre_m`` (3,)."""
        axis = self.axis or self.continuous
        generators: list[FloatArray] = []
        if axis is not None and self.flip is not None:
            square = _unit(self.flip) - _unit(axis) * (_unit(axis) @ _unit(self.flip))
            generators.append(rotation_about(square, np.pi))
        if self.cyclic is not None and axis is not None:
            generators.append(rotation_about(axis, 2 * np.pi / self.cyclic))
        group = group_from(np.array(generators).reshape(-1, 3, 3))
        assert group is not None  # the order is limited
        return Symmetry(
            centre_m,
            group,
            axis=None if self.continuous is None else _unit(self.continuous),
            ball=bool(self.ball),
            planes=np.array([_unit(normal) for normal in self.planes]).reshape(-1, 3),
        )


def _unit(vector: Vector) -> FloatArray:
    return np.array(vector) / np.linalg.norm(vector)
