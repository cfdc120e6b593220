"""The intensity of a projector that nobody has calibrated, from the white image that a data set may have."""

from __future__ import annotations

from sidelong.calibration.projector.white_image import fit_intensity
from sidelong.geometry.mesh import Part
from sidelong.planning.light import DEFAULT_INTENSITY
from sidelong.recipe import Recipe, light_model
from sidelong.recorded.dataset import Dataset


def lit_by_recording(recipe: Recipe, dataset: Dataset, object_name: str, part: Part) -> Recipe:
    """Return a recipe with an intensity: its own, else the one that fits the white image, else the default.

    Raises
    ------
    InputError
        A file of the white capture cannot be used, or its image says nothing of the light.
    """
    if recipe.light.intensity is not None:
        return recipe
    intensity, white = DEFAULT_INTENSITY, dataset.white_capture(object_name)
    if white is not None:
        fit = fit_intensity(white.frame, white.base_T_objects, part, dataset.rig, light_model(recipe, part))
        intensity = fit.intensity
    return recipe.model_copy(update={"light": recipe.light.model_copy(update={"intensity": intensity})})
