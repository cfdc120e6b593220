"""What light the cameras should receive from surface points: equations (1) to (5), with the projector's optics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sidelong.physics.reflectance import Phong, fall_off, incident_light, radiance, vignetting
from sidelong.physics.response import Response
from sidelong.physics.sensing import Sensing, SensingSettings
from sidelong.types import FloatArray, IntArray


@dataclass(frozen=True)
class LightModel:
    """Everything that turns geometry into the probability of depth.

    Attributes
    ----------
    reflectances
        By material index of the part.
    intensity
        Of the projector on its axis, at 1 m.
    fall_off
        Whether light falls with the squared distance; else it is the intensity at 1 m everywhere (the paper).
    shadows
        "none", "self" or "all": what may stand in the way of a ray.
    exposure_s
        Of the depth capture.
    response, sensing
        Sensor.
    vignetting
        The projector's intensity falls with the cosine of the angle off its axis to this power; 0: not at all.
    """

    reflectances: tuple[Phong, ...]
    intensity: float
    fall_off: bool
    shadows: str
    exposure_s: float
    response: Response
    sensing: SensingSettings
    vignetting: float = 0.0

    @cached_property
    def kind(self) -> Sensing:
        """The sensing model that the settings name."""
        return self.sensing.kind(self.response)


@dataclass(frozen=True, eq=False)
class Surface:
    """Surface points in the base frame: ``points`` and outward unit ``normals`` (N, 3), ``material`` (N,)."""

    points: FloatArray
    normals: FloatArray
    material: IntArray

    def __getitem__(self, chosen: IntArray) -> Surface:
        return Surface(self.points[chosen], self.normals[chosen], self.material[chosen])

    def __len__(self) -> int:
        return len(self.points)


def radiance_towards(
    cameras: tuple[FloatArray, ...], base_T_projector: FloatArray, surface: Surface, light: LightModel
) -> FloatArray:
    """Return E of equation (5) from each point towards each camera, (N, C), whatever stands between.

    Parameters
    ----------
    cameras
        Centres (3,) of C cameras in the base frame.
    base_T_projector
        (4, 4) pose of the projector, its optical axis along z.
    surface
        N points.
    light
        Projector and reflectances.
    """
    projector = base_T_projector[:3, 3]
    to_light = unit(projector - surface.points)
    power = _incident(base_T_projector, surface, to_light, light)
    e = np.zeros((len(surface), len(cameras)))
    for column, centre in enumerate(cameras):
        to_camera = unit(centre - surface.points)
        for index, material in enumerate(light.reflectances):
            mine = surface.material == index
            e[mine, column] = radiance(power[mine], (to_light[mine], to_camera[mine]), surface.normals[mine], material)
    return e


def _incident(base_T_projector: FloatArray, surface: Surface, to_light: FloatArray, light: LightModel) -> FloatArray:
    """Return L_in (N,) of equation (1)."""
    distance_m = np.linalg.norm(base_T_projector[:3, 3] - surface.points, axis=1)
    power = fall_off(light.intensity, distance_m) if light.fall_off else np.full(len(surface), light.intensity)
    if light.vignetting > 0:
        power = power * vignetting(-to_light @ base_T_projector[:3, 2], light.vignetting)
    return incident_light(power)


def unit(vectors: FloatArray) -> FloatArray:
    """Scale (N, 3) to unit length; a zero vector stays zero and so returns no light."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
