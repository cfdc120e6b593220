"""Puts calibrations into the settings of a scan, where they fit the device and each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from sidelong.commissioning.documents import (
    Document,
    HandEyeDocument,
    MaterialDocument,
    NoiseDocument,
    ProjectorDocument,
    ResponseDocument,
    SensingDocument,
)
from sidelong.errors import CalibrationError
from sidelong.planning.light import LightSettings, MaterialSettings
from sidelong.recipe import Recipe
from sidelong.types import FloatArray

Kind = TypeVar("Kind", bound=Document)
LIGHT = (ResponseDocument, ProjectorDocument, MaterialDocument)
"""Kinds that change the exposure which is predicted."""


def calibrated(recipe: Recipe, documents: Sequence[Document], device_serial: str) -> Recipe:
    """Return a recipe with what calibrations know in the place of presets; it names them under ``calibrations``.

    Parameters
    ----------
    recipe
        Settings. What a calibration knows goes before what they say.
    documents
        Calibrations, at most one of a kind, and one of a material.
    device_serial
        Of the camera that scans.

    Raises
    ------
    CalibrationError
        A calibration is of another device, there are two of a kind, or one was made with a calibration that is not
        among these.
    """
    unknown = sorted(set(recipe.calibrations) - {document.id for document in documents})
    if unknown:
        raise CalibrationError(f"recipe.calibrations: names {', '.join(unknown)}, which is not at hand")
    if not documents:
        return recipe
    _check(documents, device_serial)
    light = _light(recipe.light, documents)
    sensing = recipe.sensing
    curve = _the(documents, SensingDocument)
    if curve is not None:
        sensing = sensing.model_copy(update={"curve": curve.curve})
    fusion = recipe.fusion
    noise = _the(documents, NoiseDocument)
    if noise is not None:
        fusion = fusion.model_copy(update={"noise": noise.noise})
    names = tuple(document.id for document in documents)
    return recipe.model_copy(update={"light": light, "sensing": sensing, "fusion": fusion, "calibrations": names})


def calibrated_mount(flange_T_camera: FloatArray, documents: Sequence[Document]) -> FloatArray:
    """Return the hand-eye transform (4, 4) of a calibration where there is one, else the given one."""
    hand_eye = _the(documents, HandEyeDocument)
    return flange_T_camera if hand_eye is None else np.array(hand_eye.flange_T_camera).reshape(4, 4)


def _check(documents: Sequence[Document], device_serial: str) -> None:
    names = {document.id for document in documents}
    seen: dict[str, str] = {}
    for document in documents:
        if document.device_serial != device_serial:
            raise CalibrationError(
                f"calibration {document.id}: is of device {document.device_serial!r}, the camera is {device_serial!r}"
            )
        what = f"material {document.material}" if isinstance(document, MaterialDocument) else document.kind
        if what in seen:
            raise CalibrationError(f"calibrations {seen[what]} and {document.id} are both of {what}: name one of them")
        seen[what] = document.id
        lacking = sorted(set(document.uses) - names)
        if lacking:
            raise CalibrationError(
                f"calibration {document.id}: was made with {', '.join(lacking)}, which is not named beside it"
            )
    sensing = _the(documents, SensingDocument)
    light = {document.id for document in documents if isinstance(document, LIGHT)}
    beyond = sorted(light - set(sensing.uses)) if sensing is not None else []
    if sensing is not None and beyond:
        raise CalibrationError(
            f"calibration {sensing.id}: was learned without {', '.join(beyond)}, and exposures change with it: learn "
            "it again"
        )


def _light(light: LightSettings, documents: Sequence[Document]) -> LightSettings:
    response, projector = _the(documents, ResponseDocument), _the(documents, ProjectorDocument)
    sensing = _the(documents, SensingDocument)
    materials = [document for document in documents if isinstance(document, MaterialDocument)]
    changes: dict[str, object] = {}
    if response is not None:
        changes["response_table"] = response.log_exposure
    if projector is not None:
        changes |= {"intensity": projector.intensity.value, "vignetting": projector.vignetting.value, "fall_off": True}
    elif materials:
        changes |= materials[0].light.model_dump()
    elif sensing is not None:
        # the curve is over exposures as they were reckoned then
        changes |= sensing.light.model_dump()
    light = light.model_copy(update=changes)
    if not materials:
        return light
    for document in materials:
        _check_light(document, light)
    known = {document.material: _material(document, light.intensity or 1.0) for document in materials}
    return light.model_copy(update={"materials": {**light.materials, **known}})


def _check_light(document: MaterialDocument, light: LightSettings) -> None:
    for name in ("fall_off", "vignetting"):
        used, now = getattr(document.light, name), getattr(light, name)
        if used != now:
            raise CalibrationError(
                f"calibration {document.id}: was fitted with light.{name} {used}, the scan has {now}: fit it again"
            )


def _material(document: MaterialDocument, intensity: float) -> MaterialSettings:
    """Return a reflectance under another intensity: only the product of both was ever measured."""
    share = document.light.intensity / intensity
    return MaterialSettings(
        k_d=document.k_d.value * share,
        k_s=document.k_s.value * share,
        n=document.n.value,
        absorbing=document.absorbing,
    )


def _the(documents: Sequence[Document], kind: type[Kind]) -> Kind | None:
    return next((document for document in documents if isinstance(document, kind)), None)
