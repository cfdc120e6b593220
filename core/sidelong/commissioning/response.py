"""The response of the sensor from a recorded exposure bracket."""

from __future__ import annotations

from typing import Any

import numpy as np

from sidelong.calibration.response.fit import ResponseFit, fit_response
from sidelong.calibration.response.radiance_map import RadianceMap, merge_bracket
from sidelong.commissioning.documents import ResponseDocument
from sidelong.commissioning.figures import png, show_map
from sidelong.commissioning.made import Captures, Made, Progress
from sidelong.physics.response import LEVELS, Response
from sidelong.recorded.captures import Bracket


def make_response(captures: Captures, progress: Progress) -> Made:
    """Fit the response to the bracket of a data set.

    Raises
    ------
    DatasetError, ImageError
        A file is missing or cannot be used.
    CalibrationError
        The bracket cannot carry a response.
    """
    progress("response", 0, 3)
    bracket = captures.recorded.bracket()
    progress("response", 1, 3)
    fit = fit_response(bracket.images, bracket.exposures_s, bracket.names)
    progress("response", 2, 3)
    radiance = merge_bracket(bracket.images, bracket.exposures_s, fit.response, bracket.names)
    document = ResponseDocument(
        device_serial=captures.dataset.serial,
        inputs=captures.hashed(bracket.files),
        warnings=fit.warnings,
        log_exposure=tuple(float(g) for g in fit.response.log_exposure),
        standard_error=tuple(float(error) for error in fit.standard_error),
        exposures_s=bracket.exposures_s,
        samples=fit.samples,
        condition=fit.condition,
        residual_rms_ln=fit.residual_ln,
        residual_rms_grey=fit.noise_grey,
        image_residuals_grey={
            name: float(residual)
            for name, residual in zip(fit.names, fit.image_residual_grey, strict=True)
            if np.isfinite(residual)
        },
    ).sealed()
    picture = draw_response(fit, radiance, bracket)
    progress("response", 3, 3)
    summary = (
        f"{fit.samples} samples of {len(fit.names)} images, residuals {fit.noise_grey:.2f} grey levels, "
        f"g off by at most {fit.standard_error[16:240].max():.3f} ln units"
    )
    return Made(document, picture, summary)


def draw_response(fit: ResponseFit, radiance: RadianceMap, bracket: Bracket) -> bytes:
    """Draw the curve with what the images say of it, the radiance map, and where the images disagree; return a PNG."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(15, 4.6), dpi=100, layout="constrained")
    curve, light, residual = figure.subplots(1, 3)
    levels = np.arange(LEVELS)
    g = fit.response.log_exposure
    for index in np.argsort(bracket.exposures_s):
        z, log_exposure = _points(bracket, radiance, int(index))
        curve.plot(log_exposure, z, ".", markersize=2, alpha=0.4, label=f"{bracket.exposures_s[index] * 1e3:g} ms")
    curve.fill_betweenx(levels, g - 1.96 * fit.standard_error, g + 1.96 * fit.standard_error, color="black", alpha=0.2)
    curve.plot(g, levels, color="black", linewidth=1.5, label="fitted")
    curve.plot(Response.gamma().log_exposure, levels, color="grey", linestyle=":", label="linear")
    curve.set_xlim(float(g[1]) - 1, 1.0)
    curve.set_xlabel("ln exposure, saturation = 0")
    curve.set_ylabel("grey level")
    curve.legend(fontsize=7, markerscale=4)
    curve.set_title(f"response, residuals {fit.noise_grey:.2f} grey levels")
    known = radiance.radiance > 0
    shown = np.log(np.where(known, radiance.radiance, np.nan))
    show_map(figure, light, shown, "ln radiance, saturation exposures per second")
    show_map(figure, residual, radiance.residual_grey, "disagreement of the images, grey levels", limits=(0.0, 5.0))
    return png(figure)


def _points(bracket: Bracket, radiance: RadianceMap, index: int) -> tuple[Any, Any]:
    """Return grey levels and ln exposures of some pixels of an image that all the images speak of."""
    rows, columns = np.nonzero(np.isfinite(radiance.residual_grey) & (radiance.radiance > 0))
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), 1500)).astype(np.intp)
    rows, columns = rows[chosen], columns[chosen]
    z = bracket.images[index][rows, columns]
    log_exposure = np.log(radiance.radiance[rows, columns] * bracket.exposures_s[index])
    inside = (z > 0) & (z < LEVELS - 1)
    return z[inside], log_exposure[inside]
