"""Samples of reflectance from a capture: a white image of the bare parts, depth and normals of the sprayed ones.

Kept are pixels inside a material, off edges, lit by the projector and seen by the camera in question. Whether light
came by way of another surface cannot be told from one image: a robust fit takes what remains of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.calibration.reflectance.model import ReflectanceSamples, stacked
from sidelong.calibration.reflectance.registration import Registration, check_registration
from sidelong.calibration.reflectance.sprayed_scene import SprayedScene, projector_camera, sound_pixels, unhidden
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.transforms import invert, transform_points
from sidelong.physics.reflectance import fall_off, vignetting
from sidelong.physics.response import LEVELS, Response
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray


class SampleSettings(BaseModel):
    """Which pixels become samples."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    edge_px: int = Field(default=3, ge=0, le=50, description="distance kept from the border of a material")
    step_share: FiniteFloat = Field(
        default=0.015, gt=0, le=1, description="depth step between neighbours that is an edge"
    )
    shadow_tolerance_m: FiniteFloat = Field(default=4e-3, gt=0, le=0.1, description="depth that is not another surface")
    noise_grey: FiniteFloat = Field(default=1.5, gt=0, le=50, description="standard deviation of a grey level")
    saturated_grey: int = Field(default=254, ge=2, le=LEVELS - 1, description="from here on only a lower bound")
    dark_grey: int = Field(default=3, ge=0, le=100, description="up to here only an upper bound")
    tile_px: int = Field(default=8, ge=1, le=200, description="pixels of a square this wide share their errors")
    largest_shift_px: FiniteFloat = Field(
        default=2.0, gt=0, le=8, description="shift between image and depth beyond which they do not belong together"
    )


@dataclass(frozen=True)
class ProjectorLight:
    """The projector: intensity on its axis at 1 m in saturation exposures per second, and how it falls.

    Attributes
    ----------
    intensity
        On the axis, at 1 m.
    fall_off
        Whether it falls with the squared distance.
    vignetting
        Power of the cosine of the off-axis angle.
    """

    intensity: float
    fall_off: bool = True
    vignetting: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.intensity < np.inf:
            raise CalibrationError(f"light: intensity is {self.intensity}, needs a positive finite number")
        if not 0 <= self.vignetting < np.inf:
            raise CalibrationError(f"light: vignetting is {self.vignetting}, needs a finite number of at least 0")

    def incident(self, points_projector: FloatArray) -> FloatArray:
        """Return L_in (...) at points (..., 3) in the projector's frame."""
        distance = np.linalg.norm(points_projector, axis=-1)
        axial = np.divide(points_projector[..., 2], distance, out=np.zeros_like(distance), where=distance > 0)
        reached = fall_off(self.intensity, distance) if self.fall_off else np.full(distance.shape, self.intensity)
        return reached * vignetting(axial, self.vignetting)


@dataclass(frozen=True, eq=False)
class Exposed:
    """An image pair at one exposure: ``left`` (H, W) 8 bit, ``right`` likewise or None, ``exposure_s``."""

    left: GrayImage
    right: GrayImage | None
    exposure_s: float


@dataclass(frozen=True, eq=False)
class MaterialSamples:
    """Samples of one material.

    Attributes
    ----------
    samples
        N measurements.
    pixels
        (N, 2) row and column in the left image; of the right image's samples, of the same point.
    right
        (N,) which come from the right image.
    dropped
        Pixels of the material that gave no sample in the left image, by reason.
    """

    samples: ReflectanceSamples
    pixels: IntArray
    right: BoolArray
    dropped: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class CaptureSamples:
    """Samples of a capture.

    Attributes
    ----------
    materials
        By label; a material without usable pixels has no entry.
    registration
        How image and depth fit; None where there was nothing to compare.
    warnings
        What a reader should know.
    """

    materials: Mapping[int, MaterialSamples]
    registration: Registration | None
    warnings: tuple[str, ...]


DEFAULTS = SampleSettings()


def reflectance_samples(
    white: Exposed,
    scene: SprayedScene,
    rig: StereoRig,
    response: Response,
    light: ProjectorLight,
    off: Exposed | None = None,
    settings: SampleSettings = DEFAULTS,
) -> CaptureSamples:
    """Return the samples of each material of a capture.

    Parameters
    ----------
    white
        Capture of the bare scene under a white pattern.
    scene
        Depth, normals and materials of the sprayed scene.
    rig, response, light
        Cameras and projector, sensor, light.
    off
        Capture of the bare scene with the projector off, at any exposure: its radiance, the room's, is subtracted.
        Without it the room is taken for dark.
    settings
        Which pixels count.

    Raises
    ------
    CalibrationError
        Images and maps differ in size, the exposure is not positive, no pixel has a material and depth, or image and
        depth do not belong together because the camera moved between the scans.
    """
    _validate(white, scene, rig, off)
    kept, dropped = sound_pixels(scene, settings.edge_px, settings.step_share)
    finite = np.isfinite(scene.depth_m)
    points = rig.left.pixel_rays() * np.where(finite, scene.depth_m, 1.0)[..., None]
    in_projector = transform_points(invert(rig.projector.left_T_projector), points)
    seen = unhidden(in_projector, finite, projector_camera(rig), settings.shadow_tolerance_m)
    lit = rig.projector.lights(in_projector) & seen
    dropped["shadow"] = kept & ~lit
    surface = _Surface(scene, rig, points, light.incident(in_projector), settings)
    # edges have no place among the samples, but they are where a shift shows
    registration = check_registration(
        white.left, surface.cosines(), np.where(lit, scene.labels, -1), settings.largest_shift_px
    )
    found = [surface.left(kept & lit, white, off, response)]
    if white.right is not None:
        found.append(surface.right(kept & lit, finite, white, off, response))
    warnings = {
        "image and depth could not be compared well enough to notice that the camera moved by 3 px": (
            registration is None or not registration.conclusive
        ),
        "no capture with the projector off: the room's light counts as the projector's": off is None,
    }
    return CaptureSamples(
        materials=MappingProxyType(_by_material(found, scene.labels, dropped)),
        registration=registration,
        warnings=tuple(text for text, applies in warnings.items() if applies),
    )


def joined(captures: Sequence[CaptureSamples]) -> CaptureSamples:
    """Join the samples of one scene at several exposures: what saturates in one is measured in another.

    Pixels that were dropped, and how image and depth fit, are those of the first.
    """
    first = captures[0]
    materials: dict[int, MaterialSamples] = {}
    for label in {label: None for each in captures for label in each.materials}:
        mine = [each.materials[label] for each in captures if label in each.materials]
        materials[label] = MaterialSamples(
            samples=stacked([each.samples for each in mine]),
            pixels=np.concatenate([each.pixels for each in mine]),
            right=np.concatenate([each.right for each in mine]),
            dropped=mine[0].dropped,
        )
    return CaptureSamples(
        materials, first.registration, tuple(dict.fromkeys(w for each in captures for w in each.warnings))
    )


def _validate(white: Exposed, scene: SprayedScene, rig: StereoRig, off: Exposed | None) -> None:
    wanted = (rig.left.height, rig.left.width)
    images = {"white left": white.left, "white right": white.right, "depth": scene.depth_m, "labels": scene.labels}
    images |= {"normal sigma": scene.normal_sigma_rad, "normals": scene.normals_camera}
    if off is not None:
        images |= {"off left": off.left, "off right": off.right}
    for name, image in images.items():
        if image is not None and image.shape[:2] != wanted:
            raise CalibrationError(
                f"{name}: is {image.shape[1]}x{image.shape[0]} px, the camera has {wanted[1]}x{wanted[0]} px"
            )
    for name, capture in (("white", white), ("off", off)):
        if capture is not None and not 0 < capture.exposure_s < np.inf:
            raise CalibrationError(f"{name}: its exposure is {capture.exposure_s} s, needs a positive finite number")
    known = int((np.isfinite(scene.depth_m) & (scene.labels >= 0)).sum())
    if known == 0:
        raise CalibrationError(
            "sprayed depth: 0 pixels have both a material and depth, needs some: check mask and depth"
        )


@dataclass(frozen=True, eq=False)
class _Found:
    """Samples of one eye and the left pixels (N, 2) they belong to."""

    samples: ReflectanceSamples
    pixels: IntArray
    right: bool


@dataclass(frozen=True, eq=False)
class _Surface:
    """What the sprayed scene says of each left pixel: points (H, W, 3) and incident light (H, W)."""

    scene: SprayedScene
    rig: StereoRig
    points: FloatArray
    light: FloatArray
    settings: SampleSettings

    def cosines(self) -> tuple[FloatArray, FloatArray]:
        """Return cos theta and cos alpha (H, W) for the left camera."""
        to_light, to_camera = self._towards(self.points, self._source), self._towards(self.points, np.zeros(3))
        normals = self.scene.normals_camera
        cos_theta, cos_camera = (np.einsum("...i,...i", each, normals) for each in (to_light, to_camera))
        return cos_theta, 2.0 * cos_theta * cos_camera - np.einsum("...i,...i", to_light, to_camera)

    def left(self, kept: BoolArray, white: Exposed, off: Exposed | None, response: Response) -> _Found:
        """Sample the left image."""
        room = None if off is None else _room(off.left[kept], off.exposure_s, response)
        measured = _radiance(white.left[kept].astype(np.float64), white.exposure_s, response, self.settings)
        return self._samples(np.argwhere(kept), np.zeros(3), measured, room, right=False)

    def right(
        self, kept: BoolArray, known: BoolArray, white: Exposed, off: Exposed | None, response: Response
    ) -> _Found:
        """Sample the right image where its camera sees the same points."""
        assert white.right is not None
        in_right = transform_points(invert(self.rig.left_T_right), self.points)
        seen = kept & unhidden(in_right, known, self.rig.right, self.settings.shadow_tolerance_m)
        uv = self.rig.right.project(in_right[seen])
        measured = _radiance(_bilinear(white.right, uv, self.settings), white.exposure_s, response, self.settings)
        room = None
        if off is not None and off.right is not None:
            room = _room(_bilinear(off.right, uv, self.settings), off.exposure_s, response)
        return self._samples(np.argwhere(seen), self.rig.left_T_right[:3, 3], measured, room, right=True)

    @property
    def _source(self) -> FloatArray:
        return self.rig.projector.left_T_projector[:3, 3]

    @staticmethod
    def _towards(points: FloatArray, origin: FloatArray) -> FloatArray:
        towards = origin - points
        return towards / np.linalg.norm(towards, axis=-1, keepdims=True)

    def _samples(
        self, pixels: IntArray, origin: FloatArray, measured: _Reading, room: FloatArray | None, *, right: bool
    ) -> _Found:
        rows, columns = pixels.T
        points = self.points[rows, columns]
        tiles = -(-self.rig.left.width // self.settings.tile_px)
        samples = ReflectanceSamples(
            radiance=measured.radiance - (0.0 if room is None else room),
            sigma=measured.sigma,
            light=self.light[rows, columns],
            to_light=self._towards(points, self._source),
            to_camera=self._towards(points, origin),
            normals=self.scene.normals_camera[rows, columns],
            # the rms angle is that of both tangent axes together
            normal_sigma_rad=self.scene.normal_sigma_rad[rows, columns] / np.sqrt(2.0),
            saturated=measured.saturated,
            dark=measured.dark,
            group=(rows // self.settings.tile_px) * tiles + columns // self.settings.tile_px,
        )
        return _Found(samples, pixels, right)


@dataclass(frozen=True, eq=False)
class _Reading:
    """Radiance and noise (N,) read from grey levels; where saturated or dark the radiance is a bound."""

    radiance: FloatArray
    sigma: FloatArray
    saturated: BoolArray
    dark: BoolArray


def _radiance(grey: FloatArray, exposure_s: float, response: Response, settings: SampleSettings) -> _Reading:
    """Read grey levels (N,)."""
    inner = np.clip(grey, max(settings.dark_grey, 1), settings.saturated_grey)
    levels, exposure = np.arange(LEVELS, dtype=np.float64), np.exp(response.log_exposure)
    return _Reading(
        radiance=np.interp(inner, levels, exposure) / exposure_s,
        sigma=settings.noise_grey * np.interp(inner, levels, np.gradient(exposure)) / exposure_s,
        saturated=grey >= settings.saturated_grey,
        dark=grey <= settings.dark_grey,
    )


def _room(grey: FloatArray | GrayImage, exposure_s: float, response: Response) -> FloatArray:
    """Return the radiance (N,) of the room; NaN, no sample, where it saturates by itself; 0 where nothing arrives."""
    z = grey.astype(np.float64)
    exposure = np.interp(z, np.arange(LEVELS, dtype=np.float64), np.exp(response.log_exposure))
    return np.where(z >= LEVELS - 2, np.nan, np.where(z < 1, 0.0, exposure)) / exposure_s


def _bilinear(image: GrayImage, uv: FloatArray, settings: SampleSettings) -> FloatArray:
    """Return grey levels (N,) between pixels; NaN, no sample, where of the four some are saturated and some not."""
    columns, rows = (np.clip(uv[:, axis], 0, image.shape[1 - axis] - 1) for axis in (0, 1))
    left, top = np.floor(columns).astype(np.intp), np.floor(rows).astype(np.intp)
    right, bottom = np.minimum(left + 1, image.shape[1] - 1), np.minimum(top + 1, image.shape[0] - 1)
    at = ((top, left), (top, right), (bottom, left), (bottom, right))
    corners = np.stack([image[each].astype(np.float64) for each in at])
    x, y = columns - left, rows - top
    grey = (np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]) * corners).sum(axis=0)
    clipped = (corners >= settings.saturated_grey).sum(axis=0)
    return np.where((clipped > 0) & (clipped < len(corners)), np.nan, grey)


def _by_material(found: list[_Found], labels: IntArray, dropped: Mapping[str, BoolArray]) -> dict[int, MaterialSamples]:
    """Split the samples of both eyes by the label of their pixel."""
    samples = stacked([each.samples for each in found])
    pixels = np.concatenate([each.pixels for each in found])
    right = np.concatenate([np.full(len(each.pixels), each.right) for each in found])
    material = labels[pixels[:, 0], pixels[:, 1]]
    return {
        int(label): MaterialSamples(
            samples[material == label],
            pixels[material == label],
            right[material == label],
            MappingProxyType({why: int((labels[where] == label).sum()) for why, where in dropped.items()}),
        )
        for label in np.unique(material)
    }
