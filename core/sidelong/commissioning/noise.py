"""The noise of depth from recorded depth maps of a flat plate, or of repeated shots."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from sidelong.calibration.depth_noise.fit import FAR_PX, NoiseFit
from sidelong.calibration.depth_noise.plates import noise_from_plates
from sidelong.calibration.depth_noise.repeats import noise_from_repeats
from sidelong.calibration.depth_noise.table import LARGEST_SPREADS, RIM_EDGES_PX, spread_px
from sidelong.calibration.reflectance.result import Parameter as FittedParameter
from sidelong.commissioning.documents import NoiseDocument
from sidelong.commissioning.figures import png
from sidelong.commissioning.made import Captures, Made, Progress, parameter
from sidelong.commissioning.tasks import NoiseTask
from sidelong.types import FloatArray

FOLDERS = {"plate": "Plane", "repeats": "Repeats"}
"""Of a data set's ``Calibration``: ``DEPTH_<i>.png`` each. The planes are those the projector is calibrated with."""
SHOWN_SIGMAS = 6.0


def make_noise(task: NoiseTask, captures: Captures, progress: Progress) -> Made:
    """Fit the noise to the depth maps of a data set.

    Raises
    ------
    DatasetError, ImageError
        There are none, or a file cannot be used.
    CalibrationError
        They cannot carry the noise.
    """
    files = captures.recorded.depth_files(FOLDERS[task.method])
    depth_maps_m: dict[str, FloatArray] = {}
    for file in files:
        progress("depth maps", len(depth_maps_m), len(files) + 1)
        depth_maps_m[file.name] = captures.dataset.read_depth_m(file)
    progress("depth maps", len(files), len(files) + 1)
    rig = captures.dataset.rig
    fit = (noise_from_plates if task.method == "plate" else noise_from_repeats)(depth_maps_m, rig)
    document = NoiseDocument(
        device_serial=captures.dataset.serial,
        inputs=captures.hashed(files),
        warnings=fit.warnings,
        method=task.method,
        noise=fit.noise,
        parameters={name: parameter(each) for name, each in fit.parameters.items()},
        image_px=(rig.left.width, rig.left.height),
        captures=fit.captures,
        pixels=fit.pixels,
    ).sealed()
    picture = draw_noise(fit)
    progress("depth maps", len(files) + 1, len(files) + 1)
    return Made(document, picture, _summary(fit))


def _summary(fit: NoiseFit) -> str:
    at = fit.parameters
    told = (
        ("noise", at["disparity_px"], "px of disparity"),
        ("slope", at["slope_px"], "px"),
        ("rim", at["rim_px"], "px"),
        ("reach", at["rim_reach_px"], "px"),
        ("outliers", at["outlier_share"], ""),
        ("at rims", at["rim_outlier_share"], ""),
    )
    words = (f"{name} {each.value:.3g} {unit}".rstrip() + _doubt(each) for name, each, unit in told)
    return f"{', '.join(words)}; {fit.pixels} depths of {fit.captures} captures"


def _doubt(fitted: FittedParameter) -> str:
    return "" if fitted.identified else " (not identified)"


def draw_noise(fit: NoiseFit) -> bytes:
    """Draw the errors over their deviation, and the deviation by distance from rims and by slope; return a PNG."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(15, 4.6), dpi=100, layout="constrained")
    errors, rim, slope = figure.subplots(1, 3)
    _draw_errors(errors, fit)
    _draw_rim(rim, fit)
    _draw_slope(slope, fit)
    figure.suptitle(_summary(fit), fontsize=10)
    return png(figure)


def _draw_errors(axis: Any, fit: NoiseFit) -> None:
    ratio = np.concatenate([cell.error_px / fit.sigma_px(cell.gradient, cell.rim_px) for cell in fit.cells])
    inside = float((np.abs(ratio) < 1.96).mean())
    edges = np.linspace(-SHOWN_SIGMAS, SHOWN_SIGMAS, 97)
    axis.hist(np.clip(ratio, edges[0], edges[-1]), edges, density=True, color="0.6", label="measured, ends pile up")
    axis.plot(edges, np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi), color="black", label="Gaussian")
    axis.set_yscale("log")
    axis.set_ylim(1e-6, 2)
    axis.set_xlabel("error over its standard deviation")
    axis.set_title(f"{inside:.1%} within 1.96, deviation {_spread(ratio):.2f} without outliers", fontsize=10)
    axis.legend(fontsize=8)


def _draw_rim(axis: Any, fit: NoiseFit) -> None:
    rim_px = np.concatenate([cell.rim_px for cell in fit.cells])
    error_px = np.concatenate([cell.error_px for cell in fit.cells])
    gradient = float(np.sqrt(np.mean([cell.gradient**2 for cell in fit.cells])))
    for low, high in pairwise(RIM_EDGES_PX):
        inside = (rim_px >= low) & (rim_px < high)
        if inside.any():
            label = "measured" if low == RIM_EDGES_PX[0] else None
            axis.plot(min(float(rim_px[inside].mean()), 12.0), _spread(error_px[inside]), "o", color="C0", label=label)
    distance: FloatArray = np.linspace(1.0, 12.0, 100)
    axis.plot(distance, fit.sigma_px(gradient, distance), color="black", label="used")
    axis.set_ylim(bottom=0)
    axis.set_xlabel("distance from missing depth, px (12: and more)")
    axis.set_ylabel("deviation, px of disparity")
    axis.legend(fontsize=8)


def _draw_slope(axis: Any, fit: NoiseFit) -> None:
    gradient = [cell.gradient for cell in fit.cells]
    measured = [_spread(cell.error_px[cell.rim_px > FAR_PX[-1]]) for cell in fit.cells]
    axis.plot(gradient, measured, "o", label="measured, away from rims")
    steps: FloatArray = np.linspace(0.0, 1.2 * max(*gradient, 0.1), 100)
    used = [float(fit.sigma_px(float(each), np.array([np.inf]))[0]) for each in steps]
    axis.plot(steps, used, color="black", label="used")
    axis.set_ylim(bottom=0)
    axis.set_xlabel("change of disparity from pixel to pixel")
    axis.legend(fontsize=8)


def _spread(error: FloatArray) -> float:
    """Return the standard deviation without outliers."""
    inside = np.abs(error) <= LARGEST_SPREADS * spread_px(error)
    return float(np.sqrt(np.mean(error[inside] ** 2))) if inside.any() else 0.0
