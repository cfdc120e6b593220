"""The simulated active stereo camera: it makes depth from its images, as a real one does.

``capture`` renders both cameras under the projector's patterns and matches them. Where depth is missing, the images
lacked what the matcher needs; no formula decides it. ``true_depth_m`` is the truth, for evaluation only.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from sidelong.geometry.camera_model import PinholeCamera, StereoRig
from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import invert
from sidelong.simulation.exposure import ExposureSettings, exposed
from sidelong.simulation.lighting import Illumination, LightMaps, LightSettings, World
from sidelong.simulation.pattern import DotPatterns, PatternSettings
from sidelong.simulation.stereo import StereoSettings, match
from sidelong.types import FloatArray, GrayImage, Projector


class SensorSettings(BaseModel):
    """All that makes up the simulated camera but its intrinsics."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    light: LightSettings = Field(default=LightSettings(), description="projector and room")
    pattern: PatternSettings = Field(default=PatternSettings(), description="the projector's slide")
    exposure: ExposureSettings = Field(default=ExposureSettings(), description="lens and pixel")
    stereo: StereoSettings = Field(default=StereoSettings(), description="the matcher")
    noise_seed: int = Field(default=0, ge=0, description="same seed, pose and request: same images")


@dataclass(frozen=True, eq=False)
class Shot:
    """One capture: both images (H, W), of the first pattern where dots were shown, and depth (H, W) if asked for."""

    left: GrayImage
    right: GrayImage
    depth_m: FloatArray | None


@dataclass(frozen=True, eq=False)
class _Eye:
    """One camera of a capture: its light, where on the slide each pixel lies (H, W, 2), and its pose (4, 4)."""

    maps: LightMaps
    slide_uv: FloatArray
    base_T_eye: FloatArray


class ActiveStereoSensor:
    """A stereo camera with a projector in front of posed parts.

    Parameters
    ----------
    rig
        Intrinsics, baseline, projector.
    parts
        Each part with its ``base_T_object``.
    settings
        Light, pattern, pixel, matcher.

    Raises
    ------
    UnknownNameError
        A part has a material that is not in the table.
    """

    def __init__(self, rig: StereoRig, parts: Sequence[tuple[Part, FloatArray]], settings: SensorSettings) -> None:
        self.rig = rig
        self.settings = settings
        self._world = World(parts)
        self._patterns = DotPatterns(settings.pattern, rig.projector)

    def capture(self, base_T_camera: FloatArray, projector: Projector, exposure_s: float, depth: bool) -> Shot:
        """Take one capture with the left camera at ``base_T_camera`` (4, 4).

        Depth always comes from the dot patterns at this exposure, whatever the images show.
        """
        sides = self._eyes(base_T_camera, projector_on=depth or projector is not Projector.OFF)
        patterns: list[list[GrayImage]] = []
        if depth:
            shown = [(Projector.DOTS, index) for index in range(self._patterns.count)]
            patterns = [[self._image(eye, each, exposure_s) for each in shown] for eye in sides]
        depth_m = match(patterns[0], patterns[1], self.rig, self.settings.stereo) if depth else None
        if depth and projector is Projector.DOTS:
            return Shot(patterns[0][0], patterns[1][0], depth_m)
        left, right = (self._image(eye, (projector, 0), exposure_s) for eye in sides)
        return Shot(left, right, depth_m)

    def true_depth_m(self, base_T_camera: FloatArray) -> FloatArray:
        """Return the depth (H, W) of a perfect sensor at this pose, NaN where it looks into the void."""
        return self._world.rays.render(self.rig.left, base_T_camera).depth_m

    def _eyes(self, base_T_camera: FloatArray, projector_on: bool) -> tuple[_Eye, _Eye]:
        """Trace what both cameras see; all images of the capture are made from that."""
        base_T_projector = base_T_camera @ self.rig.projector.left_T_projector
        light = Illumination(self.settings.light, self.rig.projector, base_T_projector, self._world)

        def eye(camera: PinholeCamera, base_T_eye: FloatArray) -> _Eye:
            maps = light.maps(camera, base_T_eye, projector_on)
            return _Eye(maps, self._patterns.slide_uv(maps.points_base, invert(base_T_projector)), base_T_eye)

        return eye(self.rig.left, base_T_camera), eye(self.rig.right, base_T_camera @ self.rig.left_T_right)

    def _image(self, eye: _Eye, shown: tuple[Projector, int], exposure_s: float) -> GrayImage:
        """Expose a camera to what the projector shows: a kind, and the number of a pattern."""
        noise = self._noise(eye.base_T_eye, shown, exposure_s)
        return exposed(self._radiance(eye, shown), exposure_s, self.settings.exposure, noise)

    def _radiance(self, eye: _Eye, shown: tuple[Projector, int]) -> FloatArray:
        projector, index = shown
        maps = eye.maps
        if projector is Projector.OFF:
            return maps.room
        if projector is Projector.WHITE:
            return maps.room + maps.direct + maps.bounced
        # a rough mirror smears the dots it passes on: over 2 cm a lobe of alpha 0.2 spreads further than a dot
        return maps.room + maps.direct * self._patterns.sample(index, eye.slide_uv) + maps.bounced * self._patterns.mean

    def _noise(self, base_T_eye: FloatArray, shown: tuple[Projector, int], exposure_s: float) -> np.random.Generator:
        """Return the noise of one image: a function of seed, pose, exposure and what is shown, and of nothing else."""
        what = f"{shown[0]} {shown[1]} {exposure_s!r}".encode()
        digest = hashlib.blake2b(np.ascontiguousarray(base_T_eye).tobytes() + what, digest_size=16).digest()
        return np.random.default_rng([self.settings.noise_seed, int.from_bytes(digest)])
