"""The light that reaches the pixels of a camera: from the projector, from the room, and over one mirror bounce.

The geometry is traced once per camera and pose; each pattern then costs one look-up. Lengths are metres, light is
counted in full wells of the sensor per second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.geometry.camera_model import LightProjector, PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import SURFACE_OFFSET_M, RayScene
from sidelong.geometry.transforms import invert, rotate, transform_points
from sidelong.simulation.materials import Surface, dot, fresnel, printed, reflectance, surface_table, unit
from sidelong.types import FloatArray, IntArray

LAMP_DISTANCE_M = 3.0
"""How far a shadow ray towards a lamp goes: farther than anything in a cell."""


class LampSettings(BaseModel):
    """A panel lamp in the room, far away."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    direction: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(description="towards the lamp, base frame")
    irradiance: FiniteFloat = Field(ge=0.0, le=1e3, description="on a surface that faces it, full wells/s at 1 sr")
    half_angle_rad: FiniteFloat = Field(default=0.25, ge=0.0, le=0.8, description="how wide it is")


class LightSettings(BaseModel):
    """Projector and room."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    projector_intensity: FiniteFloat = Field(
        default=210.0, ge=0.0, le=1e5, description="on its axis, full wells/s at 1 m"
    )
    projector_vignetting: FiniteFloat = Field(default=1.0, ge=0.0, le=8.0, description="falls as cos to this power")
    dome: FiniteFloat = Field(default=1.7, ge=0.0, le=1e3, description="irradiance over pi, full wells/s")
    lamps: tuple[LampSettings, ...] = Field(
        default=(
            LampSettings(direction=(0.25, 0.15, 1.0), irradiance=0.9),
            LampSettings(direction=(-1.0, 0.5, 1.0), irradiance=0.7),
            LampSettings(direction=(0.5, -1.2, 1.0), irradiance=0.5),
        ),
        description="panel lamps",
    )


@dataclass(frozen=True, eq=False)
class Points:
    """Surface points in the base frame: ``position`` and outward ``normal`` (N, 3), ``surface`` (N)."""

    position: FloatArray
    normal: FloatArray
    surface: Surface

    def __getitem__(self, chosen: IntArray) -> Points:
        return Points(self.position[chosen], self.normal[chosen], self.surface[chosen])

    @property
    def lifted(self) -> FloatArray:
        """(N, 3) where rays may start without meeting the surface they leave."""
        return self.position + SURFACE_OFFSET_M * self.normal


@dataclass(frozen=True, eq=False)
class LightMaps:
    """Radiance towards a camera, (H, W) each, by the way it came.

    Attributes
    ----------
    direct
        From the projector, for a fully bright slide.
    bounced
        From the projector by way of one other surface, for a fully bright slide.
    room
        From lamps and dome.
    points_base
        (H, W, 3) what each pixel sees, NaN for nothing.
    """

    direct: FloatArray
    bounced: FloatArray
    room: FloatArray
    points_base: FloatArray


class World:
    """Parts at poses with their materials, ready for rays."""

    def __init__(self, parts: Sequence[tuple[Part, FloatArray]]) -> None:
        self.rays = RayScene(parts)
        self._surfaces = [surface_table(part.materials) for part, _ in parts]
        self._names = [part.materials for part, _ in parts]
        self._materials = [part.triangle_material for part, _ in parts]

    def hit(self, origins: FloatArray, directions: FloatArray) -> tuple[IntArray, Points]:
        """Return which of N rays (N, 3) hit something, and the points they hit."""
        hits = self.rays.cast(origins, directions)
        chosen = np.flatnonzero(hits.instance >= 0)
        origins, directions = np.broadcast_arrays(origins, directions)
        position = origins[chosen] + directions[chosen] * hits.distance[chosen, None]
        table = np.zeros((3, len(chosen)))
        instance, triangle = hits.instance[chosen], hits.triangle[chosen]
        for index, (surface, material) in enumerate(zip(self._surfaces, self._materials, strict=True)):
            mine = np.flatnonzero(instance == index)
            which = material[triangle[mine]]
            diffuse = surface.diffuse[which] * printed(self._names[index], which, position[mine])
            table[:, mine] = diffuse, surface.f0[which], surface.alpha[which]
        return chosen, Points(position, hits.normals[chosen], Surface(table[0], table[1], table[2]))


@dataclass(frozen=True, eq=False)
class Illumination:
    """All light sources at one pose of the camera."""

    settings: LightSettings
    projector: LightProjector
    base_T_projector: FloatArray
    world: World

    def maps(self, camera: PinholeCamera, base_T_camera: FloatArray, projector_on: bool) -> LightMaps:
        """Trace what ``camera`` at ``base_T_camera`` sees and return its light, apart by the way it came."""
        directions = rotate(base_T_camera, camera.pixel_rays()).reshape(-1, 3)
        seen, points = self.world.hit(base_T_camera[:3, 3], directions)
        to_camera = -unit(directions[seen])
        direct = self.from_projector(points, to_camera) if projector_on else np.zeros(len(seen))
        bounced, mirrored_room = self._mirrored(points, to_camera, projector_on)
        room = self._from_lamps(points, to_camera) + self._from_dome(points) + mirrored_room
        shape = (camera.height, camera.width)
        position = np.full((*shape, 3), np.nan)
        position.reshape(-1, 3)[seen] = points.position
        return LightMaps(
            _scattered(direct, seen, shape), _scattered(bounced, seen, shape), _scattered(room, seen, shape), position
        )

    def from_projector(self, points: Points, to_camera: FloatArray) -> FloatArray:
        """Return radiance (N,) towards ``to_camera``: lit if in the cone, turned to the projector and not shadowed."""
        source = self.base_T_projector[:3, 3]
        irradiance, to_light = self._projected(points)
        lit = np.flatnonzero(irradiance > 0)
        lit = lit[~self.world.rays.blocked(points[lit].lifted, source)]
        radiance = np.zeros(len(irradiance))
        brdf = reflectance(points.surface[lit], to_light[lit], to_camera[lit], points.normal[lit])
        radiance[lit] = brdf * irradiance[lit]
        return radiance

    def _projected(self, points: Points) -> tuple[FloatArray, FloatArray]:
        """Return the irradiance (N,) on unshadowed points, I cos / d^2, and the directions to the projector."""
        in_projector = transform_points(invert(self.base_T_projector), points.position)
        offset = self.base_T_projector[:3, 3] - points.position
        distance_squared = dot(offset, offset)
        to_light = offset / np.sqrt(distance_squared)[:, None]
        off_axis = np.clip(in_projector[:, 2] / np.sqrt(distance_squared), 0.0, 1.0)
        intensity = self.settings.projector_intensity * off_axis**self.settings.projector_vignetting
        cosine = np.maximum(dot(points.normal, to_light), 0.0)
        return np.where(self.projector.lights(in_projector), intensity * cosine / distance_squared, 0.0), to_light

    def _from_lamps(self, points: Points, to_camera: FloatArray) -> FloatArray:
        radiance = np.zeros(len(points.position))
        for lamp in self.settings.lamps:
            direction = unit(np.array(lamp.direction))
            cosine = points.normal @ direction
            facing = np.flatnonzero(cosine > 0)
            start = points[facing].lifted
            facing = facing[~self.world.rays.blocked(start, start + LAMP_DISTANCE_M * direction)]
            surface = points.surface[facing].widened(lamp.half_angle_rad)
            to_light = np.broadcast_to(direction, (len(facing), 3))
            brdf = reflectance(surface, to_light, to_camera[facing], points.normal[facing])
            radiance[facing] += brdf * cosine[facing] * lamp.irradiance
        return radiance

    def _from_dome(self, points: Points) -> FloatArray:
        """Diffuse light of the dome; its share over the horizon is that of a plane tilted like the point."""
        return points.surface.diffuse * self.settings.dome * (1.0 + points.normal[:, 2]) / 2.0

    def _dome_radiance(self, directions: FloatArray) -> FloatArray:
        """Return the radiance (N,) the dome shows in unit directions: walls, and a ceiling 4.5 times as bright."""
        upwards = directions[:, 2]
        return np.where(upwards > 0, self.settings.dome * (0.3 + 1.05 * upwards), 0.0)

    def _mirrored(self, points: Points, to_camera: FloatArray, projector_on: bool) -> tuple[FloatArray, FloatArray]:
        """Return what shiny points mirror (N,): light of the projector by way of another surface, and of the room.

        One ray in the mirror direction stands for the lobe. What it meets is lit without further bounces; of the room
        it shows the diffuse share.
        """
        bounced, room = np.zeros(len(points.position)), np.zeros(len(points.position))
        shiny = np.flatnonzero((points.surface.f0 > 0) & (dot(points.normal, to_camera) > 0))
        mirror, view = points[shiny], to_camera[shiny]
        cosine = dot(mirror.normal, view)
        reflected = 2.0 * cosine[:, None] * mirror.normal - view
        share = fresnel(mirror.surface.f0, cosine)
        met, others = self.world.hit(mirror.lifted, reflected)
        room[shiny] = share * self._dome_radiance(reflected)
        room[shiny[met]] = share[met] * (self._from_dome(others) + self._diffuse_lamps(others))
        if projector_on:
            bounced[shiny[met]] = share[met] * self.from_projector(others, -reflected[met])
        return bounced, room

    def _diffuse_lamps(self, points: Points) -> FloatArray:
        """Lambert light of the lamps, unshadowed: seen in a mirror only."""
        irradiance = np.zeros(len(points.position))
        for lamp in self.settings.lamps:
            irradiance += lamp.irradiance * np.maximum(points.normal @ unit(np.array(lamp.direction)), 0.0)
        return points.surface.diffuse / np.pi * irradiance


def _scattered(values: FloatArray, at: IntArray, shape: tuple[int, int]) -> FloatArray:
    image = np.zeros(shape)
    image.reshape(-1)[at] = values
    return image
