"""Intensity, vignetting and fall-off of the projector from white captures of a matte plane.

On a matte plane E = I k_d cos(theta) cos(phi)^p / d^q with theta at the surface, phi off the projector's axis and d the
distance. Its logarithm is linear in ln(I k_d), p and q. Before a plane that faces the projector d is in proportion to
1 / cos(phi): p and q then act alike, and one such capture fixes only p + q.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sidelong.calibration.projector.matte_plane import (
    HUBER,
    ROUNDS,
    PlaneCapture,
    PlaneRows,
    ProjectorFitSettings,
    plane_rows,
)
from sidelong.calibration.reflectance.result import Parameter
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import StereoRig
from sidelong.physics.response import Response
from sidelong.types import FloatArray, IntArray

STANDARD_95 = 1.959964
LOBES_N = (10.0, 30.0, 100.0, 300.0)
"""Highlights that are looked for in the residual."""
LARGEST_HIGHLIGHT = 0.05
"""Share of the diffuse light at the mirror direction above which a plane counts as shiny."""
HIGHLIGHT_DEVIATIONS = 5.0
LEAST_ANGLE_RAD = np.deg2rad(8.0)
"""Range of phi below which vignetting leaves no trace."""
LARGEST_ERROR = 0.15
"""Standard error of an exponent up to which it is called identified."""
LEAST_DISTANCE_RATIO = 1.2
"""Farthest over nearest capture below which the fall-off is not told from vignetting."""
INVERSE_SQUARE = 2.0


@dataclass(frozen=True, eq=False)
class ProjectorFit:
    """Result of :func:`fit_projector`.

    Attributes
    ----------
    intensity
        At 1 m on the axis, saturation exposures per second. Where the plane's diffuse share was not stated it is that
        of intensity times share, and not identified.
    vignetting
        Power p of cos(phi), with light that falls as 1/d^2.
    fall_off_exponent
        Power q of 1/d with all three free; 2 stands in where the captures do not tell it.
    residual
        One map (H, W) per capture: ln radiance minus ln model, NaN where not used.
    relative_rms
        Robust spread of these.
    plane_rms_m
        Robust distance of the points of each capture from its plane.
    distances_m
        Median distance of each capture from the projector.
    highlight
        Largest specular share found in the residual, over the diffuse.
    samples, saturated, dark
        Pixels used; dropped as too bright, too dark.
    condition
        Of the correlation of ln I, p and q.
    warnings
        What a reader should know.
    """

    intensity: Parameter
    vignetting: Parameter
    fall_off_exponent: Parameter
    residual: tuple[FloatArray, ...]
    relative_rms: float
    plane_rms_m: tuple[float, ...]
    distances_m: tuple[float, ...]
    highlight: float
    samples: int
    saturated: int
    dark: int
    condition: float
    warnings: tuple[str, ...]


DEFAULTS = ProjectorFitSettings()


def fit_projector(
    captures: Sequence[PlaneCapture],
    rig: StereoRig,
    response: Response,
    plane_k_d: float | None,
    settings: ProjectorFitSettings = DEFAULTS,
) -> ProjectorFit:
    """Fit the projector's light to captures of a matte plane at one or several distances.

    Parameters
    ----------
    captures
        At least one; several distances tell the fall-off from vignetting.
    rig, response
        Cameras and projector, sensor.
    plane_k_d
        Diffuse share of the plane, 0..1; None where unknown.
    settings
        Limits.

    Raises
    ------
    CalibrationError
        No capture, sizes or exposures that cannot be, a surface that is no plane, too few usable pixels (too bright,
        too dark, outside the cone), or a plane that shines.
    """
    if not captures:
        raise CalibrationError("matte plane: 0 captures, needs at least 1")
    if plane_k_d is not None and not 0 < plane_k_d <= 1:
        raise CalibrationError(f"plane_k_d: is {plane_k_d}, limits 0 to 1, 0 excluded")
    rows = [plane_rows(capture, rig, response, settings) for capture in captures]
    level, axial, distance, alpha = (
        np.concatenate([getattr(each, name) for each in rows])
        for name in ("log_level", "log_axial", "log_distance", "cos_alpha")
    )
    # tiles of different captures are different tiles
    tile = np.concatenate([each.tile + number * 10_000_000 for number, each in enumerate(rows)])
    ones = np.ones_like(level)
    squared = _regress(np.stack([ones, axial], axis=1), level + INVERSE_SQUARE * distance, tile)
    free = _regress(np.stack([ones, axial, -distance], axis=1), level, tile)
    highlight = _highlight(np.stack([ones, axial, -distance], axis=1), level, alpha, tile)
    distances_m = tuple(float(np.exp(np.median(each.log_distance))) for each in rows)
    vignetting, squared = _vignetting(squared, level + INVERSE_SQUARE * distance, axial, tile)
    exponent = _exponent(free, distances_m)
    relative_rms = 1.4826 * float(np.median(np.abs(squared.residual)))
    return ProjectorFit(
        intensity=_intensity(squared, plane_k_d),
        vignetting=vignetting,
        fall_off_exponent=exponent,
        residual=_maps(squared.residual, rows, captures),
        relative_rms=relative_rms,
        plane_rms_m=tuple(each.plane_rms_m for each in rows),
        distances_m=distances_m,
        highlight=highlight,
        samples=len(level),
        saturated=sum(each.saturated for each in rows),
        dark=sum(each.dark for each in rows),
        condition=free.condition,
        warnings=_warnings(exponent, relative_rms, plane_k_d),
    )


@dataclass(frozen=True, eq=False)
class _Regression:
    """Coefficients (P,), their covariance (P, P) by tiles, residual (N,), condition of their correlation."""

    value: FloatArray
    covariance: FloatArray
    residual: FloatArray
    condition: float

    def interval(self, index: int) -> tuple[float, float, float, float]:
        """Return value, standard error, and both ends of the 95 % interval."""
        value, error = float(self.value[index]), float(np.sqrt(self.covariance[index, index]))
        return value, error, value - STANDARD_95 * error, value + STANDARD_95 * error


def _regress(columns: FloatArray, values: FloatArray, tile: IntArray) -> _Regression:
    """Regress robustly (Huber); the covariance sums the scores of a tile, whose errors go together."""
    weight = np.ones(len(values))
    ridge = 1e-9 * len(values) * np.eye(columns.shape[1])
    coefficients, residual, inverse = np.zeros(columns.shape[1]), values, ridge
    for _ in range(ROUNDS):
        inverse = np.linalg.inv(columns.T @ (weight[:, None] * columns) + ridge)
        coefficients = inverse @ (columns.T @ (weight * values))
        residual = values - columns @ coefficients
        limit = HUBER * 1.4826 * float(np.median(np.abs(residual)))
        weight = np.minimum(1.0, max(limit, 1e-12) / np.maximum(np.abs(residual), 1e-12))
    score = columns * (weight * residual)[:, None]
    _, number = np.unique(tile, return_inverse=True)
    summed = np.stack([np.bincount(number, column) for column in score.T], axis=1)
    scatter = summed.T @ summed * len(summed) / max(len(summed) - columns.shape[1], 1)
    scale = np.sqrt(np.diag(inverse))
    condition = float(min(np.linalg.cond(inverse / np.outer(scale, scale)), 1e16))
    return _Regression(coefficients, inverse @ scatter @ inverse, residual, condition)


def _vignetting(
    fit: _Regression, values: FloatArray, axial: FloatArray, tile: IntArray
) -> tuple[Parameter, _Regression]:
    """Return p, and the regression with p held at 0 where it came out below."""
    value, error, low, high = fit.interval(1)
    spread = float(np.ptp(np.arccos(np.minimum(np.exp(axial), 1.0))))
    if value < 0:
        flat = _regress(np.ones((len(values), 1)), values, tile)
        value = 0.0
        fit = _Regression(np.array([flat.value[0], 0.0]), np.pad(flat.covariance, (0, 1)), flat.residual, 1.0)
    low, high = max(low, 0.0), max(high, 0.0)
    if spread < LEAST_ANGLE_RAD or error > LARGEST_ERROR:
        note = (
            f"vignetting not identifiable: angles off the axis span {np.rad2deg(spread):.1f} deg, the interval is "
            f"{low:.2g} to {high:.2g}; the best fit, {value:.2g}, holds within these angles only"
        )
        return Parameter(value, 0.0, low, high, identified=False, note=note), fit
    return Parameter(value, error, low, high, identified=True), fit


def _exponent(free: _Regression, distances_m: Sequence[float]) -> Parameter:
    value, error, low, high = free.interval(2)
    ratio = max(distances_m) / min(distances_m)
    if ratio < LEAST_DISTANCE_RATIO or error > LARGEST_ERROR:
        why = (
            f"the captures' distances differ by a factor of {ratio:.2f}, needs {LEAST_DISTANCE_RATIO:g} (before one "
            "plane that faces the projector fall-off and vignetting act alike)"
            if ratio < LEAST_DISTANCE_RATIO
            else f"its standard error is {error:.2g}, limit {LARGEST_ERROR:g}"
        )
        note = f"fall-off not identifiable: {why}; the inverse square stands in"
        return Parameter(
            INVERSE_SQUARE, 0.0, min(low, INVERSE_SQUARE), max(high, INVERSE_SQUARE), identified=False, note=note
        )
    return Parameter(value, error, low, high, identified=True)


def _intensity(fit: _Regression, plane_k_d: float | None) -> Parameter:
    value, error, low, high = fit.interval(0)
    share = 1.0 if plane_k_d is None else plane_k_d
    value, low, high = (float(np.exp(each)) / share for each in (value, low, high))
    if plane_k_d is None:
        note = "intensity not identifiable without the plane's diffuse share: this is intensity times share"
        return Parameter(value, error * value, low, high, identified=False, note=note)
    return Parameter(value, error * value, low, high, identified=True)


def _highlight(columns: FloatArray, values: FloatArray, cos_alpha: FloatArray, tile: IntArray) -> float:
    """Return the largest specular share the data show beside the model.

    Raises
    ------
    CalibrationError
        It is too large for a matte plane.
    """
    largest = 0.0
    for n in LOBES_N:
        lobe = np.maximum(cos_alpha, 0.0) ** n
        if lobe.max() < 0.5:  # nobody looked where this one would show
            continue
        share, error, _, _ = _regress(np.column_stack([columns, lobe]), values, tile).interval(columns.shape[1])
        if share > LARGEST_HIGHLIGHT and share > HIGHLIGHT_DEVIATIONS * error:
            raise CalibrationError(
                f"matte plane: it shines, a highlight (n about {n:g}) of {share:.0%} of the diffuse light is in the "
                f"image, limit {LARGEST_HIGHLIGHT:.0%}: use a matte surface, or tilt it away from the mirror direction"
            )
        largest = max(largest, share if share > 2.0 * error else 0.0)
    return largest


def _maps(residual: FloatArray, rows: Sequence[PlaneRows], captures: Sequence[PlaneCapture]) -> tuple[FloatArray, ...]:
    maps: list[FloatArray] = []
    first = 0
    for each, capture in zip(rows, captures, strict=True):
        image = np.full(capture.left.shape, np.nan)
        count = len(each.pixels)
        image[each.pixels[:, 0], each.pixels[:, 1]] = residual[first : first + count]
        maps.append(image)
        first += count
    return tuple(maps)


def _warnings(exponent: Parameter, relative_rms: float, plane_k_d: float | None) -> tuple[str, ...]:
    off = abs(exponent.value - INVERSE_SQUARE)
    said = {
        f"light falls as 1/d^{exponent.value:.2f} ({exponent.low:.2f} to {exponent.high:.2f}), not as 1/d^2: check the "
        "response, the room's light and the projector's pose": (
            exponent.identified and off > 0.1 and not exponent.low <= INVERSE_SQUARE <= exponent.high
        ),
        f"the residual is {relative_rms:.0%} of the light: the plane or its light is uneven": relative_rms > 0.05,
        "the plane's diffuse share was not given: intensity is that of intensity times share": plane_k_d is None,
    }
    return tuple(text for text, applies in said.items() if applies)
