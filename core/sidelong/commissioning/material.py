"""The reflectance of a part's materials from white images and the depth of the same scene, sprayed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sidelong.calibration.normals import informative_normals
from sidelong.calibration.reflectance.fit import fit_reflectance
from sidelong.calibration.reflectance.result import ReflectanceFit
from sidelong.calibration.reflectance.samples import (
    CaptureSamples,
    Exposed,
    MaterialSamples,
    ProjectorLight,
    joined,
    reflectance_samples,
)
from sidelong.calibration.reflectance.sprayed_scene import SprayedScene
from sidelong.calibration.white_pattern import WhiteImage, WhitePattern
from sidelong.commissioning.documents import LightUsed, MaterialDocument
from sidelong.commissioning.made import Captures, Made, Progress, parameter
from sidelong.commissioning.material_picture import draw_material
from sidelong.commissioning.tasks import MaterialTask
from sidelong.errors import CalibrationError, DepthError
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.planning.light import DEFAULT_INTENSITY, LightSettings
from sidelong.recorded.captures import SprayedCapture
from sidelong.types import GrayImage, IntArray

DARK_GREY, LEAST_LIT = 5, 1e-3
"""Grey levels above the dark image that are light, and the share of such pixels in a capture that shows something."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """What all materials of a capture share."""

    part: Part
    capture: SprayedCapture
    labels: IntArray
    white: WhiteImage
    light: LightSettings
    projector: ProjectorLight
    samples: CaptureSamples


def make_materials(task: MaterialTask, captures: Captures, progress: Progress) -> Iterator[Made]:
    """Fit the materials of a part, each that has pixels, or the one that is asked for.

    Raises
    ------
    DatasetError, ImageError, PoseError, MeshError
        A file is missing or cannot be used.
    CalibrationError
        The captures cannot carry a fit, camera or scene moved between them, or calibrations do not fit the device.
    """
    progress("samples", 0, 1)
    seen = _see(captures)
    progress("samples", 1, 1)
    wanted = _wanted(task, seen)
    for done, index in enumerate(wanted):
        progress("materials", done, len(wanted))
        yield _made(captures, seen, index)
    progress("materials", len(wanted), len(wanted))


def _see(captures: Captures) -> _Seen:
    """Read the captures and turn them into samples of each material."""
    if captures.object is None:
        raise CalibrationError("object: a material is calibrated on a part, name the object whose captures they are")
    capture, rig = captures.recorded.sprayed(), captures.dataset.rig
    part, light = captures.dataset.part(captures.object), captures.settings().light
    projector = ProjectorLight(light.intensity or DEFAULT_INTENSITY, light.fall_off, light.vignetting)
    labels = _labels(capture, captures, part)
    try:
        normals, _ = informative_normals(capture.depth_m, rig.left, labels >= 0)
    except DepthError as error:
        raise CalibrationError(f"{capture.files[0].with_name('DEPTH_sprayed.png')}: {error}") from error
    scene = SprayedScene(
        depth_m=capture.depth_m,
        normals_camera=normals.normals_camera,
        normal_sigma_rad=normals.sigma_rad,
        labels=labels,
    )
    white = _white(capture.left)
    _check_lit(white.image, capture)
    right = _white(capture.right).image if capture.right else None
    room = capture.room
    off = None if room is None else Exposed(room.left, room.right, room.exposure_s)
    lit = [Exposed(white.image, right, capture.exposure_s)]
    lit += [Exposed(other.left, other.right, other.exposure_s) for other in capture.others]
    taken = [reflectance_samples(each, scene, rig, light.response(), projector, off) for each in lit]
    return _Seen(part, capture, labels, white, light, projector, joined(taken))


def _white(images: tuple[GrayImage, ...]) -> WhiteImage:
    pattern = WhitePattern()
    for image in images:
        pattern.add(image)
    return pattern.result()


def _check_lit(white: GrayImage, capture: SprayedCapture) -> None:
    """Refuse an image without the projector's light: all materials would seem to absorb it."""
    room = capture.room
    beside = room.left if room is not None and room.exposure_s == capture.exposure_s else np.zeros_like(white)
    lit = white.astype(np.intp) - beside > DARK_GREY
    if lit.mean() < LEAST_LIT:
        raise CalibrationError(
            f"{capture.files[0]}: at {capture.exposure_s * 1e3:g} ms {int(lit.sum())} of {lit.size} px are more than "
            f"{DARK_GREY} grey levels brighter than without the projector, needs {LEAST_LIT:.1%}: did it show the "
            "white pattern? Expose longer"
        )


def _labels(capture: SprayedCapture, captures: Captures, part: Part) -> IntArray:
    """Return the material of each pixel (H, W), -1 for none: by the poses where there are some, else by the mask."""
    mask = capture.mask
    if capture.base_T_objects:
        scene = RayScene([(part, pose) for pose in capture.base_T_objects])
        seen = scene.render(captures.dataset.rig.left, capture.base_T_camera)
        labels = np.where(seen.instance >= 0, part.triangle_material[np.maximum(seen.triangle, 0)], -1)
        return labels if mask is None else np.where(mask, labels, -1)
    if len(part.materials) > 1:
        raise CalibrationError(
            f"{part.name}: has {len(part.materials)} materials ({', '.join(part.materials)}); to tell their pixels "
            "apart the poses of the parts are needed, in GT_world2obj.json"
        )
    if mask is None:
        raise CalibrationError(
            f"{part.name}: which pixels show parts is not known; needs GT_world2obj.json or mask_parts.png"
        )
    return np.where(mask, 0, -1).astype(np.intp)


def _wanted(task: MaterialTask, seen: _Seen) -> list[int]:
    part, samples = seen.part, seen.samples
    known = [index for index in range(len(part.materials)) if index in samples.materials]
    if task.material is None:
        if not known:
            raise CalibrationError(
                f"{part.name}: no material has a usable pixel: of {int((seen.labels >= 0).sum())} px on parts "
                f"{int((seen.labels >= 0)[np.isfinite(seen.capture.depth_m)].sum())} have depth, and none of these is "
                "lit, has a normal and lies off the edges: look from nearer, or at a larger part"
            )
        return known
    if task.material not in part.materials:
        raise CalibrationError(f"material: {task.material!r} is none of {part.name}'s: {', '.join(part.materials)}")
    index = part.materials.index(task.material)
    if index not in known:
        raise CalibrationError(f"{part.name}: material {task.material} has no usable pixel: is it seen and lit?")
    return [index]


def _made(captures: Captures, seen: _Seen, index: int) -> Made:
    name, mine = seen.part.materials[index], seen.samples.materials[index]
    response, exposure_s = seen.light.response(), seen.capture.exposure_s
    try:
        fit = fit_reflectance(mine.samples, sensor=(response, exposure_s))
    except CalibrationError as error:
        raise CalibrationError(f"{seen.part.name}: material {name}: {error}") from error
    document = _document(captures, seen, name, fit)
    picture = draw_material(fit, mine, name, seen.white.image, (response, exposure_s))
    return Made(document, picture, _summary(fit, mine))


def _document(captures: Captures, seen: _Seen, name: str, fit: ReflectanceFit) -> MaterialDocument:
    merged = () if len(seen.capture.left) == 1 or seen.white.warning is None else (seen.white.warning,)
    return MaterialDocument(
        device_serial=captures.dataset.serial,
        inputs=captures.hashed(seen.capture.files),
        uses=captures.used("response", "projector"),
        warnings=(*merged, *seen.samples.warnings, *fit.warnings),
        material=name,
        part=seen.part.name,
        light=LightUsed(
            intensity=seen.projector.intensity, fall_off=seen.projector.fall_off, vignetting=seen.projector.vignetting
        ),
        k_d=parameter(fit.parameters["k_d"]),
        k_s=parameter(fit.parameters["k_s"]),
        n=parameter(fit.parameters["n"]),
        absorbing=fit.absorbing,
        samples=fit.used,
        saturated=fit.saturated,
        dark=fit.dark,
        residual_rms_relative=_finite(fit.relative_rms),
        residual_rms_grey=_finite(fit.residual_rms_grey),
    ).sealed()


def _finite(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


def _summary(fit: ReflectanceFit, mine: MaterialSamples) -> str:
    if fit.absorbing:
        return f"absorbs: nothing above the noise in {fit.used} samples"
    words = (
        f"{name} {each.value:.3g}" + (f" ({each.low:.3g} to {each.high:.3g})" if each.identified else f" ({each.note})")
        for name, each in fit.parameters.items()
    )
    return f"{', '.join(words)}; {fit.used} of {len(mine.samples)} samples"
