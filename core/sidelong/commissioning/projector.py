"""The light of the projector from recorded captures of a matte plane."""

from __future__ import annotations

from typing import Any

import numpy as np

from sidelong.calibration.projector.fit import ProjectorFit, fit_projector
from sidelong.calibration.projector.matte_plane import PlaneCapture
from sidelong.calibration.reflectance.result import Parameter as FittedParameter
from sidelong.commissioning.documents import ProjectorDocument
from sidelong.commissioning.figures import png, show_map
from sidelong.commissioning.made import Captures, Made, Progress, parameter
from sidelong.commissioning.tasks import ProjectorTask
from sidelong.recorded.captures import RecordedPlane
from sidelong.types import FloatArray

SAMPLES_PER_BLOCK = 6
"""Of the picture, on average."""


def make_projector(task: ProjectorTask, captures: Captures, progress: Progress) -> Made:
    """Fit intensity, vignetting and fall-off to the plane captures of a data set.

    Raises
    ------
    DatasetError, ImageError
        A file is missing or cannot be used.
    CalibrationError
        The captures cannot carry the fit, or calibrations do not fit the device.
    """
    progress("projector", 0, 2)
    planes, files = captures.recorded.planes()
    progress("projector", 1, 2)
    response = captures.settings().light.response()
    fit = fit_projector([_capture(plane) for plane in planes], captures.dataset.rig, response, task.plane_k_d)
    document = ProjectorDocument(
        device_serial=captures.dataset.serial,
        inputs=captures.hashed(files),
        uses=captures.used("response"),
        warnings=fit.warnings,
        plane_k_d=task.plane_k_d,
        intensity=parameter(fit.intensity),
        vignetting=parameter(fit.vignetting),
        fall_off_exponent=parameter(fit.fall_off_exponent),
        samples=fit.samples,
        residual_rms_relative=fit.relative_rms,
    ).sealed()
    picture = draw_projector(fit, [plane.name for plane in planes])
    progress("projector", 2, 2)
    summary = (
        f"intensity {fit.intensity.value:.1f} saturation exposures/s at 1 m, "
        f"vignetting cos^{fit.vignetting.value:.2f}{_doubt(fit.vignetting)}, "
        f"fall-off 1/d^{fit.fall_off_exponent.value:.2f}{_doubt(fit.fall_off_exponent)}, "
        f"residuals {fit.relative_rms:.1%}"
    )
    return Made(document, picture, summary)


def _doubt(fitted: FittedParameter) -> str:
    return "" if fitted.identified else " (not identified)"


def _capture(plane: RecordedPlane) -> PlaneCapture:
    room = plane.room
    return PlaneCapture(
        name=f"LEFT_white_{plane.name}.bmp",
        left=plane.left,
        exposure_s=plane.exposure_s,
        depth_m=plane.depth_m,
        off=None if room is None else room.left,
        off_exposure_s=None if room is None else room.exposure_s,
    )


def draw_projector(fit: ProjectorFit, names: list[str]) -> bytes:
    """Draw where radiance and model differ on each plane; return a PNG."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(5 * len(names), 4.4), dpi=100, layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(names)))
    for axis, name, residual, distance_m in zip(axes, names, fit.residual, fit.distances_m, strict=True):
        title = f"plane {name}, {distance_m:.2f} m: radiance over model, %"
        show_map(figure, axis, 100 * np.expm1(_in_blocks(residual)), title, limits=(-10.0, 10.0), colours="RdBu_r")
    told = (fit.intensity, fit.vignetting, fit.fall_off_exponent)
    words = (
        f"{label} {each.value:.4g} ({each.low:.4g} to {each.high:.4g}){_doubt(each)}"
        for label, each in zip(("intensity", "vignetting", "fall-off"), told, strict=True)
    )
    figure.suptitle("; ".join(words), fontsize=11)
    return png(figure)


def _in_blocks(residual: FloatArray) -> FloatArray:
    """Return the mean of each block of pixels (h, w): single samples are too far apart to be seen."""
    known = np.isfinite(residual)
    edge = max(1, round(float(np.sqrt(SAMPLES_PER_BLOCK * residual.size / max(int(known.sum()), 1)))))
    rows, columns = np.nonzero(known)
    shape = (-(-residual.shape[0] // edge), -(-residual.shape[1] // edge))
    block = rows // edge * shape[1] + columns // edge
    count = np.bincount(block, minlength=shape[0] * shape[1])
    total = np.bincount(block, residual[known], minlength=len(count))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)
