"""The projector's intensity from one capture with a white pattern on parts whose poses are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from sidelong.errors import InputError
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import invert
from sidelong.physics.response import Response
from sidelong.planning.gain import LightModel, Planner
from sidelong.planning.prior import believe
from sidelong.types import BoolArray, DetectedObject, FloatArray, Frame, Hypothesis

USABLE_GREY = (8, 247)
REACH_LN = 0.9
"""How far from the convex minimum the intensity is looked for: a factor of 2.5 either way."""
FEWEST_PIXELS = 200
"""Pixels between the usable grey levels that one parameter needs; fewer say nothing of the light."""


@dataclass(frozen=True)
class LightFit:
    """Result of :func:`fit_intensity`.

    Attributes
    ----------
    intensity
        Of the projector at 1 m, in saturation exposures per second.
    mean_error_grey
        Mean absolute difference of predicted and measured grey level over the part pixels.
    pixels
        How many part pixels were compared.
    """

    intensity: float
    mean_error_grey: float
    pixels: int


def fit_intensity(
    white: Frame, base_T_objects: Sequence[FloatArray], part: Part, rig: StereoRig, light: LightModel
) -> LightFit:
    """Fit the one free parameter of the light model: grey levels predicted on the parts against those measured.

    The loss is the mean absolute difference in grey levels, clipping included on both sides, so that saturated and dark
    pixels say what they can.

    Parameters
    ----------
    white
        Capture with a white pattern.
    base_T_objects
        Poses of the parts in it.
    part, rig, light
        Geometry and all other parameters of the light model; its intensity is ignored.

    Raises
    ------
    InputError
        Fewer than ``FEWEST_PIXELS`` part pixels are neither black nor saturated.
    """
    camera_T_base = invert(white.view.base_T_camera)
    objects = [DetectedObject((Hypothesis(camera_T_base @ pose, 100.0, 1.0),)) for pose in base_T_objects]
    everywhere = np.ones(white.left.shape, dtype=np.bool_)
    belief = believe(objects, part, rig.left, white.view.base_T_camera, everywhere, stride_px=2)
    planner = Planner(belief, part, rig, replace(light, intensity=1.0))
    pixels, radiance = planner.left_radiance(white.view)
    lit = radiance > 0
    pixels, radiance = pixels[lit], radiance[lit]
    measured = white.left[pixels[:, 0], pixels[:, 1]].astype(np.float64)
    usable = (measured >= USABLE_GREY[0]) & (measured <= USABLE_GREY[1])
    if usable.sum() < FEWEST_PIXELS:
        raise InputError(
            f"{white.view.name}: {int(usable.sum())} part pixels lie between grey levels {USABLE_GREY[0]} and "
            f"{USABLE_GREY[1]}, the light intensity needs at least {FEWEST_PIXELS}"
        )

    def loss(log_intensity: float) -> float:
        predicted = light.response.intensity(np.exp(log_intensity) * radiance, white.exposure_s)
        return float(np.abs(predicted - measured).mean())

    # in grey levels the loss has flat ends (all black, all white), where it may be least of all, and several dips: look
    # for one near the minimum of a convex loss, and stay there where there is none
    likely = _likely(measured, usable, radiance, light.response, white.exposure_s)
    best = minimize_scalar(loss, bounds=(likely - REACH_LN, likely + REACH_LN), method="bounded")
    at_end = abs(best.x - likely) > 0.95 * REACH_LN
    log_intensity = likely if at_end else float(best.x)
    return LightFit(float(np.exp(log_intensity)), loss(log_intensity), len(measured))


def _likely(
    measured: FloatArray, usable: BoolArray, radiance: FloatArray, response: Response, exposure_s: float
) -> float:
    """Return the ln intensity with the least sum of |ln predicted - ln measured|, clipped pixels counting as bounds."""
    clipped = measured > USABLE_GREY[1]
    # the ln intensity at which each pixel would be right, or from which on (below which) it is
    ends = np.clip(measured, *USABLE_GREY)
    right = np.log(response.radiance(ends, exposure_s) / radiance)

    def loss(log_intensity: float) -> float:
        over = log_intensity - right
        return float(np.where(usable, np.abs(over), np.where(clipped, np.maximum(-over, 0), np.maximum(over, 0))).sum())

    low, high = float(right[usable].min()), float(right[usable].max())
    return float(minimize_scalar(loss, bounds=(low, high), method="bounded").x)
