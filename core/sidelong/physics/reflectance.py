"""Phong reflectance: equations (1) to (5). Directions are unit vectors that point away from the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.errors import SettingsError
from sidelong.types import FloatArray


@dataclass(frozen=True)
class Phong:
    """Reflectance of a material: diffuse share k_d, specular share k_s, glossiness n."""

    k_d: float
    k_s: float
    n: float

    def __post_init__(self) -> None:
        for name, value in (("k_d", self.k_d), ("k_s", self.k_s), ("n", self.n)):
            if not (np.isfinite(value) and value >= 0):
                raise SettingsError(f"Phong {name}: is {value}, needs a finite number of at least 0")


PAPER_MATERIALS = {
    "stainless": Phong(k_d=0.037, k_s=0.74, n=19.9),
    "plated": Phong(k_d=0.04, k_s=0.82, n=38.9),
    "matte": Phong(k_d=0.45, k_s=0.02, n=8.65),
}
"""The three materials the paper fitted: its tube fitting, the metal of its DIN connector, its matte part."""


def incident_light(projector: FloatArray, ambient: float = 0.0) -> FloatArray:
    """Return L_in = L_a + L_p, equation (1). The paper neglects L_a; so does the default."""
    return projector + ambient


def fall_off(projector_intensity: float, distance_m: FloatArray) -> FloatArray:
    """Return L_p at a distance from the projector: intensity at 1 m over the distance squared.

    Not in the paper, whose L_p is a constant; between 0.6 and 0.9 m it is a factor of 2.25. A point at the projector
    itself (distance 0) gets no light instead of an infinite amount: it cannot be lit from inside.
    """
    squared = np.square(distance_m)
    return np.divide(projector_intensity, squared, out=np.zeros_like(squared), where=squared > 0)


def vignetting(cos_off_axis: FloatArray, power: float) -> FloatArray:
    """Return the share (...) of a projector's intensity that leaves it off its axis: cos^power, 0 beyond 90 degrees.

    Not in the paper, whose L_p is a constant. Power 0 leaves the intensity as it is in all directions before the
    projector.
    """
    ahead = cos_off_axis > 0
    return np.where(ahead, np.where(ahead, cos_off_axis, 1.0) ** power, 0.0)


def lambert(light: FloatArray, to_light: FloatArray, normals: FloatArray) -> FloatArray:
    """Return E_d = L_in (L . N), equation (2); 0 where theta exceeds pi/2.

    Parameters
    ----------
    light
        (...) incident light.
    to_light, normals
        (..., 3) unit vectors.
    """
    return light * np.maximum(np.einsum("...i,...i", to_light, normals), 0.0)


def mirrored(to_light: FloatArray, normals: FloatArray) -> FloatArray:
    """Return R = 2 (L . N) N - L, equation (3), (..., 3)."""
    return 2.0 * np.einsum("...i,...i", to_light, normals)[..., None] * normals - to_light


def specular(light: FloatArray, reflected: FloatArray, to_camera: FloatArray, n: FloatArray | float) -> FloatArray:
    """Return E_s = L_in (R . C)^n, equation (4); 0 where alpha exceeds pi/2.

    1 - cos(alpha) is formed as |R - C|^2 / 2 and the power as exp(n log1p(-(1 - cos))): near the mirror direction the
    cosine itself has lost the digits that a large n needs.
    """
    one_minus_cos = 0.5 * np.square(reflected - to_camera).sum(axis=-1)
    in_front = one_minus_cos < 1.0
    power = n * np.log1p(-np.where(in_front, one_minus_cos, 0.0))
    return np.where(in_front, light * np.exp(power), 0.0)


def radiance(
    light: FloatArray, directions: tuple[FloatArray, FloatArray], normals: FloatArray, material: Phong
) -> FloatArray:
    """Return E = k_d E_d + k_s E_s, equation (5).

    Parameters
    ----------
    light
        (...) incident light L_in.
    directions
        Unit vectors to the light and to the camera, (..., 3) each.
    normals
        (..., 3) outward unit normals. A surface that faces away from light or camera returns nothing.
    material
        Reflectance.
    """
    to_light, to_camera = directions
    lit = (np.einsum("...i,...i", to_light, normals) > 0) & (np.einsum("...i,...i", to_camera, normals) > 0)
    diffuse = lambert(light, to_light, normals)
    mirror = specular(light, mirrored(to_light, normals), to_camera, material.n)
    return np.where(lit, material.k_d * diffuse + material.k_s * mirror, 0.0)
