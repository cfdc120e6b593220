"""How the simulated surfaces reflect: a Lambert share and one microfacet lobe (GGX, Walter et al. 2007).

Nothing here knows the Phong model the planner fits: the simulated cell would prove little if both shared a formula.
Directions are unit vectors that point away from the surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sidelong.errors import UnknownNameError
from sidelong.types import FloatArray, IntArray


@dataclass(frozen=True)
class Microfacets:
    """A surface.

    Attributes
    ----------
    diffuse
        Albedo of the Lambert share, 0..1.
    f0
        Mirror reflectance at normal incidence, 0..1; 0 for a surface without a lobe.
    alpha
        GGX width of the facet slopes (the square of what renderers call roughness), 0..1.
    print_contrast
        How far a print makes the diffuse albedo swing about its mean, 0..1; 0 for a plain surface.
    """

    diffuse: float
    f0: float
    alpha: float
    print_contrast: float = 0.0


MATERIALS: Mapping[str, Microfacets] = MappingProxyType(
    {
        "stainless": Microfacets(diffuse=0.02, f0=0.60, alpha=0.16),
        "plated": Microfacets(diffuse=0.018, f0=0.68, alpha=0.13),
        "matte": Microfacets(diffuse=0.22, f0=0.0, alpha=1.0),
        "black_plastic": Microfacets(diffuse=0.012, f0=0.03, alpha=0.45),
        "printed": Microfacets(diffuse=0.22, f0=0.0, alpha=1.0, print_contrast=0.9),
    }
)


PRINT_SIZES_M = (1.5e-3, 6e-3, 24e-3)
PRINT_STEEPNESS = 4.0


@dataclass(frozen=True, eq=False)
class Surface:
    """The reflectance of N surface points: ``diffuse, f0, alpha`` (N,) as in :class:`Microfacets`."""

    diffuse: FloatArray
    f0: FloatArray
    alpha: FloatArray

    def __getitem__(self, chosen: IntArray | slice) -> Surface:
        return Surface(self.diffuse[chosen], self.f0[chosen], self.alpha[chosen])

    def widened(self, half_angle_rad: float) -> Surface:
        """Return the surface as it answers to a lamp that fills a cone: the lamp's width adds to the lobe's."""
        return Surface(self.diffuse, self.f0, np.minimum(np.hypot(self.alpha, np.tan(half_angle_rad) / 2), 1.0))


def surface_table(names: Sequence[str]) -> Surface:
    """Return the reflectance of materials by name, one entry each.

    Raises
    ------
    UnknownNameError
        A name is not in ``MATERIALS``.
    """
    for name in names:
        if name not in MATERIALS:
            raise UnknownNameError(f"simulated material: {name!r} is unknown, known are {', '.join(MATERIALS)}")
    columns = np.array([(MATERIALS[name].diffuse, MATERIALS[name].f0, MATERIALS[name].alpha) for name in names])
    diffuse, f0, alpha = columns.reshape(-1, 3).T
    return Surface(diffuse, f0, alpha)


def printed(materials: Sequence[str], material: IntArray, points_m: FloatArray) -> FloatArray:
    """Return the factor (N,) by which print changes the diffuse albedo at points (N, 3) of materials (N,) by index.

    A solid texture of three octaves, blotches of 1.5 to 24 mm: flat ground and walls carry it alike.
    """
    from scipy.ndimage import map_coordinates

    contrast = np.array([MATERIALS[name].print_contrast for name in materials])[material]
    on = np.flatnonzero(contrast > 0)
    ink = np.zeros(len(on))
    for octave, size_m in enumerate(PRINT_SIZES_M if len(on) else ()):
        blocks = np.random.default_rng(octave).uniform(-1.0, 1.0, (32, 32, 32))
        ink += map_coordinates(blocks, points_m[on].T / size_m, order=1, mode="grid-wrap")
    factor = np.ones(len(points_m))
    factor[on] += contrast[on] * np.tanh(PRINT_STEEPNESS * ink)  # print has edges
    return factor


def reflectance(surface: Surface, to_light: FloatArray, to_camera: FloatArray, normals: FloatArray) -> FloatArray:
    """Return the BRDF in 1/sr, (N,); 0 where light or camera are below the surface.

    Parameters
    ----------
    surface
        N points, or one that stands for all.
    to_light, to_camera, normals
        (N, 3) unit vectors.
    """
    cos_light, cos_camera = dot(normals, to_light), dot(normals, to_camera)
    answer = np.broadcast_to(surface.diffuse / np.pi, cos_light.shape).copy()
    f0, alpha = np.broadcast_to(surface.f0, answer.shape), np.broadcast_to(surface.alpha, answer.shape)
    above = (cos_light > 0) & (cos_camera > 0)
    shiny = np.flatnonzero(above & (f0 > 0))
    answer[shiny] += _ggx(
        (f0[shiny], alpha[shiny]),
        (cos_light[shiny], cos_camera[shiny]),
        _halfway_cosines(to_light[shiny], to_camera[shiny], normals[shiny]),
    )
    return np.where(above, answer, 0.0)


def fresnel(f0: FloatArray, cosine: FloatArray) -> FloatArray:
    """Return Schlick's reflectance; a surface with f0 below 2 % has no full mirror at grazing angles either."""
    grazing = np.minimum(50.0 * f0, 1.0)
    return f0 + (grazing - f0) * np.power(np.clip(1.0 - cosine, 0.0, 1.0), 5)


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the scalar products (...) of vectors (..., 3)."""
    return np.einsum("...i,...i", a, b)


def unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (..., 3) at length 1."""
    return vectors / np.sqrt(dot(vectors, vectors))[..., None]


def _halfway_cosines(to_light: FloatArray, to_camera: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return N . H and L . H of the facet that mirrors the light into the camera."""
    half = unit(to_light + to_camera)
    return dot(normals, half), dot(to_light, half)


def _ggx(
    lobe: tuple[FloatArray, FloatArray],
    cosines: tuple[FloatArray, FloatArray],
    halfway: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Return D F G / (4 cos cos) with the height-correlated masking of Smith (Heitz 2014)."""
    f0, alpha = lobe
    cos_light, cos_camera = cosines
    cos_half, cos_facet = halfway
    squared = np.square(alpha)
    slopes = squared / (np.pi * np.square(np.square(cos_half) * (squared - 1.0) + 1.0))
    masking = 0.5 / (
        cos_light * np.sqrt(np.square(cos_camera) * (1.0 - squared) + squared)
        + cos_camera * np.sqrt(np.square(cos_light) * (1.0 - squared) + squared)
    )
    return slopes * masking * fresnel(f0, cos_facet)
