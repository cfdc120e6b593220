"""What a fitted material looks like beside what was measured."""

from __future__ import annotations

from typing import Any

import numpy as np

from sidelong.calibration.reflectance.fit import usable_samples
from sidelong.calibration.reflectance.model import ReflectanceSamples
from sidelong.calibration.reflectance.result import ReflectanceFit
from sidelong.calibration.reflectance.samples import MaterialSamples
from sidelong.commissioning.figures import png, show_map
from sidelong.physics.reflectance import Phong, lambert, mirrored, specular
from sidelong.physics.response import Response
from sidelong.types import FloatArray, GrayImage

MOST_POINTS = 4000


def draw_material(
    fit: ReflectanceFit, mine: MaterialSamples, name: str, white: GrayImage, sensor: tuple[Response, float]
) -> bytes:
    """Draw the lobe with the samples, the white image, what the fit predicts of it, and the difference; return a PNG.

    Parameters
    ----------
    fit, mine, name
        The material, its samples, its name.
    white
        (H, W) left image under the white pattern.
    sensor
        Response and exposure (s) of it.
    """
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(16, 4.6), dpi=100, layout="constrained")
    lobe, measured, predicted, difference = figure.subplots(1, 4)
    _draw_lobe(lobe, fit, mine.samples)
    left = ~mine.right
    response, exposure_s = sensor
    z = response.intensity(model(mine.samples, fit.phong)[left], exposure_s)
    window = _window(mine.pixels[left], white.shape)
    shown = np.full(white.shape, np.nan)
    shown[tuple(mine.pixels[left].T)] = z
    seen = np.where(np.isfinite(shown), white.astype(np.float64), np.nan)
    show_map(figure, measured, seen[window], "measured grey level", (0.0, 255.0), "gray")
    show_map(figure, predicted, shown[window], "predicted grey level", (0.0, 255.0), "gray")
    show_map(figure, difference, (shown - seen)[window], "predicted less measured", (-80.0, 80.0), "RdBu_r")
    numbers = ", ".join(
        f"{key} {each.value:.3g}{'' if each.identified else ' (not identified)'}"
        for key, each in fit.parameters.items()
    )
    state = "absorbs: no depth is expected on it" if fit.absorbing else numbers
    figure.suptitle(f"{name}: {state}", fontsize=12)
    return png(figure)


def model(samples: ReflectanceSamples, material: Phong) -> FloatArray:
    """Return the radiance (N,) of equation (5) at the normals as measured."""
    reflected = mirrored(samples.to_light, samples.normals)
    diffuse = lambert(samples.light, samples.to_light, samples.normals)
    return material.k_d * diffuse + material.k_s * specular(samples.light, reflected, samples.to_camera, material.n)


def _draw_lobe(axis: Any, fit: ReflectanceFit, samples: ReflectanceSamples) -> None:
    """Draw radiance over incident light against alpha, measured and fitted."""
    chosen = np.flatnonzero(usable_samples(samples))
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), MOST_POINTS)).astype(np.intp)]
    reflected = mirrored(samples.to_light[chosen], samples.normals[chosen])
    alpha = np.arccos(np.clip(np.einsum("ij,ij->i", reflected, samples.to_camera[chosen]), -1.0, 1.0))
    share = samples.radiance[chosen] / samples.light[chosen]
    fitted = model(samples, fit.phong)[chosen] / samples.light[chosen]
    clipped = samples.saturated[chosen] | samples.dark[chosen]
    degrees = np.rad2deg(alpha)
    axis.plot(degrees[~clipped], share[~clipped], ".", markersize=2, alpha=0.4, label="measured")
    axis.plot(degrees[clipped], share[clipped], "x", markersize=2, alpha=0.3, label="clipped: a bound")
    axis.plot(degrees, fitted, ".", markersize=2, color="black", label="fitted")
    positive = fitted[fitted > 0]
    axis.set_yscale("log")
    if positive.size:
        axis.set_ylim(max(positive.min() / 5, 1e-5), positive.max() * 5)
    axis.set_xlabel("angle to the mirror direction, degrees")
    axis.set_ylabel("radiance over incident light")
    axis.legend(fontsize=8, markerscale=4)


def _window(pixels: FloatArray | Any, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the part of the image that holds the pixels, with a margin."""
    if not len(pixels):
        return slice(0, shape[0]), slice(0, shape[1])
    low, high = np.maximum(pixels.min(axis=0) - 10, 0), pixels.max(axis=0) + 11
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))
