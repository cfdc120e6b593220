"""From a table of errors to the noise of a stereo pair, with intervals.

Away from rims the variance is ``disparity^2 + (slope g)^2``: a line in the squared gradient, which cells of different
gradient tell. What comes on top near rims is ``(rim exp((1 - r) / reach))^2``. Bends are not seen on a plate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sidelong.calibration.depth_noise.table import GROUPS, Errors, Table, tabulate
from sidelong.calibration.reflectance.result import Parameter
from sidelong.errors import CalibrationError
from sidelong.physics.depth_noise import DepthNoise
from sidelong.types import BoolArray, FloatArray, IntArray

DEFAULTS = DepthNoise()
STANDARD_95 = 1.959964
FEWEST_FAR = 1000
"""Depths away from rims that a capture needs."""
FAR_PX = (9.5, 6.5, 4.5, 2.5)
"""How far that is; nearer where dropout leaves no such depths."""
FEWEST_AT_RIM = 500
NEAR_RIM_PX = 1.5
LEAST_GRADIENT_RANGE = 0.1
"""Range of gradients below which the slope term is not told from the rest."""
LARGEST_RELATIVE_ERROR = 0.35
"""Standard error over value up to which a term is called identified."""
OUTLIER_SIGMAS = 5.0
MODEL_ERROR, SHARE_ERROR = 0.03, 0.1
"""Relative errors of terms and of shares of outliers that no number of depths takes away: the form of the model, and
where outliers begin, are conventions."""
REACHES_PX, REFINEMENTS = np.geomspace(0.3, 10.0, 71), 2
FEWEST_CELLS_TO_COMPARE = 3


@dataclass(frozen=True, eq=False)
class NoiseFit:
    """Noise of a stereo pair as captures show it.

    Attributes
    ----------
    noise
        The numbers to use: what was estimated, and defaults in the place of what was not.
    parameters
        Each number by its name in :class:`~sidelong.physics.depth_noise.DepthNoise`, with its interval, or the
        reason why the default was kept.
    cells
        Errors it was fitted to, by capture or class of slope.
    captures, pixels
        How many were used.
    warnings
        What a reader should know.
    """

    noise: DepthNoise
    parameters: Mapping[str, Parameter]
    cells: tuple[Errors, ...]
    captures: int
    pixels: int
    warnings: tuple[str, ...]

    def sigma_px(self, gradient: float, rim_px: FloatArray) -> FloatArray:
        """Return the standard deviation of disparity at a gradient and distances (N,) from the rim."""
        return np.sqrt(_variance(self.parameters, gradient, rim_px))


@dataclass(frozen=True, eq=False)
class _Terms:
    """Terms of the noise; ``slope`` is NaN where gradients do not tell it, rim and reach where no rim was seen."""

    disparity: float
    slope: float
    rim: float
    reach: float

    @property
    def values(self) -> FloatArray:
        return np.array([self.disparity, self.slope, self.rim, self.reach])


def fit_noise(cells: Sequence[Errors], captures: int, seen_px: float | None = None) -> NoiseFit:
    """Fit the noise to errors.

    Parameters
    ----------
    cells
        Errors of at least one capture, or class of slope.
    captures
        How many they come from.
    seen_px
        None where each cell is a capture and its errors are all there are. Else they are a lower bound, and this is the
        noise in disparity that the roughness of the maps shows: numbers count only where they exceed it, and defaults.

    Raises
    ------
    CalibrationError
        Too few depths lie away from missing ones.
    """
    table = tabulate(cells)
    far_px = _far_px(table)
    terms = _terms(table, far_px)
    error = _standard_errors(table, far_px, terms, between=seen_px is None)
    parameters = _parameters(terms, error, table)
    if seen_px is not None:
        parameters |= _bounded(parameters, seen_px)
    parameters |= _outlier_shares(cells, parameters)
    values: dict[str, float | None] = {name: each.value for name, each in parameters.items()}
    if not parameters["disparity_px"].identified:
        values["disparity_px"] = None
    pixels = sum(len(cell.error_px) for cell in cells)
    noise = DepthNoise.model_validate(values)
    return NoiseFit(noise, MappingProxyType(parameters), tuple(cells), captures, pixels, ())


def _far_px(table: Table) -> float:
    """Return from where on depths count as away from rims."""
    fewest = [int(table.count[:, :, table.rim_px > far_px].sum(axis=(1, 2)).min()) for far_px in FAR_PX]
    for far_px, count in zip(FAR_PX, fewest, strict=True):
        if count >= FEWEST_FAR:
            return far_px
    raise CalibrationError(
        f"depth noise: of a capture only {fewest[-1]} depths lie more than {FAR_PX[-1]:g} px from missing ones, needs "
        f"{FEWEST_FAR}: expose for less dropout, or show a larger surface"
    )


def _terms(table: Table, far_px: float) -> _Terms:
    far: BoolArray = np.asarray(table.rim_px > far_px, dtype=np.bool_)
    count = table.count.sum(axis=1)
    variance = table.square_px2[:, :, far].sum(axis=(1, 2)) / np.maximum(count[:, far].sum(axis=1), 1.0)
    rim, reach = _rim(table, variance, far)
    if not np.isnan(rim):
        # what is left of it far away
        share = count[:, far] @ np.exp(2 * (1 - table.rim_px[far]) / reach) / np.maximum(count[:, far].sum(axis=1), 1.0)
        variance = np.maximum(variance - rim**2 * share, variance / 2)
        rim, reach = _rim(table, variance, far)
    disparity2, slope2 = _line(table.gradient**2, variance)
    return _Terms(float(np.sqrt(disparity2)), float(np.sqrt(slope2)), rim, reach)


def _line(gradient2: FloatArray, variance: FloatArray) -> tuple[float, float]:
    """Return the intercept and slope, neither below 0, of variance over squared gradient.

    Where gradients are much alike the slope is NaN, and the intercept the whole variance, rather than too little.
    """
    if np.ptp(np.sqrt(gradient2)) < LEAST_GRADIENT_RANGE:
        return float(variance.mean()), float("nan")
    # variances are as sure as they are large
    columns = np.stack([np.ones_like(variance), gradient2], axis=1) / variance[:, None]
    intercept, slope = np.linalg.lstsq(columns, np.ones_like(variance), rcond=None)[0]
    if slope < 0:
        return float(variance.mean()), 0.0
    return max(float(intercept), 0.1 * float(variance.min())), float(slope)


def _rim(table: Table, far_variance: FloatArray, far: BoolArray) -> tuple[float, float]:
    """Return rim and reach of what comes on top near rims; NaN where too few depths are there."""
    near = ~far
    count = table.count.sum(axis=1)[:, near]
    total = count.sum(axis=0)
    if total[table.rim_px[near] < NEAR_RIM_PX].sum() < FEWEST_AT_RIM:
        return float("nan"), float("nan")
    some = total >= FEWEST_AT_RIM / 5
    variance = table.square_px2.sum(axis=(0, 1))[near][some] / total[some]
    excess = variance - (far_variance @ count)[some] / total[some]
    reach, rim2 = _decay(table.rim_px[near][some], excess / variance, variance)
    return float(np.sqrt(rim2)), reach


def _decay(rim_px: FloatArray, relative: FloatArray, variance: FloatArray) -> tuple[float, float]:
    """Return reach and height of the exponential that fits ``relative`` excesses of variance best."""

    def fitted(reaches: FloatArray) -> tuple[FloatArray, FloatArray]:
        decay = np.exp(2 * (1 - rim_px) / reaches[:, None]) / variance
        height = np.maximum(decay @ relative / (decay**2).sum(axis=1), 0.0)
        return height, ((relative - height[:, None] * decay) ** 2).sum(axis=1)

    reaches: FloatArray = REACHES_PX
    for _ in range(REFINEMENTS):
        best = int(np.argmin(fitted(reaches)[1]))
        low, high = float(reaches[max(best - 1, 0)]), float(reaches[min(best + 1, len(reaches) - 1)])
        reaches = np.asarray(np.geomspace(low, high, len(REACHES_PX)), dtype=np.float64)
    height, error = fitted(reaches)
    best = int(np.argmin(error))
    return float(reaches[best]), float(height[best])


def _standard_errors(table: Table, far_px: float, terms: _Terms, *, between: bool) -> FloatArray:
    """Return standard errors (4,) by leaving out one group, and one capture, after the other: the larger of both."""

    def scatter(fits: list[_Terms], count: int) -> FloatArray:
        values = np.array([each.values for each in fits])
        return np.sqrt((count - 1) / count * ((values - values.mean(axis=0)) ** 2).sum(axis=0))

    error = scatter([_terms(table.without_group(each), far_px) for each in range(GROUPS)], GROUPS)
    cells = len(table.gradient)
    if between and cells >= FEWEST_CELLS_TO_COMPARE:
        # without one of them the others may not tell the slope: then nothing is said of its error
        error = np.fmax(error, scatter([_terms(table.without_cell(each), far_px) for each in range(cells)], cells))
    return np.hypot(error, MODEL_ERROR * terms.values)


def _parameters(terms: _Terms, error: FloatArray, table: Table) -> dict[str, Parameter]:
    at_rim = int(table.count[:, :, table.rim_px < NEAR_RIM_PX].sum())
    span = float(np.ptp(table.gradient))
    few = f"{at_rim} depths lie beside missing ones, needs {FEWEST_AT_RIM}"
    flat = f"gradients of disparity span {span:.2g} px per px, needs {LEAST_GRADIENT_RANGE:g}: tilt the plate more"
    rim = _told("rim_px", terms.rim, error[2], few, largest=8.0)
    reach = _told("rim_reach_px", terms.reach, error[3], few, largest=32.0)
    if rim.identified and rim.value < DEFAULTS.rim_px:
        rim = _kept("rim_px", rim, f"{rim.value:.2g} here, but rims on parts are noisier than those of clean surfaces")
    if not rim.identified:
        reach = _kept("rim_reach_px", reach, "the default of rim_px goes with it")
    return {
        "disparity_px": _interval(min(terms.disparity, 4.0), error[0]),
        "slope_px": _told("slope_px", terms.slope, error[1], flat, largest=8.0),
        "rim_px": rim,
        "rim_reach_px": reach,
    }


def _told(name: str, value: float, error: float, lack: str, largest: float) -> Parameter:
    """Return a number with its interval, or the default where the captures do not tell it."""
    if np.isnan(value):
        stand_in = float(getattr(DEFAULTS, name))
        return Parameter(stand_in, 0.0, 0.0, largest, identified=False, note=f"default kept: {lack}")
    found = _interval(min(value, largest), error)
    if error > LARGEST_RELATIVE_ERROR * max(value, float(getattr(DEFAULTS, name))):
        return _kept(name, found, f"its standard error is {error:.2g}")
    return found


def _interval(value: float, error: float) -> Parameter:
    reach = STANDARD_95 * float(error)
    return Parameter(value, float(error), max(value - reach, 0.0), value + reach, identified=True)


def _kept(name: str, found: Parameter, why: str) -> Parameter:
    note = why if why.startswith("default kept") else f"default kept: {why}"
    return Parameter(float(getattr(DEFAULTS, name)), 0.0, found.low, found.high, identified=False, note=note)


def _bounded(parameters: Mapping[str, Parameter], seen_px: float) -> dict[str, Parameter]:
    """Return what stands in for lower bounds that say less than what is known anyway."""
    found = parameters["disparity_px"]
    bounded: dict[str, Parameter] = {}
    if found.value < seen_px:
        note = f"read off each depth map, {seen_px:.2g} px on these: they differ by {found.value:.2g} px only"
        bounded["disparity_px"] = Parameter(seen_px, 0.0, found.low, found.high, identified=False, note=note)
    slope = parameters["slope_px"]
    if slope.identified and slope.value < DEFAULTS.slope_px:
        bounded["slope_px"] = _kept("slope_px", slope, f"{slope.value:.2g} here is a lower bound")
    return bounded


def _outlier_shares(cells: Sequence[Errors], parameters: Mapping[str, Parameter]) -> dict[str, Parameter]:
    """Count errors beyond ``OUTLIER_SIGMAS``, away from missing depths and beside them."""
    beyond = [
        np.abs(cell.error_px) > OUTLIER_SIGMAS * np.sqrt(_variance(parameters, cell.gradient, cell.rim_px))
        for cell in cells
    ]
    at_rim = np.concatenate([cell.rim_px < NEAR_RIM_PX for cell in cells])
    outlier, group = np.concatenate(beyond), np.concatenate([cell.group for cell in cells])
    return {
        "outlier_share": _share("outlier_share", outlier[~at_rim], group[~at_rim]),
        "rim_outlier_share": _share("rim_outlier_share", outlier[at_rim], group[at_rim]),
    }


def _share(name: str, outlier: BoolArray, group: IntArray) -> Parameter:
    """Return a share that is used only where it exceeds the default: a plate has no inter-reflections."""
    stand_in = float(getattr(DEFAULTS, name))
    if len(outlier) < FEWEST_AT_RIM:
        return Parameter(stand_in, 0.0, 0.0, 1.0, identified=False, note=f"default kept: {len(outlier)} such depths")
    share = float(outlier.mean())
    count = np.bincount(group, minlength=GROUPS)
    beyond = np.bincount(group, outlier, minlength=GROUPS)
    left_out = (beyond.sum() - beyond) / np.maximum(count.sum() - count, 1)
    error = np.sqrt((GROUPS - 1) / GROUPS * ((left_out - left_out.mean()) ** 2).sum())
    error = float(np.hypot(error, SHARE_ERROR * share))
    # none seen in n: fewer than 3 / n at 95 %
    high = max(share + STANDARD_95 * error, 3.0 / len(outlier))
    low = max(share - STANDARD_95 * error, 0.0)
    if share <= stand_in:
        note = f"default kept: {share:.1g} here, but inter-reflections and depth edges of parts make more"
        return Parameter(stand_in, 0.0, low, high, identified=False, note=note)
    return Parameter(min(share, 0.5), error, low, high, identified=True)


def _variance(parameters: Mapping[str, Parameter], gradient: float, rim_px: FloatArray) -> FloatArray:
    at = {name: each.value for name, each in parameters.items()}
    edge = at["rim_px"] * np.exp((1.0 - rim_px) / at["rim_reach_px"])
    return at["disparity_px"] ** 2 + (at["slope_px"] * gradient) ** 2 + edge**2
